# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group of a glossy preview: what depends on the view. What depends on the light alone is in its images.

The images hold, for each texel, diffuse radiance and the K coefficients of incoming light times
visibility times cosine (PRTT, section 3; `backend.gloss`), in red, green and blue. The group turns
the mirrored view direction into the frame of the bake, evaluates the harmonics there, damps their
bands by the material's roughness, and adds them up.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np

from ..backend import lobes
from ..backend import spherical_harmonics as sh
from ..backend.texture import CHANNELS

_GLOSS, _VERSION = "neural_gash_gloss", 2   # custom property of the group: its version
_LOBES = "neural_gash_lobes"                # custom property of the image of attenuation by roughness: its lobe
_LOBE_STEPS = 1024
SPECULAR = 0.04                             # reflectance of a plain dielectric, facing

Socket = Any  # bpy.types.NodeSocket, which has no types to check


def is_gloss(group: bpy.types.NodeTree | None) -> bool:
    """Whether a node tree is one of `build_gloss_group`'s."""
    return group is not None and _GLOSS in group


def gloss_image_count(order: int) -> int:
    """Images for K coefficients and the diffuse radiance, each of three colours."""
    return -(-3 * (order * order + 1) // CHANNELS)


def gloss_images(group: bpy.types.NodeTree) -> list[bpy.types.Image]:
    """The images that a group reads, in their order."""
    return [node.image for node in group.nodes if node.type == "TEX_IMAGE" and node.image and _LOBES not in node.image]


def lobe_of(group: bpy.types.NodeTree) -> str:
    """The lobe that a group's material has."""
    found = {node.image[_LOBES] for node in group.nodes if node.type == "TEX_IMAGE" and node.image
             and _LOBES in node.image}
    return lobes.PHONG if lobes.PHONG in found else lobes.GGX


def build_gloss_group(order: int, images: Sequence[bpy.types.Image], uv_map: str, lobe: str = lobes.GGX
                      ) -> bpy.types.NodeTree:
    """A new group for one bake.

    Inputs: Albedo and Specular (colours), Roughness, Turn X, Y, Z: rows of the turn into the
    frame of the bake, and Lamps and Glow, as `nodes.ensure_group` has them. Output Shader, an emission.
    """
    group = bpy.data.node_groups.new(f"PRT Gloss {order}", "ShaderNodeTree")
    group[_GLOSS] = _VERSION
    interface = group.interface
    for name, kind in (("Albedo", "Color"), ("Specular", "Color"), ("Roughness", "Float"),
                       ("Turn X", "Vector"), ("Turn Y", "Vector"), ("Turn Z", "Vector"), ("Lamps", "Float"),
                       ("Glow", "Color")):
        socket = interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
        if name == "Glow":
            socket.default_value = (0, 0, 0, 1)
    interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    graph = _Graph(group)
    inputs = graph.node("NodeGroupInput").outputs
    numbers = _numbers(graph, images, uv_map)
    direction = _mirrored(graph, inputs)
    bands = _attenuation(graph, inputs["Roughness"], order, lobe)
    total: Socket | None = None
    for k, value in enumerate(_harmonics(graph, direction, order)):
        damped = graph.math("MULTIPLY", value, bands[math.isqrt(k)])
        total = graph.add_scaled(graph.join(numbers[3 * k + 3:3 * k + 6]), damped, total)
    glossy = graph.vector("MULTIPLY", total, inputs["Specular"])
    diffuse = graph.vector("MULTIPLY", graph.join(numbers[:3]), inputs["Albedo"])
    emission = graph.node("ShaderNodeEmission")
    reflected = graph.vector("ADD", glossy, diffuse)
    group.links.new(graph.vector("MULTIPLY_ADD", inputs["Glow"], inputs["Lamps"], reflected), emission.inputs["Color"])
    group.links.new(emission.outputs[0], graph.node("NodeGroupOutput").inputs["Shader"])
    return group


class _Graph:
    """Short words for making nodes."""

    def __init__(self, group: bpy.types.NodeTree) -> None:
        self.group = group

    def node(self, kind: str) -> bpy.types.Node:
        """A new node."""
        node = self.group.nodes.new(kind)
        node.location = (180 * (len(self.group.nodes) // 20), -40 * (len(self.group.nodes) % 20))
        node.hide = True
        return node

    def _fill(self, node: bpy.types.Node, values: Sequence[Socket | float | None]) -> None:
        for socket, value in zip(node.inputs, values, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.group.links.new(value, socket)
            elif value is not None:
                socket.default_value = value

    def math(self, operation: str, *values: Socket | float) -> Socket:
        """A number from numbers."""
        node = self.node("ShaderNodeMath")
        node.operation = operation
        self._fill(node, values)
        return node.outputs[0]

    def vector(self, operation: str, *values: Socket | None) -> Socket:
        """A vector (or a number, for a dot product) from vectors."""
        node = self.node("ShaderNodeVectorMath")
        node.operation = operation
        self._fill(node, values)
        return node.outputs["Value" if operation == "DOT_PRODUCT" else "Vector"]

    def add_scaled(self, vector: Socket, factor: Socket, total: Socket | None) -> Socket:
        """total + factor * vector."""
        return self.vector("MULTIPLY_ADD" if total is not None else "MULTIPLY", vector, factor, total)

    def join(self, numbers: Sequence[Socket]) -> Socket:
        """A vector of three numbers."""
        node = self.node("ShaderNodeCombineXYZ")
        self._fill(node, numbers)
        return node.outputs[0]


def _numbers(graph: _Graph, images: Sequence[bpy.types.Image], uv_map: str) -> list[Socket]:
    """The numbers of a texel."""
    uv = graph.node("ShaderNodeUVMap")
    uv.uv_map = uv_map
    numbers: list[Socket] = []
    for image in images:
        texture = graph.node("ShaderNodeTexImage")
        texture.image, texture.interpolation, texture.extension = image, "Linear", "EXTEND"
        graph.group.links.new(uv.outputs["UV"], texture.inputs["Vector"])
        split = graph.node("ShaderNodeSeparateColor")
        graph.group.links.new(texture.outputs["Color"], split.inputs[0])
        numbers += [*split.outputs, texture.outputs["Alpha"]]
    return numbers


def _mirrored(graph: _Graph, inputs) -> tuple[Socket, Socket, Socket]:
    """x, y, z of the mirrored view direction in the frame of the bake."""
    geometry = graph.node("ShaderNodeNewGeometry")
    away = graph.vector("REFLECT", geometry.outputs["Incoming"], geometry.outputs["Normal"])  # v - 2 (n.v) n = -r
    x, y, z = (graph.math("MULTIPLY", graph.vector("DOT_PRODUCT", away, inputs[f"Turn {axis}"]), -1.0)
               for axis in "XYZ")
    return x, y, z


def _attenuation(graph: _Graph, roughness: Socket, order: int, lobe: str) -> list[Socket | float]:
    """Attenuation of each band, looked up in an image."""
    texture = graph.node("ShaderNodeTexImage")
    texture.image, texture.interpolation, texture.extension = _lobe_image(lobe), "Linear", "EXTEND"
    # texel centres are at (i + 0.5) / steps
    u = graph.math("MULTIPLY_ADD", roughness, (_LOBE_STEPS - 1) / _LOBE_STEPS, 0.5 / _LOBE_STEPS)
    graph.group.links.new(graph.join([u]), texture.inputs["Vector"])
    split = graph.node("ShaderNodeSeparateColor")
    graph.group.links.new(texture.outputs["Color"], split.inputs[0])
    return [1.0, *split.outputs, texture.outputs["Alpha"]][:order]


def _lobe_image(lobe: str) -> bpy.types.Image:
    """Attenuation of bands 1 to 4 of a lobe, for roughness 0 to 1."""
    image = next((i for i in bpy.data.images if i.get(_LOBES) == lobe), None)
    if image is None:
        image = bpy.data.images.new(f"PRT lobes {lobe}", _LOBE_STEPS, 1, alpha=True, float_buffer=True, is_data=True)
        image.use_half_precision, image.alpha_mode = False, "CHANNEL_PACKED"
        values = lobes.attenuation(np.linspace(0, 1, _LOBE_STEPS), sh.MAX_ORDER, lobe)[:, 1:]
        image.pixels.foreach_set(values.astype(np.float32).ravel())
        image.pack()
        image[_LOBES] = lobe
    return image


def _harmonics(graph: _Graph, direction: tuple[Socket, Socket, Socket], order: int) -> list[Socket | float]:
    """Y_k of a direction, k = 0..K-1, by the usual recurrences in z and in x, y."""
    x, y, z = direction
    cosines: list[Socket | float] = [1.0, x]
    sines: list[Socket | float] = [0.0, y]
    for _ in range(2, order):
        c, s = cosines[-1], sines[-1]
        cosines.append(graph.math("SUBTRACT", graph.math("MULTIPLY", x, c), graph.math("MULTIPLY", y, s)))
        sines.append(graph.math("ADD", graph.math("MULTIPLY", x, s), graph.math("MULTIPLY", y, c)))
    out: list[Socket | float] = [0.0] * (order * order)
    for m in range(order):
        before: Socket | float = 0.0
        now: Socket | float = float(np.prod(np.arange(1, 2 * m, 2)))   # (2m - 1)!!
        for band in range(m, order):
            if band > m:
                up = graph.math("MULTIPLY", graph.math("MULTIPLY", z, now), (2 * band - 1) / (band - m))
                down = graph.math("MULTIPLY", before, (band + m - 1) / (band - m))
                before, now = now, graph.math("SUBTRACT", up, down)
            scaled = graph.math("MULTIPLY", now, sh.normalisation(band, m))
            centre = band * (band + 1)
            out[centre + m] = graph.math("MULTIPLY", scaled, cosines[m])
            if m:
                out[centre - m] = graph.math("MULTIPLY", scaled, sines[m])
    return out
