# SPDX-License-Identifier: GPL-3.0-or-later
"""What a person may do to texture bakes: names that clash, UV maps that go, numbers that are none."""
from __future__ import annotations

import json
import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

FLOOR = ([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [(0, 1, 2, 3)])
LID = ([(-1, -1, 0.5), (1, -1, 0.5), (1, 1, 0.5), (-1, 1, 0.5)], [(0, 1, 2, 3)])


@pytest.fixture
def texture(settings):
    settings.target, settings.side, settings.rays = "TEXTURE", 32, 16
    return settings


def _bake(*objects):
    for obj in bpy.context.view_layer.objects:
        obj.select_set(obj in objects)
    bpy.context.view_layer.objects.active = objects[0]
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def _images(obj, key="neural_gash_images"):
    stored = obj.data[key]
    return [stored[number] for number in sorted(stored.keys(), key=int)]


def _pixels(image):
    values = np.empty((image.size[1], image.size[0], 4), np.float32)
    image.pixels.foreach_get(values.ravel())
    return values


def _whole(obj):
    from neural_gash_addon.scene.attributes import check_whole, read_record
    check_whole(obj.data, read_record(obj))


@pytest.mark.parametrize("names", [("a b", "a/b"), ("Kiste", "kiste")])
def test_names_that_are_the_same_in_files_do_not_share_them(make, texture, tmp_path, names):
    texture.texture_folder = str(tmp_path)
    floor, lid = make(*FLOOR, name=names[0]), make(*LID, name=names[1])
    _bake(floor, lid)
    _whole(floor)
    _whole(lid)
    files = sorted(tmp_path.iterdir())
    _bake(floor, lid)  # over the files that each has already
    assert sorted(tmp_path.iterdir()) == files and len({f.name.casefold() for f in files}) == 8


def test_the_files_of_renamed_copied_and_shared_bakes_are_kept(make, texture, tmp_path):
    texture.texture_folder, texture.share = str(tmp_path), True
    old = make(*FLOOR, name="Floor")
    _bake(old)
    bpy.ops.object.duplicate()
    copy = bpy.context.object
    old.name = "Old"
    new, lid = make(*LID, name="Floor"), make(*LID, name="Lid")
    lid.location.z = 3
    _bake(new, lid)
    _bake(new)
    for obj in (old, copy, new, lid):
        _whole(obj)


def test_the_uv_map_of_an_earlier_bake_can_be_chosen(make, texture):
    obj = make()
    _bake(obj)
    texture.uv_map = "PRT"
    _bake(obj)
    assert [u.name for u in obj.data.uv_layers] == ["PRT"]
    _whole(obj)
    bpy.ops.neural_gash.clear()
    assert not obj.data.uv_layers and not bpy.data.images and not obj.data.keys()


def test_another_uv_map_in_the_place_of_the_bakes_is_said(make, texture, refused):
    obj = make()
    for number in range(7):
        obj.data.uv_layers.new(name=f"Mine {number}")
    _bake(obj)
    obj.data.uv_layers.remove(obj.data.uv_layers["PRT"])
    obj.data.uv_layers.new(name="Mine too")
    record = obj.data["neural_gash"]
    assert "8 UV maps" in refused(bpy.ops.neural_gash.bake)
    assert obj.data["neural_gash"] == record and len(_images(obj)) == 3


@pytest.mark.parametrize("sizing", ["RESOLUTION", "FIT", "DENSITY"])
def test_a_mesh_without_area_is_named_and_the_others_share_a_texture(make, texture, refused, sizing):
    texture.sizing, texture.tolerance, texture.texels_per_metre, texture.share = sizing, 0.2, 10, True
    flat = make([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)], name="Flat")
    assert "area" in refused(bpy.ops.neural_gash.bake)
    floor, lid = make(*FLOOR, name="Floor"), make(*LID, name="Lid")
    _bake(floor, lid, flat)
    assert "neural_gash" in floor.data and "neural_gash" in lid.data and "neural_gash" not in flat.data


