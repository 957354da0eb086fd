# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender objects to arrays: the mesh to bake, what else blocks its light, and its fingerprint."""
from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import UserError
from ..backend.geometry import Surface, TriangleMesh, unit
from .albedo import Finish, Images, triangle_finish
from .attributes import RECORD, discard
from .evaluation import evaluated, revealed
from .frames import Array, as_array, bake_frame, rotation_part
from .mesh_arrays import (
    check_coordinates,
    check_matrix,
    check_topology,
    outward,
    read_corner_vertices,
    read_positions,
    read_triangle_corners,
    to_world,
)
from .normal_maps import normal_map_key
from .preview import preview_off
from .solids import Finishing, Solid, instances
from .uv_maps import mark_own_uv, own_uv_name

SELF, VISIBLE = "SELF", "VISIBLE"
# Stretch and places are compared to this part of their size: far above float32 noise of a turned
# matrix, far below what changes a shadow.
_SAME = 1e-4

__all__ = ["SELF", "VISIBLE", "SceneMesh", "bake_frame", "fingerprint", "group_mode", "is_group", "make_applied_copy",
           "read_object", "read_occluders", "refusal", "same_fingerprint"]


@dataclass(frozen=True, eq=False)
class SceneMesh:
    """What `read_object` gives."""

    surface: Surface  # in world axes, metres; vertices and corners in Blender's order
    matrix: Array     # (4, 4) the object's world matrix when it was read

    @cached_property
    def mesh(self) -> TriangleMesh:
        """The points of a bake to vertices."""
        return self.surface.vertex_points()

    @property
    def frame(self) -> tuple[float, ...]:
        """(9,) row-major rotation for `BakeRecord.frame`."""
        return tuple(float(v) for v in rotation_part(self.matrix).ravel())


def refusal(obj: bpy.types.Object | None) -> str:
    """Why `obj` cannot be baked at all, in one sentence; '' where it can. Reads no geometry."""
    reason = _unreadable(obj)
    if reason or obj is None:
        return reason
    if obj.library or obj.data.library:
        return (f"'{obj.name}' is linked from another file, where a bake cannot be stored; "
                "make its object and mesh local to bake it.")
    if obj.data.override_library:
        return (f"The mesh of '{obj.name}' is a library override, which cannot store a bake; "
                "make it local to bake it.")
    return ""


def _unreadable(obj: bpy.types.Object | None) -> str:
    """`refusal`, but for where a bake cannot be stored."""
    if obj is None:
        return "No object is active; click a mesh object to make it the active one."
    if obj.type != "MESH":
        return f"'{obj.name}' is not a mesh object ({obj.type.title()}); convert it to a mesh to bake it."
    if obj.data.is_editmode:  # its own mode, or that of another object with the same mesh
        return f"'{obj.name}' is in Edit Mode, which would discard the bake; leave Edit Mode to bake it."
    if not obj.data.polygons:
        return f"'{obj.name}' has no faces, so there is nothing to bake."
    return ""


def read_object(obj: bpy.types.Object | None, depsgraph: bpy.types.Depsgraph) -> SceneMesh:
    """The object as it stands evaluated, in world axes.

    Raises:
        UserError: it cannot be baked (see `refusal`), its coordinates or matrix are not finite, it
            is flattened by a zero scale, or its modifiers change the topology.
    """
    reason = refusal(obj)
    if reason or obj is None:
        raise UserError(reason)
    with evaluated(obj, depsgraph) as copy:
        matrix = as_array(copy.matrix_world)
        check_matrix(obj.name, matrix)
        mesh = copy.to_mesh()
        try:
            check_topology(obj, mesh)
            local = read_positions(mesh)
            check_coordinates(obj.name, local, matrix)
            corner_vertices = read_corner_vertices(mesh)
            corners = read_triangle_corners(mesh)
            normals = np.empty((len(corner_vertices), 3), np.float32)
            mesh.corner_normals.foreach_get("vector", normals.ravel())
            sizes = np.empty(len(mesh.polygons), np.int32)
            mesh.polygons.foreach_get("loop_total", sizes)
        finally:
            copy.to_mesh_clear()
    if not len(corners):
        raise UserError(f"'{obj.name}' has no faces, so there is nothing to bake.")
    linear = matrix[:3, :3]
    # Rounding of the floats that Blender holds: the local coordinates', grown by the largest scale.
    # The place of the object adds none, as its translation is the same number for every vertex.
    spacing = float(np.spacing(np.abs(local).max())) * float(np.linalg.norm(linear, 2))
    corner_faces = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    normals = normals @ np.linalg.inv(linear).astype(np.float32)  # inverse transpose: outward in mirrors, too
    return SceneMesh(Surface(to_world(local, matrix), corner_vertices, unit(normals).astype(np.float32), corner_faces,
                             outward(corners, matrix), spacing), matrix)


