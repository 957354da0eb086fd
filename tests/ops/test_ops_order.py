# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes of fewer bands than were asked for: they are drawn, kept, exported and followed as they are."""
from __future__ import annotations

import json

import numpy as np
import pytest

from .moving import bake, quiet, stored

bpy = pytest.importorskip("bpy")

FLOOR = ([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [(0, 1, 2, 3)])


@pytest.fixture
def draft(settings):
    """Settings with which open surfaces want three of five bands."""
    settings.method, settings.quality, settings.tolerance, settings.order = "auto", "TOLERANCE", 0.1, 5
    return settings


def _record(obj):
    from neural_gash_addon.scene.attributes import read_record
    return read_record(obj)


def test_a_lower_order_is_stored_drawn_and_up_to_date(make, draft):
    from neural_gash_addon.scene import attributes, preview, staleness
    obj = make()
    bake(obj)
    record = _record(obj)
    assert (record.order, record.tolerance) == (3, pytest.approx(0.1)) and "order 3 is enough." in record.plan
    assert stored(obj).shape[1] == 9 and staleness.status(obj) == staleness.CURRENT
    group = preview._group_nodes(obj)[0].node_tree
    assert group.name.startswith("PRT Shading 3") and preview.is_on(obj)
    draft.tolerance = 0.02  # and all five where they would be seen, over the same attributes
    bake(obj)
    assert _record(obj).order == 5 and stored(obj).shape[1] == 25
    assert preview._group_nodes(obj)[0].node_tree.name.startswith("PRT Shading 5")
    draft.tolerance = 0.1
    bake(obj)
    assert stored(obj).shape[1] == 9 and sum(a.name.startswith(attributes.PREFIX) for a in obj.data.attributes) == 3


def test_a_preview_of_fewer_bands_shows_what_they_say(make, draft):
    """Pixels of an open floor under a light of all bands, against the product of the bands that there are."""
    from neural_gash_addon.backend import spherical_harmonics as sh
    from neural_gash_addon.scene.lighting import apply_light, store_light
    from neural_gash_addon.scene.render import render_pixels
    obj = make(*FLOOR)
    bake(obj)
    light = np.random.default_rng(0).normal(size=(25, 3))
    light[0] = 6
    draft.light_source = "SKY"
    store_light(bpy.context.scene, light)
    apply_light(bpy.context.scene)
    picture = render_pixels([obj], direction=(0, 0.01, 1), resolution=(9, 9))
    expected = 0.8 * sh.cosine_lobe(np.array([[0.0, 0, 1]]), 3)[0] @ light[:9]
    assert (expected > 0).all()
    np.testing.assert_allclose(picture[4, 4, :3], expected, rtol=1e-3)


@pytest.mark.parametrize("gloss", [False, True])
def test_textures_keep_all_bands_where_glossy_materials_are_shown(make, draft, gloss):
    obj = make(*FLOOR)
    draft.target, draft.side, draft.gloss = "TEXTURE", 16, gloss
    bake(obj)
    assert _record(obj).order == (5 if gloss else 3)
    assert len(obj.data["neural_gash_images"]) == (7 if gloss else 3)


def test_objects_of_one_texture_have_one_order(make, draft):
    floor = make(*FLOOR, "Floor")
    # two squares that face each other are all shadow, and want every band
    box = make([(x, y + 9, z) for z in (0, 0.3) for y in (0, 1) for x in (0, 1)],
               [(0, 1, 3, 2), (4, 6, 7, 5)], "Box")
    draft.target, draft.side, draft.share = "TEXTURE", 64, True
    bake(floor, box)
    assert {_record(o).order for o in (floor, box)} == {5}
    assert len(bpy.data.images) == 7


def test_all_frames_of_a_sequence_have_the_order_asked_for(sheet, draft, tmp_path, capfd):
    """The first frame is flat, and alone would have three bands."""
    from neural_gash_addon.backend.sequence import open_sequence
    obj = sheet()
    bpy.context.scene.frame_set(1)
    bake(obj)
    assert _record(obj).order == 3
    draft.sequence_folder = str(tmp_path)
    assert bpy.ops.neural_gash.bake_sequence() == {"FINISHED"}
    assert {r.order for r in open_sequence(tmp_path / "Sheet.prtseq").records} == {5}
    for frame in (3, 1):
        bpy.context.scene.frame_set(frame)
        assert stored(obj).shape[1] == 25
    quiet(capfd)


@pytest.mark.parametrize(("baked", "order"), [(1, 3), (3, 5)])
def test_live_keeps_the_order_of_the_bake(sheet, draft, baked, order):
    """Flat in frame 1, folded in 3: where a plan would take more bands, and fewer."""
    obj = sheet()
    bpy.context.scene.frame_set(baked)
    bake(obj)
    assert _record(obj).order == order
    draft.live = True
    for frame in (2, 4 - baked):
        bpy.context.scene.frame_set(frame)
        record = _record(obj)
        assert record.order == order and stored(obj).shape[1] == order ** 2 and not record.plan.startswith("Live")
    draft.live = False
    bake(obj)
    assert _record(obj).order == 8 - order


def test_compare_and_confidence_of_fewer_bands(make, draft):
    obj = make(*FLOOR)
    bake(obj)
    assert bpy.ops.neural_gash.show_confidence() == {"FINISHED"}
    assert bpy.ops.neural_gash.compare() == {"FINISHED"}


def test_the_file_has_the_bands_that_were_baked(make, draft, tmp_path):
    from neural_gash_addon.backend import exchange
    from neural_gash_addon.cli import main
    path = tmp_path / "floor.ply"
    path.write_text("ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
                    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
                    "-1 -1 0\n1 -1 0\n1 1 0\n-1 1 0\n4 0 1 2 3\n")
    assert main(["bake", str(path), "--tolerance", "0.1", "--order", "5", "--npz", str(tmp_path / "floor.npz"),
                 "--json"]) == 0
    arrays, record = exchange.load_npz(tmp_path / "floor.npz")
    assert arrays["transfer"].shape == (4, 9) and record.order == 3
    assert json.loads(record.to_json())["order"] == 3