def test_bad_uvs_of_one_object_spare_the_others_and_name_it(make, texture, capfd):
    texture.uv_map, texture.share = "Mine", True
    floor, lid, bad = (make(*FLOOR, name=name) for name in ("Floor", "Lid", "Bad"))
    for column, obj in enumerate((floor, lid, bad)):
        obj.data.uv_layers.new(name="Mine")
        for loop, (u, v) in enumerate([(0, 0), (1, 0), (1, 1), (0, 1)]):
            obj.data.uv_layers["Mine"].uv[loop].vector = ((column + 0.1 + 0.8 * u) / 3, v)
    bad.data.uv_layers["Mine"].uv[0].vector = (math.nan, 0)
    _bake(floor, lid, bad)
    assert "neural_gash" in floor.data and "neural_gash" in lid.data and "neural_gash" not in bad.data
    assert "'Bad': The UVs" in capfd.readouterr().out


def test_a_folder_that_cannot_be_made_is_said_before_the_bake(make, texture, refused, monkeypatch, tmp_path):
    from neural_gash_addon.ops import bake
    monkeypatch.setattr(bake, "run", lambda _: pytest.fail("was baked"))
    make()
    (tmp_path / "file").write_text("x")
    texture.texture_folder = str(tmp_path / "file" / "maps")
    assert "is a file" in refused(bpy.ops.neural_gash.bake)


def _normal_map(obj, value, uv_map=""):
    image = bpy.data.images.new("bumps", 4, 4, float_buffer=True, is_data=True)
    image.pixels.foreach_set(np.full(64, value, np.float32))
    material = bpy.data.materials.new("Bumpy")
    material.use_nodes = True
    tree = material.node_tree
    source, bend = tree.nodes.new("ShaderNodeTexImage"), tree.nodes.new("ShaderNodeNormalMap")
    source.image, bend.uv_map = image, uv_map
    tree.links.new(source.outputs["Color"], bend.inputs["Color"])
    tree.links.new(bend.outputs["Normal"], tree.nodes["Principled BSDF"].inputs["Normal"])
    tree.links.new(source.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    obj.data.materials.clear()
    obj.data.materials.append(material)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e38])
def test_images_and_uvs_that_are_no_numbers_give_numbers(make, texture, value):
    texture.bounces, texture.occluders = 2, "VISIBLE"
    make(*LID, name="Lid")
    obj = make(*FLOOR)
    obj.data.uv_layers.new(name="Mine")
    _normal_map(obj, value)
    _bake(obj)
    obj.data.uv_layers["Mine"].uv[0].vector = (math.nan, math.inf)
    _bake(obj)
    assert all(np.isfinite(_pixels(image)).all() for image in _images(obj))


def test_a_normal_map_without_its_uv_map_is_named(make, texture, refused):
    obj = make()
    _normal_map(obj, 0.5)
    assert "'Bumpy' needs a UV map" in refused(bpy.ops.neural_gash.bake)
    _normal_map(obj, 0.5, "Gone")
    assert "'Gone', which 'Thing' does not have" in refused(bpy.ops.neural_gash.bake)


def test_infinite_pixels_of_the_world_are_refused(make, texture, refused):
    world = bpy.context.scene.world = bpy.data.worlds.new("World")
    world.use_nodes = True
    sky = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    sky.image = bpy.data.images.new("sky", 8, 4, float_buffer=True, is_data=True)
    sky.image.pixels.foreach_set(np.full(128, math.inf, np.float32))
    world.node_tree.links.new(sky.outputs[0], world.node_tree.nodes["Background"].inputs[0])
    texture.gloss, texture.light_strength = True, math.inf
    _bake(make(*FLOOR))  # with a warning
    assert "infinite" in refused(bpy.ops.neural_gash.read_light)
    assert all(np.isfinite(_pixels(image)).all() for image in bpy.data.images if image != sky.image)


def test_glossy_bounces_in_edit_mode_are_refused_by_that(make, texture, refused):
    _bake(make())
    bpy.ops.object.mode_set(mode="EDIT")
    assert "Edit Mode" in refused(bpy.ops.neural_gash.bake_gloss)
    bpy.ops.object.mode_set(mode="OBJECT")


