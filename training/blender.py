# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender is asked for: its primitives, exact booleans and the voxel remesh."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .solids import Mesh, tidy

UNION, DIFFERENCE, INTERSECT = "UNION", "DIFFERENCE", "INTERSECT"


def primitive(kind: str, **settings: Any) -> Mesh:
    """The result of `bmesh.ops.create_<kind>`: 'cube', 'icosphere', 'cone', 'monkey'."""
    import bpy  # noqa: F401  (bmesh comes with it)
    import bmesh  # isort: skip

    shape = bmesh.new()
    try:
        getattr(bmesh.ops, f"create_{kind}")(shape, **settings)
        bmesh.ops.triangulate(shape, faces=shape.faces[:])
        shape.verts.index_update()
        return (np.array([v.co for v in shape.verts], dtype=np.float64),
                np.array([[v.index for v in f.verts] for f in shape.faces], dtype=np.int32))
    finally:
        shape.free()


def suzanne(subdivisions: int) -> Mesh:
    """Blender's monkey, 507 vertices before it is subdivided (Catmull-Clark)."""
    import bpy
    import bmesh  # isort: skip

    data = bpy.data.meshes.new("training")
    shape = bmesh.new()
    try:
        bmesh.ops.create_monkey(shape)
        shape.to_mesh(data)
    finally:
        shape.free()
    return _evaluated(data, [("SUBSURF", {"levels": subdivisions})] if subdivisions else [])


def boolean(mesh: Mesh, other: Mesh, operation: str) -> Mesh:
    """UNION, DIFFERENCE or INTERSECT by Blender's exact solver. May be empty."""
    import bpy

    operand = bpy.data.objects.new("training", _data(other))
    bpy.context.scene.collection.objects.link(operand)
    try:
        return _evaluated(_data(mesh), [("BOOLEAN", {"operation": operation, "solver": "EXACT", "object": operand})])
    finally:
        bpy.data.meshes.remove(operand.data)  # and the object with it


def voxel_remesh(mesh: Mesh, size: float) -> Mesh:
    """Quads, halved, of about `size`, over the outside of what may be a soup of parts."""
    return _evaluated(_data(mesh), [("REMESH", {"mode": "VOXEL", "voxel_size": size})])


def _data(mesh: Mesh) -> Any:
    """A Blender mesh of the arrays; the caller removes it."""
    import bpy

    positions, triangles = mesh
    data = bpy.data.meshes.new("training")
    data.from_pydata(positions.tolist(), [], triangles.tolist())
    return data


def _evaluated(data: Any, modifiers: Sequence[tuple[str, dict[str, Any]]]) -> Mesh:
    """A Blender mesh with modifiers applied, as arrays; `data` is removed."""
    import bpy

    made = bpy.data.objects.new("training", data)
    bpy.context.scene.collection.objects.link(made)
    try:
        for kind, settings in modifiers:
            modifier = made.modifiers.new(kind, kind)
            for name, value in settings.items():
                setattr(modifier, name, value)
        evaluated = made.evaluated_get(bpy.context.evaluated_depsgraph_get())
        result = evaluated.to_mesh()
        result.calc_loop_triangles()
        positions = np.empty(3 * len(result.vertices), dtype=np.float32)
        result.vertices.foreach_get("co", positions)
        triangles = np.empty(3 * len(result.loop_triangles), dtype=np.int32)
        result.loop_triangles.foreach_get("vertices", triangles)
        evaluated.to_mesh_clear()
        return tidy((positions.reshape(-1, 3).astype(np.float64), triangles.reshape(-1, 3)))
    finally:
        bpy.data.meshes.remove(data)  # and the object with it
