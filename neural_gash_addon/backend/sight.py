# SPDX-License-Identifier: GPL-3.0-or-later
"""What stage 1 of the paper's network hears of a mesh: points spread over all of it, and where each point sees these.

Neighbours on the surface tell of a few hundredths of a mesh. So the k-NN graph of stage 1 joins each vertex with its
nearest among 1,024 points spread over the mesh, and with some of only 128 around these: in three hops a vertex hears of
all of it, however fine the mesh is. Only these points send messages; so all vertices are asked alike, in any chunks.

An edge tells where its source lies and how it faces in the receiver's own frame: what the reverse of the receiver's
motor carries the source to. The directions of the visibilities are fixed in that frame.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import conformal
from .nearest import nearest_to

SIDE = 8.0      # longest side of a mesh as the networks know it
SPREAD, NEAREST = 1024, 12  # points that are heard, and how many nearest of them each vertex hears
FIRST, FAR = 128, 8         # and of the first of them, those nearest to the nearest
EDGE = 8         # numbers of an edge
CHUNK = 1 << 14  # vertices asked at a time
_NEAR = SIDE / 200   # nearer than that, where a point is fades away
_CANDIDATES = 4096   # voxels with a vertex, from which points are taken, at least; where there are so many
_STEPS = 1 << 14     # places along a mesh's longest side that are told apart: distances are then exact
_FINEST = 9          # times that the 16 voxels along it are halved


class Sight(NamedTuple):
    """A graph of stage 1; arrays, or tensors."""

    encoded: Any  # (C + n, 32): the points of the mesh that are heard, and vertices that hear them
    source: Any   # (e,), below C
    start: Any    # (C + n + 1,)
    edge: Any     # (e, EDGE)
    asked: Any    # (m,) of the C + n, whose answers are wanted


@dataclass(frozen=True, eq=False)
class Places:
    """A mesh's points as the networks know them, SIDE long; rows of `spread` are what is heard."""

    points: NDArray[np.float64]   # (N, 3)
    normals: NDArray[np.float64]  # (N, 3)
    frames: NDArray[np.float64]   # (N, 3, 3) of their motors
    spread: NDArray[np.int64]     # (C,)

    def turned(self, turn: NDArray, scale: float = 1.0) -> Places:
        """Of the mesh turned by `turn` (3, 3), and scaled."""
        normals = self.normals @ turn.T
        return Places(scale * self.points @ turn.T, normals, frames_of(normals), self.spread)

    def sight(self, rows: NDArray, encode: Callable[[NDArray, NDArray], NDArray] = conformal.encode) -> Sight:
        """Of some vertices (m,); encode: what is told of each point."""
        number = np.full(len(self.points), -1)
        number[self.spread] = np.arange(len(self.spread))
        others = rows[number[rows] < 0]
        number[others] = len(self.spread) + np.arange(len(others))
        nodes = np.concatenate([self.spread, others])
        near = heard(self.points[nodes], self.points[self.spread])
        return Sight(encode(self.points[nodes], self.normals[nodes]).astype(np.float32), near.ravel(),
                     np.arange(len(nodes) + 1) * near.shape[1],
                     self.relative(nodes, nodes[near]).reshape(-1, EDGE), number[rows])

    def relative(self, receiver: NDArray, sender: NDArray) -> NDArray[np.float32]:
        """(n, K, EDGE) of vertices (n, K) as (n,) others see them: direction, normal, logarithm of distance, and the
        cosine between the normal and the way back."""
        out = np.empty((*sender.shape, EDGE), np.float32)
        frames = self.frames[receiver].astype(np.float32)
        away = (self.points[sender] - self.points[receiver, None]).astype(np.float32) @ frames
        out[..., 3:6] = self.normals[sender].astype(np.float32) @ frames
        distance = np.sqrt(np.einsum("nkx,nkx->nk", away, away) + np.float32(_NEAR ** 2))
        out[..., :3] = away / distance[..., None]
        out[..., 6] = np.log(distance)
        out[..., 7] = -np.einsum("nkx,nkx->nk", out[..., :3], out[..., 3:6])
        return out

    def sights(self) -> Iterator[Sight]:
        """Of all vertices, in chunks."""
        for first in range(0, len(self.points), CHUNK):
            yield self.sight(np.arange(first, min(first + CHUNK, len(self.points))))