@pytest.mark.parametrize("density", [1e5, 1e12, 0.1])
def test_densities_that_no_texture_has_are_refused(make, texture, refused, density):
    texture.sizing, texture.texels_per_metre = "DENSITY", density
    make(*FLOOR)
    sentence = refused(bpy.ops.neural_gash.bake)  # Blender died of the large ones
    assert "choose fewer texels" in sentence if density > 1 else "choose more texels" in sentence


@pytest.mark.parametrize("damage", ["deleted", "resized", "sockets"])
def test_glossy_previews_that_were_damaged_are_made_anew(make, texture, damage):
    texture.gloss = True
    bpy.context.scene.world = bpy.data.worlds.new("Sky")
    _bake(make(*FLOOR))
    for image in [i for i in bpy.data.images if "gloss" in i.name]:
        if damage == "deleted":
            bpy.data.images.remove(image)
        elif damage == "resized":
            image.scale(8, 8)
    if damage == "sockets":
        bpy.data.node_groups[0].interface.clear()
    bpy.ops.neural_gash.read_light()
    lit = [i for i in bpy.data.images if "gloss" in i.name]
    assert len(lit) == 8 and any(_pixels(i).any() for i in lit) and len(bpy.data.node_groups) == 1


@pytest.mark.parametrize("target", ["TEXTURE", "VERTICES"])
def test_previews_whose_group_lost_its_inputs_are_made_anew(make, texture, target):
    texture.target = target
    _bake(make(*FLOOR))
    bpy.data.node_groups[0].interface.clear()
    texture.light_rotation = 0.5
    bpy.ops.neural_gash.read_light()
    assert len(bpy.data.node_groups) == 1 and "L8" in bpy.data.node_groups[0].interface.items_tree


def test_damaged_lists_of_images_are_a_bake_that_lost_some(make, texture, refused):
    obj = make()
    _bake(obj)
    obj.data["neural_gash_images"] = {"x": 1, "0": 2}
    bpy.ops.neural_gash.preview()
    assert "lost some of its images" in refused(bpy.ops.neural_gash.preview)
    _bake(obj)
    _whole(obj)


def test_an_applied_copy_does_not_keep_the_uv_map_of_an_earlier_bake(make, texture):
    obj = make()
    _bake(obj)
    obj.modifiers.new("Finer", "SUBSURF")
    bpy.context.view_layer.update()
    assert bpy.ops.neural_gash.bake_applied_copy() == {"FINISHED"}
    assert [u.name for u in bpy.context.object.data.uv_layers] == ["PRT"]
    bpy.ops.neural_gash.clear()
    assert not bpy.context.object.data.uv_layers and [u.name for u in obj.data.uv_layers] == ["PRT"]


def test_a_file_cut_short_is_said_to_be_unreadable(make, texture, refused, tmp_path):
    texture.texture_folder = str(tmp_path)
    _bake(make(*LID))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    for path in tmp_path.glob("*.exr"):
        path.write_bytes(path.read_bytes()[:-20])
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.neural_gash.preview()
    assert "cannot be read" in refused(bpy.ops.neural_gash.preview)
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def test_a_folder_without_a_beginning_is_refused(make, texture, refused, tmp_path):
    make(*FLOOR)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    texture.texture_folder = "maps"
    assert "begin it with //" in refused(bpy.ops.neural_gash.bake)


def test_faces_that_cannot_be_unwrapped_are_said(make, texture, capfd):
    texture.method = "analytic"
    make([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0)], [(0, 1, 2, 3), (1, 2, 4, 5)], "Bow Tie")
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    assert "1 of the faces of 'Bow Tie' could not be unwrapped" in capfd.readouterr().out


