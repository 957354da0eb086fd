# SPDX-License-Identifier: GPL-3.0-or-later
"""Preview, Clear and the light: what they change and what they give back."""
from __future__ import annotations

import math

import numpy as np
import pytest

from .conftest import WEDGE

bpy = pytest.importorskip("bpy")


def _slots(obj):
    return [(slot.link, slot.material) for slot in obj.material_slots]


def _dressed(make):
    """An object with a material on the mesh, one on the object, and an empty slot."""
    obj = make()
    for name in ("Red", "Blue", None):
        obj.data.materials.append(bpy.data.materials.new(name) if name else None)
    obj.material_slots[1].link = "OBJECT"
    obj.material_slots[1].material = bpy.data.materials.new("Own")
    return obj


def _constants(obj):
    """Light constants (K, 3) of the preview's node group."""
    from neural_gash_addon.scene.preview import _group_nodes
    node = _group_nodes(obj)[0]
    return np.array([node.inputs[f"L{k}"].default_value[:3] for k in range(len(node.inputs) - 2)])


def test_round_trip_gives_the_materials_back(make, settings):
    obj = _dressed(make)
    before, count = _slots(obj), len(bpy.data.materials)
    bpy.ops.neural_gash.bake()
    assert _slots(obj) != before
    assert bpy.ops.neural_gash.preview() == {"FINISHED"}
    assert _slots(obj) == before and len(bpy.data.materials) == count and not bpy.data.node_groups
    bpy.ops.neural_gash.preview()
    assert _slots(obj) != before
    bpy.ops.neural_gash.bake()  # again, with the preview on
    bpy.ops.neural_gash.preview()
    assert _slots(obj) == before and len(bpy.data.materials) == count


def test_clear_leaves_nothing(make, settings, snapshot):
    obj = _dressed(make)
    before = snapshot()
    bpy.ops.neural_gash.bake()
    bpy.ops.neural_gash.clear()
    del bpy.context.scene["neural_gash_light"]
    assert snapshot() == before
    assert not obj.data.get("neural_gash")


def test_a_preview_that_outlives_its_bake_goes_off(make, settings):
    obj = _dressed(make)
    before = _slots(obj)
    bpy.ops.neural_gash.bake()
    del obj.data["neural_gash"]
    assert bpy.ops.neural_gash.preview() == {"FINISHED"}
    assert _slots(obj) == before


def test_sliders_only_turn_and_scale_the_light(make, settings, monkeypatch):
    from neural_gash_addon.scene import lighting
    from neural_gash_addon.scene.world import rotated_light
    obj = make(*WEDGE)
    bpy.ops.neural_gash.bake()
    light = np.random.default_rng(3).normal(size=(25, 3))
    bpy.context.scene.neural_gash.light_source = "SKY"  # which nothing changes
    lighting.store_light(bpy.context.scene, light)
    monkeypatch.setattr(lighting, "world_light", lambda *_: pytest.fail("projected again"))
    materials = [m.name for m in bpy.data.materials]
    settings.light_rotation, settings.light_strength = math.radians(50), 2.5
    np.testing.assert_allclose(_constants(obj), rotated_light(light[:9], math.radians(50), 2.5), atol=1e-5)
    assert [m.name for m in bpy.data.materials] == materials
    settings.light_rotation, settings.light_strength = 0, 1
    np.testing.assert_allclose(_constants(obj), light[:9], atol=1e-5)


def test_windowing_is_off_until_asked_for(make, settings):
    from neural_gash_addon.backend import light as sh_light
    from neural_gash_addon.scene import lighting
    assert not settings.soften
    obj = make(*WEDGE)
    bpy.ops.neural_gash.bake()
    light = np.random.default_rng(3).normal(size=(25, 3))
    bpy.context.scene.neural_gash.light_source = "SKY"  # which nothing changes
    lighting.store_light(bpy.context.scene, light)
    settings.soften = True
    np.testing.assert_allclose(_constants(obj), sh_light.window(light[:9], 3), atol=1e-5)


def test_read_light_follows_the_world(make, settings):
    obj = make(*WEDGE)
    world = bpy.data.worlds.new("Sky")
    world.color = (1, 0, 0)
    bpy.context.scene.world = world
    if bpy.app.version >= (5, 0, 0):
        world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 0, 0, 1)
    bpy.ops.neural_gash.bake()
    np.testing.assert_allclose(_constants(obj)[0], (math.sqrt(4 * math.pi), 0, 0), atol=1e-5)
    bpy.context.scene.world = None
    assert bpy.ops.neural_gash.read_light() == {"FINISHED"}
    np.testing.assert_allclose(_constants(obj), 0, atol=1e-7)


def test_unreadable_world_is_one_sentence(make, settings, refused):
    world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    tree = world.node_tree
    tree.links.new(tree.nodes.new("ShaderNodeTexSky").outputs[0], tree.nodes["Background"].inputs["Color"])
    bpy.context.scene.world = world
    assert "Sky" in refused(bpy.ops.neural_gash.read_light)
