# SPDX-License-Identifier: GPL-3.0-or-later
"""What blocks light, as an Embree scene in normalised coordinates."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Geometry = tuple[NDArray, NDArray]  # positions (V, 3), triangles (F, 3)

# Offsets of ray origins, relative to the extent of the scene in float32: a few tens of roundings,
# enough for Embree's own error, and thin enough for plates of 1e-5.
OFFSET = 3e-6
# ... and relative to the spacing of the coordinates as they came, whose rounding tilts flat faces.
RESOLUTION_STEPS = 2.0
_FARTHEST = 1e15  # of coordinates: Embree's boxes hold no more
# Triangles handed to Embree at a time: its wrapper copies them holding the interpreter's lock, for
# about 40 ms a piece, and a window must get a turn in between.
PIECE = 1 << 15


@dataclass(frozen=True, eq=False)
class Hits:
    """The h rays that met something."""

    rays: NDArray[np.int64]   # (h,) which
    faces: NDArray[np.int64]  # (h,) triangle, counted over all parts that were given
    u: NDArray[np.float32]    # (h,) barycentric coordinate of its second corner
    v: NDArray[np.float32]    # (h,) and of its third
    front: NDArray[np.bool_]  # (h,) the side from which its corners run counter-clockwise


class Occluders:
    """Triangles that block; asks whether rays meet any of them.

    Coordinates are centred on what is baked and scaled to its size in float64 before Embree's float32 sees them,
    so a bake is as exact at any size and at any distance from the origin as its input is.
    """

    def __init__(self, geometry: Sequence[Geometry], resolution: float = 0.0) -> None:
        """Build and commit.

        geometry: parts (positions, triangles), what is baked first. resolution: of its coordinates,
        metres (see TriangleMesh).
        """
        from embreex.mesh_construction import TriangleMesh as EmbreeMesh
        from embreex.rtcore_scene import EmbreeScene

        parts = [(np.asarray(p, dtype=np.float64), np.asarray(t, dtype=np.int32)) for p, t in geometry]
        parts = [(p, t) for p, t in parts if len(p) and len(t)]
        # The box is that of what is baked, however large the world around it: rays must not start
        # farther off a coin on a floor because the floor is wide. Loose vertices do not stretch it.
        corners = parts[0][0][used(*parts[0])]
        low, high = corners.min(0), corners.max(0)
        self.centre = 0.5 * (low + high)
        extent = float(np.max(high - low))
        self.scale = 1.0 / extent if extent > 0 else 1.0
        self.offset = max(OFFSET, RESOLUTION_STEPS * resolution * self.scale)
        self._scene = EmbreeScene(robust=True)  # watertight edges
        first: list[int] = []  # triangle of each of Embree's geometries, counted over all parts
        before = 0
        for positions, triangles in parts:
            number = np.empty(len(positions), np.int32)  # of a vertex in its piece
            for start in range(0, len(triangles), PIECE):
                first.append(before + start)
                piece = triangles[start:start + PIECE]
                here = used(positions, piece)
                number[here] = np.arange(len(here), dtype=np.int32)
                EmbreeMesh(self._scene, self.normalise(positions[here]), _rows(number[piece]))
            before += len(triangles)
        self._first = np.array([*first, 0], dtype=np.int64)
        # the first query commits the scene, which only one thread may do
        self.blocked(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))

    def normalise(self, positions: NDArray) -> NDArray[np.float32]:
        """World positions (N, 3) in the scene's own coordinates."""
        local = np.clip((positions - self.centre) * self.scale, -_FARTHEST, _FARTHEST)
        return np.ascontiguousarray(local, dtype=np.float32)

    def origins(self, points: NDArray, clearance: NDArray) -> NDArray[np.float32]:
        """Where rays from points (N, 3) start: `clearance` (N, 3) offsets away, more where floats are coarser."""
        local = (points - self.centre) * self.scale
        x, y, z = np.abs(local).T  # not .max(1): NumPy is slow along short last axes
        coarser = np.maximum(1.0, 2.0 * np.maximum(np.maximum(x, y), z))
        local += (self.offset * coarser)[:, None] * clearance
        return local.astype(np.float32)

    def blocked(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                reach: NDArray[np.float32] | None = None) -> NDArray[np.int32]:
        """0 where a ray is blocked, -1 where it is free. Both (R, 3) float32, contiguous. Releases the GIL.

        reach: (R,) how far along it, in lengths of its direction; to the end of the scene where not given.
        """
        return self._scene.run(origins, directions, reach, query="OCCLUDED")

    def hits(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> Hits:
        """The first triangle that each ray (R, 3) meets. Releases the GIL."""
        faces, u, v, normals = self.first(origins, directions)
        rays = np.flatnonzero(faces >= 0)
        front = np.einsum("rx,rx->r", normals[rays], directions[rays]) < 0
        return Hits(rays, faces[rays], u[rays], v[rays], front)

    def first(self, origins: NDArray[np.float32], directions: NDArray[np.float32]
              ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """As `hits`, of every ray: triangle (R,), -1 where it meets none, u and v (R,), its normal (R, 3), not unit."""
        found = self._scene.run(origins, directions, query="INTERSECT", output=True)
        faces = self._first[found["geomID"]] + found["primID"]  # nothing is -1 and -1, and the last row holds 0
        return faces, found["u"], found["v"], found["Ng"]


def _rows(triangles: NDArray[np.int32]) -> NDArray[np.object_]:
    """The same triangles (F, 3) as a row (F,) of tuples.

    Embree's wrapper copies them by `indices[i][0]`, for which an array makes a view and a number each time: from tuples
    it takes three fifths of the time, making them included.
    """
    numbers = np.arange(int(triangles.max()) + 1).astype(object)
    return np.fromiter(zip(*(numbers[corner] for corner in triangles.T), strict=True), np.dtype(object), len(triangles))


def used(positions: NDArray, triangles: NDArray) -> NDArray[np.int64]:
    """Vertices that triangles (F, 3) have, rising. By a mask: sorting takes as long as Embree does for the rest."""
    mask = np.zeros(len(positions), dtype=bool)
    mask[triangles] = True
    return np.flatnonzero(mask)
