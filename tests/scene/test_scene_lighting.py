# SPDX-License-Identifier: GPL-3.0-or-later
"""Previews follow the light that their scene has chosen, on their own."""
import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

import neural_gash_addon  # noqa: E402
from neural_gash_addon.backend import light as sh_light  # noqa: E402
from neural_gash_addon.backend import spherical_harmonics as sh  # noqa: E402
from neural_gash_addon.scene import lighting, preview  # noqa: E402
from neural_gash_addon.scene.world import rotated_light, world_light  # noqa: E402


@pytest.fixture(autouse=True)
def addon(empty_file):
    """Handlers and settings are there."""
    neural_gash_addon.register()
    yield
    neural_gash_addon.unregister()


@pytest.fixture
def lit(make):
    """A baked object with its preview on, lit by a World that has an image, turned; and the parts of that World."""
    world = bpy.data.worlds.new("World")
    if bpy.app.version < (5, 0, 0):
        world.use_nodes = True
    bpy.context.scene.world = world
    tree = world.node_tree
    texture, mapping, coordinates = (tree.nodes.new(f"ShaderNode{kind}") for kind in
                                     ("TexEnvironment", "Mapping", "TexCoord"))
    texture.image = _image("Sky", 1)
    tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    tree.links.new(texture.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    obj = make.sphere(detail=1)
    make.bake(obj)
    preview.preview_on(obj)
    lighting.take_light(bpy.context.scene)
    lighting.apply_light(bpy.context.scene)
    return obj, tree.nodes["Background"], mapping, texture


def _image(name, seed):
    image = bpy.data.images.new(name, 16, 8, float_buffer=True, is_data=True)
    image.pixels.foreach_set(np.random.default_rng(seed).uniform(0, 2, 16 * 8 * 4).astype(np.float32))
    return image


def _constants(obj):
    """(9, 3) light constants of the preview, as the shader has them."""
    node = next(n for n in obj.material_slots[0].material.node_tree.nodes if n.type == "GROUP")
    return np.array([node.inputs[f"L{i}"].default_value[:3] for i in range(9)])


def _followed(obj):
    """Assert that the preview has the World's light as it is now, which is another than before."""
    before = _constants(obj)
    bpy.context.view_layer.update()
    now = _constants(obj)
    expected = rotated_light(world_light(bpy.context.scene, 3), bpy.context.scene.neural_gash.light_rotation)
    np.testing.assert_allclose(now, expected, atol=1e-5)
    assert np.abs(now - before).max() > 1e-3
    return now


def test_the_world_is_followed(lit):
    obj, background, mapping, texture = lit
    background.inputs["Strength"].default_value = 3
    _followed(obj)
    mapping.inputs["Rotation"].default_value = (0.2, 0.4, 1)
    _followed(obj)
    bpy.context.scene.neural_gash.light_rotation = 1
    texture.image = _image("Another", 2)
    _followed(obj)
    other = bpy.data.worlds.new("Other")
    if bpy.app.version < (5, 0, 0):
        other.color = (1, 0.5, 0)
    else:
        other.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 0.5, 0, 1)
    bpy.context.scene.world = other
    _followed(obj)


def test_suns_are_followed(lit):
    obj = lit[0]
    bpy.context.scene.world = None
    _followed(obj)
    lamp = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    bpy.context.scene.collection.objects.link(lamp)
    _followed(obj)
    lamp.data.energy = 5
    _followed(obj)
    lamp.rotation_euler = (1, 0.5, 0)
    shining = _followed(obj)
    lamp.hide_render = True
    assert np.abs(_followed(obj)).max() == 0
    lamp.hide_render = False
    np.testing.assert_allclose(_followed(obj), shining, atol=1e-6)
    holder = bpy.data.objects.new("Crane", bpy.data.meshes.new("Crane"))
    bpy.context.scene.collection.objects.link(holder)
    lamp.parent = holder
    bpy.context.view_layer.update()
    holder.rotation_euler = (0, 1, 0)
    _followed(obj)
    bpy.data.objects.remove(lamp)
    assert np.abs(_followed(obj)).max() == 0


def test_animated_light_is_followed(lit):
    obj, background, *_ = lit
    strength = background.inputs["Strength"]
    for frame, value in ((1, 1), (11, 11)):
        strength.default_value = value
        strength.keyframe_insert("default_value", frame=frame)
    bpy.context.scene.frame_set(1)
    one = _constants(obj)
    for frame in (6, 11):
        bpy.context.scene.frame_set(frame)
        assert _constants(obj)[0, 0] / one[0, 0] == pytest.approx(strength.default_value, rel=1e-4)
    assert strength.default_value == pytest.approx(11)