def make_applied_copy(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bpy.types.Object:
    """A new object beside `obj` whose mesh is the evaluated one: same place, collections, materials.

    Raises:
        UserError: `obj` is no mesh object, or its modifiers leave no faces.
    """
    reason = refusal(obj)
    if reason:
        raise UserError(reason)
    with evaluated(obj, depsgraph) as copy:
        data = bpy.data.meshes.new_from_object(copy, preserve_all_data_layers=True, depsgraph=depsgraph)
    if not data.polygons:
        bpy.data.meshes.remove(data)
        raise UserError(f"The modifiers of '{obj.name}' leave no faces, so there is nothing to bake.")
    data.name = f"{obj.data.name} (applied)"
    new = obj.copy()
    new.name = f"{obj.name} (applied)"
    preview_off(new)
    for index, material in enumerate(obj.data.materials):
        if index < len(data.materials):  # evaluation puts the object's own materials in their place
            data.materials[index] = material
    if RECORD in obj.data:  # a new mesh takes the attributes of an earlier bake along, but not its record
        mark_own_uv(data, own_uv_name(obj.data))
        data[RECORD] = obj.data[RECORD]
        discard(data)
    new.data = data
    new.modifiers.clear()
    for collection in obj.users_collection:
        collection.objects.link(new)
    return new


def group_mode(objects: Sequence[bpy.types.Object]) -> str:
    """The occluder mode of objects that are baked together: each is shadowed by itself and the others."""
    return SELF if len(objects) == 1 else json.dumps(sorted(obj.name for obj in objects))


def is_group(mode: str) -> bool:
    """Whether an occluder mode is a `group_mode` of several objects."""
    return mode.startswith("[")


def _members(mode: str) -> list[bpy.types.Object]:
    """The objects that a mode names: of a group, or of a collection. UserError where one is gone."""
    if is_group(mode):
        names = json.loads(mode)
        lost = [name for name in names if name not in bpy.data.objects]
        if lost:
            raise UserError(f"There is no object named '{lost[0]}' any more to cast its shadow.")
        return [bpy.data.objects[name] for name in names]
    collection = bpy.data.collections.get(mode)
    if collection is None:
        raise UserError(f"There is no collection named '{mode}' to take occluders from.")
    return list(collection.all_objects)


def read_occluders(obj: bpy.types.Object, mode: str, depsgraph: bpy.types.Depsgraph,
                   ) -> list[tuple[Array, NDArray[np.int32]]]:
    """What blocks the light of `obj` besides itself, in world axes.

    Args:
        mode: 'SELF' (nothing), 'VISIBLE' (what the viewport shows and a render would), or a
            collection's name or a `group_mode` (all their objects, hidden ones too).
    Returns:
        One (positions (V, 3) float64, triangles (F, 3) int32) per object and instance.
    Raises:
        UserError: there is no such collection or object.
    """
    return [(to_world(local, matrix), outward(triangles, matrix))
            for local, triangles, _, matrix in _occluders(obj, mode, depsgraph)]


def read_finish(obj: bpy.types.Object, mode: str, depsgraph: bpy.types.Depsgraph) -> Finish:
    """`triangle_finish` of the triangles of `obj`, then of those of `read_occluders`, in its order."""
    known: Images = {}

    def finishing(solid: bpy.types.Object, mesh: bpy.types.Mesh, corners: NDArray[np.int32]) -> Finish:
        return triangle_finish(solid, mesh, corners, known)

    with evaluated(obj, depsgraph) as copy:
        mesh = copy.to_mesh()
        try:
            own = finishing(copy, mesh, read_triangle_corners(mesh))
        finally:
            copy.to_mesh_clear()
    values: list[Array] = []
    pictures = []
    others = ((finish, matrix) for _, _, finish, matrix in _occluders(obj, mode, depsgraph, finishing))
    for (found, images), matrix in [(own, as_array(obj.matrix_world)), *others]:
        start = sum(map(len, values))
        pictures += [replace(image, triangles=start + image.triangles, uv=outward(image.uv, matrix))
                     for image in images]
        values.append(found)
    return np.concatenate(values), pictures


def fingerprint(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, occluder_mode: str = SELF,
                uv: NDArray[np.float32] | None = None, bounces: bool = False) -> str:
    """What a bake of `obj` depends on, in a short text; compare two with `same_fingerprint`.

    Without other occluders it is the same wherever the object stands, however it is turned and
    uniformly scaled (none of which changes transfer). With them, what counts is where they stand
    from the object. A texture's UVs (C, 2) count too, and its normal maps;
    and with bounces the albedo of everything.

    Raises:
        UserError: as `read_object`; but what is linked from another file has one.
    """
    reason = _unreadable(obj)
    if reason:
        raise UserError(reason)
    with evaluated(obj, depsgraph) as copy:
        matrix = as_array(copy.matrix_world)
        check_matrix(obj.name, matrix)
        mesh = copy.to_mesh()
        try:
            check_topology(obj, mesh)
            digest = hashlib.blake2b(digest_size=16)
            local = read_positions(mesh)
            check_coordinates(obj.name, local, matrix)
            digest.update(local.tobytes())
            digest.update(read_corner_vertices(mesh).tobytes())
            _hash_shading(mesh, digest)
            if uv is not None:
                digest.update(uv.tobytes())
                digest.update(normal_map_key(obj))
        finally:
            copy.to_mesh_clear()
    linear = matrix[:3, :3]
    mirrored = np.linalg.det(linear) < 0
    _, sizes, axes = np.linalg.svd(linear)
    stretch = (axes.T * sizes) @ axes  # symmetric part of the polar decomposition: turned by nothing
    size = float(sizes[0])
    digest.update(b"mirrored" if mirrored else b"")
    text = ["%.4f" % (v + 0.0) for v in np.round(stretch[np.triu_indices(3)] / size, 4)]
    if occluder_mode != SELF:
        text.append(f"{size:.4g}")
        rigid = np.eye(4)
        rigid[:3, :3] = rotation_part(matrix)
        rigid[:3, 3] = matrix[:3, 3]
        grain = _SAME * max(float(np.ptp(local, axis=0).max(initial=0.0)) * size, 1e-30)
        seen = np.linalg.inv(rigid)
        shapes: dict[int, tuple[NDArray, bytes]] = {}  # instances share arrays; held, so that ids stay theirs
        entries = []
        for local, triangles, _, place in _occluders(obj, occluder_mode, depsgraph):
            if id(local) not in shapes:
                shapes[id(local)] = local, hashlib.blake2b(local.tobytes() + triangles.tobytes()).digest()
            entries.append(shapes[id(local)][1] + _place(seen @ place, grain))
        digest.update(b"".join(sorted(entries)))
    if bounces:
        finish, pictures = read_finish(obj, occluder_mode, depsgraph)
        digest.update(np.round(finish[:, :3], 4).tobytes())
        for picture in pictures:
            digest.update(np.round(picture.lookups()[..., picture.columns < 3], 4).tobytes())
    return digest.hexdigest() + ":" + ",".join(text)


def same_fingerprint(first: str, second: str) -> bool:
    """Whether two fingerprints are of the same shape: the stretch may differ by rounding."""
    (digest, _, text), (other_digest, _, other_text) = first.partition(":"), second.partition(":")
    if digest != other_digest:
        return False
    try:
        a, b = (np.array([float(v) for v in t.split(",")]) for t in (text, other_text))
    except ValueError:
        return text == other_text
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=2 * _SAME, atol=2 * _SAME))


