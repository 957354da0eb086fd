# SPDX-License-Identifier: GPL-3.0-or-later
"""Seeing a bake: each material slot shows its material's colour lit by the baked transfer.

The preview materials sit in object-level slots, so neither the mesh's materials nor other users of
the mesh change. What a slot held is stored on the preview material in it, so it survives saving,
reordering of slots, duplicating and joining.
"""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend import spherical_harmonics as sh
from ..backend.errors import UserError
from ..backend.geometry import TEXEL
from ..backend.record import BakeRecord
from ..backend.texture import image_count
from .attributes import attribute_names, check_whole, has_bake, read_record
from .emission import emits_alone, emitters, set_glow
from .frames import bake_frame, world_matrix
from .gloss import can_gloss, gloss_group, gloss_whole, light_gloss
from .gloss_nodes import SPECULAR, is_gloss, lobe_of
from .images import bake_images, remove_unused
from .nodes import DEFAULT_ALBEDO, ensure_group, group_terms, is_group, set_light
from .shaders import COLOUR_SOCKETS, has_nodes, shader_node, surface_socket, upstream

_STATE = "neural_gash_preview"  # custom property of a preview material: what its slot held
EEVEE_ATTRIBUTES = 14           # with 15, EEVEE draws magenta, whatever their types
DEFAULT_ROUGHNESS = 0.5         # of a material that says nothing of it
_TEXTURES_ON_UV = {"TEX_IMAGE"}


def is_on(obj: bpy.types.Object | None) -> bool:
    """Whether the object shows its bake. Cheap enough to ask while drawing."""
    return obj is not None and any(_state(slot.material) is not None for slot in obj.material_slots)


def is_glossy(obj: bpy.types.Object | None) -> bool:
    """Whether the preview of the object is a glossy one."""
    return obj is not None and any(is_gloss(node.node_tree) for node in _group_nodes(obj))


def preview_on(obj: bpy.types.Object, lobe: str = "") -> None:
    """Show the bake of `obj`, lit by a white sky (glossy: dark) until `update_light`.

    Args:
        lobe: with which its materials mirror light (`lobes`), where the bake allows that; '' for a dull preview.
    Raises:
        UserError: there is no bake, its images are not whole, or a material's colour reads more
            attributes than EEVEE can draw beside the bake's.
    """
    record = read_record(obj)
    if obj.mode != "EDIT":  # in which a mesh's attributes cannot be seen
        check_whole(obj.data, record)
    images = bake_images(obj.data, record) if record.domain == TEXEL else []
    if images and record.uv_map not in obj.data.uv_layers:
        raise UserError(f"The UV map '{record.uv_map}' of the bake of '{obj.name}' is gone; bake again.")
    preview_off(obj)
    if lobe and can_gloss(record):
        group = gloss_group(obj.data, record, lobe)
    else:
        dull = images[:image_count(record.terms) + bool(record.lamps)]
        group = ensure_group(record.order, record.colours, dull, record.uv_map if images else "", bool(record.lamps))
    originals = [slot.material for slot in obj.material_slots] or [None]
    previews: list[bpy.types.Material] = []
    try:
        for original in originals:
            previews.append(_preview_material(original, group))
            _check_attributes(original, previews[-1], record.order, 1 if images else len(attribute_names(record)))
    except UserError:
        _remove_unused(previews)
        raise
    added = not obj.material_slots
    if added:
        obj.data.materials.append(None)
    for slot, original, preview in zip(obj.material_slots, originals, previews, strict=True):
        state = {"link": slot.link, "added": added}
        slot.link = "OBJECT"
        for key, material in (("object", slot.material), ("shown", original)):
            if material is not None:
                state[key] = material
        preview[_STATE] = state
        slot.material = preview


def preview_off(obj: bpy.types.Object) -> None:
    """Give every slot of `obj` back what it held, and remove what the preview made."""
    found: set[bpy.types.Material] = set()
    added = False
    for slot in obj.material_slots:
        link = slot.link
        slot.link = "DATA"
        state = _state(slot.material)
        if state is not None:  # only after joining, which moves materials to the mesh
            found.add(slot.material)
            slot.material = state.get("shown")
        slot.link = "OBJECT"
        state = _state(slot.material)
        if state is None:
            slot.link = link
            continue
        found.add(slot.material)
        added = added or bool(state["added"])
        slot.material = state.get("object")
        slot.link = state["link"]
    if added and len(obj.material_slots) == 1:
        _remove_slot(obj)
    _remove_unused(found)