def test_undo_takes_the_light_back(lit):
    obj, background, *_ = lit
    name = obj.name
    bpy.ops.ed.undo_push(message="before")
    before = _constants(obj)
    background.inputs["Strength"].default_value = 3
    bpy.ops.ed.undo_push(message="stronger")
    bpy.context.view_layer.update()
    np.testing.assert_allclose(_constants(obj), 3 * before, rtol=1e-5)
    bpy.ops.ed.undo_push(message="something else")
    bpy.ops.ed.undo()
    bpy.ops.ed.undo()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(_constants(bpy.data.objects[name]), before, rtol=1e-5)
    bpy.ops.ed.redo()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(_constants(bpy.data.objects[name]), 3 * before, rtol=1e-5)


def test_what_cannot_be_read_leaves_the_light_and_says_so(lit):
    obj, background, _, texture = lit
    before = _constants(obj)
    texture.projection = "MIRROR_BALL"
    bpy.context.view_layer.update()
    np.testing.assert_array_equal(_constants(obj), before)
    assert "mirror ball" in lighting.problem(bpy.context.scene)
    texture.projection = "EQUIRECTANGULAR"
    background.inputs["Strength"].default_value = 2
    _followed(obj)
    assert lighting.problem(bpy.context.scene) == ""


def test_other_sources(lit, tmp_path):
    obj, background, _, texture = lit
    settings = bpy.context.scene.neural_gash
    settings.sky = (1, 2, 3)
    settings.light_source = "SKY"
    sky = sh_light.constant(np.array((1, 2, 3)), 3)
    np.testing.assert_allclose(_constants(obj), sky, atol=1e-5)
    background.inputs["Strength"].default_value = 7
    bpy.context.view_layer.update()
    np.testing.assert_allclose(_constants(obj), sky, atol=1e-5)  # the World is not what was chosen
    settings.light_source = "HDRI"
    assert "Choose" in lighting.problem(bpy.context.scene)
    settings.hdri = str(tmp_path / "missing.exr")
    assert "missing.exr" in lighting.problem(bpy.context.scene)
    np.testing.assert_allclose(_constants(obj), sky, atol=1e-5)
    image = texture.image
    image.file_format = "OPEN_EXR"
    image.filepath_raw = str(tmp_path / "sky.exr")
    image.save()
    count = len(bpy.data.images)
    settings.hdri = image.filepath_raw
    pixels = np.array(image.pixels[:]).reshape(8, 16, 4)
    np.testing.assert_allclose(_constants(obj), sh_light.project_equirect(pixels, 3), rtol=1e-3, atol=1e-3)
    assert len(bpy.data.images) == count and lighting.problem(bpy.context.scene) == ""
    lamp = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    lamp.data.energy = math.pi
    bpy.context.scene.collection.objects.link(lamp)
    settings.light_source = "SUNS"
    np.testing.assert_allclose(_constants(obj), sh_light.sun(np.array((0, 0, 1.0)), np.full(3, math.pi), 3), atol=1e-5)
    settings.light_source = "WORLD"
    np.testing.assert_allclose(_constants(obj), world_light(bpy.context.scene, 3), atol=1e-5)


def test_a_scene_without_light_leaves_others_previews(lit):
    obj = lit[0]
    before = _constants(obj)
    other = bpy.data.scenes.new("Other")
    other.collection.objects.link(obj)
    other.world = bpy.data.worlds.new("Dark")
    other.view_layers[0].update()
    np.testing.assert_array_equal(_constants(obj), before)
    assert len(before) == sh.coefficient_count(3)


def test_a_rendered_animation_shows_no_stale_light(lit, tmp_path):
    """Each frame of a render has that frame's light."""
    _, background, *_ = lit
    strength = background.inputs["Strength"]
    for frame, value in ((1, 0.25), (3, 1.25)):
        strength.default_value = value
        strength.keyframe_insert("default_value", frame=frame)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", 2.2, (0, 0, 5)
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.seed = "CYCLES", 4, False, 1
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(tmp_path / "frame")
    scene.frame_start, scene.frame_end = 1, 3
    scene.render.film_transparent = True
    bpy.ops.render.render(animation=True)
    shown = []
    for frame in (1, 2, 3):
        image = bpy.data.images.load(str(tmp_path / f"frame{frame:04d}.exr"))
        shown.append(np.array(image.pixels[:]).reshape(-1, 4)[:, :3])
    assert shown[0].max() > 0.01
    np.testing.assert_allclose(shown[1], shown[0] * 3, rtol=2e-2, atol=2e-3)  # half way, as the curve is even
    np.testing.assert_allclose(shown[2], shown[0] * 5, rtol=2e-2, atol=2e-3)