def frames_of(normals: NDArray) -> NDArray[np.float64]:
    """Rotations (N, 3, 3) of the motors at normals (N, 3)."""
    return conformal.frames(conformal.motor(np.zeros_like(normals), normals))


def encode(points: NDArray, normals: NDArray) -> NDArray[np.float32]:
    """(N, 32)."""
    return conformal.encode(points, normals).astype(np.float32)


def places(points: NDArray, normals: NDArray) -> Places:
    """Of points (N, 3) of any size and normals (N, 3), zero where there is none."""
    lit = np.any(normals != 0, axis=1)
    placed_ = placed(points, lit)
    normals = np.asarray(normals, np.float64)
    return Places(placed_, normals, frames_of(normals), spread(placed_, normals, SPREAD))


def placed(points: NDArray, lit: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Points (N, 3) as the networks know them: box of those that are `lit` centred on the origin, longest side SIDE."""
    seen = points[lit] if lit.any() else points
    low, high = seen.min(0), seen.max(0)
    return (points - (low + high) / 2) * (SIDE / (float((high - low).max()) or 1.0))


def heard(points: NDArray, spread: NDArray) -> NDArray[np.int64]:
    """(N, K) of points (C, 3) that are spread, farthest first, those that each of N points (N, 3) hears.

    One may be there twice, and a point may be its own neighbour. Of points equally far, which meshes with symmetries
    have, the earlier one is heard, whatever the rounding.
    """
    points, spread = _whole(points), _whole(spread)
    near = nearest_to(points, spread, NEAREST)
    return np.concatenate([near, nearest_to(spread, spread[:FIRST], FAR)[near[:, 0]]], 1)


def spread(points: NDArray, normals: NDArray, most: int) -> NDArray[np.int64]:
    """Of points (N, 3) with normals (N, 3), SIDE long, those that are farthest from all before them (Gonzalez 1985,
    "Clustering to minimize the maximum intercluster distance"): (C,), C at most `most`. Those without a normal only
    where there are no others.

    They do not depend on the points' order: distances are of whole numbers, and of points equally far the first by
    its coordinates is taken. One candidate of each voxel is enough, which bounds the time.
    """
    rows = np.flatnonzero(np.any(normals != 0, axis=1))
    rows = rows if len(rows) else np.arange(len(points))
    whole = _whole(points[rows]).astype(np.int64) + _STEPS // 2
    chosen = _one_a_voxel(whole, points[rows], normals[rows])
    rows, at = rows[chosen], whole[chosen].astype(np.float64)
    out = np.empty(min(most, len(rows)), np.int64)
    away = np.full(len(rows), np.inf)
    now = int(np.square(at - _STEPS // 2).sum(1).argmax())
    x, y, z = np.ascontiguousarray(at.T)
    for count in range(len(out)):
        out[count] = now
        square = np.square(x - x[now])
        square += np.square(y - y[now])
        square += np.square(z - z[now])
        np.minimum(away, square, out=away)
        now = int(away.argmax())
    return rows[out]


def _whole(points: NDArray) -> NDArray[np.float64]:
    """Points (N, 3), SIDE long, in whole numbers of steps."""
    return np.rint(points * (_STEPS / SIDE))


def _one_a_voxel(whole: NDArray[np.int64], points: NDArray, normals: NDArray) -> NDArray[np.int64]:
    """Indices of points, one of each voxel, by their coordinates; voxels so fine that there are _CANDIDATES or more."""
    for level in range(_FINEST + 1):
        voxel = whole // (_STEPS >> (4 + level))
        key = (voxel[:, 0] << 40) + (voxel[:, 1] << 20) + voxel[:, 2]
        if len(np.unique(key)) >= min(_CANDIDATES, len(whole)):
            break
    middle = np.square(whole - (voxel * 2 + 1) * (_STEPS >> (5 + level))).sum(1)
    order = np.lexsort((middle, key))
    begins = np.flatnonzero(np.diff(key[order], prepend=-1))
    least = np.repeat(middle[order][begins], np.diff(begins, append=len(order)))
    tied = order[middle[order] == least]  # one or a few of each voxel: which of them does not depend on their order
    tied = tied[np.lexsort((*normals[tied].T, *points[tied].T, *whole[tied].T, key[tied]))]
    return tied[np.flatnonzero(np.diff(key[tied], prepend=-1))]
