# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes to textures through the operators: images, UV maps, previews, files, and bad input."""
from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

bpy = pytest.importorskip("bpy")

FLOOR = ([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [(0, 1, 2, 3)])


@pytest.fixture
def texture(settings):
    """Settings of a small texture."""
    settings.target, settings.side, settings.order = "TEXTURE", 64, 3
    return settings


def _bake():
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def _images(obj):
    stored = obj.data.get("neural_gash_images")
    return [] if stored is None else [stored[key] for key in sorted(stored.keys(), key=int)]


def _pixels(image):
    values = np.empty((image.size[1], image.size[0], 4), np.float32)
    image.pixels.foreach_get(values.ravel())
    return values


def _state(obj):
    return ([u.name for u in obj.data.uv_layers], [(u.active, u.active_render) for u in obj.data.uv_layers],
            [(s.link, s.material and s.material.name) for s in obj.material_slots], sorted(obj.data.keys()),
            sorted(i.name for i in bpy.data.images), sorted(g.name for g in bpy.data.node_groups),
            sorted(m.name for m in bpy.data.materials))


@pytest.mark.parametrize("uv_maps", [0, 2])
def test_bake_and_clear_leave_the_mesh_as_it_was(make, texture, uv_maps):
    obj = make()
    for number in range(uv_maps):
        obj.data.uv_layers.new(name=f"Mine {number}")
    if uv_maps:
        obj.data.uv_layers["Mine 1"].active_render = True
    before = _state(obj)
    _bake()
    record = obj.data["neural_gash"]
    assert '"target": "texture"' in record and '"uv_map": "PRT"' in record
    assert [tuple(i.size) for i in _images(obj)] == [(64, 64)] * 3
    assert all(i.packed_file and i.alpha_mode == "CHANNEL_PACKED" and i.colorspace_settings.name == "Non-Color"
               for i in _images(obj))
    assert _state(obj)[0] == before[0] + ["PRT"]
    assert [u.name for u in obj.data.uv_layers if u.active_render] == (["Mine 1"] if uv_maps else ["PRT"])
    _bake()
    assert len(bpy.data.images) == 3 and len(obj.data.uv_layers) == uv_maps + 1
    bpy.ops.neural_gash.clear()
    assert _state(obj) == before


def test_numbers_are_those_of_the_library_and_survive_saving(make, texture, tmp_path):
    from neural_gash_addon.backend import methods
    from neural_gash_addon.backend import texture as backend
    from neural_gash_addon.scene.read import read_object
    from neural_gash_addon.scene.uv_maps import read_uv
    obj = make()
    _bake()
    surface = read_object(obj, bpy.context.evaluated_depsgraph_get()).surface
    found = methods.run(backend.bake(surface, order=3, side=64, rays=64))
    np.testing.assert_array_equal(read_uv(obj.data, "PRT"), found.uv.astype(np.float32))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    obj = bpy.data.objects["Thing"]
    for number, image in enumerate(_images(obj)):
        expected = found.image(number, found.fill_map()).reshape(64, 64, 4)
        assert (_pixels(image) == expected).all()
    from neural_gash_addon.scene import staleness
    assert staleness.status(obj) == staleness.CURRENT
    obj.data.uv_layers["PRT"].uv[0].vector.x += 0.1
    assert staleness.status(obj) == staleness.STALE


@pytest.mark.parametrize("half", [False, True])
def test_files_beside_the_blend_hold_the_record(make, texture, tmp_path, half):
    texture.texture_folder, texture.half = str(tmp_path / "maps"), half
    obj = make(name="Böse Kiste/1")
    _bake()
    files = sorted((tmp_path / "maps").iterdir())
    assert [f.suffix for f in files].count(".exr") == 3 and [f.suffix for f in files].count(".json") == 1
    for image in _images(obj):
        buffer = oiio.ImageBuf(str(Path(bpy.path.abspath(image.filepath))))
        assert str(buffer.spec().format) == ("half" if half else "float")
        np.testing.assert_array_equal(buffer.get_pixels(oiio.FLOAT)[::-1], _pixels(image))
        assert '"order": 3' in buffer.spec().get_string_attribute("neuralGash")
    _bake()   # over its own files
    assert sorted((tmp_path / "maps").iterdir()) == files


def test_foreign_files_are_neither_overwritten_nor_taken(make, texture, tmp_path, refused, snapshot):
    obj = make()
    (tmp_path / "Thing_prt_1.exr").write_bytes(b"somebody's")
    texture.texture_folder = str(tmp_path)
    before = snapshot()
    assert "no bake made" in refused(bpy.ops.neural_gash.bake)
    assert snapshot() == before and (tmp_path / "Thing_prt_1.exr").read_bytes() == b"somebody's"
    (tmp_path / "Thing_prt_1.exr").unlink()
    _bake()
    bpy.ops.neural_gash.preview()
    texture.side = 32
    other = make(name="Other")
    _bake()
    (tmp_path / "Other_prt_0.exr").replace(tmp_path / "Thing_prt_0.exr")
    bpy.context.view_layer.objects.active = obj
    assert "another bake" in refused(bpy.ops.neural_gash.preview)
    (tmp_path / "Thing_prt_0.exr").unlink()
    assert "missing" in refused(bpy.ops.neural_gash.preview)
    assert other.data.get("neural_gash")


def test_a_folder_that_cannot_be_written_is_refused(make, texture, tmp_path, refused, snapshot):
    make()
    (tmp_path / "file").write_text("x")
    texture.texture_folder = str(tmp_path / "file")
    before = snapshot()
    assert "cannot be" in refused(bpy.ops.neural_gash.bake)
    assert snapshot() == before
    texture.texture_folder = "//maps"
    assert "save it first" in refused(bpy.ops.neural_gash.bake)


def test_uv_maps_that_do_not_serve_are_refused(make, texture, refused):
    obj = make()
    texture.uv_map = "None"
    assert "no UV map named 'None'" in refused(bpy.ops.neural_gash.bake)
    layer = obj.data.uv_layers.new(name="Mine")      # every face over all of it
    texture.uv_map = "Mine"
    assert "lie over each other" in refused(bpy.ops.neural_gash.bake)
    layer.uv[2].vector = (1.5, 0.2)
    assert "outside 0 to 1" in refused(bpy.ops.neural_gash.bake)
    layer.uv[2].vector = (math.nan, 0.2)
    assert "not numbers" in refused(bpy.ops.neural_gash.bake)
    texture.uv_map = ""
    for number in range(7):
        obj.data.uv_layers.new(name=f"More {number}")
    assert "8 UV maps" in refused(bpy.ops.neural_gash.bake)


def test_a_uv_map_of_ones_own_serves_and_stays(make, texture):
    obj = make(*FLOOR)
    obj.data.uv_layers.new(name="Mine")   # Blender fills a quad
    texture.uv_map = "Mine"
    _bake()
    assert [u.name for u in obj.data.uv_layers] == ["Mine"]
    open_sky = _pixels(_images(obj)[0])
    np.testing.assert_allclose(open_sky[..., 0], 0.5 / math.sqrt(math.pi), rtol=1e-5)
    bpy.ops.neural_gash.clear()
    assert [u.name for u in obj.data.uv_layers] == ["Mine"] and not bpy.data.images


def test_render_equals_the_numbers(make, texture):
    """A floor of two triangles under a box, through the node group in Cycles."""
    from neural_gash_addon.backend import light, shading
    from neural_gash_addon.scene.lighting import apply_light, store_light
    from neural_gash_addon.scene.render import render_pixels
    make([(0.5 * x, 0.5 * y, 0.5 * z + 0.6) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)],
         [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)], "Box")
    floor = make(*FLOOR, "Floor")
    floor.data.uv_layers.new(name="Mine")
    texture.uv_map, texture.occluders, texture.order, texture.rays = "Mine", "VISIBLE", 5, 1024
    _bake()
    rng = np.random.default_rng(0)
    lamp = light.constant(np.ones(3), 5) + 0.3 * rng.normal(size=(25, 3))
    bpy.context.scene.neural_gash.light_source = "SKY"  # which nothing changes
    store_light(bpy.context.scene, lamp)
    apply_light(bpy.context.scene)
    camera = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", 4, (0, 0, 5)
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.view_layer.update()
    for scene in bpy.data.scenes:
        scene.cycles.filter_width = 0.01
    picture = render_pixels([floor], camera=camera, resolution=(64, 64), samples=1)[::-1, :, :3]
    transfer = np.concatenate([_pixels(i) for i in _images(floor)], -1)[..., :25].reshape(-1, 25)
    expected = shading.radiance(transfer, lamp, 0.8).reshape(64, 64, 3)
    shadow = expected[28:36, 28:36].mean() / expected[:4, :4].mean()
    assert shadow < 0.5
    # samples lie anywhere within a pixel: compare where neighbours agree
    steps = [np.abs(expected - np.roll(expected, shift, axis)).max(-1) for shift in (-1, 1) for axis in (0, 1)]
    flat = np.max(steps, axis=0) < 0.02
    assert flat.mean() > 0.3
    assert np.abs(picture - expected)[flat].max() < 0.02
    assert np.abs(picture - expected).mean() < 0.01


