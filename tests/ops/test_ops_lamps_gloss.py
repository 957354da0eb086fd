# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy previews of bakes with lamps, beside closed forms and Cycles."""
from __future__ import annotations

import math

import numpy as np
import pytest

from .lit import FLOOR, PANEL, area, bake, paint, record

bpy = pytest.importorskip("bpy")


@pytest.fixture
def floor(make, settings):
    obj = make(*FLOOR, name="Floor")
    bpy.context.scene.world = bpy.data.worlds.new("Dark")
    bpy.context.scene.world.color = (0, 0, 0)
    settings.method, settings.target, settings.side = "analytic", "TEXTURE", 64
    settings.gloss, settings.lamps, settings.lamps_by = True, True, "PATHS"
    return obj


def eye():
    """A camera that looks down at the floor, a little aslant: the model loses what mirrors at grazing angles."""
    found = bpy.data.objects.get("Eye") or bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    found.location, found.rotation_euler, found.data.angle = (0, -1.2, 3), (math.atan(1.2 / 3), 0, 0), 0.6
    if found.name not in bpy.context.scene.collection.objects:
        bpy.context.scene.collection.objects.link(found)
    bpy.context.scene.camera = found
    bpy.context.view_layer.update()
    return found


def picture(objects):
    """Linear radiance (H, W, 3) of previews."""
    from neural_gash_addon.scene.render import render_pixels
    return render_pixels(objects, camera=eye(), resolution=(96, 64), samples=16)[..., :3]


def cycles():
    """Likewise, of the scene as Cycles has it."""
    from neural_gash_addon.scene.preview import preview_off
    from neural_gash_addon.scene.render import silent_blender
    for obj in bpy.context.scene.objects:
        if obj.type == "MESH":
            preview_off(obj)
    eye()
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 256, False
    scene.cycles.max_bounces = 4
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 96, 64, 100
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = bpy.app.tempdir + "cycles.exr"
    with silent_blender():
        bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    out = np.empty(96 * 64 * 4, np.float32)
    image.pixels.foreach_get(out)
    return out.reshape(64, 96, 4)[::-1, :, :3]


def choose(obj):
    """The only object that is selected, and active."""
    for other in bpy.context.selected_objects:
        other.select_set(False)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)


def metal(shader, roughness):
    shader.inputs["Metallic"].default_value, shader.inputs["Roughness"].default_value = 1, roughness


def test_images_hold_irradiance_first_and_a_diffuse_surface_looks_as_dull(floor, settings):
    from neural_gash_addon.scene.images import bake_images
    from neural_gash_addon.scene.preview import is_glossy
    shader = paint(floor)
    area()
    bake()
    glossy = record(floor)
    assert is_glossy(floor) and glossy.lamps_order == glossy.order == 3
    images = bake_images(floor.data, glossy)
    assert [image.name.rsplit(" ", 1)[-1] for image in images[3:]] == ["lamps", *(f"lamps{n}" for n in range(1, 7))]
    shown = picture([floor])
    shader.inputs["Specular IOR Level"].default_value = 0
    settings.gloss = False
    bake()
    dull = picture([floor])
    assert record(floor).lamps_order == 1
    # a plain dielectric mirrors 4 %
    seen = dull.max(-1) > 0
    assert seen.mean() > 0.1 and (shown[seen] >= 0.98 * dull[seen]).mean() > 0.97
    assert np.median(shown[seen] / dull[seen]) < 1.2


def test_a_lamp_far_away_is_mirrored_as_the_sun_is(floor, settings):
    metal(paint(floor, (1, 0.8, 0.6)), 0.4)
    settings.order, settings.rays, settings.quality = 5, 512, "RAYS"
    away = np.array([0.0, 1.2, 3.0]) / np.hypot(1.2, 3)
    lamp = area(energy=3 * math.pi * 200 ** 2, location=tuple(200 * away), size=2)  # 3 W/m² on a plane that faces it
    lamp.rotation_euler = (-math.atan(1.2 / 3), 0, 0)
    bake()
    mirrored = picture([floor])
    bpy.data.objects.remove(lamp)
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy, sun.data.angle, sun.rotation_euler = 3, 0, (-math.atan(1.2 / 3), 0, 0)
    bpy.context.scene.collection.objects.link(sun)
    settings.lamps = False
    bake()
    truth = picture([floor])
    assert truth.max() > 0.5
    # the sun's light has five bands before it is multiplied by the cosine, the lamp's after
    assert np.linalg.norm(mirrored - truth) < 0.15 * np.linalg.norm(truth)


def test_metal_mirrors_an_area_lamp_where_cycles_does(floor, settings):
    """Softer and dimmer: there are five bands, and the cosine stays in what is mirrored (docs/gloss-error.md)."""
    metal(paint(floor, (1, 1, 1)), 0.6)
    area(energy=20, location=(0, 0.6, 1.5), size=0.8)
    settings.order, settings.rays, settings.quality = 5, 512, "RAYS"
    bake()
    shown, truth = picture([floor])[..., 0], cycles()[..., 0]
    seen = (truth > 0.02 * truth.max()) & (shown > 0)
    assert seen.mean() > 0.8
    assert np.corrcoef(shown[seen], truth[seen])[0, 1] > 0.95
    assert 0.6 < shown[seen].mean() / truth[seen].mean() < 1.05
    (row, column), (true_row, true_column) = ([int(np.average(axis, weights=np.where(seen, light, 0) ** 2)) for axis in
                                               np.indices(light.shape)] for light in (shown, truth))
    assert abs(row - true_row) <= 3 and abs(column - true_column) <= 3


def test_the_lamps_slider_dims_what_is_mirrored_and_what_glows(floor, make, settings):
    metal(paint(floor, (1, 1, 1)), 0.5)
    panel = make(*PANEL, name="Panel")
    paint(panel, emission=(1, 1, 1), strength=5)
    choose(floor)
    settings.rays, settings.quality = 64, "RAYS"
    bake()
    whole = picture([floor])
    settings.lamps_strength = 0.5
    half = picture([floor])
    assert whole.max() > 0.1
    np.testing.assert_allclose(half, whole / 2, atol=2e-3 * whole.max())


def test_reflected_light_by_the_network_is_mirrored(floor, make, settings):
    pytest.importorskip("torch", reason="the network needs torch")
    metal(paint(floor, (1, 1, 1)), 0.6)
    wall = make([(-1, 1, 0), (1, 1, 0), (1, 1, 2), (-1, 1, 2)], [(0, 3, 2, 1)], name="Wall")
    paint(wall, (0.9, 0.1, 0.1))
    choose(floor)
    area(energy=20, location=(0, 0, 1.5), size=0.4)
    settings.rays, settings.quality, settings.side = 1024, "RAYS", 24
    bake()
    paths = picture([floor])
    settings.lamps_by = "NETWORK"
    bake()
    network = picture([floor])
    seen = paths.max(-1) > 0
    assert np.linalg.norm((network - paths)[seen]) < 0.2 * np.linalg.norm(paths[seen])
    assert (paths[seen][:, 0] > 1.2 * paths[seen][:, 1]).mean() > 0.1  # the red wall
