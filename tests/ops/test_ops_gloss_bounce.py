# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy bounces through the operator: what they add to a picture, and what makes them stale."""
from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

FLOOR = ([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [(0, 1, 2, 3)])
WALL = ([(-2, 0, 0), (2, 0, 0), (2, 0, 3), (-2, 0, 3)], [(0, 1, 2, 3)])


def _material(obj, colour, roughness, metallic):
    material = bpy.data.materials.new(obj.name)
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1)
    shader.inputs["Roughness"].default_value, shader.inputs["Metallic"].default_value = roughness, metallic
    obj.data.materials.append(material)
    return shader


@pytest.fixture
def room(make, settings):
    """A mirroring floor before a red wall, the floor baked glossy in sight of the wall, under a white sky."""
    wall = make(*WALL, name="Wall")
    wall.location.y = 1.5
    floor = make(*FLOOR, name="Floor")
    _material(wall, (0.9, 0.05, 0.05), 1.0, 0.0)
    shader = _material(floor, (0.8, 0.8, 0.8), 0.2, 1.0)
    settings.target, settings.side, settings.order, settings.occluders = "TEXTURE", 32, 4, "VISIBLE"
    settings.gloss = True
    bpy.context.scene.world = bpy.data.worlds.new("Sky")
    bpy.context.scene.world.color = (1, 1, 1)
    bpy.context.view_layer.update()
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    return floor, wall, shader


def _numbers(obj):
    """All that the glossy preview's images hold."""
    from neural_gash_addon.scene.gloss_nodes import gloss_images
    group = next(n.node_tree for n in obj.material_slots[0].material.node_tree.nodes if n.type == "GROUP")
    found = []
    for image in gloss_images(group):
        pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
        image.pixels.foreach_get(pixels)
        found.append(pixels)
    return np.stack(found)


def test_the_floor_shows_the_wall(room):
    from neural_gash_addon.scene.render import render_pixels
    floor, _, _ = room
    eye = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    bpy.context.scene.collection.objects.link(eye)
    eye.location, eye.rotation_euler = (0, -4, 2.0), (1.1, 0, 0)
    bpy.context.view_layer.update()
    before = render_pixels([floor], camera=eye, resolution=(48, 32), samples=64)[..., :3]
    assert bpy.ops.neural_gash.bake_gloss(bounces=1) == {"FINISHED"}
    after = render_pixels([floor], camera=eye, resolution=(48, 32), samples=64)[..., :3]
    added = (after - before).reshape(-1, 3).sum(0)
    assert added[0] > 4 * max(added[1], added[2]) > 0
    assert added[0] > 0.03 * before[..., 0].sum()


def test_another_light_leaves_them_out_and_the_same_one_shows_them(room, settings):
    from neural_gash_addon.scene.gloss_bounce import bounces_shown
    floor, _, _ = room
    direct = _numbers(floor)
    assert bpy.ops.neural_gash.bake_gloss(bounces=2) == {"FINISHED"}
    both = _numbers(floor)
    assert bounces_shown(floor.data) and np.abs(both - direct).max() > 0.01
    settings.light_strength = 0.5
    np.testing.assert_allclose(_numbers(floor), 0.5 * direct, atol=1e-5)
    assert not bounces_shown(floor.data)
    settings.light_strength = 1.0
    np.testing.assert_array_equal(_numbers(floor), both)
    assert bounces_shown(floor.data)


def test_another_lobe_leaves_them_out(room, settings):
    from neural_gash_addon.scene.gloss_bounce import bounces_shown
    from neural_gash_addon.scene.staleness import CURRENT, status
    floor, _, _ = room
    direct = _numbers(floor)
    assert bpy.ops.neural_gash.bake_gloss() == {"FINISHED"}
    ggx = _numbers(floor) - direct
    settings.lobe = "PHONG"
    assert not bounces_shown(floor.data) and status(floor) == CURRENT
    np.testing.assert_array_equal(_numbers(floor), direct)
    assert bpy.ops.neural_gash.bake_gloss() == {"FINISHED"}
    phong = _numbers(floor) - direct
    assert bounces_shown(floor.data) and np.abs(phong).max() > 0.01
    assert np.abs(phong - ggx).max() > 1e-3 * np.abs(ggx).max()   # the wall is rough: what it mirrors differs little
    settings.lobe = "GGX"
    assert not bounces_shown(floor.data)


def test_another_roughness_makes_them_stale(room):
    from neural_gash_addon.scene.staleness import CURRENT, STALE, status
    floor, wall, shader = room
    shader.inputs["Roughness"].default_value = 0.4
    assert status(floor) == CURRENT     # transfer does not know of it
    shader.inputs["Roughness"].default_value = 0.2
    assert bpy.ops.neural_gash.bake_gloss() == {"FINISHED"} and status(floor) == CURRENT
    for changed in (shader, wall.data.materials[0].node_tree.nodes["Principled BSDF"]):
        was = changed.inputs["Roughness"].default_value
        changed.inputs["Roughness"].default_value = 0.45
        assert status(floor) == STALE
        changed.inputs["Roughness"].default_value = was
        assert status(floor) == CURRENT


def test_they_survive_saving_and_go_with_the_bake(room, tmp_path):
    floor, _, _ = room
    assert bpy.ops.neural_gash.bake_gloss() == {"FINISHED"}
    before = _numbers(floor)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "room.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "room.blend"))
    floor = bpy.data.objects["Floor"]
    np.testing.assert_allclose(_numbers(floor), before, atol=1e-6)
    bpy.context.view_layer.objects.active = floor
    assert bpy.ops.neural_gash.clear() == {"FINISHED"}
    assert not [i for i in bpy.data.images if "PRT" in i.name and "lobes" not in i.name]
    assert not [k for k, _ in floor.data.items() if k.startswith("neural_gash")]


def test_what_cannot_have_them_is_refused(room, settings, refused, make):
    floor, wall, _ = room
    wall.location.y = 1.0
    bpy.context.view_layer.update()
    assert "changed since its bake" in refused(bpy.ops.neural_gash.bake_gloss)
    wall.location.y = 1.5
    bpy.context.view_layer.update()
    settings.target = "VERTICES"
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    assert "to a texture" in refused(bpy.ops.neural_gash.bake_gloss)
    make(name="New")
    assert "first" in refused(bpy.ops.neural_gash.bake_gloss)
