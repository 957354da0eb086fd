# SPDX-License-Identifier: GPL-3.0-or-later
"""Surfaces pooled into a pyramid of voxels: how much area lies in each, and which way it faces.

Source: the pre-filtered voxels of Crassin et al. 2011, "Interactive Indirect Illumination Using Voxel Cone
Tracing", without octree: what cones (`cones`) read lies within a small box, so each level is a plain array, and
pages of it that nothing is written to cost nothing.

Lengths are in units of the longest side of what is baked, from just below the low corner of its box.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .raycast import Geometry

FINEST = 192      # voxels of level 0 along the longest side of what is baked
_DENSITY = 1.5    # samples of a surface for each face of a voxel that it would cover
# of a voxel, from the low corner of what is baked to that of its first voxel: people build on round coordinates, and a
# wall that lay on a border of voxels would be on either side of it as floats are rounded
_SHIFT = 0.37
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True, eq=False)
class Level:
    """The voxels of one size, as far as they are read."""

    # (x * y * z,) four float32 each: the area a in the voxel, in its faces, as a / (1 + a), and the sum of area times
    # normal, over 1 + a, too. One item of 16 bytes, because NumPy gathers items faster than rows.
    voxels: NDArray[np.complex128]
    shape: tuple[int, int, int]
    low: NDArray[np.float64]  # (3,) index of the first voxel, counted from the low corner of what is baked
    size: float               # side of a voxel


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Levels from the finest, each of voxels twice as large."""

    levels: list[Level]
    low: NDArray[np.float64]  # (3,) where places are counted from, metres
    side: float               # its longest side, metres; 1 where it has none

    @staticmethod
    def of(geometry: Sequence[Geometry], reaches: Sequence[float]) -> Pyramid:
        """Build.

        Args:
            geometry: parts (positions (V, 3), triangles (F, 3)), what is baked first.
            reaches: for each level, how far from the box of what is baked it is read; not falling. Further levels
                reach twice as far each, as long as there are surfaces beyond.
        """
        parts = [np.stack([np.ascontiguousarray(p.T, np.float64).take(corner, 1) for corner in t.T])
                 for p, t in geometry if len(t)]  # (3 corners, 3 coordinates, m): NumPy is quick along the last
        low, high = parts[0].min((0, 2)), parts[0].max((0, 2))
        side = float((high - low).max()) or 1.0
        low = low - _SHIFT * side / FINEST
        box = (high - low) / side
        for part in parts:
            part -= low[:, None]
            part *= 1 / side
        extent = max(float(np.maximum(-part.min((0, 2)), part.max((0, 2)) - box).max()) for part in parts)
        reaches = list(reaches)
        while 0 < extent > reaches[-1] - 1:  # seen from the other side of the box
            reaches.append(2 * reaches[-1])
        reaches = [reach + 2.0 ** level / FINEST for level, reach in enumerate(reaches)]  # whole voxels
        cut = [(parts[0], np.zeros(1)), *(_near(part, box, reaches) for part in parts[1:])]
        # what is far is not pooled from finer voxels, and sampled more densely instead
        samples = [_samples(part, 2.0 ** np.maximum(level - 1, 0) / FINEST) for part, level in cut]
        places, values = (np.concatenate(column, 1) for column in zip(*samples, strict=True))
        return Pyramid(_levels(places, values, box, reaches), low, side)


def _near(triangles: NDArray, box: NDArray, reaches: Sequence[float]) -> tuple[NDArray, NDArray[np.int64]]:
    """Parts (3, 3, m) of triangles, and of each the finest level that it reaches into; none that reaches into none.

    A floor may be a thousand times as wide as what stands on it: it is cut finely only where it is seen so.
    """
    done, levels = [triangles[..., :0]], [np.zeros(0, np.int64)]
    while triangles.shape[2]:
        first, last = triangles.min(0), triangles.max(0)
        away = np.maximum(np.maximum(-last, first - box[:, None]), 0).max(0)
        level = np.searchsorted(reaches, away)
        near = level < len(reaches)
        triangles, level, size = triangles[..., near], level[near], (last - first).max(0)[near]
        large = size > np.asarray(reaches)[level] + 0.5
        done.append(triangles[..., ~large])
        levels.append(level[~large])
        a, b, c = triangles[..., large]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))
        triangles = np.concatenate([np.stack(quarter) for quarter in quarters], 2)
    return np.concatenate(done, 2), np.concatenate(levels)


