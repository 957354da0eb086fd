# SPDX-License-Identifier: GPL-3.0-or-later
"""Few rays, and a small network that says how much of its neighbours' blocked part each point takes.

Every point's blocked part B_i is traced with few rays. In each of PASSES passes it becomes a mean of
its own and its neighbours', band by band: (B_i + sum_j w_ij B_j) / (1 + sum_j w_ij). The network
gives log w_ij from numbers that do not change when the mesh is turned, moved or scaled: so the
answer turns with the mesh. Weights fall as 1 / rays, so with many rays the traced value stays.
Where nothing was blocked in a neighbourhood, nothing is computed.

The network is a perceptron with one hidden layer, 245 numbers a pass; it runs in NumPy.
"""
from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import spherical_harmonics as sh
from .neighbours import Neighbours

FEATURES = 9
FULL = 0.5 / np.pi ** 0.5  # coefficient 0 of a point of which all is blocked
MOST, LEAST = 4.0, -12.0  # of log w
HALF = 64.0               # rays at which weights are halved
_TINY = 1e-5              # of a squared difference: below noise of any ray count
_MOST_POINTS = 4096            # at a time: less, and threads wait for the interpreter; more, and the cache runs over
_BLAS_COLUMNS = 1024      # of one matrix product: small enough for BLAS to stay on the calling thread


@dataclass(frozen=True, eq=False)
class Layer:
    """One layer of a perceptron."""

    weight: NDArray[np.float32]  # (inputs, outputs)
    bias: NDArray[np.float32]    # (outputs,)


Network = Sequence[Sequence[Layer]]  # of each pass, its layers


@dataclass(frozen=True, eq=False)
class Cloud:
    """N points and their L neighbours: what stays the same from pass to pass."""

    links: Neighbours
    shape: NDArray[np.float32]  # (4, L) features of a pair that do not change from pass to pass

    @staticmethod
    def of(points: NDArray, normals: NDArray, links: Neighbours, pool: ThreadPoolExecutor) -> Cloud:
        """Points (N, 3) and unit normals (N, 3) of any size and place."""
        places = np.ascontiguousarray(normalised(points).T, dtype=np.float32)
        shape = np.empty((4, len(links.points)), np.float32)
        turned = np.ascontiguousarray(normals.T, dtype=np.float32)

        step = _step(len(points))

        def part(start: int) -> None:
            point, other, edges = _pairs(links, start, min(start + step, len(points)))
            shape[:, edges] = pair_shape(places, turned, point, other)

        list(pool.map(part, range(0, len(points), step)))
        return Cloud(links, shape)


def normalised(points: NDArray) -> NDArray[np.float64]:
    """Points (N, 3) about their mean, in units of twice the distance of the farthest: the same however turned."""
    away = points - points.mean(0)
    extent = 2 * float(np.sqrt(np.square(away).sum(1).max(initial=0.0)))
    return away / (extent or 1.0)


def filtered(cloud: Cloud, blocked: NDArray[np.float32], unshadowed: NDArray[np.float32], rays: int, network: Network,
             pool: ThreadPoolExecutor) -> NDArray[np.float32]:
    """The blocked part of all points after all passes.

    What is passed on is the share that is blocked (in coefficient 0), and how the rest differs from
    that share of the unshadowed transfer: a neighbour that faces another way is so read as it would
    be here if its sky were blocked evenly. Exact where all is blocked, or nothing.

    Args:
        blocked: (N, K), traced with `rays` rays from each point. unshadowed: (N, K).
        network: from `weights.load_hybrid`.
    Returns:
        (N, K).
    """
    even = np.ascontiguousarray(unshadowed.T[1:], dtype=np.float32) / np.float32(FULL)
    now = np.array(blocked.T, dtype=np.float32, order="C")  # by coefficient: what is beside in memory is alike
    now[1:] -= now[0] * even
    step = _step(len(blocked))
    for layers in network:
        out = now.copy()
        seen = now[0] != 0

        def part(start: int, layers: Sequence[Layer] = layers, now: NDArray = now, out: NDArray = out,
                 seen: NDArray = seen) -> None:
            _pass(cloud, now, out, seen, start, min(start + step, now.shape[1]), rays, layers)

        list(pool.map(part, range(0, now.shape[1], step)))
        now = out
    now[1:] += now[0] * even
    return np.ascontiguousarray(now.T)


