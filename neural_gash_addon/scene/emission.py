# SPDX-License-Identifier: GPL-3.0-or-later
"""What materials and lamps emit, as numbers and in previews: Emission and Principled shaders, added and mixed."""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from .shaders import shader_node, surface_socket
from .world import feeding

# sockets of the shaders that emit: colour and strength
_SOCKETS = {"EMISSION": ("Color", "Strength"), "BSDF_PRINCIPLED": ("Emission Color", "Emission Strength")}

Emitter = tuple[bpy.types.NodeSocket, bpy.types.NodeSocket, float]  # colour, strength, and its part of the surface


def emitters(socket: bpy.types.NodeSocket | None, part: float = 1.0) -> list[Emitter]:
    """The shaders that emit and reach an input, a material's or a lamp's."""
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
        second = float(np.clip(number(node.inputs[0])[0], 0, 1))
        return emitters(node.inputs[1], part * (1 - second)) + emitters(node.inputs[2], part * second)
    return []


def radiance(found: list[Emitter]) -> NDArray[np.float64]:
    """(3,) of some shaders, W m^-2 sr^-1; what other nodes make counts as its socket's own value."""
    return sum((part * number(strength)[0] * number(colour) for colour, strength, part in found), np.zeros(3))


def set_glow(shading: bpy.types.ShaderNodeGroup, found: list[Emitter]) -> None:
    """Have the node of a preview add what some shaders of its material emit; one whose colour is made by nodes, so."""
    shading.inputs["Glow"].default_value = (*radiance(found), 1.0)
    if len(found) == 1 and not plain(found[0][0]):
        colour, strength, part = found[0]
        tree = shading.id_data
        scaled = tree.nodes.new("ShaderNodeVectorMath")
        scaled.operation = "SCALE"
        scaled.inputs["Scale"].default_value = part * number(strength)[0]
        tree.links.new(colour.links[0].from_socket, scaled.inputs[0])
        tree.links.new(scaled.outputs[0], shading.inputs["Glow"])


def emits_alone(material: bpy.types.Material | None) -> bool:
    """Whether a material emits and reflects nothing."""
    return bool(emitters(surface_socket(material))) and shader_node(material) is None


def number(socket: bpy.types.NodeSocket) -> NDArray[np.float64]:
    """(3,) of an input, a colour or a number."""
    output = feeding(socket)
    source = output if output is not None and output.node.type in ("RGB", "VALUE") else socket
    return np.resize(np.array(source.default_value, float), 4)[:3]


def plain(socket: bpy.types.NodeSocket) -> bool:
    """Whether `number` is all that there is to an input."""
    output = feeding(socket)
    return output is None or output.node.type in ("RGB", "VALUE")