def test_normal_map_bends_the_shading_normal_as_in_cycles(make, texture):
    """Cycles bakes the same material's normals into an image; the texels' must be those."""
    from neural_gash_addon.backend.raster import Layout
    from neural_gash_addon.backend.texels import texel_points
    from neural_gash_addon.scene.normal_maps import read_normal_maps
    from neural_gash_addon.scene.read import read_object
    from neural_gash_addon.scene.uv_maps import read_uv
    obj = make([(-1, -1, 0), (1, -1, 0.4), (1, 1, 0), (-1, 1, -0.3)], [(0, 1, 2), (0, 2, 3)], "Bumps", smooth=True)
    obj.data.uv_layers.new(name="Mine")
    for loop, uv in enumerate([(0.05, 0.05), (0.95, 0.1), (0.9, 0.95), (0.05, 0.05), (0.9, 0.95), (0.1, 0.9)]):
        obj.data.uv_layers["Mine"].uv[loop].vector = uv
    obj.rotation_euler = (0.4, -0.2, 0.9)
    y, x = np.mgrid[:32, :32] / 32 * 2 * math.pi
    slopes = np.stack([0.6 * np.sin(2 * x), 0.6 * np.cos(y + x), np.ones_like(x)], -1)
    colours = np.ones((32, 32, 4), np.float32)
    colours[..., :3] = 0.5 + 0.5 * slopes / np.linalg.norm(slopes, axis=-1, keepdims=True)
    image = bpy.data.images.new("bumps", 32, 32, float_buffer=True, is_data=True)
    image.pixels.foreach_set(colours.ravel())
    material = bpy.data.materials.new("Bumpy")
    material.use_nodes = True
    tree = material.node_tree
    source, bend = tree.nodes.new("ShaderNodeTexImage"), tree.nodes.new("ShaderNodeNormalMap")
    source.image, bend.inputs["Strength"].default_value = image, 0.7
    tree.links.new(source.outputs["Color"], bend.inputs["Color"])
    tree.links.new(bend.outputs["Normal"], tree.nodes["Principled BSDF"].inputs["Normal"])
    obj.data.materials.append(material)
    target = bpy.data.images.new("target", 64, 64, float_buffer=True, is_data=True)
    receiver = tree.nodes.new("ShaderNodeTexImage")
    receiver.image = target
    tree.nodes.active = receiver
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", 256
    bpy.context.view_layer.update()
    bpy.ops.object.bake(type="NORMAL", normal_space="OBJECT", margin=0)
    expected = (2 * _pixels(target)[..., :3] - 1).reshape(-1, 3) @ np.array(obj.matrix_world.to_3x3()).T
    depsgraph = bpy.context.evaluated_depsgraph_get()
    read = read_object(obj, depsgraph)
    uv = read_uv(obj.data, "Mine")[read.surface.corners]
    coverage = Layout(uv, read.surface.triangles, 64).coverage()
    maps = read_normal_maps(obj, depsgraph, read.surface, read.matrix)
    bent = texel_points(read.surface, coverage, maps).normals
    inside = np.abs(coverage.centres - coverage.barycentric).max(1) < 1e-9
    inside &= coverage.barycentric.min(1) > 0.02
    there = expected[coverage.texels[inside]]
    plain = texel_points(read.surface, coverage).normals
    angle = np.degrees(np.arccos(np.clip((there * bent[inside]).sum(1) / np.linalg.norm(there, axis=1), -1, 1)))
    without = np.degrees(np.arccos(np.clip((there * plain[inside]).sum(1) / np.linalg.norm(there, axis=1), -1, 1)))
    assert np.median(without) > 10
    assert np.median(angle) < 1 and np.percentile(angle, 95) < 3


def test_texture_of_the_wrong_size_is_refused(make, texture, refused):
    obj = make()
    _bake()
    bpy.ops.neural_gash.preview()
    _images(obj)[1].scale(32, 32)
    assert "32 x 32" in refused(bpy.ops.neural_gash.preview)


def test_density_decides_the_side(make, texture):
    obj = make()
    texture.sizing, texture.texels_per_metre = "DENSITY", 20
    _bake()
    assert 90 < _images(obj)[0].size[0] < 160   # 6 faces of 40 x 40