def _occluders(obj: bpy.types.Object, mode: str, depsgraph: bpy.types.Depsgraph, finishing: Finishing | None = None,
               ) -> Iterator[Solid]:
    """Each object and instance that blocks, but `obj`. Their finish is empty where it is not asked for: it takes time.
    """
    if mode == SELF:
        return
    if mode == VISIBLE:
        yield from instances(depsgraph, None, obj, finishing)
        return
    members = _members(mode)
    hidden = [o for o in members if o != obj and not o.visible_get(view_layer=depsgraph.view_layer)]
    owners = {o.session_uid for o in members} - {o.session_uid for o in hidden}
    yield from instances(depsgraph, owners, obj, finishing)
    if hidden:
        with revealed(hidden, depsgraph) as (own_depsgraph, _):
            yield from instances(own_depsgraph, None, None, finishing)


def _hash_shading(mesh: bpy.types.Mesh, digest) -> None:
    """What decides the normals beside the positions; not the normals, whose last bits vary by version."""
    for name in ("sharp_face", "sharp_edge"):
        attribute = mesh.attributes.get(name)
        if attribute is not None:
            flags = np.empty(len(attribute.data), bool)
            attribute.data.foreach_get("value", flags)
            if flags.any():  # an attribute of zeros means the same as none
                digest.update(name.encode() + flags.tobytes())
    if mesh.has_custom_normals:
        normals = np.empty(3 * len(mesh.loops), np.float32)
        mesh.corner_normals.foreach_get("vector", normals)
        digest.update(np.round(normals, 4).tobytes())


def _place(matrix: Array, grain: float) -> bytes:
    """Where an occluder stands, seen from the baked object, rounded; its translation to `grain` metres."""
    linear = matrix[:3, :3]
    size = max(float(np.abs(linear).max()), 1e-30)
    rounded = np.concatenate([np.rint(linear / (_SAME * size)).ravel(), np.rint(matrix[:3, 3] / grain)])
    return f"{size:.4g}".encode() + (rounded + 0.0).tobytes()
