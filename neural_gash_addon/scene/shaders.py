# SPDX-License-Identifier: GPL-3.0-or-later
"""The nodes of a material that say how its surface looks."""
from __future__ import annotations

import bpy

COLOUR_SOCKETS = {"BSDF_PRINCIPLED": "Base Color", "BSDF_DIFFUSE": "Color"}


def has_nodes(material: bpy.types.Material) -> bool:
    """Whether the material is made of nodes; from 5.0 on all are, and asking warns."""
    return bpy.app.version >= (5, 0, 0) or material.use_nodes


def surface_socket(material: bpy.types.Material | None) -> bpy.types.NodeSocket | None:
    """The input of a material's output that says how its surface looks; None where no nodes do."""
    if material is None or not has_nodes(material) or material.node_tree is None:
        return None
    output = next((o for o in map(material.node_tree.get_output_node, ("ALL", "EEVEE", "CYCLES")) if o is not None),
                  None)
    return None if output is None else output.inputs["Surface"]


def shader_node(material: bpy.types.Material | None) -> bpy.types.Node | None:
    """The first Principled or Diffuse shader that reaches the output of a material."""
    surface = surface_socket(material)
    if surface is None:
        return None
    return next((node for node in upstream(surface) if node.type in COLOUR_SOCKETS), None)


def upstream(*sockets: bpy.types.NodeSocket) -> list[bpy.types.Node]:
    """The nodes that feed some input sockets, nearest first, each once."""
    found: dict[bpy.types.Node, None] = {}
    front = list(sockets)
    while front:
        nodes = [link.from_node for socket in front for link in socket.links]
        front = []
        for node in nodes:
            if node not in found:
                found[node] = None
                front += node.inputs
    return list(found)
