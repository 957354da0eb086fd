# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group that shades a bake: albedo * (T . L), T from attributes, L from its sockets."""
from __future__ import annotations

import math

import bpy
from numpy.typing import NDArray

from .attributes import CHANNELS, PREFIX, attribute_count

GROUP_VERSION = 1  # raise it when the group changes; materials in old files keep the group they have
_VERSION, _ORDER = "neural_gash_version", "neural_gash_order"  # custom properties of the group
DEFAULT_ALBEDO = 0.8


def ensure_group(order: int) -> bpy.types.NodeTree:
    """The group `PRT Shading <order>`: made where it is missing or of another version only.

    Inputs Albedo and L0..L{K-1}, one RGB vector for each coefficient of the light; output Shader, an
    emission. Its light is at first a white sky of radiance 1, which shows ambient occlusion.
    """
    for group in bpy.data.node_groups:
        if group.get(_ORDER) == order and group.get(_VERSION) == GROUP_VERSION and group.library is None:
            return group
    group = bpy.data.node_groups.new(f"PRT Shading {order}", "ShaderNodeTree")
    _build(group, order)
    return group


def is_group(group: bpy.types.NodeTree | None) -> bool:
    """Whether a node tree is one of `ensure_group`'s."""
    return group is not None and _ORDER in group


def group_order(group: bpy.types.NodeTree) -> int:
    """The order of one of `ensure_group`'s groups."""
    return int(group[_ORDER])


def set_light(node: bpy.types.ShaderNodeGroup, light: NDArray) -> None:
    """Set the light (K, 3), in the bake frame, on a node of the group. Recompiles no shader."""
    for index, value in enumerate(light.tolist()):
        node.inputs[f"L{index}"].default_value = value


def _build(group: bpy.types.NodeTree, order: int) -> None:
    """Fill the group. K multiply-adds, each of a scalar coefficient and an RGB light vector."""
    terms = order * order
    albedo = group.interface.new_socket("Albedo", in_out="INPUT", socket_type="NodeSocketColor")
    albedo.default_value = (DEFAULT_ALBEDO,) * 3 + (1.0,)
    for index in range(terms):
        socket = group.interface.new_socket(f"L{index}", in_out="INPUT", socket_type="NodeSocketVector")
        socket.default_value = (math.sqrt(4 * math.pi) if index == 0 else 0.0,) * 3
        socket.description = "Light coefficient, RGB; k = l*(l+1)+m"
    group.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")

    def add(kind: str, x: float, y: float) -> bpy.types.Node:
        node = group.nodes.new(kind)
        node.location = (x, y)
        node.hide = True
        return node

    inputs = add("NodeGroupInput", -800, 0)
    total = None
    for index in range(attribute_count(order)):
        attribute = add("ShaderNodeAttribute", -600, -200 * index)
        attribute.attribute_type = "GEOMETRY"
        attribute.attribute_name = f"{PREFIX}{index}"
        split = add("ShaderNodeSeparateColor", -400, -200 * index)
        group.links.new(attribute.outputs["Color"], split.inputs[0])
        coefficients = [*split.outputs, attribute.outputs["Alpha"]]
        for channel, coefficient in enumerate(coefficients[:terms - CHANNELS * index]):
            k = CHANNELS * index + channel
            term = add("ShaderNodeVectorMath", -200, -200 * index - 45 * channel)
            term.operation = "MULTIPLY" if total is None else "MULTIPLY_ADD"
            group.links.new(coefficient, term.inputs[0])
            group.links.new(inputs.outputs[f"L{k}"], term.inputs[1])
            if total is not None:
                group.links.new(total, term.inputs[2])
            total = term.outputs[0]
    coloured = add("ShaderNodeVectorMath", 0, 0)
    coloured.operation = "MULTIPLY"
    group.links.new(inputs.outputs["Albedo"], coloured.inputs[0])
    group.links.new(total, coloured.inputs[1])
    emission = add("ShaderNodeEmission", 200, 0)
    group.links.new(coloured.outputs[0], emission.inputs["Color"])
    outputs = add("NodeGroupOutput", 400, 0)
    group.links.new(emission.outputs[0], outputs.inputs["Shader"])
    group[_ORDER], group[_VERSION] = order, GROUP_VERSION
