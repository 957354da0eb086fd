# SPDX-License-Identifier: GPL-3.0-or-later
"""Which points lie beside which: along the edges of the mesh, or in the grid of a texture."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .geometry import CORNER, TEXEL, TriangleMesh


@dataclass(frozen=True, eq=False)
class Neighbours:
    """For each of N points, the points beside it."""

    start: NDArray[np.int64]   # (N + 1,) where a point's begin in `points`
    points: NDArray[np.int32]  # (L,)


def neighbours(mesh: TriangleMesh, seen: NDArray[np.bool_] | None = None) -> Neighbours:
    """The neighbours of a mesh's points.

    Args:
        seen: (N,) only of these points, of the points beside them, and of those beside the latter;
            the others are given none.

    A triangle a b c makes b a neighbour of a, c of b and a of c: each edge of a closed mesh is so
    found once in each direction, without a search. Texels have the four beside them that are covered.
    """
    if mesh.domain == TEXEL:
        assert mesh.texels is not None
        point, other = _in_grid(mesh.texels, mesh.side)
        if seen is not None:
            near = seen.copy()
            near[point[seen[other]]] = True
            kept = near[point] | near[other]
            point, other = point[kept], other[kept]
    else:
        triangles: NDArray = mesh.triangles
        if mesh.domain == CORNER:
            assert mesh.corners is not None
            triangles = mesh.elements[mesh.corners]
        if seen is not None:
            near = seen.copy()
            near[triangles[_any(seen, triangles)]] = True
            triangles = triangles[_any(near, triangles)]
        point, other = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    order = _sorting(point)
    start = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(mesh.points)))])
    return Neighbours(start, other[order].astype(np.int32))


def _any(flags: NDArray[np.bool_], triangles: NDArray) -> NDArray[np.bool_]:
    """(F,) whether a flag of (N,) is set at one of the corners of each triangle (F, 3)."""
    a, b, c = (flags.take(triangles[:, corner]) for corner in range(3))
    return a | b | c


def _in_grid(texels: NDArray[np.int64], side: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of points whose texels (N,), rising, share an edge of a texture's grid; each pair both ways."""
    right = np.flatnonzero((texels[1:] == texels[:-1] + 1) & (texels[1:] % side != 0))
    above = np.minimum(np.searchsorted(texels, texels + side), len(texels) - 1)
    up = np.flatnonzero(texels[above] == texels + side)
    one, two = np.concatenate([right, up]), np.concatenate([right + 1, above[up]])
    return np.concatenate([one, two]), np.concatenate([two, one])


def _sorting(keys: NDArray) -> NDArray[np.int64]:
    """What sorts non-negative keys (n,) below 2**32, stably: by halves, as NumPy sorts 16 bits in linear time."""
    low = np.argsort((keys & 0xFFFF).astype(np.uint16), kind="stable")
    return low[np.argsort((keys >> 16).astype(np.uint16)[low], kind="stable")]
