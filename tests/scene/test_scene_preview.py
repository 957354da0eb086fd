# SPDX-License-Identifier: GPL-3.0-or-later
"""The preview shows the bake, and off means as if it had never been on."""
import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from mathutils import Euler  # noqa: E402

from neural_gash_addon.backend import spherical_harmonics as sh  # noqa: E402
from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.scene import preview  # noqa: E402


def _material(name, colour=(0.2, 0.4, 0.6, 1)):
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = colour
    return material


def _state(obj):
    """Everything that the preview could touch: slots with both their materials, mesh, faces, data-blocks."""
    slots = []
    for slot in obj.material_slots:
        link = slot.link
        held = {}
        for slot.link in ("DATA", "OBJECT"):
            held[slot.link] = slot.material
        slot.link = link
        slots.append((link, held))
    return (slots, list(obj.data.materials), [p.material_index for p in obj.data.polygons],
            sorted(m.name for m in bpy.data.materials), sorted(g.name for g in bpy.data.node_groups),
            sorted((m.name, m.users) for m in bpy.data.materials), list(obj.keys()))


def _group_node(material):
    return next(n for n in material.node_tree.nodes if n.type == "GROUP" and preview.is_group(n.node_tree))


def _no_slots(obj):
    pass


def _none(obj):
    obj.data.materials.append(None)


def _several(obj):
    shared = _material("Shared")
    for material in (shared, None, _material("Other"), shared):
        obj.data.materials.append(material)
    for index, polygon in enumerate(obj.data.polygons):
        polygon.material_index = index % 4


def _object_linked(obj):
    _several(obj)
    obj.material_slots[1].link = "OBJECT"
    obj.material_slots[1].material = _material("Mine")
    obj.material_slots[2].link = "OBJECT"  # and empty
    obj.material_slots[3].link = "OBJECT"
    obj.material_slots[3].material = _material("Waiting")
    obj.material_slots[3].link = "DATA"    # an object's material that is not shown


def _odd_indices(obj):
    for index, polygon in enumerate(obj.data.polygons):
        polygon.material_index = index     # of slots that do not exist


CASES = [_no_slots, _none, _several, _object_linked, _odd_indices]


@pytest.mark.parametrize("prepare", CASES)
def test_off_restores_everything(make, prepare):
    obj = make.cube()
    prepare(obj)
    make.bake(obj)
    before = _state(obj)
    for _ in range(2):
        preview.preview_on(obj)
        preview.preview_on(obj)  # on while on
        assert preview.is_on(obj)
        assert list(obj.data.materials)[:len(before[1])] == before[1]
        assert all(slot.link == "OBJECT" and slot.material for slot in obj.material_slots)
        preview.preview_off(obj)
        assert not preview.is_on(obj) and _state(obj) == before
    preview.preview_off(obj)
    assert _state(obj) == before


