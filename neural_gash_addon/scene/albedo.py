# SPDX-License-Identifier: GPL-3.0-or-later
"""How an object's triangles reflect, from the base colours of its materials, their metal and their roughness."""
from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import UserError
from ..backend.pictures import Picture
from .gloss_nodes import SPECULAR
from .nodes import DEFAULT_ALBEDO
from .preview import COLOUR_SOCKETS, DEFAULT_ROUGHNESS, shader_node, shown_material
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
    polygons = np.empty(len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("polygon_index", polygons)
    slots = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("material_index", slots)
    materials = [shown_material(slot.material.original if slot.material else None) for slot in obj.material_slots]
    slot_of = np.clip(slots[polygons], 0, max(len(materials) - 1, 0))
    out, pictures = np.empty((len(corners), 7)), []
    for number, material in enumerate(materials or [None]):
        here = np.flatnonzero(slot_of == number)
        if len(here):
            out[here], found = _finish(material, mesh, corners[here], known)
            pictures += [replace(picture, triangles=here) for picture in found]
    out = np.clip(np.nan_to_num(out), 0, 1)
    for picture in pictures:
        out[picture.triangles[:, None], picture.columns] = picture.lookups().mean(1)
    return out, pictures


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
        pictures = _pictures(socket, mesh, corners, known, np.arange(6), np.arange(6) % 3,
                             np.repeat([1 - metallic, metallic], 3), np.repeat([0.0, SPECULAR * (1 - metallic)], 3))
        if "Roughness" in node.inputs:
            out[6] = _value(node.inputs["Roughness"])[0]
            pictures += _pictures(node.inputs["Roughness"], mesh, corners, known, *np.array([[6], [0], [1], [0]]))
    out[3:6] = SPECULAR + metallic * (out[:3] - SPECULAR)
    out[:3] *= 1 - metallic
    return out, pictures


def _value(socket: bpy.types.NodeSocket) -> NDArray[np.float64]:
    """(3,) of an input, a colour or a number."""
    output = feeding(socket)
    if output is not None and output.node.type == "RGB":
        return np.array(output.default_value[:3])
    return np.resize(np.array(socket.default_value, float), 4)[:3]


def _pictures(socket: bpy.types.NodeSocket, mesh: bpy.types.Mesh, corners: NDArray, known: Images,
              columns: NDArray, channels: NDArray, gain: NDArray, offset: NDArray) -> list[Picture]:
    """The image that an input takes its value from by UV, if it does."""
    output = feeding(socket)
    source = output.node if output is not None and output.name == "Color" else None
    if source is None or source.type != "TEX_IMAGE" or source.image is None or source.projection != "FLAT":
        return []
    layer = _uv_layer(source, mesh)
    if layer is None:
        return []
    uid = source.image.session_uid
    try:
        if uid not in known:
            known[uid] = np.nan_to_num(linear_pixels(source.image)[..., :3])
    except UserError:
        return []  # pink on screen, too
    uv = np.empty((len(layer.uv), 2), np.float32)
    layer.uv.foreach_get("vector", uv.ravel())
    return [Picture(np.arange(len(corners)), uv[corners].astype(np.float64), known[uid], columns, channels, gain,
                    offset)]


def _uv_layer(texture: bpy.types.Node, mesh: bpy.types.Mesh) -> bpy.types.MeshUVLoopLayer | None:
    """The UV map that an Image Texture node reads; None where its mapping is made otherwise."""
    output = feeding(texture.inputs["Vector"])
    if output is not None:
        node = output.node
        if node.type == "UVMAP" and node.uv_map:
            return mesh.uv_layers.get(node.uv_map)
        if node.type != "UVMAP" and not (node.type == "TEX_COORD" and output.name == "UV"):
            return None
    own = own_uv_name(mesh)  # the rendered one only where the person has none: was not there when it was baked
    return next((layer for layer in mesh.uv_layers if layer.active_render and layer.name != own), None)
