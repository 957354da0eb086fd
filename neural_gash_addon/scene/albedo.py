# SPDX-License-Identifier: GPL-3.0-or-later
"""How an object's triangles reflect, from the base colours of its materials, their metal and their roughness."""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import UserError
from ..backend.texels import bilinear
from .gloss_nodes import SPECULAR
from .nodes import DEFAULT_ALBEDO
from .preview import COLOUR_SOCKETS, DEFAULT_ROUGHNESS, shader_node, shown_material
from .world import linear_pixels

# where in a triangle an image is looked up: its centre and half-way to its corners
_PLACES = np.array([[4, 4, 4], [8, 2, 2], [2, 8, 2], [2, 2, 8]]) / 12


def triangle_finish(obj: bpy.types.Object, mesh: bpy.types.Mesh, corners: NDArray[np.int32]) -> NDArray[np.float64]:
    """(F, 7) of the triangles with these face corners (F, 3): albedo, specular colour (linear) and roughness.

    A plain colour or an image by UV counts; where other nodes make the colour, the socket's own value
    does. What is metallic reflects nothing diffusely, and mirrors its colour.

    Args:
        obj: evaluated, or not. mesh: its geometry, whose loop triangles have been computed.
    """
    polygons = np.empty(len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("polygon_index", polygons)
    slots = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("material_index", slots)
    materials = [shown_material(slot.material.original if slot.material else None) for slot in obj.material_slots]
    slot_of = np.clip(slots[polygons], 0, max(len(materials) - 1, 0))
    out = np.empty((len(corners), 7))
    out[:] = _finish(None, mesh, corners)
    for number, material in enumerate(materials):
        here = slot_of == number
        if here.any():
            out[here] = _finish(material, mesh, corners[here])
    return np.clip(np.nan_to_num(out), 0, 1)


def _finish(material: bpy.types.Material | None, mesh: bpy.types.Mesh, corners: NDArray) -> NDArray[np.float64]:
    """(f, 7) of one material."""
    node = shader_node(material)
    out = np.empty((len(corners), 7))
    metallic, out[:, 6] = 0.0, DEFAULT_ROUGHNESS
    if node is None:
        out[:, :3] = DEFAULT_ALBEDO if material is None else material.diffuse_color[:3]
    else:
        out[:, :3] = _value(node.inputs[COLOUR_SOCKETS[node.type]], mesh, corners)
        if "Metallic" in node.inputs and not node.inputs["Metallic"].is_linked:
            metallic = node.inputs["Metallic"].default_value
        if "Roughness" in node.inputs:
            out[:, 6] = _value(node.inputs["Roughness"], mesh, corners)[..., :1].mean(-1)
    out[:, 3:6] = SPECULAR + metallic * (out[:, :3] - SPECULAR)
    out[:, :3] *= 1 - metallic
    return out


def _value(socket: bpy.types.NodeSocket, mesh: bpy.types.Mesh, corners: NDArray) -> NDArray[np.float64]:
    """(3,) or (f, 3) of an input, a colour or a number."""
    own = np.resize(np.array(socket.default_value, float), 4)[:3]
    source = socket.links[0].from_node if socket.is_linked else None
    if source is not None and source.type == "RGB":
        return np.array(source.outputs[0].default_value[:3])
    if source is not None and source.type == "TEX_IMAGE" and source.image is not None:
        layer = _uv_layer(source, mesh)
        if layer is not None:
            try:
                pixels = linear_pixels(source.image)[..., :3]
            except UserError:
                return own  # pink on screen, too
            uv = np.empty((len(layer.uv), 2), np.float32)
            layer.uv.foreach_get("vector", uv.ravel())
            places = np.einsum("pc,fcx->fpx", _PLACES, uv[corners])
            pixels = np.nan_to_num(pixels)
            return bilinear(pixels, places.reshape(-1, 2)).reshape(len(corners), len(_PLACES), 3).mean(1)
    return own


def _uv_layer(texture: bpy.types.Node, mesh: bpy.types.Mesh) -> bpy.types.MeshUVLoopLayer | None:
    """The UV map that an Image Texture node reads; None where its mapping is made otherwise."""
    if texture.inputs["Vector"].is_linked:
        node = texture.inputs["Vector"].links[0].from_node
        if node.type == "UVMAP" and node.uv_map:
            return mesh.uv_layers.get(node.uv_map)
        if node.type != "UVMAP" and not (node.type == "TEX_COORD"
                                         and texture.inputs["Vector"].links[0].from_socket.name == "UV"):
            return None
    return next((layer for layer in mesh.uv_layers if layer.active_render), None)
