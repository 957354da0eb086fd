# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy previews: the shader's pixels against NumPy, and what a light change does."""
from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

FLOOR = ([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [(0, 1, 2, 3)])
ALBEDO, SIZE = np.array([0.5, 0.4, 0.3]), 48


@pytest.fixture
def shiny(make, settings):
    """An open floor, baked to a small texture of order 5, with the colour ALBEDO."""
    floor = make(*FLOOR, "Floor")
    material = bpy.data.materials.new("Shiny")
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*ALBEDO, 1)
    floor.data.materials.append(material)
    settings.target, settings.side, settings.order, settings.method = "TEXTURE", 16, 5, "analytic"
    settings.gloss = True
    return floor, shader


def _light(seed=0):
    from neural_gash_addon.scene.lighting import apply_light, store_light
    lamp = np.random.default_rng(seed).normal(size=(25, 3))
    lamp[0] = 6
    store_light(bpy.context.scene, lamp)
    apply_light(bpy.context.scene)
    return lamp


def _camera():
    camera = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    camera.location, camera.data.angle = (0, 0, 3), 0.9
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.view_layer.update()
    return camera


def _expected(normal, light, roughness, metallic):
    """(SIZE, SIZE, 3) radiance of a plane through the origin, seen by the camera at (0, 0, 3); row 0 at the bottom."""
    from neural_gash_addon.backend import gloss, lobes, shading
    from neural_gash_addon.backend import spherical_harmonics as sh
    half = np.tan(0.45)
    line = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    x, y = np.meshgrid(line * half, line * half)
    view = -np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    normals = np.tile(normal, (len(view), 1))
    transfer = sh.cosine_lobe(normals, 5)
    glossy = gloss.reflected_radiance(gloss.transferred(transfer, light), view, normals,
                                      lobes.ggx_attenuation(roughness, 5))
    mirrored = 0.04 + metallic * (ALBEDO - 0.04)
    return (shading.radiance(transfer, light, ALBEDO * (1 - metallic)) + mirrored * glossy).reshape(SIZE, SIZE, 3)


@pytest.mark.parametrize(("roughness", "metallic", "tilt"), [(0.3, 1.0, 0), (0.7, 0.0, 0), (0.5, 0.6, 0.3)])
def test_pixels_equal_numpy(shiny, roughness, metallic, tilt):
    from neural_gash_addon.scene.render import render_pixels
    floor, shader = shiny
    shader.inputs["Roughness"].default_value, shader.inputs["Metallic"].default_value = roughness, metallic
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    floor.rotation_euler = (tilt, -tilt / 2, 1.1 * tilt)   # after the bake: the light turns into its frame
    bpy.context.view_layer.update()
    light = _light()
    normal = np.array(floor.matrix_world.to_3x3()) @ [0, 0, 1]
    picture = render_pixels([floor], camera=_camera(), resolution=(SIZE, SIZE), samples=256)[::-1, :, :3]
    expected = _expected(normal, light, roughness, metallic)
    dull = _expected(normal, light, roughness, metallic) - _expected(normal, light, 1.0, metallic)
    inner = (slice(8, -8), slice(8, -8))
    assert np.abs(dull[inner]).max() > 0.01
    # pixels average smooth radiance over their filter, by chance: 256 samples leave a little
    assert np.abs(picture - expected)[inner].max() < 1e-2 * np.abs(expected).max()
    assert np.abs(picture - expected)[inner].mean() < 1e-3 * np.abs(expected).max()


def test_light_changes_fill_the_images_and_nothing_else(shiny, settings):
    from neural_gash_addon.scene.gloss_nodes import gloss_images, is_gloss
    floor, _ = shiny
    bpy.ops.neural_gash.bake()
    group = next(n.node_tree for s in floor.material_slots for n in s.material.node_tree.nodes if n.type == "GROUP")
    assert is_gloss(group) and len(gloss_images(group)) == 20
    names = [len(getattr(bpy.data, kind)) for kind in ("images", "materials", "node_groups")]

    def pixels():
        values = np.empty(16 * 16 * 4, np.float32)
        gloss_images(group)[5].pixels.foreach_get(values)   # of harmonics that a turn about z changes
        return values

    before = pixels()
    _light()
    lit = pixels()
    settings.light_rotation = 1.0
    assert not np.allclose(before, lit) and not np.allclose(lit, pixels())
    settings.light_rotation = 0.0
    np.testing.assert_allclose(pixels(), lit, atol=1e-5)
    assert names == [len(getattr(bpy.data, kind)) for kind in ("images", "materials", "node_groups")]


def test_turned_off_and_cleared_leaves_nothing(shiny, settings):
    floor, _ = shiny
    before = sorted(i.name for i in bpy.data.images), sorted(g.name for g in bpy.data.node_groups)
    bpy.ops.neural_gash.bake()
    settings.gloss = False
    assert not [g for g in bpy.data.node_groups if "Gloss" in g.name] and \
        not [i for i in bpy.data.images if "gloss" in i.name]
    settings.gloss = True
    assert [g for g in bpy.data.node_groups if "Gloss" in g.name]
    bpy.ops.neural_gash.clear()
    images = sorted(i.name for i in bpy.data.images if i.name != "PRT lobes")
    after = images, sorted(g.name for g in bpy.data.node_groups)
    assert after == before
    assert [s.material and s.material.name for s in floor.material_slots] == ["Shiny"]


def test_a_reopened_file_is_lit_again(shiny, tmp_path):
    from neural_gash_addon.scene.gloss_nodes import gloss_images
    bpy.ops.neural_gash.bake()
    _light()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    floor = bpy.data.objects["Floor"]
    group = next(n.node_tree for s in floor.material_slots for n in s.material.node_tree.nodes if n.type == "GROUP")
    values = np.empty(16 * 16 * 4, np.float32)
    gloss_images(group)[0].pixels.foreach_get(values)
    assert np.abs(values).max() > 0.1


def test_vertex_bakes_stay_dull(make, settings):
    settings.gloss = True
    obj = make()
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    assert [n.node_tree.name for s in obj.material_slots for n in s.material.node_tree.nodes
            if n.type == "GROUP"] == ["PRT Shading 3"]
