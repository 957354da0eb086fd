# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group that shades a bake: albedo * (T . L), T from attributes or images, L from its sockets.

With lamps, albedo * E / pi is added, E from one more attribute or image, and what the material itself emits.
"""
from __future__ import annotations

import math
from collections.abc import Sequence

import bpy
from numpy.typing import NDArray

from .attributes import LAMPS, PREFIX, attribute_count

GROUP_VERSION = 3  # raise it when the group changes; materials in old files keep the group they have
# custom properties of the group
_VERSION, _ORDER, _COLOURS, _LAMPS = ("neural_gash_version", "neural_gash_order", "neural_gash_colours",
                                      "neural_gash_lamps")
DEFAULT_ALBEDO = 0.8


def ensure_group(order: int, colours: int = 1, images: Sequence[bpy.types.Image] = (), uv_map: str = "",
                 lamps: bool = False) -> bpy.types.NodeTree:
    """The group `PRT Shading <order>`: made where it is missing or of another version only.

    Inputs Albedo, Tint (how much of the albedo is seen, 0 to 1) and L0..L{K-1}, one RGB vector for each
    coefficient of the light; output Shader, an emission. Its light is at first a white sky of radiance 1, which
    shows ambient occlusion.

    Args:
        colours: 3 where each coefficient has a red, a green and a blue.
        images, uv_map: where the coefficients of a texture bake are; such a group is of that bake alone.
        lamps: it adds the irradiance of the bake, whose image is the last of `images`. Then there are inputs Lamps, a
            factor on their light, and Glow, radiance that the surface emits by itself, which the factor is on, too.
    """
    place = [image.session_uid for image in images]
    for group in bpy.data.node_groups:
        if (is_group(group) and group.get(_VERSION) == GROUP_VERSION and group.library is None
                and group_terms(group) == (order, colours, lamps) and _place(group) == (place, uv_map)):
            return group
    group = bpy.data.node_groups.new(f"PRT Shading {order}", "ShaderNodeTree")
    _build(group, order, colours,
           _images(group, images, uv_map) if images else _attributes(group, order ** 2 * colours, lamps), lamps)
    return group


def _place(group: bpy.types.NodeTree) -> tuple[list[int], str]:
    """Images (session uids) and UV map that a group reads."""
    images = [n.image.session_uid if n.image else 0 for n in group.nodes if n.type == "TEX_IMAGE"]
    return images, next((n.uv_map for n in group.nodes if n.type == "UVMAP"), "")


def is_group(group: bpy.types.NodeTree | None) -> bool:
    """Whether a node tree is one of `ensure_group`'s."""
    return group is not None and _ORDER in group


def group_terms(group: bpy.types.NodeTree) -> tuple[int, int, bool]:
    """Order and colours of one of `ensure_group`'s groups, and whether it has lamps; zeros where inputs are gone."""
    lamps = bool(group.get(_LAMPS, False))
    if not {f"L{int(group[_ORDER]) ** 2 - 1}", *(["Lamps", "Glow"] if lamps else [])} <= {
            *group.interface.items_tree.keys()}:
        return 0, 0, False
    return int(group[_ORDER]), int(group.get(_COLOURS, 1)), lamps


def set_light(node: bpy.types.ShaderNodeGroup, light: NDArray, tint: float = 1.0, lamps: float = 1.0) -> None:
    """Set the light (K, 3), in the bake frame, on a node of the group, how much of the albedo is seen, and a factor on
    the lamps.

    Recompiles no shader. Groups in files from before version 3 show all of the albedo.
    """
    if "Tint" in node.inputs:
        node.inputs["Tint"].default_value = tint
    if "Lamps" in node.inputs:
        node.inputs["Lamps"].default_value = lamps
    for index, value in enumerate(light.tolist()):
        node.inputs[f"L{index}"].default_value = value


Sources = list[tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]]  # colour and alpha: four coefficients


def _add(group: bpy.types.NodeTree, kind: str, x: float, y: float) -> bpy.types.Node:
    node = group.nodes.new(kind)
    node.location = (x, y)
    node.hide = True
    return node


def _attributes(group: bpy.types.NodeTree, terms: int, lamps: bool) -> Sources:
    """Nodes that read the attributes of a bake to vertices."""
    sources = []
    names = [f"{PREFIX}{index}" for index in range(attribute_count(terms))] + ([LAMPS] if lamps else [])
    for index, name in enumerate(names):
        attribute = _add(group, "ShaderNodeAttribute", -600, -200 * index)
        attribute.attribute_type = "GEOMETRY"
        attribute.attribute_name = name
        sources.append((attribute.outputs["Color"], attribute.outputs["Alpha"]))
    return sources


