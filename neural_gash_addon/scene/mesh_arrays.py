# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes of Blender as arrays, and checks of what can be computed with."""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import UserError
from .frames import Array

_FARTHEST = 1e18  # metres; beyond, squares of coordinates leave float32


def read_positions(mesh: bpy.types.Mesh) -> NDArray[np.float32]:
    """(V, 3) local coordinates."""
    out = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.attributes["position"].data.foreach_get("vector", out.ravel())
    return out


def read_corner_vertices(mesh: bpy.types.Mesh) -> NDArray[np.int32]:
    """(C,) vertex of each face corner; the attribute is 300 times faster than mesh.loops."""
    out = np.empty(len(mesh.loops), np.int32)
    if len(out):
        mesh.attributes[".corner_vert"].data.foreach_get("value", out)
    return out


def read_triangle_corners(mesh: bpy.types.Mesh) -> NDArray[np.int32]:
    """(F, 3) face corners of each triangle."""
    mesh.calc_loop_triangles()
    corners = np.empty((len(mesh.loop_triangles), 3), np.int32)
    mesh.loop_triangles.foreach_get("loops", corners.ravel())
    return corners


def check_topology(obj: bpy.types.Object, mesh: bpy.types.Mesh) -> None:
    """UserError unless the evaluated mesh has the elements of the object's own, in the same order."""
    own = obj.data
    same = (len(mesh.vertices) == len(own.vertices) and len(mesh.polygons) == len(own.polygons)
            and np.array_equal(read_corner_vertices(mesh), read_corner_vertices(own)))
    if not same:
        raise UserError(f"The modifiers of '{obj.name}' change its vertices or faces, so a bake has no place "
                        "on its mesh; bake an applied copy instead.")


def check_coordinates(name: str, local: NDArray[np.float32], matrix: Array) -> None:
    """UserError for coordinates that nothing can be computed from."""
    largest = float(np.abs(local).max(initial=0.0)) * float(np.linalg.norm(matrix[:3, :3], 2))
    if not largest < _FARTHEST:  # also where it is not a number
        raise UserError(f"'{name}' has coordinates that are infinite, too large or not numbers.")


def check_matrix(name: str, matrix: Array) -> None:
    """UserError for a transform that leaves no shape."""
    if not np.isfinite(matrix).all():
        raise UserError(f"'{name}' has a location, rotation or scale that is infinite or not a number.")
    sizes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if sizes[2] <= 1e-9 * sizes[0]:
        raise UserError(f"'{name}' has a scale of zero, which leaves no shape to bake.")


def to_world(local: NDArray[np.float32], matrix: Array) -> Array:
    """Local points (V, 3) to world axes, in float64."""
    return local.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def outward(triangles: NDArray, matrix: Array) -> NDArray:
    """Triangles (F, 3, ...) wound as in local coordinates also where the matrix mirrors, which turns them round."""
    return triangles[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else triangles
