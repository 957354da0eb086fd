# SPDX-License-Identifier: GPL-3.0-or-later
"""Organic shapes as distance fields, and their surfaces by naive surface nets.

A field is a function of points (N, 3) that gives (N,) about their distance from a surface, negative inside.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from .solids import Mesh, tidy

Field = Callable[[NDArray], NDArray]
_FIRST = 28           # cells along the longest side of the grid that finds the surface and how fine a one it needs
_MOST = 150           # and of the grid that is used: some millions of values
_BLOCK = 4            # cells along a side of the blocks that are left out where they are far from the surface


def ellipsoid(centre: Sequence[float] | NDArray, radii: float | Sequence[float] | NDArray) -> Field:
    """Exact for a ball, about right near the surface of others."""
    c, r = np.asarray(centre, dtype=np.float64), np.asarray(radii, dtype=np.float64) * np.ones(3)
    return lambda p: (np.linalg.norm((p - c) / r, axis=1) - 1) * r.min()


def capsule(start: Sequence[float] | NDArray, end: Sequence[float] | NDArray, radius: float,
            last: float | None = None) -> Field:
    """A rounded rod; its radius goes over to `last` at the end."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    taper = 0.0 if last is None else last - radius

    def field(p: NDArray) -> NDArray:
        along = np.clip((p - a) @ (b - a) / max((b - a) @ (b - a), 1e-12), 0, 1)
        return np.linalg.norm(p - a - along[:, None] * (b - a), axis=1) - radius - taper * along
    return field


def slab(centre: Sequence[float] | NDArray, half: Sequence[float] | NDArray, rounding: float = 0.0) -> Field:
    """A box with rounded edges."""
    c, h = np.asarray(centre, dtype=np.float64), np.asarray(half, dtype=np.float64) - rounding

    def field(p: NDArray) -> NDArray:
        q = np.abs(p - c) - h
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0) - rounding
    return field


def union(parts: Sequence[Field], blend: float = 0.0) -> Field:
    """The parts together; `blend` is the radius of the fillets between them (exponential smooth minimum)."""
    def field(p: NDArray) -> NDArray:
        if blend <= 0:
            return np.min([part(p) for part in parts], axis=0)
        total = np.zeros(len(p))
        for part in parts:
            total += np.exp(np.clip(-part(p) / blend, -300, 300))
        return -blend * np.log(total)
    return field


def common(first: Field, second: Field, blend: float) -> Field:
    """What is in both. The edges between are rounded, as thin ones would come out ragged."""
    return lambda p: blend * np.logaddexp(first(p) / blend, second(p) / blend)


def without(whole: Field, hole: Field, blend: float) -> Field:
    """What is in the first and not in the second; see `common`."""
    return common(whole, lambda p: -hole(p), blend)


def surface(field: Field, low: NDArray, high: NDArray, target: int) -> Mesh:
    """The zero surface inside a box, closed at its sides, with about `target` vertices."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    side = float((high - low).max())
    step = side / _FIRST
    found = _nets(*_sampled(field, low, high, step))[0]
    if not len(found):
        return found, np.zeros((0, 3), np.int32)
    low, high = np.maximum(low, found.min(0) - 1.5 * step), np.minimum(high, found.max(0) + 1.5 * step)
    # cells that a surface crosses grow with the square of the resolution
    step = max(step * np.sqrt(len(found) / target), float((high - low).max()) / _MOST)
    return _nets(*_sampled(field, low, high, step))


def _sampled(field: Field, low: NDArray, high: NDArray, step: float) -> tuple[NDArray, NDArray, float]:
    """Values on a grid one cell wider than the box, positive on its hull; where it starts; its step."""
    counts = np.ceil((high - low) / step).astype(int) + 3
    blocks = -(-counts // _BLOCK)
    centres = low - step + step * (_BLOCK * np.indices(blocks).reshape(3, -1).T + (_BLOCK - 1) / 2)
    coarse = field(centres)
    values = coarse.reshape(blocks)
    for axis in range(3):
        values = values.repeat(_BLOCK, axis)
    # the values inside a block differ from its centre's by no more than half its diagonal (and some, as not
    # all fields are exact distances); only where the sign may change must they be known
    near = np.argwhere((np.abs(coarse) < 1.3 * np.sqrt(3) / 2 * _BLOCK * step).reshape(blocks))
    at = (_BLOCK * near[:, None] + np.indices((_BLOCK,) * 3).reshape(3, -1).T).reshape(-1, 3)
    values[tuple(at.T)] = field(low - step + step * at)
    values = values[:counts[0], :counts[1], :counts[2]]
    for axis in range(3):
        edge = np.moveaxis(values, axis, 0)  # a view
        edge[0] = np.maximum(edge[0], step / 2)
        edge[-1] = np.maximum(edge[-1], step / 2)
    return values, low - step, step


def _nets(values: NDArray, origin: NDArray, step: float) -> Mesh:
    """Naive surface nets (Gibson 1998): a vertex in each crossed cell, a quad across each crossed edge."""
    inside = values < 0
    cells = tuple(n - 1 for n in values.shape)
    total, count = np.zeros((*cells, 3)), np.zeros(cells)
    quads = []
    strides = np.array([cells[1] * cells[2], cells[2], 1])
    for axis in range(3):
        near, far = (np.moveaxis(np.moveaxis(values, axis, 0)[s], 0, axis) for s in (slice(None, -1), slice(1, None)))
        at = np.argwhere((near < 0) != (far < 0))
        a, b = near[tuple(at.T)], far[tuple(at.T)]
        crossing = at.astype(np.float64)
        crossing[:, axis] += a / (a - b)
        u, v = (axis + 1) % 3, (axis + 2) % 3
        around = []
        for du, dv in ((-1, -1), (0, -1), (0, 0), (-1, 0)):
            cell = at.copy()
            cell[:, u] += du
            cell[:, v] += dv
            np.add.at(total, tuple(cell.T), crossing)
            np.add.at(count, tuple(cell.T), 1)
            around.append(cell @ strides)
        quad = np.stack(around, 1)
        leaves = inside[tuple(at.T)]  # the edge points from the inside out, as the quad then must
        quads.append(np.where(leaves[:, None], quad, quad[:, ::-1]))
    used = count > 0
    number = np.cumsum(used.ravel()) - 1
    positions = origin + step * (total[used] / count[used][:, None])
    q = number[np.concatenate(quads)]
    if not len(q):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    first, second = (np.linalg.norm(positions[q[:, i]] - positions[q[:, i + 2]], axis=1) for i in (0, 1))
    q = np.where((first <= second)[:, None], q, np.roll(q, -1, 1))
    return tidy((positions, np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]]).astype(np.int32)))