@pytest.mark.parametrize("prepare", CASES)
def test_off_restores_everything_after_save_and_load(make, prepare, tmp_path):
    obj = make.cube()
    prepare(obj)
    make.bake(obj)
    for material in bpy.data.materials:
        material.use_fake_user = True  # saving drops what nothing uses

    def names(state):
        return repr(state)
    before = names(_state(obj))
    preview.preview_on(obj)
    path = str(tmp_path / "preview.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    obj = bpy.data.objects["Cube"]
    assert preview.is_on(obj)
    preview.preview_off(obj)
    assert names(_state(obj)) == before


@pytest.mark.parametrize("prepare", CASES)
def test_users_of_one_mesh_have_previews_of_their_own(make, prepare):
    obj = make.cube()
    prepare(obj)
    twin = bpy.data.objects.new("Twin", obj.data)
    bpy.context.scene.collection.objects.link(twin)
    make.bake(obj)
    before, twin_before = _state(obj), _state(twin)
    preview.preview_on(obj)
    assert not preview.is_on(twin)
    preview.preview_on(twin)
    preview.preview_off(obj)
    assert preview.is_on(twin) and not preview.is_on(obj)
    preview.preview_off(twin)
    assert _state(obj) == before and _state(twin) == twin_before


def test_what_a_person_put_in_a_slot_meanwhile_stays(make):
    obj = make.cube()
    _several(obj)
    make.bake(obj)
    preview.preview_on(obj)
    new = _material("New")
    obj.material_slots[0].material = new
    preview.preview_off(obj)
    assert obj.material_slots[0].material == new and obj.material_slots[2].link == "DATA"


def test_duplicate_of_a_previewed_object(make):
    obj = make.cube()
    obj.data.materials.append(_material("Paint"))
    make.bake(obj)
    preview.preview_on(obj)
    twin = obj.copy()
    bpy.context.scene.collection.objects.link(twin)
    twin.rotation_euler = (1, 0, 0)
    bpy.context.view_layer.update()
    light = np.random.default_rng(0).normal(size=(9, 3))
    preview.update_light(twin, light)
    preview.update_light(obj, light)
    mine, theirs = obj.material_slots[0].material, twin.material_slots[0].material
    assert mine != theirs
    lights = [tuple(_group_node(m).inputs["L1"].default_value) for m in (mine, theirs)]
    assert lights[0] != lights[1]
    preview.preview_off(obj)
    preview.preview_off(twin)
    assert twin.material_slots[0].material == obj.material_slots[0].material == bpy.data.materials["Paint"]
    assert [m.name for m in bpy.data.materials] == ["Paint"] and not bpy.data.node_groups


def test_joined_previews_can_be_switched_off(make):
    first, second = make.cube("First"), make.cube("Second")
    for obj in (first, second):
        obj.data.materials.append(_material(f"Paint {obj.name}"))
        make.bake(obj)
        preview.preview_on(obj)
    with bpy.context.temp_override(active_object=first, selected_editable_objects=[first, second],
                                   object=first, selected_objects=[first, second]):
        bpy.ops.object.join()
    preview.preview_off(first)
    assert not preview.is_on(first)
    shown = {slot.material.name for slot in first.material_slots}
    assert shown == {"Paint First", "Paint Second"}
    assert len(bpy.data.materials) == 2


def test_albedo_is_the_base_colour(make):
    obj = make.cube()
    plain, textured = _material("Plain"), _material("Textured")
    noise = textured.node_tree.nodes.new("ShaderNodeTexNoise")
    textured.node_tree.links.new(noise.outputs["Color"],
                                 textured.node_tree.nodes["Principled BSDF"].inputs["Base Color"])
    mixed = _material("Mixed")
    tree = mixed.node_tree
    mix, glass = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeBsdfTransparent")
    tree.links.new(glass.outputs[0], mix.inputs[1])
    tree.links.new(tree.nodes["Principled BSDF"].outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    glowing = _material("Glowing")
    glow = glowing.node_tree.nodes.new("ShaderNodeEmission")
    glowing.node_tree.links.new(glow.outputs[0], glowing.node_tree.nodes["Material Output"].inputs["Surface"])
    for material in (plain, textured, mixed, glowing, None):
        obj.data.materials.append(material)
    make.bake(obj)
    preview.preview_on(obj)
    albedos = [_group_node(slot.material).inputs["Albedo"] for slot in obj.material_slots]
    for index in (0, 2):
        np.testing.assert_allclose(albedos[index].default_value, (0.2, 0.4, 0.6, 1), atol=1e-7)
    assert albedos[1].links[0].from_node.type == "TEX_NOISE"
    for index in (3, 4):
        np.testing.assert_allclose(albedos[index].default_value, (0.8, 0.8, 0.8, 1), atol=1e-7)
    assert plain.node_tree.nodes["Principled BSDF"].outputs[0].is_linked  # the originals are untouched


def test_material_without_nodes(make):
    obj = make.cube()
    material = bpy.data.materials.new("Old")
    if bpy.app.version >= (5, 0, 0):
        pytest.skip("from 5.0 on every material has nodes")
    material.diffuse_color = (0.1, 0.2, 0.3, 1)
    obj.data.materials.append(material)
    make.bake(obj)
    preview.preview_on(obj)
    colour = _group_node(obj.material_slots[0].material).inputs["Albedo"].default_value
    np.testing.assert_allclose(colour, (0.1, 0.2, 0.3, 1), atol=1e-7)


def test_light_is_turned_into_the_frame_of_the_bake(make):
    obj = make.cube()
    obj.rotation_euler = (0.3, -0.2, 1)
    bpy.context.view_layer.update()
    make.bake(obj, order=4)
    preview.preview_on(obj)
    before = np.array(Euler((0.3, -0.2, 1)).to_matrix())
    obj.rotation_euler = (2, 1, -0.5)
    obj.scale = (2, 2, 2)
    bpy.context.view_layer.update()
    after = np.array(Euler((2, 1, -0.5)).to_matrix())
    towards = np.array([0.6, 0.0, 0.8])
    light = np.repeat(sh.evaluate(towards[None], 5)[0][:, None], 3, axis=1)  # of a higher order, too
    preview.update_light(obj, light)
    node = _group_node(obj.material_slots[0].material)
    found = np.array([node.inputs[f"L{k}"].default_value for k in range(16)])
    seen = before @ after.T @ towards
    np.testing.assert_allclose(found[:, 0], sh.evaluate(seen[None], 4)[0], atol=1e-5)
    with pytest.raises(ValueError):
        preview.update_light(obj, light[:9])


def test_light_step_changes_nothing_but_constants(make):
    obj = make.cube()
    make.bake(obj)
    preview.preview_on(obj)
    material = obj.material_slots[0].material
    bpy.context.view_layer.update()
    count = len(material.node_tree.nodes), len(material.node_tree.links), material.name
    for value in (1.0, 2.0):
        preview.update_light(obj, np.full((9, 3), value))
    assert (len(material.node_tree.nodes), len(material.node_tree.links), material.name) == count
    assert obj.material_slots[0].material is material or obj.material_slots[0].material == material


def test_baked_again_at_another_order(make):
    obj = make.cube()
    make.bake(obj, order=3)
    preview.preview_on(obj)
    make.bake(obj, order=5)
    preview.update_light(obj, np.ones((25, 3)))
    assert [g.name for g in bpy.data.node_groups] == ["PRT Shading 5"]
    preview.preview_off(obj)
    assert not bpy.data.materials and not bpy.data.node_groups


def test_without_a_bake(make):
    obj = make.cube()
    before = _state(obj)
    with pytest.raises(UserError, match="not been baked"):
        preview.preview_on(obj)
    preview.update_light(obj, np.ones((9, 3)))
    assert _state(obj) == before


def test_more_attributes_than_eevee_draws(make):
    obj = make.cube()
    material = _material("Busy")
    tree = material.node_tree
    target = tree.nodes["Principled BSDF"].inputs["Base Color"]
    for index in range(8):
        attribute, mix = tree.nodes.new("ShaderNodeAttribute"), tree.nodes.new("ShaderNodeMixRGB")
        attribute.attribute_name = f"own {index}"
        tree.links.new(mix.outputs[0], target)
        tree.links.new(attribute.outputs[0], mix.inputs[1])
        target = mix.inputs[2]
    obj.data.materials.append(material)
    make.bake(obj, order=5)
    before = _state(obj)
    with pytest.raises(UserError, match="Busy"):
        preview.preview_on(obj)
    assert _state(obj) == before
    make.bake(obj, order=4)  # 4 attributes and the 8
    preview.preview_on(obj)
    assert preview.is_on(obj)