def _step(count: int) -> int:
    """Points at a time, of so many in all: small meshes give work to all threads, too."""
    return min(max(count // 4 + 1, 512), _MOST_POINTS)


def _pairs(links: Neighbours, start: int, stop: int) -> tuple[NDArray, NDArray, slice]:
    """The pairs (point, other) of points start..stop, and which of all they are."""
    edges = slice(int(links.start[start]), int(links.start[stop]))
    point = np.repeat(np.arange(start, stop, dtype=np.int32), np.diff(links.start[start:stop + 1]))
    return point, links.points[edges], edges


def _pass(cloud: Cloud, now: NDArray[np.float32], out: NDArray[np.float32], seen: NDArray[np.bool_], start: int,
          stop: int, rays: int, layers: Sequence[Layer]) -> None:
    """One pass for points start..stop: `now` to `out` (K, N)."""
    point, other, edges = _pairs(cloud.links, start, stop)
    shape = cloud.shape[:, edges]
    some = np.flatnonzero(seen[point] | seen[other])
    if not len(some):
        return
    if len(some) < len(point):
        point, other, shape = point[some], other[some], shape[:, some]
    theirs = [row.take(other) for row in now]
    mine = [row.take(point) for row in now[:4]]
    bands = sh.order_of(len(now))
    weight = weights_of(features(shape, mine, theirs, rays), layers, rays, bands)
    begins = np.flatnonzero(np.concatenate([[True], point[1:] != point[:-1]]))
    rows = point[begins]
    for band in range(bands):
        total = 1 + np.add.reduceat(weight[band], begins)
        for k in range(band * band, (band + 1) ** 2):
            theirs[k] *= weight[band]
            out[k, rows] = (now[k].take(rows) + np.add.reduceat(theirs[k], begins)) / total


def pair_shape(points: NDArray[np.float32], normals: NDArray[np.float32], point: NDArray, other: NDArray
               ) -> NDArray[np.float32]:
    """(4, L) of pairs of points: cosine of their normals, height of each over the other's plane, distance (log).

    Args:
        points, normals: (3, N), the points `normalised`. point, other: (L,) indices.
    """
    away = [axis.take(other) - axis.take(point) for axis in points]
    one, two = [axis.take(point) for axis in normals], [axis.take(other) for axis in normals]
    square = _dot(away, away) + np.float32(1e-14)
    inverse = 1 / np.sqrt(square)
    return np.stack([_dot(one, two), _dot(one, away) * inverse, -_dot(two, away) * inverse, 0.25 * np.log(square)])


def features(shape: NDArray[np.float32], mine: Sequence[NDArray], theirs: Sequence[NDArray], rays: int
             ) -> NDArray[np.float32]:
    """(FEATURES + 1, L) of pairs of points, none of which changes when everything is turned, moved or scaled.

    Args:
        shape: (4, L) from `pair_shape`. mine, theirs: K arrays (L,), their blocked parts, of which four count.
        rays: from each point.
    """
    out = np.empty((FEATURES + 1, shape.shape[1]), np.float32)
    out[:4] = shape
    out[4] = 0.5 * np.log(rays)
    one = mine[0] - theirs[0]
    one *= one
    more = [a - b for a, b in zip(mine[1:4], theirs[1:4], strict=True)]
    for row, values in ((5, one), (6, _dot(more, more))):
        values += np.float32(_TINY)
        np.log(values, out=out[row])
        out[row] *= 0.25
    np.multiply(mine[0], 4, out=out[7])  # to about 0..1
    np.multiply(theirs[0], 4, out=out[8])
    out[9] = 1  # for the biases
    return out


def weights_of(values: NDArray[np.float32], layers: Sequence[Layer], rays: int, bands: int) -> NDArray[np.float32]:
    """(bands, L) from `features`."""
    for number, layer in enumerate(layers):
        matrix = np.concatenate([layer.weight, layer.bias[None]]).T
        last = number + 1 == len(layers)
        if last:
            matrix = matrix[:bands]
        out = np.empty((len(matrix) + (not last), values.shape[1]), np.float32)
        out[len(matrix):] = 1
        for start in range(0, values.shape[1], _BLAS_COLUMNS):
            here = slice(start, start + _BLAS_COLUMNS)
            np.matmul(matrix, values[:, here], out=out[:len(matrix), here])
        values = out
        if not last:
            np.maximum(values, 0, out=values)
    np.clip(values, LEAST, MOST, out=values)
    np.exp(values, out=values)
    values *= np.float32(HALF / (HALF + rays))
    return values


def _dot(one: Sequence[NDArray], two: Sequence[NDArray]) -> NDArray:
    """Of vectors given by their three components."""
    out = one[0] * two[0]
    out += one[1] * two[1]
    out += one[2] * two[2]
    return out
