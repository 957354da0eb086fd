# SPDX-License-Identifier: GPL-3.0-or-later
"""Several objects baked in one go: each by itself, or all to one texture; what shadows what; failures of one."""
from __future__ import annotations

import json
import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

FLOOR = ([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [(0, 1, 2, 3)])
LID = ([(-1, -1, 0.5), (1, -1, 0.5), (1, 1, 0.5), (-1, 1, 0.5)], [(0, 1, 2, 3)])


@pytest.fixture
def pair(make):
    """A floor and a turned lid above it, both selected, the floor active."""
    floor, lid = make(*FLOOR, name="Floor"), make(*LID, name="Lid")
    lid.rotation_euler = (0, 0, math.radians(30))
    floor.select_set(True)
    bpy.context.view_layer.objects.active = floor
    bpy.context.view_layer.update()
    return floor, lid


def _record(obj):
    return json.loads(obj.data["neural_gash"])


def _images(obj):
    stored = obj.data["neural_gash_images"]
    return [stored[key] for key in sorted(stored.keys(), key=int)]


def _pixels(image):
    values = np.empty((image.size[1], image.size[0], 4), np.float32)
    image.pixels.foreach_get(values.ravel())
    return values


def _bake():
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def test_selected_objects_shadow_each_other(pair, settings):
    from neural_gash_addon.backend import spherical_harmonics as sh
    from neural_gash_addon.scene.attributes import read_transfer
    from neural_gash_addon.scene.preview import is_on
    floor, lid = pair
    _bake()
    up = sh.cosine_lobe(np.array([[0.0, 0.0, 1.0]]), 3)[0]
    together = read_transfer(floor)[0]
    assert np.abs(together - up).max() > 5e-3 and is_on(floor) and is_on(lid)
    assert json.loads(_record(floor)["occluders"]) == ["Floor", "Lid"]
    lid.select_set(False)
    _bake()
    np.testing.assert_allclose(read_transfer(floor)[0], np.tile(up, (4, 1)), atol=1e-5)
    assert _record(floor)["occluders"] == "SELF"


def test_only_the_active_object_is_baked_where_it_is_not_selected(pair, settings):
    floor, lid = pair
    floor.select_set(False)
    _bake()
    assert "neural_gash" in floor.data and "neural_gash" not in lid.data


def test_the_set_goes_stale_with_the_other_object(pair, settings):
    from neural_gash_addon.scene.staleness import CURRENT, STALE, status
    floor, lid = pair
    _bake()
    assert status(floor) == status(lid) == CURRENT
    lid.location.x += 0.5
    bpy.context.view_layer.update()
    assert status(floor) == STALE
    lid.location.x -= 0.5
    bpy.context.view_layer.update()
    assert status(floor) == CURRENT
    bpy.data.objects.remove(lid)
    bpy.context.view_layer.update()
    assert status(floor) == STALE


def test_one_bad_object_does_not_stop_the_others(pair, make, settings):
    floor, lid = pair
    empty = make([(0, 0, 0)], [], name="Bare")
    for obj in (floor, lid):
        obj.select_set(True)
    bpy.context.view_layer.objects.active = floor
    _bake()
    assert "neural_gash" in floor.data and "neural_gash" in lid.data and "neural_gash" not in empty.data


def test_none_that_can_be_baked_is_an_error(make, settings):
    first = make([(0, 0, 0)], [], name="Bare")
    from neural_gash_addon.backend.errors import UserError
    from neural_gash_addon.ops.batch import prepare_batch
    with pytest.raises(UserError, match="'Bare' has no faces"):
        prepare_batch(bpy.context, [first], settings)


def test_objects_of_one_mesh_are_baked_once(pair, settings):
    floor, lid = pair
    twin = bpy.data.objects.new("Twin", floor.data)
    bpy.context.scene.collection.objects.link(twin)
    from neural_gash_addon.backend import methods
    from neural_gash_addon.ops.batch import finish_batch, prepare_batch
    batch = prepare_batch(bpy.context, [floor, twin, lid], settings)
    outcomes = finish_batch(bpy.context, batch, methods.run(batch.baking))
    refused = {o.name: o.sentence for o in outcomes if o.record is None}
    assert list(refused) == ["Twin"] and "same mesh as 'Floor'" in refused["Twin"]


@pytest.mark.parametrize("share", [False, True])
def test_textures_of_a_set(pair, settings, share):
    floor, lid = pair
    settings.target, settings.side, settings.order, settings.share = "TEXTURE", 64, 3, share
    _bake()
    assert _record(floor)["side"] == _record(lid)["side"] == 64
    same = [a == b for a, b in zip(_images(floor), _images(lid), strict=True)]
    assert same == [share] * 3 and len(bpy.data.images) == (3 if share else 6)
    assert _record(floor)["fingerprint"] != _record(lid)["fingerprint"]
    from neural_gash_addon.scene.staleness import CURRENT, status
    assert status(floor) == status(lid) == CURRENT
    if share:
        occupied = [np.zeros((64, 64), bool) for _ in pair]
        for obj, mask in zip(pair, occupied, strict=True):
            uv = np.array([tuple(u.vector) for u in obj.data.uv_layers["PRT"].uv]) * 64
            low, high = uv.min(0), uv.max(0)
            mask[int(low[1]):int(high[1]), int(low[0]):int(high[0])] = True
        assert not (occupied[0] & occupied[1]).any() and occupied[0].sum() > 2 * occupied[1].sum()
    bpy.context.view_layer.objects.active = floor
    bpy.ops.neural_gash.clear()
    assert len(_images(lid)) == 3


def test_a_shared_texture_shows_what_textures_of_their_own_show(pair, settings, tmp_path):
    from neural_gash_addon.scene.render import render_preview
    settings.target, settings.side, settings.order, settings.rays = "TEXTURE", 128, 3, 512
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("Sky")
    scene.world.color = (1, 0.8, 0.6)
    pictures = []
    for share in (False, True):
        settings.share = share
        _bake()
        path = tmp_path / f"{share}.exr"
        render_preview(list(pair), path)
        image = bpy.data.images.load(str(path))
        pictures.append(_pixels(image)[..., :3])
        bpy.data.images.remove(image)
    assert pictures[0].std() > 0.05
    error = np.sqrt(np.square(pictures[0] - pictures[1]).mean() / np.square(pictures[0]).mean())
    assert error < 0.03, f"rel L2 between the two pictures {error:.4f}"


def test_a_shared_bake_with_bounces_where_one_is_black(pair, settings):
    floor, lid = pair
    settings.target, settings.side, settings.order, settings.share, settings.bounces = "TEXTURE", 32, 2, True, 2
    for obj, colour in ((floor, (0, 0, 0, 1)), (lid, (0.8, 0.1, 0.1, 1))):
        material = bpy.data.materials.new(obj.name)
        material.diffuse_color = colour
        obj.data.materials.append(material)
    _bake()
    assert _record(floor)["colours"] == _record(lid)["colours"]
    assert len(_images(floor)) == -(-4 * _record(floor)["colours"] // 4)


def test_own_uv_maps_that_overlap_between_objects_are_refused_by_name(pair, settings, refused):
    for obj in pair:
        layer = obj.data.uv_layers.new(name="Mine")
        layer.uv.foreach_set("vector", np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32).ravel())
    settings.target, settings.side, settings.share, settings.uv_map = "TEXTURE", 64, True, "Mine"
    sentence = refused(bpy.ops.neural_gash.bake)
    assert "0 of 'Floor' and 0 of 'Lid'" in sentence
    for obj in pair:
        assert "neural_gash" not in obj.data
    uv = np.array([[0, 0], [0.4, 0], [0.4, 1], [0, 1]], np.float32)
    pair[0].data.uv_layers["Mine"].uv.foreach_set("vector", uv.ravel())
    pair[1].data.uv_layers["Mine"].uv.foreach_set("vector", (uv + [0.5, 0]).astype(np.float32).ravel())
    _bake()
    assert _images(pair[0]) == _images(pair[1])


def test_fitted_textures_are_as_large_as_the_shadows_need(pair, make, settings):
    floor, lid = pair
    lid.location.z = -0.48  # a sharp shadow on one floor, none on the other
    far = make(*FLOOR, name="Far")
    far.location.x = 50
    for obj in pair:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = floor
    bpy.context.view_layer.update()
    settings.target, settings.sizing, settings.order, settings.tolerance = "TEXTURE", "FIT", 3, 0.02
    _bake()
    sides = [_record(obj)["side"] for obj in (floor, far)]
    assert sides[0] > 3 * sides[1], sides
    settings.tolerance = 0.1
    _bake()
    assert _record(floor)["side"] < sides[0]


def test_record_of_a_shared_file_tells_each_object(pair, settings, tmp_path):
    settings.target, settings.side, settings.order, settings.share = "TEXTURE", 64, 2, True
    settings.texture_folder = str(tmp_path)
    _bake()
    data = json.loads((tmp_path / "Floor_prt.json").read_text())
    frames = {name: np.array(entry["frame"]).reshape(3, 3) for name, entry in data["objects"].items()}
    assert set(frames) == {"Floor", "Lid"} and data["points"] > 1000
    assert frames["Lid"][0, 0] == pytest.approx(math.cos(math.radians(30)), abs=1e-5)
