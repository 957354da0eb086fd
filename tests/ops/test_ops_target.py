# SPDX-License-Identifier: GPL-3.0-or-later
"""Target: Automatic. Objects go to vertices or to a texture by themselves, and nothing of the other is left."""
from __future__ import annotations

import pytest

from .moving import bake, select

bpy = pytest.importorskip("bpy")

FLOOR = ([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2, 3)])
BOX = ([(x / 4, y / 4, 0.3 + z / 10) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)],
       [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
MISSED = "Shadow edges inside faces are missed by their corners ("


@pytest.fixture
def planned(settings):
    """Settings as they are by default, but for a rough tolerance."""
    settings.method, settings.quality, settings.tolerance = "auto", "TOLERANCE", 0.1
    assert settings.target == "AUTO"
    return settings


@pytest.fixture
def pair(make, planned):
    """A large square under a small box."""
    return make(*FLOOR, "Floor"), make(*BOX, "Box")


def _record(obj):
    from neural_gash_addon.scene.attributes import read_record
    return read_record(obj)


def _numbers(obj):
    return sorted(a.name for a in obj.data.attributes if a.name.startswith("_prt_"))


def test_each_object_decides_for_itself(pair, planned):
    from neural_gash_addon.scene import preview, staleness
    floor, box = pair
    bake(floor, box)
    textured, plain = _record(floor), _record(box)
    assert (textured.target, plain.target) == ("texture", "vertices")
    assert MISSED in textured.plan and textured.plan.endswith(f"%): texture of {textured.side}.")
    assert 32 <= textured.side <= 1024 and textured.tolerance == plain.tolerance == pytest.approx(0.1)
    assert plain.plan.endswith("vertices are enough.")
    assert (list(floor.data.uv_layers.keys()), list(box.data.uv_layers.keys())) == (["PRT"], [])
    assert (_numbers(floor), _numbers(box)) == ([], [f"_prt_{i}" for i in range(3)])
    assert all(staleness.status(o) == staleness.CURRENT and preview.is_on(o) for o in pair)
    assert bpy.ops.neural_gash.clear() == {"FINISHED"}
    assert not floor.data.uv_layers.keys() and not bpy.data.images.keys()


def test_what_changes_from_one_to_the_other_leaves_nothing_behind(pair, planned):
    from neural_gash_addon.scene import preview
    floor, box = pair
    bake(floor, box)
    planned.tolerance = 0.7  # which corners keep to
    bake(floor, box)
    assert _record(floor).target == "vertices" and _numbers(floor)
    assert not floor.data.uv_layers.keys() and not bpy.data.images.keys()
    assert preview._group_nodes(floor)[0].node_tree.name.startswith("PRT Shading")
    planned.tolerance = 0.1
    bake(floor, box)
    assert _record(floor).target == "texture" and not _numbers(floor)
    assert list(floor.data.uv_layers.keys()) == ["PRT"] and len(bpy.data.images) == 3


def test_those_that_want_a_texture_can_share_one(pair, planned, make):
    floor, box = pair
    other = make([(x + 5, y, z) for x, y, z in FLOOR[0]], FLOOR[1], "Other")
    over = make([(x + 5, y, z) for x, y, z in BOX[0]], BOX[1], "Over")
    planned.share = True
    bake(floor, box, other, over)
    records = [_record(o) for o in (floor, box, other, over)]
    assert [r.target for r in records] == ["texture", "vertices", "texture", "vertices"]
    assert records[0].side == records[2].side and len(bpy.data.images) == 3


def test_your_own_uv_map_is_baked_to(pair, planned):
    floor, box = pair
    layer = floor.data.uv_layers.new(name="Mine")
    for entry, place in zip(layer.uv, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
        entry.vector = place
    planned.uv_map = "Mine"
    bake(floor, box)  # a box without that map is to have no texture anyway
    assert (_record(floor).target, _record(floor).uv_map) == ("texture", "Mine")
    assert _record(box).target == "vertices"
    assert list(floor.data.uv_layers.keys()) == ["Mine"]


def test_a_texture_that_cannot_be_is_refused_and_nothing_changes(make, planned, refused, snapshot):
    floor = make(*FLOOR, "Floor")
    make(*BOX, "Box")
    for number in range(8):
        floor.data.uv_layers.new(name=f"Map {number}")
    planned.occluders = "VISIBLE"
    bpy.context.view_layer.objects.active = floor
    for obj in bpy.context.selected_objects:
        obj.select_set(obj == floor)
    before = snapshot()
    assert "UV map" in refused(bpy.ops.neural_gash.bake)
    assert snapshot() == before
    planned.tolerance = 0.7  # and it troubles nobody where none is wanted
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    assert _record(floor).target == "vertices"


@pytest.mark.parametrize(("change", "words"), [
    ({"method": "embree"}, "only the method Automatic"), ({"quality": "RAYS"}, "no tolerance"),
    ({"live": True}, "Live is on")])
def test_without_a_planner_automatic_means_vertices_and_says_so(pair, planned, change, words):
    floor, box = pair
    for name, value in change.items():
        setattr(planned, name, value)
    bake(floor, box)
    record = _record(floor)
    assert record.target == "vertices" and words in record.plan and words in planned.target_note()
    planned.target = "VERTICES"
    bake(floor, box)
    assert words not in _record(floor).plan and planned.target_note() == ""


def test_a_sequence_has_its_vertices(pair, planned, tmp_path):
    floor, box = pair
    select(floor, box)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 2
    planned.sequence_folder = str(tmp_path)
    assert bpy.ops.neural_gash.bake_sequence() == {"FINISHED"}
    assert _record(floor).target == "vertices" and len(_numbers(floor)) == 3


def test_the_panel_shows_what_the_target_needs(make, settings):
    from .test_ops_registration import _draw
    make()
    settings.target, settings.method, settings.quality = "AUTO", "auto", "TOLERANCE"
    shown = _draw("settings")
    assert {"target", "uv_map", "padding", "share", "half", "texture_folder"} <= set(shown)
    assert not {"sizing", "side", "texels_per_metre"} & set(shown) and shown.count("tolerance") == 1
    settings.method = "embree"
    assert "uv_map" not in _draw("settings")
    assert settings.target_note().split()[0] in " ".join(_draw("settings"))
    settings.target = "TEXTURE"
    assert {"sizing", "side", "uv_map"} <= set(_draw("settings"))
    settings.target = "VERTICES"
    assert "uv_map" not in _draw("settings")
