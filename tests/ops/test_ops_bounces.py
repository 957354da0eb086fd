# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that bounces, from materials to what is rendered."""
from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

GRID = 12
FLOOR = ([(x / GRID * 2 - 1, y / GRID * 2 - 1, 0) for y in range(GRID + 1) for x in range(GRID + 1)],
         [(i + j * (GRID + 1), i + 1 + j * (GRID + 1), i + 1 + (j + 1) * (GRID + 1), i + (j + 1) * (GRID + 1))
          for j in range(GRID) for i in range(GRID)])
WALL = ([(-1, -1, 0), (-1, 1, 0), (-1, 1, 2), (-1, -1, 2)], [(0, 1, 2, 3)])


def _paint(obj, colour, image=None):
    material = bpy.data.materials.new(obj.name)
    material.use_nodes = True
    socket = material.node_tree.nodes["Principled BSDF"].inputs["Base Color"]
    socket.default_value = (*colour, 1)
    if image is not None:
        node = material.node_tree.nodes.new("ShaderNodeTexImage")
        node.image = image
        material.node_tree.links.new(node.outputs["Color"], socket)
    obj.data.materials.append(material)
    return material


def _bake():
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def _read(obj):
    from neural_gash_addon.scene.attributes import read_transfer
    return read_transfer(obj)


@pytest.fixture
def room(make, settings):
    """A white floor beside a red wall."""
    wall = make(*WALL, "Wall")
    _paint(wall, (0.8, 0.1, 0.1))
    floor = make(*FLOOR, "Floor", smooth=True)
    _paint(floor, (0.8, 0.8, 0.8))
    settings.occluders, settings.bounces = "VISIBLE", 8
    return floor, wall


def test_a_red_wall_reddens_the_floor(room):
    from neural_gash_addon.scene import staleness
    floor, wall = room
    _bake()
    transfer, record = _read(floor)
    assert transfer.shape == ((GRID + 1) ** 2, 9, 3) and record.colours == 3 and 1 <= record.bounces <= 8
    near = transfer[::GRID + 1][1:-1, 0].mean(0)
    assert near[0] > 1.05 * near[1] and near[1] == pytest.approx(near[2], rel=0.02)
    assert staleness.check(floor)
    wall.data.materials[0].node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.1, 0.8, 0.1, 1)
    bpy.context.view_layer.update()
    assert not staleness.check(floor)
    _bake()
    near = _read(floor)[0][::GRID + 1][1:-1, 0].mean(0)
    assert near[1] > 1.05 * near[0]


def test_black_surfaces_compute_no_bounce(room):
    floor, wall = room
    for obj in room:
        obj.data.materials[0].node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0, 0, 0, 1)
    _bake()
    transfer, record = _read(floor)
    assert transfer.shape == ((GRID + 1) ** 2, 9) and record.bounces == 0


def test_the_picture_is_the_numbers(room):
    from neural_gash_addon.backend import shading
    from neural_gash_addon.scene.lighting import apply_light, store_light
    from neural_gash_addon.scene.render import render_pixels
    floor, _ = room
    _bake()
    light = np.random.default_rng(0).normal(size=(25, 3))
    light[0] = 5
    bpy.context.scene.neural_gash.light_source = "SKY"  # which nothing changes
    store_light(bpy.context.scene, light)
    apply_light(bpy.context.scene)
    camera = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", 2, (0, 0, 5)
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.view_layer.update()
    picture = render_pixels([floor], camera=camera, resolution=(96, 96), samples=64)[::-1, :, :3]
    expected = shading.radiance(_read(floor)[0], light[:9], 0.8).reshape(GRID + 1, GRID + 1, 3)
    cells = 96 // GRID
    middle = (expected[1:, 1:] + expected[:-1, 1:] + expected[1:, :-1] + expected[:-1, :-1]) / 4
    shown = picture.reshape(GRID, cells, GRID, cells, 3).mean((1, 3))
    assert np.abs(shown - middle).mean() < 0.01 * np.abs(middle).mean()


def test_images_and_previews_give_their_colours(make, settings):
    from neural_gash_addon.scene.read import read_finish
    obj = make([(-1, -1, 0), (0, -1, 0), (0, 1, 0), (-1, 1, 0), (1, -1, 0), (1, 1, 0)], [(0, 1, 2, 3), (1, 4, 5, 2)])
    obj.data.uv_layers.new(name="Mine")
    for loop in obj.data.loops:
        x = obj.data.vertices[loop.vertex_index].co.x
        obj.data.uv_layers["Mine"].uv[loop.index].vector = (0.5 + 0.45 * x, 0.5)
    image = bpy.data.images.new("halves", 64, 4, float_buffer=True, is_data=True)
    pixels = np.ones((4, 64, 4), np.float32)
    pixels[:, :32, :3], pixels[:, 32:, :3] = (0.9, 0.1, 0.2), (0.1, 0.6, 0.3)
    image.pixels.foreach_set(pixels.ravel())
    _paint(obj, (0, 0, 0), image)

    def albedo():
        return read_finish(obj, "SELF", bpy.context.evaluated_depsgraph_get())[0][:, :3]

    expected = [(0.9, 0.1, 0.2)] * 2 + [(0.1, 0.6, 0.3)] * 2
    np.testing.assert_allclose(albedo(), expected, atol=0.03)  # the middle mixes both
    _bake()   # its preview stands in the slot now
    np.testing.assert_allclose(albedo(), expected, atol=0.03)  # the middle mixes both