def test_a_full_disk_leaves_the_earlier_bake_whole(make, texture, refused, snapshot, tmp_path, monkeypatch):
    from neural_gash_addon.backend import exr
    texture.texture_folder, texture.method = str(tmp_path), "analytic"
    make()
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    before, files = snapshot(), {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    written, real = [], exr.write

    def fills_up(path, *arguments):
        written.append(path)
        if len(written) == 3:   # the last of three images
            raise OSError(28, "No space left on device")
        real(path, *arguments)

    monkeypatch.setattr(exr, "write", fills_up)
    texture.method, texture.side = "embree", 32
    assert "no space left on device" in refused(bpy.ops.neural_gash.bake)
    assert snapshot() == before and {p.name: p.read_bytes() for p in tmp_path.iterdir()} == files
    monkeypatch.undo()
    assert bpy.ops.neural_gash.preview() == {"FINISHED"}   # off and on again: it is still the bake's
    assert bpy.ops.neural_gash.preview() == {"FINISHED"}


def test_an_unreadable_normal_map_is_said(make, texture, refused, snapshot, tmp_path):
    obj = make(*FLOOR)
    obj.data.uv_layers.new(name="Mine")
    _normal_map(obj, 0.5, "Mine")
    (tmp_path / "bumps.png").write_bytes(b"no image")
    texture_node = next(n for n in obj.data.materials[0].node_tree.nodes if n.type == "TEX_IMAGE")
    texture_node.image = bpy.data.images.load(str(tmp_path / "bumps.png"))
    before = snapshot()
    said = refused(bpy.ops.neural_gash.bake)
    assert f"The normal map of the material '{obj.data.materials[0].name}' cannot be read" in said
    assert snapshot() == before
    texture_node.image = None
    assert "normal map" in refused(bpy.ops.neural_gash.bake)


def test_flipped_uvs_give_the_same_bake_flipped(make, texture):
    """A UV map seen from behind is a place like any other, as long as no faces lie over each other."""
    texture.uv_map, texture.rays, texture.side, found = "Mine", 4096, 64, []
    for flip in (1, -1):
        obj = make([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (1, -1, 2), (1, 1, 2)],
                   [(0, 1, 2, 3), (1, 4, 5, 2)], f"Corner {flip}")
        layer = obj.data.uv_layers.new(name="Mine")
        for loop, (u, v) in enumerate([(.02, .02), (.48, .02), (.48, .98), (.02, .98),
                                       (.52, .02), (.98, .02), (.98, .98), (.52, .98)]):
            layer.uv[loop].vector = (0.5 + flip * (u - 0.5), v)
        assert bpy.ops.neural_gash.bake() == {"FINISHED"}
        image = obj.data["neural_gash_images"]["0"]
        pixels = np.empty((64, 64, 4), np.float32)
        image.pixels.foreach_get(pixels.ravel())
        found.append(pixels[:, ::flip])
    assert np.abs(found[0]).max() > 0.2
    np.testing.assert_allclose(found[0], found[1], atol=0.01)


def test_a_normal_map_counts_again_while_the_preview_is_on(make, texture):
    obj = make(*FLOOR)
    obj.data.uv_layers.new(name="Mine")
    _normal_map(obj, 0.8, "Mine")
    _bake(obj)
    before = _pixels(_images(obj)[0])
    _bake(obj)  # the preview's material is in the slot now
    np.testing.assert_array_equal(_pixels(_images(obj)[0]), before)
    assert np.abs(before[16, 16, [1, 3]]).min() > 0.1  # bent: a flat floor's are zero


def test_a_fitted_texture_is_small_where_next_to_no_light_comes(make, texture):
    """Some rays slip through where the box's faces meet; they are no shadows that ask for texels."""
    make(name="Box").scale = (4, 4, 4)
    floor = make(*FLOOR)
    texture.sizing, texture.tolerance, texture.occluders, texture.rays = "FIT", 0.02, "VISIBLE", 64
    _bake(floor)  # to 4096 texels a side, once, in two minutes
    assert json.loads(floor.data["neural_gash"])["side"] <= 64


def test_a_record_file_that_no_bake_made_is_kept(make, texture, tmp_path, refused, snapshot):
    texture.texture_folder = str(tmp_path)
    make(*FLOOR, name="Floor")
    before = snapshot()
    (tmp_path / "Floor_prt.json").write_text('{"mine": 1}')
    assert "Floor_prt.json' that no bake made" in refused(bpy.ops.neural_gash.bake)
    assert snapshot() == before and [p.name for p in tmp_path.iterdir()] == ["Floor_prt.json"]
    assert (tmp_path / "Floor_prt.json").read_text() == '{"mine": 1}'


@pytest.mark.parametrize("by", ["its UV map", "a mapping"])
def test_a_normal_map_is_looked_up_where_its_image_lies(make, texture, by):
    """Whose left half is flat: the Normal Map node's own UV map is that of the tangents only."""
    obj = make(*FLOOR)
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    for name, uv in (("Whole", square), ("Left", 0.3 * square + 0.1)):
        obj.data.uv_layers.new(name=name).uv.foreach_set("vector", uv.ravel())
    _normal_map(obj, 0.5, "Whole")
    tree = obj.data.materials[0].node_tree
    node = next(n for n in tree.nodes if n.type == "TEX_IMAGE")
    pixels = np.tile(np.array([0.5, 0.5, 1, 1], np.float32), (4, 4, 1))
    pixels[:, 2:, 0] = 0.9
    node.image.pixels.foreach_set(pixels.ravel())
    _bake(obj)
    assert np.abs(_pixels(_images(obj)[0])[..., 3]).max() > 0.1  # the right half is bent
    if by == "a mapping":
        place, mapping = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeMapping")
        mapping.inputs["Location"].default_value, mapping.inputs["Scale"].default_value = (0.1,) * 3, (0.3,) * 3
        tree.links.new(place.outputs["UV"], mapping.inputs["Vector"])
        tree.links.new(mapping.outputs["Vector"], node.inputs["Vector"])
    else:
        other = tree.nodes.new("ShaderNodeUVMap")
        other.uv_map = "Left"
        tree.links.new(other.outputs["UV"], node.inputs["Vector"])
    _bake(obj)
    assert np.abs(_pixels(_images(obj)[0])[16, 8:24, 3]).max() < 1e-5


def test_glossy_bounces_of_a_bright_light_are_numbers_in_16_bits_too(make, texture):
    world = bpy.context.scene.world = bpy.data.worlds.new("Sky")
    world.color = (1e6, 1e6, 1e6)
    texture.half, texture.gloss = True, True
    make([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (0, 1, 1)], [(0, 1, 2, 3), (0, 3, 5, 4)])
    assert bpy.ops.neural_gash.bake() == bpy.ops.neural_gash.bake_gloss() == {"FINISHED"}
    obj = bpy.context.object
    bounced = [_pixels(image) for image in _images(obj, "neural_gash_gloss_images")]
    assert all(np.isfinite(pixels).all() for pixels in bounced) and np.max(bounced) > 1e5
    assert _images(obj)[0].use_half_precision


def test_a_changed_normal_map_makes_the_bake_stale(make, texture):
    from neural_gash_addon.scene import staleness
    obj = make(*FLOOR)
    obj.data.uv_layers.new(name="Mine")
    for loop in obj.data.loops:
        obj.data.uv_layers["Mine"].uv[loop.index].vector = [
            0.5 + 0.4 * c for c in obj.data.vertices[loop.vertex_index].co[:2]]
    _normal_map(obj, 0.5)
    _bake(obj)
    assert staleness.check(obj)
    tree = obj.data.materials[0].node_tree
    strength = tree.nodes["Normal Map"].inputs["Strength"]
    for change, back in ((lambda: setattr(strength, "default_value", 0.3),
                          lambda: setattr(strength, "default_value", 1.0)),
                         (lambda: bpy.data.images["bumps"].pixels.foreach_set(np.full(64, 0.25, np.float32)),
                          lambda: bpy.data.images["bumps"].pixels.foreach_set(np.full(64, 0.5, np.float32)))):
        change()
        bpy.context.view_layer.update()
        assert not staleness.check(obj)
        back()
        bpy.context.view_layer.update()
        assert staleness.check(obj)
    assert staleness._reflects(obj)   # so an edit of the material is looked at by itself
