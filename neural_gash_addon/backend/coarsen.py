# SPDX-License-Identifier: GPL-3.0-or-later
"""A mesh by a quarter of its vertices, and what was found at those given to all: by topology alone.

The vertices that stay are a maximal independent set of the mesh's graph (Luby 1986, "A simple parallel algorithm for
the maximal independent set problem"), as in algebraic multigrid: no two are neighbours, and every other vertex is
beside one. Each vertex goes to the one beside it that is nearest and faces the same way; triangles whose corners go to
three different ones stay. So nothing needs doing again while the mesh deforms.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .geometry import POINT, TriangleMesh
from .neighbours import neighbours

BESIDE = 3        # vertices that stay from which another takes, at most
_FACING = 0.02    # of a vertex that faces another way altogether, beside one that faces the same way


@dataclass(frozen=True, eq=False)
class Coarsening:
    """Some of N points, and how all take from them."""

    rows: NDArray[np.int64]          # (M,) the points that stay, rising
    triangles: NDArray[np.int32]     # (F, 3) of those
    beside: NDArray[np.int64]        # (N, BESIDE) of those M, from which each point takes
    shares: NDArray[np.float32]      # (N, BESIDE) how much; they add up to 1

    def mesh(self, fine: TriangleMesh) -> TriangleMesh:
        """The mesh of the points that stay, where those of `fine` are now."""
        points = fine.points[self.rows]
        return replace(fine, positions=points, triangles=self.triangles, points=points,
                       normals=fine.normals[self.rows], clearance=fine.clearance[self.rows],
                       elements=np.arange(len(points), dtype=np.int32))

    def spread(self, values: NDArray) -> NDArray[np.float32]:
        """(N, C) of all points from values (M, C) at those that stay, which keep theirs."""
        out = self.shares[:, :1] * values.take(self.beside[:, 0], 0)
        some = np.flatnonzero(self.shares[:, 1])  # those that take from several; fewer the more they take
        for column in range(1, self.beside.shape[1]):
            some = some[self.shares[some, column] > 0]
            out[some] += self.shares[some, column, None] * values.take(self.beside[some, column], 0)
        return out


def coarsened(mesh: TriangleMesh, seed: int = 0) -> Coarsening | None:
    """Coarsen a mesh whose points are its vertices; None where that leaves no triangle.

    Raises:
        ValueError: its points are not its vertices.
    """
    if mesh.domain != POINT:
        raise ValueError(f"points are {mesh.domain}, not vertices")
    count = len(mesh.points)
    one, other = _edges(mesh)
    stays = independent(count, one, other, np.random.default_rng(seed))
    number = np.cumsum(stays) - 1
    pairs = np.flatnonzero(~stays[one] & stays[other])
    point, near = one[pairs], other[pairs]
    facing = np.einsum("nx,nx->n", mesh.normals[point], mesh.normals[near])
    apart = np.sqrt(np.square(mesh.points[point] - mesh.points[near]).sum(1))
    weight = np.maximum(facing, _FACING) / np.maximum(apart, 1e-30 + 1e-6 * float(apart.mean() if len(apart) else 1.0))
    order = np.lexsort((-weight, point))
    point, near, weight = point[order], near[order], weight[order]
    rank = np.arange(len(point)) - np.searchsorted(point, point)  # the heaviest of each point first
    kept = rank < BESIDE
    beside = np.zeros((count, BESIDE), np.int64)
    shares = np.zeros((count, BESIDE))
    beside[point[kept], rank[kept]] = number[near[kept]]
    shares[point[kept], rank[kept]] = weight[kept]
    beside[stays, 0], shares[stays, 0] = number[stays], 1
    shares /= shares.sum(1, keepdims=True)
    triangles = beside[:, 0][mesh.triangles]
    triangles = triangles[(triangles != np.roll(triangles, 1, 1)).all(1)]
    if not len(triangles):
        return None
    _, first = np.unique(np.sort(triangles, 1), axis=0, return_index=True)
    return Coarsening(np.flatnonzero(stays), triangles[np.sort(first)].astype(np.int32), beside,
                      shares.astype(np.float32))


def _edges(mesh: TriangleMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The two ends of each edge of a mesh, once in each direction, by the first end; none to itself."""
    links = neighbours(mesh)
    count = len(mesh.points)
    one, other = np.repeat(np.arange(count), np.diff(links.start)), links.points.astype(np.int64)
    keys = np.unique(np.concatenate([one * count + other, other * count + one])[np.tile(one != other, 2)])
    return keys // count, keys % count


def independent(count: int, one: NDArray, other: NDArray, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(count,) whether each vertex is of a maximal independent set; edges in both directions, by their first ends."""
    chance = rng.permutation(count) + 1
    taken, left = np.zeros(count, bool), np.ones(count, bool)
    while left.any():
        highest = np.zeros(count, chance.dtype)  # chance of any neighbour that is left
        if len(one):
            start = np.flatnonzero(np.diff(one, prepend=-1))
            highest[one[start]] = np.maximum.reduceat(chance[other], start)
        now = left & (chance > highest)
        taken |= now
        left[now] = False
        left[one[now[other]]] = False
        going_on = left[one] & left[other]
        one, other = one[going_on], other[going_on]
    return taken