def update_light(obj: bpy.types.Object, light: NDArray, tint: float = 1.0, lamps: float = 1.0,
                 depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Light the preview of `obj`, where it is on. Sets socket values only, so no shader recompiles.

    Args:
        light: (K, 3) in world axes, of the bake's order or higher. It is turned into the frame of
            the bake, so the object may have been rotated since.
        tint: how much of the materials' colours a dull preview shows. lamps: factor on the light of baked lamps.
        depsgraph: of the frame in which the object stands so (`world_matrix`).
    Raises:
        UserError: the record of the bake is damaged.
        ValueError: the light is of a lower order than the bake.
    """
    if not (is_on(obj) and has_bake(obj)) or obj.library or not np.isfinite(world_matrix(obj, depsgraph)).all():
        return
    record = read_record(obj)
    terms = record.order ** 2
    if len(light) < terms:
        raise ValueError(f"the light has {len(light)} coefficients, the bake {terms}")
    turn = turn_since(obj, record, depsgraph)
    seen = sh.rotate(np.asarray(light)[:terms], turn)
    holds = record.order, record.colours, bool(record.lamps)
    if any(not is_gloss(node.node_tree) and group_terms(node.node_tree) != holds
           for node in _group_nodes(obj)):
        preview_on(obj)  # baked again at another order
    for node in _group_nodes(obj):
        if is_gloss(node.node_tree) and not gloss_whole(node, record):
            preview_on(obj, lobe_of(node.node_tree))  # somebody deleted or resized its images
            break
    for slot in obj.material_slots:
        if _state(slot.material) is not None and slot.material.users > 1:
            slot.material = slot.material.copy()  # a duplicated object, which may be turned differently
    for node in _group_nodes(obj):
        if is_gloss(node.node_tree):
            light_gloss(obj.data, record, node, seen, turn, lamps)
        else:
            set_light(node, seen, tint, lamps)


def turn_since(obj: bpy.types.Object, record: BakeRecord, depsgraph: bpy.types.Depsgraph | None = None) -> NDArray:
    """(3, 3) from world axes into the frame of a bake: the identity unless the object was turned since."""
    return np.array(record.frame).reshape(3, 3) @ bake_frame(obj, depsgraph).T


def is_preview(material: bpy.types.Material) -> bool:
    """Whether a material is a preview's, not the person's."""
    return _STATE in material


def _state(material: bpy.types.Material | None):
    """What the slot of a preview material held; None for any other material."""
    return None if material is None else material.get(_STATE)


def _group_nodes(obj: bpy.types.Object) -> list[bpy.types.Node]:
    """The shading group's nodes in the preview materials of `obj`."""
    return [node for slot in obj.material_slots if _state(slot.material) is not None
            for node in slot.material.node_tree.nodes
            if node.type == "GROUP" and (is_group(node.node_tree) or is_gloss(node.node_tree))]


def _preview_material(original: bpy.types.Material | None, group: bpy.types.NodeTree) -> bpy.types.Material:
    """A material whose surface is the group with the original's colour as albedo."""
    if original is None or not has_nodes(original):
        name = "Material" if original is None else original.name
        colour = (DEFAULT_ALBEDO,) * 3 + (1.0,) if original is None else tuple(original.diffuse_color)
        preview = bpy.data.materials.new(f"{name} (PRT preview)")
        if not has_nodes(preview):
            preview.use_nodes = True
        preview.node_tree.nodes.clear()
        source = None
    else:
        preview = original.copy()
        preview.name = f"{original.name} (PRT preview)"
        preview.use_fake_user = False
        preview.asset_clear()
        source = _colour_socket(preview)
        colour = (DEFAULT_ALBEDO,) * 3 + (1.0,) if source is None else tuple(source.default_value)
    tree = preview.node_tree
    glowing, alone = emitters(surface_socket(preview)), emits_alone(preview)
    for node in [n for n in tree.nodes if n.type == "OUTPUT_MATERIAL"]:
        tree.nodes.remove(node)
    shading = tree.nodes.new("ShaderNodeGroup")
    shading.node_tree = group
    shading.inputs["Albedo"].default_value = colour
    if source is not None and source.is_linked:
        tree.links.new(source.links[0].from_socket, shading.inputs["Albedo"])
    if "Glow" in shading.inputs:
        set_glow(shading, glowing)
        if alone:
            shading.inputs["Albedo"].default_value = (0, 0, 0, 1)
    if is_gloss(group):
        _set_gloss(tree, shading, None if source is None else source.node)
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    output.location = (200, 0)
    tree.links.new(shading.outputs[0], output.inputs["Surface"])
    if hasattr(preview, "surface_render_method"):
        preview.surface_render_method = "DITHERED"  # the preview is opaque, whatever the original was
    return preview


def _set_gloss(tree: bpy.types.NodeTree, shading: bpy.types.Node, shader: bpy.types.Node | None) -> None:
    """Take roughness and metal from the material's own shader: dielectrics mirror 4 %, metals their colour."""
    metallic = 0.0
    if shader is not None and "Roughness" in shader.inputs:
        rough = shader.inputs["Roughness"]
        shading.inputs["Roughness"].default_value = rough.default_value
        if rough.is_linked:
            tree.links.new(rough.links[0].from_socket, shading.inputs["Roughness"])
        if "Metallic" in shader.inputs and not shader.inputs["Metallic"].is_linked:
            metallic = shader.inputs["Metallic"].default_value
    else:
        shading.inputs["Roughness"].default_value = DEFAULT_ROUGHNESS
    colour = shading.inputs["Albedo"]
    mirrored = [SPECULAR + metallic * (value - SPECULAR) for value in colour.default_value[:3]]
    shading.inputs["Specular"].default_value = (*mirrored, 1.0)
    if metallic and colour.is_linked:
        mix = tree.nodes.new("ShaderNodeMix")
        mix.data_type = "RGBA"
        mix.inputs[0].default_value = metallic
        mix.inputs[6].default_value = (SPECULAR,) * 3 + (1.0,)
        tree.links.new(colour.links[0].from_socket, mix.inputs[7])
        tree.links.new(mix.outputs[2], shading.inputs["Specular"])
    if metallic:
        dim = tree.nodes.new("ShaderNodeVectorMath")
        dim.operation = "SCALE"
        dim.inputs[0].default_value = colour.default_value[:3]
        dim.inputs["Scale"].default_value = 1 - metallic
        if colour.is_linked:
            tree.links.new(colour.links[0].from_socket, dim.inputs[0])
        tree.links.new(dim.outputs[0], colour)


def shown_material(material: bpy.types.Material | None) -> bpy.types.Material | None:
    """The person's material: of a preview's, the one that it stands for."""
    state = _state(material)
    return material if state is None else state.get("shown")


def _colour_socket(material: bpy.types.Material) -> bpy.types.NodeSocket | None:
    """The colour input of a material's shader."""
    node = shader_node(material)
    return None if node is None else node.inputs[COLOUR_SOCKETS[node.type]]


def _check_attributes(original: bpy.types.Material | None, preview: bpy.types.Material, order: int, bake: int) -> None:
    """UserError where the preview reads more of the mesh's attributes than EEVEE can draw."""
    output = preview.node_tree.get_output_node("ALL")
    reads = _mesh_reads(upstream(output.inputs["Surface"]))
    if original is not None and len(reads) > EEVEE_ATTRIBUTES:
        raise UserError(f"The colour of the material '{original.name}' reads {len(reads) - bake} attributes "
                        f"of the mesh; with the {bake} of an order-{order} bake that is more than the "
                        f"{EEVEE_ATTRIBUTES} that EEVEE draws, so simplify it or bake at a lower order.")


def _mesh_reads(nodes: list[bpy.types.Node]) -> set[tuple[str, str]]:
    """The attributes of the mesh that some shader nodes read, those in their groups too."""
    reads: set[tuple[str, str]] = set()
    for node in nodes:
        if node.type == "GROUP" and node.node_tree is not None:
            ends = [n for n in node.node_tree.nodes if n.type == "GROUP_OUTPUT"]
            reads |= _mesh_reads(upstream(*(socket for end in ends for socket in end.inputs)))
        elif node.type == "ATTRIBUTE" and node.attribute_type == "GEOMETRY":
            reads.add(("attribute", node.attribute_name))
        elif node.type == "VERTEX_COLOR":
            reads.add(("attribute", node.layer_name))
        elif node.type == "UVMAP":
            reads.add(("attribute", node.uv_map))
        elif node.type in ("TANGENT", "NORMAL_MAP"):
            reads.add(("tangent", node.uv_map))
        elif node.type == "TEX_COORD":
            reads |= {(s.name, "") for s in node.outputs if s.is_linked and s.name in ("UV", "Generated")}
        elif node.type.startswith("TEX_") and not all(s.is_linked for s in node.inputs if s.name == "Vector"):
            reads.add(("UV" if node.type in _TEXTURES_ON_UV else "Generated", ""))
    return reads


def _remove_slot(obj: bpy.types.Object) -> None:
    """Remove the slot that the preview added, unless another user of the mesh shows its bake in it."""
    for other in bpy.data.objects:
        if other != obj and other.data == obj.data and is_on(other):
            for slot in other.material_slots:
                if _state(slot.material) is not None:
                    slot.material[_STATE]["added"] = True
            return
    data = obj.data
    before = np.empty(len(data.polygons), np.int32)
    data.polygons.foreach_get("material_index", before)
    data.materials.clear()  # pop() would leave the object its slot
    if before.any():  # faces may name slots that do not exist; clearing renumbers them
        data.polygons.foreach_set("material_index", before)


def _remove_unused(previews) -> None:
    """Delete preview materials, shading groups and images of bakes that nothing uses any more."""
    for material in previews:
        if material.users == 0:
            bpy.data.materials.remove(material)
    for group in [g for g in bpy.data.node_groups if (is_group(g) or is_gloss(g)) and g.users == 0]:
        bpy.data.node_groups.remove(group)
    remove_unused(bpy.data.images)
