# SPDX-License-Identifier: GPL-3.0-or-later
"""The World and the suns become the light that Cycles shows."""
import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from mathutils import Euler  # noqa: E402

from neural_gash_addon.backend import light as sh_light  # noqa: E402
from neural_gash_addon.backend import spherical_harmonics as sh  # noqa: E402
from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.scene.world import forget_image, rotated_light, world_light  # noqa: E402


def _world(strength=1.0, colour=(0.2, 0.5, 1.0)):
    """A World with a Background, of the current scene."""
    world = bpy.data.worlds.new("World")
    if bpy.app.version < (5, 0, 0):
        world.use_nodes = True
    bpy.context.scene.world = world
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (*colour, 1)
    background.inputs["Strength"].default_value = strength
    return world


def _environment(pixels, rotation=None, kind="POINT", is_float=True):
    """The World shows an image (H, W, 3), row 0 at the bottom."""
    world = _world(strength=1.5)
    height, width = pixels.shape[:2]
    image = bpy.data.images.new("Sky", width, height, float_buffer=is_float, is_data=is_float)
    opaque = np.concatenate([pixels, np.ones((height, width, 1))], -1)
    image.pixels.foreach_set(opaque.astype(np.float32).ravel())
    image.update()
    tree = world.node_tree
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = image
    texture.interpolation = "Closest"
    tree.links.new(texture.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    if rotation is not None:
        mapping, coordinates = tree.nodes.new("ShaderNodeMapping"), tree.nodes.new("ShaderNodeTexCoord")
        mapping.vector_type = kind
        mapping.inputs["Rotation"].default_value = rotation
        tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
        tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    return world, texture


def _constant(colour, order=3):
    return sh_light.constant(np.array(colour), order)


def test_no_world_is_black():
    bpy.context.scene.world = None
    np.testing.assert_array_equal(world_light(bpy.context.scene, 3), np.zeros((9, 3)))


def test_plain_colour_and_strength():
    _world(strength=2.5)
    np.testing.assert_allclose(world_light(bpy.context.scene, 4), _constant((0.5, 1.25, 2.5), 4), atol=1e-6)


def test_colour_node_and_reroute():
    world = _world()
    tree = world.node_tree
    colour, reroute = tree.nodes.new("ShaderNodeRGB"), tree.nodes.new("NodeReroute")
    colour.outputs[0].default_value = (1, 2, 3, 1)
    tree.links.new(colour.outputs[0], reroute.inputs[0])
    tree.links.new(reroute.outputs[0], tree.nodes["Background"].inputs["Color"])
    np.testing.assert_allclose(world_light(bpy.context.scene, 3), _constant((1, 2, 3)), atol=1e-6)


def test_world_without_nodes():
    world = bpy.data.worlds.new("Plain")
    bpy.context.scene.world = world
    if bpy.app.version >= (5, 0, 0):
        pytest.skip("from 5.0 on every World has nodes")
    world.color = (0.1, 0.2, 0.3)
    np.testing.assert_allclose(world_light(bpy.context.scene, 3), _constant((0.1, 0.2, 0.3)), atol=1e-6)


def test_world_of_no_nodes_at_all_is_black():
    _world().node_tree.nodes.clear()
    assert not world_light(bpy.context.scene, 3).any()


@pytest.mark.parametrize("kind", [None, "POINT", "TEXTURE", "VECTOR", "NORMAL"])
def test_bright_texel_is_where_cycles_shows_it(render, camera, kind):
    pixels = np.full((16, 32, 3), 0.01)
    pixels[11, 5] = (100, 200, 300)
    _environment(pixels, None if kind is None else Euler((0.4, -0.8, 2.1)), kind or "POINT")
    light = world_light(bpy.context.scene, 3)
    towards = light[[3, 1, 2], 0] / np.linalg.norm(light[[3, 1, 2], 0])
    camera((0, 0, 0), towards, angle=math.radians(2))
    np.testing.assert_allclose(render(4, 4)[..., :3], np.broadcast_to((150, 300, 450), (4, 4, 3)), rtol=1e-5)
    camera((0, 0, 0), -towards, angle=math.radians(2))
    np.testing.assert_allclose(render(4, 4)[..., :3], 0.015, rtol=1e-5)


@pytest.mark.parametrize("kind", ["POINT", "TEXTURE"])
def test_image_light_is_what_cycles_shows_all_round(render, camera, kind):
    """Monte Carlo of the harmonics over what a camera sees in many directions."""
    rng = np.random.default_rng(3)
    pixels = rng.uniform(0, 2, (4, 8, 3))
    _environment(pixels, Euler((1.0, 0.3, -0.7)), kind)
    light = world_light(bpy.context.scene, 3)
    total, weight = np.zeros((9, 3)), 0.0
    for towards in np.concatenate([np.eye(3), -np.eye(3)]):  # the six faces of a cube
        obj = camera((0, 0, 0), towards, angle=math.pi / 2)
        bpy.context.view_layer.update()
        size = 96
        picture = render(size, size)[..., :3].reshape(-1, 3).astype(float)
        line = (np.arange(size) + 0.5) / size * 2 - 1
        x, y = (a.ravel() for a in np.meshgrid(line, line))
        local = np.stack([x, y, -np.ones_like(x)], -1)
        solid_angle = (2 / size) ** 2 / np.linalg.norm(local, axis=1) ** 3
        directions = local @ np.array(obj.matrix_world)[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        total += (sh.evaluate(directions, 3) * solid_angle[:, None]).T @ picture
        weight += solid_angle.sum()
    assert weight == pytest.approx(4 * math.pi, rel=1e-3)
    np.testing.assert_allclose(total, light, atol=0.02 * np.abs(light).max())


def test_byte_srgb_image_is_linearised(render, camera):
    pixels = np.full((2, 4, 3), 128 / 255)
    pixels[..., 0] = 8 / 255
    _environment(pixels, is_float=False)
    camera((0, 0, 0), (1, 0, 0), angle=0.1)
    shown = render(4, 4)[0, 0, :3]
    light = world_light(bpy.context.scene, 2)
    np.testing.assert_allclose(light[0], math.sqrt(4 * math.pi) * shown, rtol=1e-4)


@pytest.mark.parametrize("space", ["sRGB", "Non-Color"])
def test_alpha_darkens_colours_but_not_numbers_as_in_cycles(render, camera, tmp_path, space):
    """A normal map or a roughness may have something of its own in the alpha of its file."""
    _, texture = _environment(np.ones((2, 4, 3)), is_float=False)
    drawn = bpy.data.images.new("drawn", 4, 2, alpha=True)
    drawn.pixels.foreach_set(np.tile(np.array([0.2, 0.4, 0.8, 0.25], np.float32), 8))
    drawn.filepath_raw, drawn.file_format = str(tmp_path / "drawn.png"), "PNG"
    drawn.save()
    texture.image = bpy.data.images.load(drawn.filepath_raw)
    texture.image.colorspace_settings.name = space
    assert texture.image.alpha_mode == "STRAIGHT"
    camera((0, 0, 0), (1, 0, 0), angle=0.1)
    shown = render(4, 4)[0, 0, :3]
    np.testing.assert_allclose(world_light(bpy.context.scene, 2)[0], math.sqrt(4 * math.pi) * shown,
                               rtol=0.01, atol=0.005)  # eight bits


def test_image_is_read_anew_when_it_is_forgotten():
    _, texture = _environment(np.ones((2, 4, 3)))
    before = world_light(bpy.context.scene, 2)
    texture.image.pixels.foreach_set(np.full(32, 2, np.float32))
    forget_image(bpy.data.images.new("Another", 1, 1))
    np.testing.assert_array_equal(world_light(bpy.context.scene, 2), before)
    forget_image(texture.image)
    np.testing.assert_allclose(world_light(bpy.context.scene, 2), 2 * before, atol=1e-6)


def test_image_from_a_file(tmp_path):
    _, texture = _environment(np.random.default_rng(0).uniform(0, 5, (8, 16, 3)))
    before = world_light(bpy.context.scene, 3)
    image = texture.image
    image.file_format = "OPEN_EXR"
    image.filepath_raw = str(tmp_path / "sky.exr")
    image.save()
    texture.image = bpy.data.images.load(image.filepath_raw)
    np.testing.assert_allclose(world_light(bpy.context.scene, 3), before, rtol=1e-3, atol=1e-3)


def _mirror_ball(world, texture):
    texture.projection = "MIRROR_BALL"


def _no_image(world, texture):
    texture.image = None


def _missing_file(world, texture):
    texture.image = bpy.data.images.new("Gone", 4, 4)
    texture.image.source = "FILE"
    texture.image.filepath = "/nowhere/gone.hdr"


def _sequence(world, texture):
    texture.image.source = "SEQUENCE"


def _sky(world, texture):
    tree = world.node_tree
    noise = tree.nodes.new("ShaderNodeTexNoise")
    tree.links.new(noise.outputs["Color"], tree.nodes["Background"].inputs["Color"])


def _mixed(world, texture):
    tree = world.node_tree
    mix = tree.nodes.new("ShaderNodeAddShader")
    tree.links.new(mix.outputs[0], tree.nodes["World Output"].inputs["Surface"])


def _driven_strength(world, texture):
    tree = world.node_tree
    value = tree.nodes.new("ShaderNodeValue")
    tree.links.new(value.outputs[0], tree.nodes["Background"].inputs["Strength"])


def _mapping(world):
    return next(n for n in world.node_tree.nodes if n.type == "MAPPING")


def _moved(world, texture):
    _mapping(world).inputs["Location"].default_value = (0, 0, 1)


def _flipped(world, texture):
    _mapping(world).inputs["Scale"].default_value = (-1, 1, 1)


def _driven_rotation(world, texture):
    tree = world.node_tree
    value = tree.nodes.new("ShaderNodeCombineXYZ")
    tree.links.new(value.outputs[0], _mapping(world).inputs["Rotation"])


def _other_coordinates(world, texture):
    tree = world.node_tree
    coordinates = next(n for n in tree.nodes if n.type == "TEX_COORD")
    tree.links.new(coordinates.outputs["Window"], _mapping(world).inputs["Vector"])


def _unmapped(world, texture):
    tree = world.node_tree
    tree.links.remove(_mapping(world).inputs["Vector"].links[0])


@pytest.mark.parametrize("spoil", [_mirror_ball, _no_image, _missing_file, _sequence, _sky, _mixed,
                                   _driven_strength, _moved, _flipped, _driven_rotation, _other_coordinates,
                                   _unmapped])
def test_what_cannot_be_read_gets_one_sentence(spoil):
    world, texture = _environment(np.ones((2, 4, 3)), Euler((0, 0, 1)))
    world_light(bpy.context.scene, 3)
    spoil(world, texture)
    with pytest.raises(UserError) as error:
        world_light(bpy.context.scene, 3)
    text = str(error.value)
    assert "'World'" in text and text.endswith(".") and text.count(". ") == 0


def test_even_scale_and_reroutes_change_nothing():
    world, texture = _environment(np.random.default_rng(0).uniform(0, 1, (4, 8, 3)), Euler((0.3, 0.2, 1)))
    before = world_light(bpy.context.scene, 3)
    _mapping(world).inputs["Scale"].default_value = (2, 2, 2)
    tree = world.node_tree
    for socket in (texture.inputs["Vector"], _mapping(world).inputs["Vector"]):
        reroute = tree.nodes.new("NodeReroute")
        tree.links.new(socket.links[0].from_socket, reroute.inputs[0])
        tree.links.new(reroute.outputs[0], socket)
    np.testing.assert_allclose(world_light(bpy.context.scene, 3), before, atol=1e-6)


def _sun(rotation=(0.5, 0.3, 0), **settings):
    data = bpy.data.lights.new("Sun", "SUN")
    data.angle = 0
    for name, value in settings.items():
        setattr(data, name, value)
    obj = bpy.data.objects.new("Sun", data)
    obj.rotation_euler = rotation
    bpy.context.scene.collection.objects.link(obj)
    return obj


SUNS = [{}, {"color": (1, 0.5, 0.25), "energy": 3}, {"exposure": 1.5},
        {"use_temperature": True, "temperature": 3000}, {"angle": 0.6}, {"angle": 0.6, "normalize": False}]


@pytest.mark.parametrize("settings", SUNS, ids=lambda s: ", ".join(s) or "plain")
def test_sun_lights_a_plane_as_in_cycles(make, render, camera, settings):
    bpy.context.scene.world = None
    if not all(n in bpy.types.SunLight.bl_rna.properties for n in settings):
        pytest.skip("this Blender's suns have no such setting")
    _sun(**settings)
    plane = make.grid(1)
    material = bpy.data.materials.new("White")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    tree = material.node_tree
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (1, 1, 1, 1)
    tree.links.new(diffuse.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    plane.data.materials.append(material)
    camera((0, 0, 5), (0, 0, -1), width=1)
    shown = render(16, 16, samples=64)[..., :3].mean((0, 1))
    light = world_light(bpy.context.scene, 2)
    towards = light[[3, 1, 2], 0] / np.linalg.norm(light[[3, 1, 2], 0])
    np.testing.assert_allclose(towards, np.array(Euler((0.5, 0.3, 0)).to_matrix())[:, 2], atol=1e-6)
    irradiance = light[0] / sh.evaluate(towards[None], 1)[0, 0]
    # the exact cosine, not its four-coefficient approximation
    np.testing.assert_allclose(irradiance * towards[2] / math.pi, shown, rtol=5e-3)


def test_hidden_suns_do_not_shine(make):
    bpy.context.scene.world = None
    visible, hidden, unrendered = _sun(), _sun(), _sun()
    lit = world_light(bpy.context.scene, 3)
    hidden.hide_set(True)
    unrendered.hide_render = True
    np.testing.assert_allclose(world_light(bpy.context.scene, 3), lit / 3, atol=1e-6)
    visible.rotation_euler = (0, 0, 0)
    light = world_light(bpy.context.scene, 3)
    np.testing.assert_allclose(light[2, 0] / light[0, 0], math.sqrt(3), rtol=1e-5)


def test_rotated_light_turns_about_z():
    light = sh.evaluate(np.array([[1.0, 0, 0]]), 3).T * np.ones((1, 3))
    turned = rotated_light(light, math.pi / 2, 2.0)
    np.testing.assert_allclose(turned[:, 0], 2 * sh.evaluate(np.array([[0.0, 1, 0]]), 3)[0], atol=1e-9)