def _images(group: bpy.types.NodeTree, images: Sequence[bpy.types.Image], uv_map: str) -> Sources:
    """Nodes that read the images of a texture bake."""
    uv = _add(group, "ShaderNodeUVMap", -900, 0)
    uv.uv_map = uv_map
    sources = []
    for index, image in enumerate(images):
        texture = _add(group, "ShaderNodeTexImage", -650, -200 * index)
        texture.image, texture.interpolation, texture.extension = image, "Linear", "EXTEND"
        group.links.new(uv.outputs["UV"], texture.inputs["Vector"])
        sources.append((texture.outputs["Color"], texture.outputs["Alpha"]))
    return sources


def _build(group: bpy.types.NodeTree, order: int, colours: int, sources: Sources, lamps: bool) -> None:
    """Fill the group. K multiply-adds, each of a coefficient (a number, or RGB) and an RGB light vector."""
    terms = order * order
    albedo = group.interface.new_socket("Albedo", in_out="INPUT", socket_type="NodeSocketColor")
    albedo.default_value = (DEFAULT_ALBEDO,) * 3 + (1.0,)
    tint = group.interface.new_socket("Tint", in_out="INPUT", socket_type="NodeSocketFloat")
    tint.subtype, tint.default_value, tint.min_value, tint.max_value = "FACTOR", 1.0, 0.0, 1.0
    tint.description = "How much of the albedo is seen; 0 shows what the bake holds, as on white"
    for index in range(terms):
        socket = group.interface.new_socket(f"L{index}", in_out="INPUT", socket_type="NodeSocketVector")
        socket.default_value = (math.sqrt(4 * math.pi) if index == 0 else 0.0,) * 3
        socket.description = "Light coefficient, RGB; k = l*(l+1)+m"
    if lamps:
        factor = group.interface.new_socket("Lamps", in_out="INPUT", socket_type="NodeSocketFloat")
        factor.default_value, factor.min_value = 1.0, 0.0
        factor.description = "Factor on the light of lamps, and on what the material emits"
        glow = group.interface.new_socket("Glow", in_out="INPUT", socket_type="NodeSocketColor")
        glow.default_value, glow.description = (0.0, 0.0, 0.0, 1.0), "Radiance that the material emits"
    group.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    inputs = _add(group, "NodeGroupInput", -800, 300)
    numbers: list[bpy.types.NodeSocket] = []
    for index, (colour, alpha) in enumerate(sources[:-1] if lamps else sources):
        split = _add(group, "ShaderNodeSeparateColor", -400, -200 * index)
        group.links.new(colour, split.inputs[0])
        numbers += [*split.outputs, alpha]
    total = None
    for k in range(terms):
        coefficient = numbers[k]
        if colours == 3:
            joined = _add(group, "ShaderNodeCombineXYZ", -300, -50 * k)
            for channel in range(3):
                group.links.new(numbers[3 * k + channel], joined.inputs[channel])
            coefficient = joined.outputs[0]
        term = _add(group, "ShaderNodeVectorMath", -200, -50 * k)
        term.operation = "MULTIPLY" if total is None else "MULTIPLY_ADD"
        group.links.new(coefficient, term.inputs[0])
        group.links.new(inputs.outputs[f"L{k}"], term.inputs[1])
        if total is not None:
            group.links.new(total, term.inputs[2])
        total = term.outputs[0]
    if lamps:  # irradiance over pi
        over_pi = _add(group, "ShaderNodeMath", -300, 100)
        over_pi.operation = "MULTIPLY"
        over_pi.inputs[1].default_value = 1 / math.pi
        group.links.new(inputs.outputs["Lamps"], over_pi.inputs[0])
        total = _multiply_add(group, sources[-1][0], over_pi.outputs[0], total)
    tinted = _add(group, "ShaderNodeMix", -200, 200)
    tinted.data_type = "RGBA"
    tinted.inputs[6].default_value = (1.0,) * 4
    group.links.new(inputs.outputs["Tint"], tinted.inputs[0])
    group.links.new(inputs.outputs["Albedo"], tinted.inputs[7])
    coloured = _add(group, "ShaderNodeVectorMath", 0, 0)
    coloured.operation = "MULTIPLY"
    group.links.new(tinted.outputs[2], coloured.inputs[0])
    group.links.new(total, coloured.inputs[1])
    shaded = coloured.outputs[0]
    if lamps:
        shaded = _multiply_add(group, inputs.outputs["Glow"], inputs.outputs["Lamps"], shaded)
    emission = _add(group, "ShaderNodeEmission", 200, 0)
    group.links.new(shaded, emission.inputs["Color"])
    outputs = _add(group, "NodeGroupOutput", 400, 0)
    group.links.new(emission.outputs[0], outputs.inputs["Shader"])
    group[_ORDER], group[_VERSION], group[_COLOURS] = order, GROUP_VERSION, colours
    group[_LAMPS] = lamps


def _multiply_add(group: bpy.types.NodeTree, *sockets: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """The first times the second, and the third."""
    node = _add(group, "ShaderNodeVectorMath", 0, 100)
    node.operation = "MULTIPLY_ADD"
    for source, target in zip(sockets, node.inputs, strict=False):
        group.links.new(source, target)
    return node.outputs[0]
