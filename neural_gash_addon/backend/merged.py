# SPDX-License-Identifier: GPL-3.0-or-later
"""A dense mesh by the cells of a grid, for a first look at how large its shadows are.

Embree's scene of a dense mesh takes longer (1 µs a triangle, most of it copying) than a bake that wants none. Shadows
as a whole hardly change where all vertices of a cell are one, at their mean (Rossignac and Borrel 1993,
"Multi-resolution 3D approximations for rendering complex scenes"): where they were less than a half, on 32 meshes of
the training set, subdivided to 33,000 triangles or more, 0.7 to 1.06 times as large: 0.93 and more but for three with
thin parts, and hardly nearer with half as many cells again (0.84 to 1.35). Of small meshes that is not so. Where cells
are many (blobs, and surfaces within surfaces) larger ones are taken.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .geometry import TriangleMesh
from .raycast import Geometry, Occluders

DENSE = 1 << 15  # triangles from which on this is quicker than a scene, and near enough
SAFE = 1.1       # what shadows may be larger by than they seem
_CELLS = 40      # along the longest side of each part, at most,
_MOST = 3072     # and so many vertices, about: their scene takes 4 ms


@dataclass(frozen=True, eq=False)
class Merged:
    """A mesh of fewer triangles, with all that blocks."""

    mesh: TriangleMesh            # its points are those of the whole mesh, each moved with its cell
    vertices: NDArray[np.float64]  # (V, 3) one of each cell,
    triangles: NDArray[np.int32]  # (F, 3) between them
    scene: Occluders

    def surface(self) -> TriangleMesh:
        """Whose points are its vertices."""
        return TriangleMesh.from_triangles(self.vertices, self.triangles)


def dense(mesh: TriangleMesh, occluders: Sequence[Geometry]) -> bool:
    """Whether it is worth while to look at a merged mesh first."""
    return len(mesh.triangles) + sum(len(triangles) for _, triangles in occluders) >= DENSE


def merged(mesh: TriangleMesh, occluders: Sequence[Geometry]) -> Merged | None:
    """Merge the mesh and what else blocks. None where nothing is left of the mesh."""
    cells = _Cells(mesh.positions)
    triangles = cells.left(mesh.triangles)
    if not len(triangles):
        return None
    others = [(own.means, own.left(parts)) for own, parts in
              ((_Cells(positions), parts) for positions, parts in occluders if len(parts))]
    moved = cells.means[cells.own if mesh.points is mesh.positions else cells.of(mesh.points)]
    return Merged(replace(mesh, points=moved), cells.means, triangles,
                  Occluders([(cells.means, triangles), *others], mesh.resolution))


class _Cells:
    """The cells of a grid about positions (V, 3) that have any."""

    def __init__(self, positions: NDArray) -> None:
        axes = np.asarray(positions).T  # by axis: NumPy is slow along short last ones
        self._low = [float(axis.min()) for axis in axes]
        self._extent = max(float(axis.max()) - low for axis, low in zip(axes, self._low, strict=True))
        self._side = _CELLS
        here = self._places(positions)
        counts = np.bincount(here, minlength=self._side ** 3)
        if (many := np.count_nonzero(counts)) > _MOST:  # on a surface, their number goes with the square of the side
            self._side = int(_CELLS * (_MOST / many) ** 0.5)
            here = self._places(positions)
            counts = np.bincount(here, minlength=self._side ** 3)
        filled = np.flatnonzero(counts)
        self._number = np.zeros(self._side ** 3, np.int32)
        self._number[filled] = np.arange(len(filled), dtype=np.int32)
        sums = np.stack([np.bincount(here, axis, minlength=self._side ** 3)[filled] for axis in axes], 1)
        self.means = sums / counts[filled, None]  # (M, 3) of the positions of each cell
        self.own = self._number[here]             # (V,) the cell of each position

    def of(self, points: NDArray) -> NDArray[np.int32]:
        """(N,) the cell of each point, which is one of the positions."""
        return self._number[self._places(points)]

    def left(self, triangles: NDArray) -> NDArray[np.int32]:
        """(M, 3) those of triangles (F, 3) whose corners are in three cells."""
        corners = self.own[triangles]
        one, two, three = corners.T
        return corners[(one != two) & (two != three) & (three != one)]

    def _places(self, points: NDArray) -> NDArray[np.int32]:
        places = np.zeros(len(points), np.int32)
        times = self._side / self._extent if self._extent > 0 else 0.0
        for axis, low in zip(np.asarray(points).T, self._low, strict=True):
            places = places * self._side + np.minimum(((axis - low) * times).astype(np.int32), self._side - 1)
        return places
