# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps through the Bake operator: numbers, picture, staleness, clear, textures, sets, what is said."""
from __future__ import annotations

import numpy as np
import pytest

from .lit import GRID, PANEL, area, attribute, bake, paint, record

bpy = pytest.importorskip("bpy")

def square(size, distance):
    """Form factor of a square over a parallel element under its centre (Howell 1982)."""
    a = size / 2 / distance
    x = np.hypot(1, a)
    return 4 * (a / x * np.arctan(a / x) * 2) / (2 * np.pi)


def picture(objects, camera=True, size=96):
    """Linear radiance (H, W, 3) of previews, seen from above; row 0 at the bottom."""
    from neural_gash_addon.scene.render import render_pixels
    eye = bpy.data.objects.get("Eye") or bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    eye.data.type, eye.data.ortho_scale, eye.location = "ORTHO", 2, (0, 0, 5)
    if eye.name not in bpy.context.scene.collection.objects:
        bpy.context.scene.collection.objects.link(eye)
    bpy.context.view_layer.update()
    return render_pixels(objects, camera=eye, resolution=(size, size), samples=16)[::-1, :, :3]


def test_the_attribute_is_the_irradiance_and_the_picture_shows_it(floor):
    area(energy=20)
    bake()
    found = attribute(floor)
    middle = found[(GRID + 1) ** 2 // 2]
    np.testing.assert_allclose(middle, 20 / 0.64 * square(0.8, 1), rtol=0.03)
    baked = record(floor)
    assert baked.lamps and 0 < baked.lamps_error <= 0.02 and baked.lamps_rays >= 32 * len(found)
    assert "E / pi" in baked.basis and not baked.lamps_notice
    shown = picture([floor])
    np.testing.assert_allclose(shown[46:50, 46:50].mean((0, 1)), 0.8 * middle / np.pi, rtol=0.02)
    # the strength is of the lamps alone, and other views show none of them
    settings = bpy.context.scene.neural_gash
    settings.lamps_strength = 0.5
    np.testing.assert_allclose(picture([floor])[46:50, 46:50], 0.5 * shown[46:50, 46:50], rtol=1e-3)
    settings.lamps_strength = 0.0
    assert not picture([floor]).any()
    settings.lamps_strength, settings.view = 1.0, "OCCLUSION"
    np.testing.assert_allclose(picture([floor])[48, 48], 1, rtol=1e-4)
    settings.view, settings.sky = "LIT", (1, 1, 1)
    np.testing.assert_allclose(picture([floor])[48, 48], shown[48, 48] + 0.8, rtol=1e-3)


def test_it_is_the_library_call(floor):
    from neural_gash_addon.backend import irradiance, methods
    from neural_gash_addon.scene.lamps import read_lamps
    from neural_gash_addon.scene.read import read_object
    area()
    bake()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    mesh = read_object(floor, depsgraph).mesh
    scene, key, _ = read_lamps(floor, depsgraph)
    truth = methods.run(irradiance.irradiance(scene, mesh.points, mesh.normals, 4096, seed=3)).values
    found = attribute(floor)
    assert np.linalg.norm(found - truth) < 0.025 * np.linalg.norm(truth) and record(floor).lamps == key


@pytest.mark.parametrize("target", ["VERTICES", "TEXTURE"])
def test_emissive_objects_light_others_and_glow(floor, make, settings, target):
    settings.target, settings.side, settings.tolerance = target, 32, 0.05
    panel = make(*PANEL, "Panel")
    shader = paint(panel, (0.1, 0.1, 0.1), (1, 0.5, 0.25), 6.0)
    floor.select_set(True)
    bake()
    expected = 6 * np.pi * square(0.8, 1) * np.array([1, 0.5, 0.25])
    shown = picture([floor])
    np.testing.assert_allclose(shown[46:50, 46:50].mean((0, 1)), 0.8 * expected / np.pi, rtol=0.06)
    glow = picture([panel])[48, 48]
    assert (glow >= 6 * np.array([1, 0.5, 0.25])).all() and glow == pytest.approx([6, 3, 1.5], rel=0.05)
    assert shader.inputs["Emission Strength"].default_value == 6  # the person's own


def test_an_emission_shader_alone_shows_its_glow_and_no_light(floor, make):
    panel = make(*PANEL, "Panel")
    paint(panel)
    tree = panel.data.materials[0].node_tree
    emission, texture = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeTexImage")
    texture.image = bpy.data.images.new("even", 4, 4, float_buffer=True, is_data=True)
    texture.image.pixels.foreach_set(np.tile(np.array([0.25, 0.5, 1, 1], np.float32), 16))
    emission.inputs["Strength"].default_value = 4
    tree.links.new(texture.outputs["Color"], emission.inputs["Color"])
    tree.links.new(emission.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    bpy.context.scene.neural_gash.sky = (1, 1, 1)
    bake()
    np.testing.assert_allclose(picture([panel])[48, 48], (1, 2, 4), rtol=0.01)


def test_a_coloured_wall_bleeds_onto_the_floor(floor, make):
    wall = make([(-1, -1, 0), (-1, 1, 0), (-1, 1, 2), (-1, -1, 2)], [(0, 1, 2, 3)], "Wall")
    paint(wall, (0.8, 0.05, 0.05))
    area()
    bpy.context.view_layer.objects.active = floor
    floor.select_set(True)
    wall.select_set(False)
    bake()
    values = attribute(floor).reshape(GRID + 1, GRID + 1, 3)
    assert values[1:-1, 1, 0].mean() > 1.1 * values[1:-1, 1, 2].mean()
    np.testing.assert_allclose(values[1:-1, 1, 1], values[1:-1, 1, 2], rtol=0.05)


def test_vertices_and_texels_agree(floor, settings):
    area()
    bake()
    at_vertices = attribute(floor).reshape(GRID + 1, GRID + 1, 3)
    floor.data.uv_layers.new(name="Flat")
    for loop in floor.data.loops:
        x, y, _ = floor.data.vertices[loop.vertex_index].co
        floor.data.uv_layers["Flat"].uv[loop.index].vector = (0.5 + 0.5 * x, 0.5 + 0.5 * y)
    settings.target, settings.side, settings.uv_map, settings.half = "TEXTURE", 64, "Flat", True
    bake()
    assert "_prt_lamps" not in floor.data.attributes
    images = floor.data["neural_gash_images"]
    assert sorted(images.keys()) == ["0", "1", "2", "3"]
    image = images["3"]
    assert image.name == "Floor PRT lamps" and not image.use_half_precision and images["0"].use_half_precision
    pixels = np.empty((64, 64, 4), np.float32)
    image.pixels.foreach_get(pixels.ravel())
    corners = pixels.reshape(GRID, 4, GRID, 4, 4)
    around = np.mean([corners[j:GRID - 1 + j, -j - 1 if j == 0 else 0, i:GRID - 1 + i, -1 if i == 0 else 0, :3]
                      for j in (0, 1) for i in (0, 1)], axis=0)  # the four texels about each inner vertex
    inner = at_vertices[1:-1, 1:-1]
    assert np.linalg.norm(around - inner) < 0.03 * np.linalg.norm(inner)
    shown = picture([floor])[46:50, 46:50].mean((0, 1))
    np.testing.assert_allclose(shown, 0.8 / np.pi * pixels[31:33, 31:33, :3].mean((0, 1)), rtol=0.01)


def test_objects_that_share_a_texture_share_its_lamps(floor, make, settings):
    area()
    other = make(*PANEL, "Panel")
    paint(other)
    other.location.z = 1
    floor.select_set(True)
    settings.target, settings.side, settings.share = "TEXTURE", 64, True
    bpy.context.view_layer.update()
    bake()
    first, second = (obj.data["neural_gash_images"] for obj in (floor, other))
    assert first["3"] == second["3"] and record(floor).lamps == record(other).lamps
    middle = picture([floor])[48, 48]
    np.testing.assert_allclose(middle, 0.8 / np.pi * 20 / 0.64 * square(0.8, 1), rtol=0.1)


def test_textures_in_a_folder_say_what_they_are(floor, settings, tmp_path):
    from neural_gash_addon.backend import exr
    area()
    settings.target, settings.side, settings.texture_folder = "TEXTURE", 32, str(tmp_path)
    bake()
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"Floor_prt_0.exr", "Floor_prt_1.exr", "Floor_prt_2.exr", "Floor_prt_lamps.exr", "Floor_prt.json"}
    text, _, _ = exr.read_record(tmp_path / "Floor_prt_lamps.exr")
    assert "E / pi" in text
    bake()
    assert {path.name for path in tmp_path.iterdir()} == names
    (tmp_path / "Floor_prt_lamps.exr").unlink()
    from neural_gash_addon.scene import staleness
    assert not staleness.check(floor)


def test_what_lights_it_makes_it_stale_when_it_changes(floor, make):
    from neural_gash_addon.scene import staleness
    lamp = area()
    bulb = make([(x / 10, y / 10, 0.3 + z / 10) for x, y, z in PANEL[0]], PANEL[1], "Bulb")
    shader = paint(bulb, emission=(1, 1, 1), strength=2)
    bulb.select_set(False)
    floor.select_set(True)
    bpy.context.view_layer.objects.active = floor

    def current():
        bpy.context.view_layer.update()
        return staleness.check(floor)

    bake()
    assert current()
    for change, back in [
            (lambda: setattr(lamp.location, "x", 0.2), lambda: setattr(lamp.location, "x", 0)),
            (lambda: setattr(lamp.data, "energy", 21), lambda: setattr(lamp.data, "energy", 20)),
            (lambda: setattr(bulb.location, "x", 0.2), lambda: setattr(bulb.location, "x", 0)),
            (lambda: setattr(shader.inputs["Emission Strength"], "default_value", 3),
             lambda: setattr(shader.inputs["Emission Strength"], "default_value", 2)),
            (lambda: setattr(floor.rotation_euler, "z", 0.1), lambda: setattr(floor.rotation_euler, "z", 0))]:
        change()
        assert not current()
        back()
        assert current()
    settings = bpy.context.scene.neural_gash
    settings.lamps = False
    bake()
    lamp.location.x = 1
    assert current() and not record(floor).lamps and "_prt_lamps" not in floor.data.attributes


def test_changes_of_lamps_are_noted(floor):
    from neural_gash_addon.scene import staleness
    lamp = area()
    bake()
    bpy.context.view_layer.update()
    for change in (lambda: setattr(lamp.data, "energy", 9), lambda: setattr(lamp.location, "x", 1)):
        staleness._changed.clear()
        change()
        bpy.context.view_layer.update()
        assert staleness._changed
        staleness._known.clear()
        staleness._compare_changed()
        assert staleness._known[floor.session_uid] == "STALE"


def test_clear_leaves_nothing(floor, snapshot, settings):
    area()
    assert bpy.ops.neural_gash.read_light() == {"FINISHED"}
    before = snapshot()
    for target in ("VERTICES", "TEXTURE"):
        settings.target, settings.side = target, 32
        bake()
        assert bpy.ops.neural_gash.clear() == {"FINISHED"}
        assert snapshot() == before


def test_a_lamp_that_changes_during_the_bake_is_noticed(floor, snapshot):
    from neural_gash_addon.backend.errors import UserError
    from neural_gash_addon.backend.progress import run
    from neural_gash_addon.ops.batch import finish_batch, prepare_batch
    lamp = area()
    batch = prepare_batch(bpy.context, [floor], bpy.context.scene.neural_gash)
    results = run(batch.baking)
    lamp.data.energy = 1
    bpy.context.view_layer.update()
    before = snapshot()
    with pytest.raises(UserError, match="lamps of 'Floor'"):
        finish_batch(bpy.context, batch, results)
    assert snapshot() == before


def test_preparing_and_baking_touch_nothing_of_the_scene(floor, snapshot):
    from neural_gash_addon.backend.progress import run
    from neural_gash_addon.ops.batch import prepare_batch
    area()
    before = snapshot()
    run(prepare_batch(bpy.context, [floor], bpy.context.scene.neural_gash).baking)
    assert snapshot() == before


def test_no_emitter_is_said_and_gives_zero(floor):
    from neural_gash_addon.ops.batch import bake_object
    baked, sentence = bake_object(bpy.context, floor, bpy.context.scene.neural_gash)
    assert not attribute(floor).any() and baked.lamps
    assert sentence == "Nothing in the scene emits light, so the irradiance is zero."


def test_spots_are_said_and_bad_lamps_refused(floor, refused):
    from neural_gash_addon.ops.batch import bake_object
    spot = bpy.data.objects.new("Spot", bpy.data.lights.new("Spot", "SPOT"))
    bpy.context.scene.collection.objects.link(spot)
    lamp = area()
    _, sentence = bake_object(bpy.context, floor, bpy.context.scene.neural_gash)
    assert sentence == record(floor).lamps_notice == "1 spot lamp is left out."
    lamp.data.energy = float("nan")
    bpy.context.view_layer.update()
    assert "The lamp 'Lamp'" in refused(bpy.ops.neural_gash.bake)


def test_rays_are_paths_and_the_summary_tells(floor, settings):
    from neural_gash_addon.ops.job import summary
    area()
    settings.method, settings.quality, settings.rays = "embree", "RAYS", 64
    bake()
    baked = record(floor)
    assert baked.lamps_rays == 64 * (GRID + 1) ** 2
    assert "; lamps with 64 paths a point, estimated error" in summary(baked)


def test_order_5_with_lamps_is_drawn(floor, settings):
    area()
    settings.order = 5
    bake()
    assert sum(name.startswith("_prt_") for name in list(floor.data.attributes.keys())) == 8
    assert picture([floor])[48, 48].min() > 0


def test_with_bounces_too(floor, settings):
    area()
    settings.method, settings.bounces, settings.order = "embree", 2, 4
    wall = bpy.data.objects.new("Copy", floor.data)
    wall.rotation_euler.x = 1
    bpy.context.scene.collection.objects.link(wall)
    settings.occluders = "VISIBLE"
    bpy.context.view_layer.update()
    bake()
    assert record(floor).colours == 3 and len(attribute(floor))
    assert picture([floor])[30, 48].min() > 0


def test_a_bake_that_does_not_know_where_light_comes_from_is_shown_dull(floor, settings):
    from neural_gash_addon.scene.preview import is_glossy, is_on
    area()
    settings.target, settings.side = "TEXTURE", 32
    bake()
    assert record(floor).lamps_order == 1
    settings.gloss = True
    assert is_on(floor) and not is_glossy(floor)


def test_live_and_sequences_say_that_they_have_no_lamps(floor, refused, settings):
    from neural_gash_addon.scene import live
    area()
    bake()
    settings.live = True
    assert "without lamps" in live.problem(floor)
    settings.live = False
    assert "Lamps" in refused(bpy.ops.neural_gash.bake_sequence)


def test_a_saved_file_shows_the_same(floor, tmp_path):
    area()
    bake()
    before = picture([floor])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    from neural_gash_addon.scene import staleness
    again = bpy.data.objects["Floor"]
    assert staleness.check(again)
    np.testing.assert_allclose(picture([again]), before, rtol=1e-4)


@pytest.mark.parametrize("method, quality, shown", [("analytic", "RAYS", 1), ("embree", "RAYS", 0),
                                                    ("embree", "TOLERANCE", 1)])
def test_the_panel_shows_what_lamps_need(floor, settings, method, quality, shown):
    from .test_ops_registration import _draw
    area()
    bake()
    assert "lamps_strength" in _draw("light")
    assert any(text.startswith("Lamps: estimated error") for text in _draw("main"))
    settings.method, settings.quality = method, quality
    assert "lamps" in _draw("settings") and _draw("settings").count("tolerance") == shown
    settings.target, settings.sizing = "TEXTURE", "FIT"
    assert _draw("settings").count("tolerance") == 1
    settings.lamps, settings.target = False, "VERTICES"
    bake()
    assert "lamps_strength" not in _draw("light")


def test_the_scene_is_read_once_for_all_that_are_baked_together(floor, make, settings, monkeypatch):
    from neural_gash_addon.scene import lamps, staleness
    area()
    objects = [floor, make(*PANEL, "One"), make([(x + 1, y, z) for x, y, z in PANEL[0]], PANEL[1], "Two")]
    for obj in objects:
        obj.select_set(True)
    read, times = lamps.read_lamps, []
    monkeypatch.setattr(lamps, "read_lamps", lambda *a: times.append(1) or read(*a))
    bake()
    assert len(times) == 2  # before and after
    assert len({record(obj).lamps for obj in objects}) == 1
    times.clear()
    staleness._changed.update(obj.session_uid for obj in objects)
    staleness._compare_changed()
    assert len(times) == 1 and all(staleness._known[obj.session_uid] == "CURRENT" for obj in objects)