def test_order_5_with_bounces_goes_to_textures(room, settings, refused):
    floor, _ = room
    settings.order = 5
    assert "texture" in refused(bpy.ops.neural_gash.bake)
    settings.target, settings.side = "TEXTURE", 32
    _bake()
    images = floor.data["neural_gash_images"]
    assert len(images.keys()) == 19
    values = np.empty((32, 32, 4), np.float32)
    images["0"].pixels.foreach_get(values.ravel())
    assert values[..., 0].mean() > 1.01 * values[..., 1].mean()   # red and green of the first coefficient


def _two_coloured(name, float_pixels):
    image = bpy.data.images.new(name, float_pixels.shape[1], float_pixels.shape[0], float_buffer=True, is_data=True)
    image.pixels.foreach_set(float_pixels.ravel())
    return image


@pytest.mark.parametrize("mirrored", [False, True])
def test_texels_take_the_colour_of_the_part_of_anothers_image_that_is_beside_them(make, settings, mirrored):
    from neural_gash_addon.scene.read import read_finish
    from neural_gash_addon.scene.uv_maps import read_uv
    wall = make(*WALL, "Wall")   # one face: its image changes within its triangles
    pixels = np.ones((4, 8, 4), np.float32)
    pixels[:, :4, :3], pixels[:, 4:, :3] = (0.9, 0.05, 0.05), (0.05, 0.9, 0.05)  # red where y < 0, green beyond
    _paint(wall, (0, 0, 0), _two_coloured("halves", pixels))
    wall.data.uv_layers.new(name="Mine")
    for loop in wall.data.loops:
        _, y, z = wall.data.vertices[loop.vertex_index].co
        wall.data.uv_layers["Mine"].uv[loop.index].vector = (0.5 + 0.45 * y * (-1 if mirrored else 1), 0.45 * z)
    if mirrored:
        wall.scale.y = -1
    floor = make([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2, 3)], "Floor")
    _paint(floor, (0.8, 0.8, 0.8))
    floor.data.uv_layers.new(name="Flat")
    for loop in floor.data.loops:
        floor.data.uv_layers["Flat"].uv[loop.index].vector = [
            0.5 + 0.5 * c for c in floor.data.vertices[loop.vertex_index].co[:2]]
    settings.occluders, settings.bounces, settings.target, settings.side = "VISIBLE", 2, "TEXTURE", 32
    settings.order, settings.uv_map = 3, "Flat"
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = floor
    _bake()
    assert len(read_uv(floor.data, "Flat")) == 4
    images = floor.data["neural_gash_images"]
    values = np.empty((32, 32, 4), np.float32)
    images["0"].pixels.foreach_get(values.ravel())
    red, green = values[:, :6, 0], values[:, :6, 1]   # beside the wall; rows go along y
    assert red[3:10].mean() > 1.05 * green[3:10].mean() and green[22:29].mean() > 1.05 * red[22:29].mean()
    found, (picture,) = read_finish(wall, "SELF", bpy.context.evaluated_depsgraph_get())
    assert found[:, 0].max() < 0.8 and picture.lookups()[..., 0].max() > 0.85   # a mean, and what it is of


def test_the_embedding_has_them_at_vertices(room, settings):
    pytest.importorskip("torch")
    floor, _ = room
    settings.method = "embedding"
    _bake()
    transfer, record = _read(floor)
    assert record.method == "embedding" and record.colours == 3 and 1 <= record.bounces <= 8
    near = transfer[::GRID + 1][1:-1, 0].mean(0)
    assert near[0] > 1.05 * near[1] and near[1] == pytest.approx(near[2], rel=0.02)
    settings.method = "embree"
    _bake()
    reddened, truth = (each[:, 0, 0].mean() / each[:, 0, 1].mean() for each in (transfer, _read(floor)[0]))
    assert truth > 1.1 and reddened == pytest.approx(truth, rel=0.02)


def test_the_embedding_has_them_in_textures(room, settings):
    pytest.importorskip("torch")
    floor, _ = room
    settings.method, settings.target, settings.side = "embedding", "TEXTURE", 32
    _bake()
    values = np.empty((32, 32, 4), np.float32)
    floor.data["neural_gash_images"]["0"].pixels.foreach_get(values.ravel())
    assert values[..., 0].mean() > 1.01 * values[..., 1].mean()


@pytest.mark.parametrize("method, shown", [("embree", True), ("embedding", True), ("gnn", False), ("analytic", False)])
def test_the_panel_offers_them_where_the_method_follows_them(room, settings, method, shown):
    from .test_ops_registration import _draw
    settings.method = method
    assert ("bounces" in _draw("settings")) == shown
