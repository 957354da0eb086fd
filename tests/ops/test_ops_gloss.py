# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy previews: the shader's pixels against NumPy, and what a light change does."""
from __future__ import annotations

from ctypes.util import find_library

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

FLOOR = ([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [(0, 1, 2, 3)])
ALBEDO, SIZE, ANGLE = np.array([0.5, 0.4, 0.3]), 48, 0.9
VARYING = 0.2, 0.5  # slope along x, and roughness at 0


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
    bpy.context.scene.neural_gash.light_source = "SKY"  # which nothing changes
    store_light(bpy.context.scene, lamp)
    apply_light(bpy.context.scene)
    return lamp


def _camera():
    camera = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    camera.location, camera.data.angle = (0, 0, 3), ANGLE
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.view_layer.update()
    return camera


def _expected(normal, light, roughness, metallic, lobe="GGX"):
    """(SIZE, SIZE, 3) radiance of a plane through the origin, seen by the camera at (0, 0, 3); row 0 at the bottom.

    Args:
        roughness: a number, or None for VARYING of a plane in z = 0.
    """
    from neural_gash_addon.backend import gloss, lobes, shading
    from neural_gash_addon.backend import spherical_harmonics as sh
    half = np.tan(ANGLE / 2)
    line = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    x, y = np.meshgrid(line * half, line * half)
    if roughness is None:
        roughness = VARYING[0] * 3 * x.ravel() + VARYING[1]
    roughness = np.asarray(roughness)
    bands = lobes.ggx_attenuation(roughness, 5) if lobe == "GGX" else \
        lobes.phong_attenuation((roughness ** -4 - 1) / 2, 5)
    view = -np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    normals = np.tile(normal, (len(view), 1))
    transfer = sh.cosine_lobe(normals, 5)
    glossy = gloss.reflected_radiance(gloss.transferred(transfer, light), view, normals, bands)
    mirrored = 0.04 + metallic * (ALBEDO - 0.04)
    return (shading.radiance(transfer, light, ALBEDO * (1 - metallic)) + mirrored * glossy).reshape(SIZE, SIZE, 3)


def _vary(material, socket):
    """Link a roughness that rises along x."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    place, split, rise = (nodes.new(f"ShaderNode{kind}") for kind in ("NewGeometry", "SeparateXYZ", "Math"))
    rise.operation = "MULTIPLY_ADD"
    rise.inputs[1].default_value, rise.inputs[2].default_value = VARYING
    links.new(place.outputs["Position"], split.inputs[0])
    links.new(split.outputs["X"], rise.inputs[0])
    links.new(rise.outputs[0], socket)


@pytest.mark.parametrize(("roughness", "metallic", "tilt", "lobe"), [
    (0.3, 1.0, 0, "GGX"), (0.7, 0.0, 0, "GGX"), (0.5, 0.6, 0.3, "GGX"), (None, 1.0, 0, "GGX"),
    (0.3, 1.0, 0, "PHONG"), (0.8, 0.0, 0, "PHONG"), (0.5, 0.6, 0.3, "PHONG"), (None, 1.0, 0, "PHONG")])
def test_pixels_equal_numpy(shiny, settings, roughness, metallic, tilt, lobe):
    from neural_gash_addon.scene.render import render_pixels
    floor, shader = shiny
    settings.lobe = lobe
    shader.inputs["Metallic"].default_value = metallic
    if roughness is None:
        _vary(floor.data.materials[0], shader.inputs["Roughness"])
    else:
        shader.inputs["Roughness"].default_value = roughness
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    floor.rotation_euler = (tilt, -tilt / 2, 1.1 * tilt)   # after the bake: the light turns into its frame
    bpy.context.view_layer.update()
    light = _light()
    normal = np.array(floor.matrix_world.to_3x3()) @ [0, 0, 1]
    picture = render_pixels([floor], camera=_camera(), resolution=(SIZE, SIZE), samples=256)[::-1, :, :3]
    expected = _expected(normal, light, roughness, metallic, lobe)
    inner = (slice(8, -8), slice(8, -8))
    other = _expected(normal, light, roughness, metallic, {"GGX": "PHONG", "PHONG": "GGX"}[lobe])
    for wrong in (_expected(normal, light, 1.0, metallic, lobe), other):
        assert np.abs(expected - wrong)[inner].max() > 1e-2 * np.abs(expected).max()
    # pixels average smooth radiance over their filter, by chance: 256 samples leave a little
    assert np.abs(picture - expected)[inner].max() < 1e-3 * np.abs(expected).max()


@pytest.mark.skipif(not find_library("EGL"), reason="EEVEE needs a graphics driver")
def test_eevee_pixels_equal_numpy_to_half_precision(shiny, tmp_path):
    """With images for colour and roughness besides: 23 textures in one material."""
    floor, shader = shiny
    tree = floor.data.materials[0].node_tree
    for name, value in (("Base Color", ALBEDO), ("Roughness", [0.3] * 3)):
        image = bpy.data.images.new(name, 4, 4, float_buffer=True, is_data=True)
        image.pixels.foreach_set(np.tile([*value, 1], 16).astype(np.float32))
        node = tree.nodes.new("ShaderNodeTexImage")
        node.image = image
        tree.links.new(node.outputs["Color"], shader.inputs[name])
    shader.inputs["Metallic"].default_value = 1.0
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    light = _light()
    scene = bpy.context.scene
    scene.camera = _camera()
    scene.render.engine = "BLENDER_EEVEE" if bpy.app.version >= (5, 0, 0) else "BLENDER_EEVEE_NEXT"
    scene.eevee.taa_render_samples, scene.render.filter_size = 1, 0.01
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.resolution_percentage = 100
    if bpy.app.version >= (5, 0, 0):
        scene.render.image_settings.media_type = "IMAGE"
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(tmp_path / "picture.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    picture = np.empty((SIZE, SIZE, image.channels), np.float32)
    image.pixels.foreach_get(picture.ravel())
    expected = np.maximum(_expected(np.array([0., 0, 1]), light, 0.3, 1.0), 0)  # it cannot show less
    inner = (slice(8, -8), slice(8, -8))
    assert expected[inner].max() > 1.2 * expected[inner].min() > 0
    np.testing.assert_allclose(picture[..., :3][inner], expected[inner], atol=3e-3 * expected.max())


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


def test_another_lobe_shows_at_once_and_leaves_nothing_behind(shiny, settings):
    from neural_gash_addon.scene.gloss_nodes import lobe_of
    floor, _ = shiny
    bpy.ops.neural_gash.bake()
    _light()

    def group():
        return next(n.node_tree for s in floor.material_slots for n in s.material.node_tree.nodes if n.type == "GROUP")

    assert lobe_of(group()) == "GGX"
    count = [len(getattr(bpy.data, kind)) for kind in ("materials", "node_groups")]
    settings.lobe = "PHONG"
    assert lobe_of(group()) == "PHONG"
    assert [len(getattr(bpy.data, kind)) for kind in ("materials", "node_groups")] == count
    for action in (bpy.ops.neural_gash.preview, bpy.ops.neural_gash.preview, bpy.ops.neural_gash.bake):
        action()
    assert lobe_of(group()) == "PHONG"
    settings.lobe = "GGX"
    assert lobe_of(group()) == "GGX" and len([i for i in bpy.data.images if "gloss" in i.name]) == 20


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
    images = sorted(i.name for i in bpy.data.images if not i.name.startswith("PRT lobes"))
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
