# SPDX-License-Identifier: GPL-3.0-or-later
"""The solid objects and instances of an evaluated scene, as arrays."""
from __future__ import annotations

from collections.abc import Callable, Iterator

import bpy
import numpy as np
from numpy.typing import NDArray

from .albedo import Finish
from .evaluation import shown_objects
from .frames import Array, as_array
from .mesh_arrays import read_corner_vertices, read_positions, read_triangle_corners

Solid = tuple[NDArray[np.float32], NDArray[np.int32], Finish, Array]  # local positions, triangles, finish, world matrix
# finish of the triangles with these face corners (F, 3) of an evaluated object and its geometry
Finishing = Callable[[bpy.types.Object, bpy.types.Mesh, NDArray[np.int32]], Finish]


def instances(depsgraph: bpy.types.Depsgraph, owners: set[int] | None = None, baked: bpy.types.Object | None = None,
              finishing: Finishing | None = None) -> Iterator[Solid]:
    """The solid objects and instances of a depsgraph that renders show.

    Args:
        owners: of these objects (session uids) only, shown or not.
        baked: which itself is left out, but instances of it elsewhere are not.
        finishing: the finish is empty where not given.
    """
    known: dict[tuple[int, int], tuple[NDArray, NDArray, Finish] | None] = {}
    shown = shown_objects(depsgraph) if owners is None else set()
    for instance in depsgraph.object_instances:
        solid = instance.object
        if solid.type != "MESH" or not instance.show_self:  # curves, texts and balls come as meshes too
            continue
        owner = (instance.parent if instance.is_instance else solid).original
        if owner == baked and not instance.is_instance:
            continue
        if owners is None and (owner.session_uid not in shown or solid.hide_render):
            continue
        if owners is not None and owner.session_uid not in owners:
            continue
        key = (solid.data.as_pointer(), solid.original.session_uid)
        if key not in known:
            known[key] = solid_arrays(solid, finishing)
        arrays = known[key]
        matrix = as_array(instance.matrix_world)
        if arrays is not None and np.isfinite(matrix).all():
            yield *arrays, matrix


def solid_arrays(solid: bpy.types.Object, finishing: Finishing | None
                 ) -> tuple[NDArray[np.float32], NDArray[np.int32], Finish] | None:
    """Local positions, triangles and their finish of an evaluated object; None where it has no faces."""
    try:
        mesh = solid.to_mesh()
    except RuntimeError:  # Blender's way to say that the object has no geometry, as a second metaball
        return None
    if mesh is None:
        return None
    try:
        if not len(mesh.polygons):
            return None
        positions = read_positions(mesh)
        corners = read_triangle_corners(mesh)
        triangles = read_corner_vertices(mesh)[corners]
        whole = np.isfinite(positions).all(axis=1)[triangles].all(axis=1)
        finish, pictures = (np.zeros((len(whole), 7)), []) if finishing is None else finishing(solid, mesh, corners)
        return (np.nan_to_num(positions), triangles[whole],
                (finish[whole], [picture.only(whole) for picture in pictures]))
    finally:
        solid.to_mesh_clear()
