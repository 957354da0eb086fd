# SPDX-License-Identifier: GPL-3.0-or-later
"""An object that is read again and again while it deforms: of a topology that stays, only what moves is read."""
from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.geometry import POINT, TriangleMesh, unit
from .evaluation import evaluated
from .frames import Array, as_array
from .mesh_arrays import check_coordinates, read_corner_vertices, read_positions, to_world
from .read import read_object


class Deforming:
    """The reader of one object. Holds arrays, nothing of Blender's."""

    def __init__(self) -> None:
        self._mesh: TriangleMesh | None = None
        self._corner_vertices: NDArray[np.int32] | None = None
        self._mirrored = False

    def read(self, obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> tuple[TriangleMesh, Array]:
        """The points of a bake to vertices, as the object stands evaluated, and its world matrix (4, 4).

        Raises:
            UserError: as `read_object`.
        """
        again = self._read_again(obj, depsgraph)
        if again is not None:
            return again
        read = read_object(obj, depsgraph)
        self._mesh, self._corner_vertices = read.mesh, read.surface.corner_vertices
        self._mirrored = bool(np.linalg.det(read.matrix[:3, :3]) < 0)
        return read.mesh, read.matrix

    def _read_again(self, obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> tuple[TriangleMesh, Array] | None:
        """`read` where vertices alone have moved and have one normal each; None where that is not so."""
        before = self._mesh
        if before is None or self._corner_vertices is None or before.domain != POINT or not obj.visible_get(
                view_layer=depsgraph.view_layer):
            return None
        with evaluated(obj, depsgraph) as copy:
            mesh, matrix = copy.data, as_array(copy.matrix_world)
            if (len(mesh.vertices) != len(before.points) or mesh.normals_domain != POINT
                    or not np.array_equal(read_corner_vertices(mesh), self._corner_vertices)):
                return None
            local = read_positions(mesh)
            normals = np.empty_like(local)
            mesh.vertex_normals.foreach_get("vector", normals.ravel())
        linear = matrix[:3, :3]
        sizes = np.linalg.svd(linear, compute_uv=False)
        if not sizes[2] > 1e-9 * sizes[0] or (np.linalg.det(linear) < 0) != self._mirrored:
            return None
        check_coordinates(obj.name, local, matrix)
        points = to_world(local, matrix)
        turned = unit(normals @ np.linalg.inv(linear).astype(np.float32))
        turned[~np.any(before.normals != 0, axis=1)] = 0  # vertices of no face, to which Blender gives a normal
        self._mesh = replace(before, positions=points, points=points, normals=turned, clearance=turned)
        return self._mesh, matrix
