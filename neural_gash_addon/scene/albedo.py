# SPDX-License-Identifier: GPL-3.0-or-later
"""How an object's triangles reflect, from the base colours of its materials, their metal and their roughness."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..backend.errors import UserError
from ..backend.pictures import Picture
from .gloss_nodes import SPECULAR
from .nodes import DEFAULT_ALBEDO
from .preview import DEFAULT_ROUGHNESS, shown_material
from .shaders import COLOUR_SOCKETS, shader_node
from .uv_maps import own_uv_name
from .world import feeding, linear_pixels

Finish = tuple[NDArray[np.float64], list[Picture]]  # (F, 7) of triangles, and images that say it from place to place
Images = dict[int, NDArray[np.float32]]  # session uid of an image -> (H, W, 3) scene-linear


def triangle_finish(obj: bpy.types.Object, mesh: bpy.types.Mesh, corners: NDArray[np.int32], known: Images) -> Finish:
    """Of the triangles with these face corners (F, 3): albedo, specular colour (linear) and roughness (F, 7).

    A plain colour or an image by UV counts; where other nodes make the colour, the socket's own value
    does. What is metallic reflects nothing diffusely, and mirrors its colour.

    Args:
        obj: evaluated, or not. mesh: its geometry, whose loop triangles have been computed.
        known: images that have been read, to which others are added: many objects may share a large one.
    Returns:
        The means over each triangle, and the images.
    """
    out, pictures = np.empty((len(corners), 7)), []
    for material, here in by_material(obj, mesh):
        out[here], found = _finish(material, mesh, corners[here], known)
        pictures += [replace(picture, triangles=here) for picture in found]
    out = np.clip(np.nan_to_num(out), 0, 1)
    for picture in pictures:
        out[picture.triangles[:, None], picture.columns] = picture.lookups().mean(1)
    return out, pictures


def by_material(obj: bpy.types.Object, mesh: bpy.types.Mesh
                ) -> Iterator[tuple[bpy.types.Material | None, NDArray[np.int64]]]:
    """Each material of an object, as `triangle_finish` has it, and its triangles (f,), where it has any."""
    polygons = np.empty(len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("polygon_index", polygons)
    slots = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("material_index", slots)
    # not the original of a preview's: a frame handler may have removed it, while what is evaluated still names it
    shown = [shown_material(slot.material) for slot in obj.material_slots]
    materials = [material and material.original for material in shown]
    slot_of = np.clip(slots[polygons], 0, max(len(materials) - 1, 0))
    for number, material in enumerate(materials or [None]):
        here = np.flatnonzero(slot_of == number)
        if len(here):
            yield material, here


def _finish(material: bpy.types.Material | None, mesh: bpy.types.Mesh, corners: NDArray, known: Images) -> Finish:
    """(7,) of one material, and the images that say it better, of these triangles (f, 3)."""
    node = shader_node(material)
    out, pictures = np.empty(7), []
    metallic, out[6] = 0.0, DEFAULT_ROUGHNESS
    if node is None:
        out[:3] = DEFAULT_ALBEDO if material is None else material.diffuse_color[:3]
    else:
        socket = node.inputs[COLOUR_SOCKETS[node.type]]
        out[:3] = _value(socket)
        if "Metallic" in node.inputs and not node.inputs["Metallic"].is_linked:
            metallic = float(np.clip(np.nan_to_num(node.inputs["Metallic"].default_value), 0, 1))
        pictures = socket_pictures(socket, mesh, corners, known, np.arange(6), np.arange(6) % 3,
                                   np.repeat([1 - metallic, metallic], 3),
                                   np.repeat([0.0, SPECULAR * (1 - metallic)], 3))
        if "Roughness" in node.inputs:
            out[6] = _value(node.inputs["Roughness"])[0]
            pictures += socket_pictures(node.inputs["Roughness"], mesh, corners, known, *np.array([[6], [0], [1], [0]]))
    out[3:6] = SPECULAR + metallic * (out[:3] - SPECULAR)
    out[:3] *= 1 - metallic
    return out, pictures


def _value(socket: bpy.types.NodeSocket) -> NDArray[np.float64]:
    """(3,) of an input, a colour or a number."""
    output = feeding(socket)
    if output is not None and output.node.type == "RGB":
        return np.array(output.default_value[:3])
    return np.resize(np.array(socket.default_value, float), 4)[:3]


def socket_pictures(socket: bpy.types.NodeSocket, mesh: bpy.types.Mesh, corners: NDArray, known: Images,
                    columns: NDArray, channels: NDArray, gain: NDArray, offset: NDArray) -> list[Picture]:
    """The image that an input takes its value from by UV, if it does."""
    output = feeding(socket)
    source = output.node if output is not None and output.name == "Color" else None
    if source is None or source.type != "TEX_IMAGE" or source.image is None:
        return []
    uv = image_uv(source, mesh)
    if uv is None:
        return []
    uid = source.image.session_uid
    try:
        if uid not in known:
            known[uid] = np.nan_to_num(linear_pixels(source.image)[..., :3])
    except UserError:
        return []  # pink on screen, or not one image
    return [Picture(np.arange(len(corners)), uv[corners], known[uid], columns, channels, gain, offset,
                    source.extension)]


def image_uv(texture: bpy.types.Node, mesh: bpy.types.Mesh) -> NDArray[np.float64] | None:
    """(C, 2) at which each face corner has an Image Texture node looked up; None where no UV map says it."""
    if texture.projection != "FLAT":
        return None
    output = feeding(texture.inputs["Vector"])
    placing: NDArray | None = np.eye(4)
    if output is not None and output.node.type == "MAPPING":
        placing = _placing(output.node)
        output = feeding(output.node.inputs["Vector"])
        if output is None:
            return None
    layer = _uv_layer(output, mesh)
    if layer is None or placing is None:
        return None
    uv = np.empty((len(layer.uv), 2), np.float32)
    layer.uv.foreach_get("vector", uv.ravel())
    found: NDArray[np.float64] = np.where(np.isfinite(uv), uv, 0) @ placing[:2, :2].T + placing[:2, 3]
    return found


def _placing(mapping: bpy.types.Node) -> NDArray[np.float64] | None:
    """(4, 4) of a Mapping node; None where it is none that numbers make."""
    if mapping.vector_type not in ("POINT", "TEXTURE") or any(socket.is_linked for socket in mapping.inputs[1:]):
        return None
    location, rotation, scale = (mapping.inputs[name] for name in ("Location", "Rotation", "Scale"))
    matrix = np.array(Matrix.LocRotScale(location.default_value, rotation.default_value, scale.default_value))
    if not np.isfinite(matrix).all():
        return None
    if mapping.vector_type == "POINT":
        return matrix
    return np.linalg.inv(matrix) if np.linalg.det(matrix) else None


def _uv_layer(output: bpy.types.NodeSocket | None, mesh: bpy.types.Mesh) -> bpy.types.MeshUVLoopLayer | None:
    """The UV map that an output gives, or that serves where none is linked; None where it gives something else."""
    if output is not None:
        if output.node.type == "UVMAP" and output.node.uv_map:
            return mesh.uv_layers.get(output.node.uv_map)
        if output.node.type != "UVMAP" and not (output.node.type == "TEX_COORD" and output.name == "UV"):
            return None
    own = own_uv_name(mesh)  # the rendered one only where the person has none: was not there when it was baked
    return next((layer for layer in mesh.uv_layers if layer.active_render and layer.name != own), None)
