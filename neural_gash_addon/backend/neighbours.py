# SPDX-License-Identifier: GPL-3.0-or-later
"""Which points lie beside which along the edges of a mesh."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .geometry import CORNER, TriangleMesh


@dataclass(frozen=True, eq=False)
class Neighbours:
    """For each of N points, the points beside it."""

    start: NDArray[np.int64]   # (N + 1,) where a point's begin in `points`
    points: NDArray[np.int32]  # (L,)


def neighbours(mesh: TriangleMesh) -> Neighbours:
    """The neighbours of a mesh's vertices or corners.

    A triangle a b c makes b a neighbour of a, c of b and a of c: each edge of a closed mesh is so
    found once in each direction, without a search.
    """
    triangles: NDArray = mesh.triangles
    if mesh.domain == CORNER:
        assert mesh.corners is not None
        triangles = mesh.elements[mesh.corners]
    point, other = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    order = np.argsort(point, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(mesh.points)))])
    return Neighbours(start, other[order].astype(np.int32))
