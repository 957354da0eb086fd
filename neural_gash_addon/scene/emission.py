# SPDX-License-Identifier: GPL-3.0-or-later
"""What materials emit: Emission and Principled shaders, through Add and Mix Shader."""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from .albedo import Images, by_material, socket_pictures
from .preview import shader_node, surface_socket
from .world import feeding

# sockets of the shaders that emit: colour and strength
_SOCKETS = {"EMISSION": ("Color", "Strength"), "BSDF_PRINCIPLED": ("Emission Color", "Emission Strength")}


def emitters(socket: bpy.types.NodeSocket | None, part: float = 1.0
             ) -> list[tuple[bpy.types.NodeSocket, bpy.types.NodeSocket, float]]:
    """Colour, strength and part of each shader that emits and reaches an input, a material's or a lamp's."""
    output = None if socket is None else feeding(socket)
    if output is None:
        return []
    node = output.node
    if node.type in _SOCKETS:
        colour, strength = (node.inputs[name] for name in _SOCKETS[node.type])
        return [(colour, strength, part)] if strength.is_linked or strength.default_value else []
    if node.type == "ADD_SHADER":
        return emitters(node.inputs[0], part) + emitters(node.inputs[1], part)
    if node.type == "MIX_SHADER":
        second = float(np.clip(_number(node.inputs[0])[0], 0, 1))
        return emitters(node.inputs[1], part * (1 - second)) + emitters(node.inputs[2], part * second)
    return []


def radiance(socket: bpy.types.NodeSocket | None) -> NDArray[np.float64]:
    """(3,) of the shaders that reach an input, W m^-2 sr^-1; what other nodes make counts as its socket's own value."""
    return sum((part * _number(strength)[0] * _number(colour) for colour, strength, part in emitters(socket)),
               np.zeros(3))


def triangle_emission(obj: bpy.types.Object, mesh: bpy.types.Mesh, corners: NDArray[np.int32], known: Images
                      ) -> tuple[NDArray[np.float64], NDArray[np.bool_], list[str]]:
    """Radiance (F, 3) of the triangles with these face corners (F, 3), of images their mean over each.

    Args:
        obj, mesh, corners, known: as `albedo.triangle_finish`.
    Returns:
        It; which of them (F,) only emit, and reflect nothing; and the materials whose emission other nodes make, which
        counts as the value of the socket that they feed.
    """
    out, alone, unread = np.zeros((len(corners), 3)), np.zeros(len(corners), bool), []
    for material, here in by_material(obj, mesh):
        found = emitters(surface_socket(material))
        for colour, strength, part in found:
            channels = np.arange(3)
            pictures = socket_pictures(colour, mesh, corners[here], known, channels, channels, np.ones(3), np.zeros(3))
            shown = pictures[0].lookups().mean(1) if pictures else _number(colour)
            out[here] += part * _number(strength)[0] * shown
            if material is not None and not (_plain(strength) and (pictures or _plain(colour))):
                unread.append(material.name)
        alone[here] = emits_alone(material)
    return out, alone, unread


def emits_alone(material: bpy.types.Material | None) -> bool:
    """Whether a material emits and reflects nothing."""
    return bool(emitters(surface_socket(material))) and shader_node(material) is None


def _number(socket: bpy.types.NodeSocket) -> NDArray[np.float64]:
    """(3,) of an input, a colour or a number."""
    output = feeding(socket)
    source = output if output is not None and output.node.type in ("RGB", "VALUE") else socket
    return np.resize(np.array(source.default_value, float), 4)[:3]


def _plain(socket: bpy.types.NodeSocket) -> bool:
    """Whether `_number` is all that there is to an input."""
    output = feeding(socket)
    return output is None or output.node.type in ("RGB", "VALUE")
