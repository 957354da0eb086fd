# SPDX-License-Identifier: GPL-3.0-or-later
"""The tangent-space normal maps of an object's materials, for bakes to textures."""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import UserError
from ..backend.geometry import Surface
from ..backend.texels import NormalMap
from .albedo import image_uv
from .evaluation import evaluated
from .frames import Array
from .preview import shader_node, shown_material
from .uv_maps import own_uv_name
from .world import feeding, linear_pixels

_STEEPEST = 1e3  # of what a normal map says: far beyond 0 to 1
_KEY_SIDE = 256  # of the pixels that tell one image from another


def read_normal_maps(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, surface: Surface, matrix: Array
                     ) -> list[NormalMap]:
    """What the Normal Map nodes of the object's materials say, as far as a bake can follow them.

    Args:
        surface, matrix: the object as it was read for the bake.
    Raises:
        UserError: a normal map's image or UV map cannot be read.
    """
    materials = [shown_material(slot.material) for slot in obj.material_slots]
    found = [(slot, material, *nodes) for slot, material in enumerate(materials)
             if material is not None and (nodes := _normal_nodes(material)) is not None]
    if not found:
        return []
    slots = np.zeros(int(surface.corner_faces.max()) + 1, np.int32)
    maps = []
    with evaluated(obj, depsgraph) as copy:
        mesh = copy.to_mesh()
        try:
            mesh.polygons.foreach_get("material_index", slots)
            slots = np.clip(slots, 0, len(materials) - 1)
            for slot, material, node, texture in found:
                name = node.uv_map or _rendered_uv(obj.data)
                if name not in obj.data.uv_layers:
                    wanted = f"reads the UV map '{name}'" if name else "needs a UV map"
                    raise UserError(f"The normal map of the material '{material.name}' "
                                    f"{wanted}, which '{obj.name}' does not have.")
                pixels, uv = _pixels(material, texture), image_uv(texture, mesh)
                if uv is None:
                    continue  # it is not looked up by UV
                maps.append(NormalMap(pixels, float(node.inputs["Strength"].default_value),
                                      slots[surface.polygons] == slot, uv, _tangents(obj.name, mesh, name, matrix),
                                      texture.extension))
        finally:
            copy.to_mesh_clear()
    return maps


def normal_map_key(obj: bpy.types.Object) -> bytes:
    """What tells the normal maps of an object from others: their settings, and every so many of their pixels."""
    parts = []
    for slot, material in enumerate(shown_material(slot.material) for slot in obj.material_slots):
        nodes = _normal_nodes(material) if material is not None else None
        if nodes is None:
            continue
        node, texture = nodes
        parts.append(repr((slot, round(node.inputs["Strength"].default_value, 4), node.uv_map)).encode())
        try:
            pixels = _pixels(material, texture)
        except UserError:
            continue  # a bake says so
        step = -(-max(pixels.shape[:2]) // _KEY_SIDE)
        parts.append(np.rint(pixels[::step, ::step] * 255).astype(np.int32).tobytes())
    return b"".join(parts)


def _normal_nodes(material: bpy.types.Material) -> tuple[bpy.types.Node, bpy.types.Node] | None:
    """The Normal Map node that feeds the shader of a material and its Image Texture node; None where it has none."""
    shader = shader_node(material)
    normal = feeding(shader.inputs["Normal"]) if shader is not None else None
    if normal is None or normal.node.type != "NORMAL_MAP":
        return None
    node = normal.node
    colour = feeding(node.inputs["Color"])
    if node.space != "TANGENT" or node.inputs["Strength"].is_linked or colour is None:
        return None
    return (node, colour.node) if colour.node.type == "TEX_IMAGE" and colour.name == "Color" else None


def _pixels(material: bpy.types.Material, texture: bpy.types.Node) -> NDArray[np.float32]:
    """(H, W, 3) of an Image Texture node."""
    if texture.image is None:
        raise UserError(f"The normal map of the material '{material.name}' has no image.")
    try:
        pixels = np.nan_to_num(linear_pixels(texture.image)[..., :3], nan=0.5)  # a half in all channels bends nothing
    except UserError as error:
        raise UserError(f"The normal map of the material '{material.name}' cannot be read: {error}") from error
    return np.ascontiguousarray(np.clip(pixels, -_STEEPEST, _STEEPEST))


def _rendered_uv(data: bpy.types.Mesh) -> str:
    """Name of the UV map of the person's that renders use where none is named; '' where there is none."""
    return next((layer.name for layer in data.uv_layers
                 if layer.active_render and layer.name != own_uv_name(data)), "")


def _tangents(name: str, mesh: bpy.types.Mesh, uv_map: str, matrix: Array) -> NDArray[np.float32]:
    """(C, 4) MikkTSpace tangents in world axes, and the signs of their bitangents there."""
    try:
        mesh.calc_tangents(uvmap=uv_map)
    except RuntimeError as error:
        raise UserError(f"'{name}' has faces of more than four corners, for which Blender computes no tangents; "
                        "triangulate them to bake with a normal map.") from error
    out = np.empty((len(mesh.loops), 4), np.float32)
    directions, signs = np.empty((len(mesh.loops), 3), np.float32), np.empty(len(mesh.loops), np.float32)
    mesh.loops.foreach_get("tangent", directions.ravel())
    mesh.loops.foreach_get("bitangent_sign", signs)
    linear = matrix[:3, :3]
    turned = directions @ linear.T
    out[:, :3] = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)
    out[:, 3] = signs * np.sign(np.linalg.det(linear))
    return out