def _samples(triangles: NDArray, size: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Places (3, n) spread over triangles (3, 3, m), dense enough for voxels of `size` (m,); and what each stands for:
    (4, n) area and area times normal.
    """
    a, b, c = triangles  # each (3, m)
    ab, ac = b - a, c - a
    normal = 0.5 * np.stack([ab[1] * ac[2] - ab[2] * ac[1], ab[2] * ac[0] - ab[0] * ac[2],
                             ab[0] * ac[1] - ab[1] * ac[0]])
    area = np.sqrt(_square(normal))
    longest = np.sqrt(np.maximum(np.maximum(_square(ab), _square(ac)), _square(c - b)))
    count = np.ceil(np.maximum(_DENSITY * area / size ** 2, longest / size)).astype(np.int64)
    count[~(area > 0)] = 0
    value = np.stack([area, *normal]).astype(np.float32)
    one, many = np.flatnonzero(count == 1), np.flatnonzero(count > 1)  # most triangles of a dense mesh have one
    count = count[many]
    of = np.repeat(many, count)
    number = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    total = np.repeat(count, count)
    # a lattice of the unit square, folded into the triangle by the root that keeps areas
    root, along = np.sqrt((number + 0.5) / total), np.modf(0.5 + _GOLDEN * number)[0]
    places = a.take(of, 1) + root * (1 - along) * ab.take(of, 1) + root * along * ac.take(of, 1)
    return (np.concatenate([(a + b + c).take(one, 1) / 3, places], 1),
            np.concatenate([value.take(one, 1), value.take(of, 1) / total.astype(np.float32)], 1))


def _square(vectors: NDArray) -> NDArray:
    return vectors[0] * vectors[0] + vectors[1] * vectors[1] + vectors[2] * vectors[2]


def _levels(places: NDArray, values: NDArray[np.float32], box: NDArray, reaches: Sequence[float]) -> list[Level]:
    """Add samples (3, n) with values (4, n) up in all levels, each from the one below and from what that had not."""
    out = []
    cells, sums = np.zeros((3, 0), np.int64), values[:, :0]
    for number, reach in enumerate(reaches):
        size = 2.0 ** number / FINEST
        if places.shape[1]:
            x, y, z = ((place >= -reach) & (place <= most + reach) for place, most in zip(places, box, strict=True))
            inside = x & y & z
            whole = bool(inside.all())
            here = places if whole else places[:, inside]
            cells = np.concatenate([cells, np.floor(here / size).astype(np.int64)], 1)
            sums = np.concatenate([sums, values if whole else values[:, inside]], 1)
            places, values = (places[:, :0], values[:, :0]) if whole else (places[:, ~inside], values[:, ~inside])
        low = np.full(3, int(np.floor(-reach / size)))
        shape = np.floor((box + reach) / size).astype(np.int64) + 1 - low
        index = ((cells[0] - low[0]) * shape[1] + cells[1] - low[1]) * shape[2] + cells[2] - low[2]
        grid = np.zeros((int(shape.prod()), 4), np.float32)
        filled = np.zeros(len(grid), bool)
        filled[index] = True
        full = np.flatnonzero(filled)
        rank = np.empty(len(grid), np.int32)  # of each full voxel; pages that are not written to cost nothing
        rank[full] = np.arange(len(full), dtype=np.int32)
        index = rank[index]
        sums = np.stack([np.bincount(index, value, len(full)) for value in sums]).astype(np.float32)
        area = sums[0] * np.float32(1 / size ** 2)
        grid[full] = (sums * (np.float32(1 / size ** 2) / (1 + area))).T
        cells = (np.stack(np.unravel_index(full, tuple(shape))) + low[:, None]) >> 1
        x, y, z = shape.tolist()
        out.append(Level(grid.view(np.complex128)[:, 0], (x, y, z), low.astype(np.float64), size))
    return out
