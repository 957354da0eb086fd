# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes that follow their objects: while posing, in rendered frames, and from a sequence."""
from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from neural_gash_addon.backend import methods  # noqa: E402
from neural_gash_addon.backend import spherical_harmonics as sh  # noqa: E402
from neural_gash_addon.backend.sequence import open_sequence  # noqa: E402
from neural_gash_addon.ops.sequence import bake_sequence  # noqa: E402
from neural_gash_addon.scene import attributes, live, read, staleness  # noqa: E402

FULL = 0.5 / np.pi ** 0.5  # coefficient 0 of a point that sees all of its sky


def stored(obj):
    """(E, K) as the attributes have it."""
    return attributes.read_transfer(obj)[0]


def baked(obj, settings, **quality):
    """(N, K) of the object as it stands."""
    mesh = read.read_object(obj, bpy.context.evaluated_depsgraph_get()).mesh
    return methods.run(methods.bake(mesh, settings.method, settings.order, **(quality or settings.tracing()))
                       ).coefficients, mesh


def same(one, other):
    """Bakes of the same mesh, whose normals were read in two ways and differ in their last bits."""
    np.testing.assert_allclose(one, other, atol=1e-6)


def follow(obj):
    """What a window does when something changed."""
    live.follow(bpy.context.scene, bpy.context.evaluated_depsgraph_get())


def test_without_live_a_bake_grows_stale(wing):
    before = stored(wing)
    bpy.context.scene.frame_set(8)
    np.testing.assert_array_equal(stored(wing), before)
    assert staleness.status(wing) == staleness.STALE


def test_rendered_frames_are_what_bake_gives(wing, settings):
    settings.live = True
    for frame in (4, 10, 2):
        bpy.context.scene.frame_set(frame)
        same(stored(wing), baked(wing, settings)[0])
        assert staleness.status(wing) == staleness.CURRENT
        record = attributes.read_record(wing)
        assert record.rays == 64 * record.points and record.method == "embree"


def test_live_keeps_to_its_plan_and_is_near_the_truth(wing, settings):
    settings.live_budget, settings.live = 1.0, True
    text = live.status(wing)
    assert "ms; error about" in text and not live.problem(wing), text
    with live.suspended():
        bpy.context.scene.frame_set(9)
    follow(wing)
    record = attributes.read_record(wing)
    assert record.plan.startswith("Live. ") and "rays at" in record.plan and record.order == 3
    truth, mesh = baked(wing, settings, rays=1024)
    unshadowed = sh.cosine_lobe(mesh.normals, 3)
    assert np.square(stored(wing) - truth).sum() < 0.05 * np.square(unshadowed - truth).sum()
    assert staleness.check(wing)


def test_a_frame_that_the_window_showed_is_baked_anew_to_be_rendered(wing, settings):
    settings.live = True
    with live.suspended():
        bpy.context.scene.frame_set(9)
    follow(wing)
    assert attributes.read_record(wing).plan.startswith("Live.")
    bpy.context.scene.frame_set(9)  # in background, as in a render
    same(stored(wing), baked(wing, settings)[0])
    assert not attributes.read_record(wing).plan


def test_what_fits_is_left_alone(wing, settings, monkeypatch):
    settings.live = True
    bpy.context.scene.frame_set(5)
    written = []
    monkeypatch.setattr(live, "write_transfer", lambda *a: written.append(a))
    follow(wing)
    bpy.context.view_layer.update()
    assert not written
    with live.suspended():
        bpy.context.scene.frame_set(6)
    follow(wing)
    assert len(written) == 1


def test_moving_a_vertex_is_followed_at_once(wing, settings):
    settings.live = True
    before = stored(wing)
    wing.active_shape_key_index = 0
    for key in wing.data.shape_keys.key_blocks:
        for point in key.data[:60]:
            point.co.z += 1.0
    wing.data.update_tag()
    bpy.context.view_layer.update()
    assert np.abs(stored(wing) - before).max() > 0.05
    same(stored(wing), baked(wing, settings)[0])


def test_other_objects_are_followed_where_they_cast_shadows(make, settings):
    ground = make([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2, 3)], "Ground")
    settings.occluders = "VISIBLE"
    lid = make([(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)], [(3, 2, 1, 0)], "Lid")
    bpy.context.view_layer.objects.active = ground
    lid.select_set(False)
    ground.select_set(True)
    bpy.ops.neural_gash.bake()
    assert stored(ground)[:, 0].mean() < 0.9 * FULL
    settings.live = True
    lid.location.z = 50
    bpy.context.view_layer.update()
    np.testing.assert_allclose(stored(ground)[:, 0], FULL, rtol=1e-3)
    assert not attributes.has_bake(lid)


@pytest.mark.parametrize("how", ["hidden", "removed", "collection"])
def test_others_that_go_take_their_shadow_with_them(make, settings, how):
    ground = make([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2, 3)], "Ground")
    settings.occluders = "VISIBLE"
    lid = make([(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)], [(3, 2, 1, 0)], "Lid")
    there = bpy.data.collections.new("There")
    bpy.context.scene.collection.children.link(there)
    there.objects.link(lid)
    bpy.context.scene.collection.objects.unlink(lid)
    bpy.context.view_layer.objects.active = ground
    ground.select_set(True)
    lid.select_set(False)
    bpy.ops.neural_gash.bake()
    settings.live = True
    assert stored(ground)[:, 0].mean() < 0.9 * FULL
    if how == "hidden":
        lid.hide_set(True)
    elif how == "removed":
        bpy.data.objects.remove(lid)
    else:
        bpy.context.view_layer.layer_collection.children["There"].exclude = True
    bpy.context.view_layer.update()
    np.testing.assert_allclose(stored(ground)[:, 0], FULL, rtol=1e-3)


def test_turned_and_deformed_it_stays_lit_from_the_same_side(wing, settings):
    """Turning alone turns the light; the next deformation is baked in another frame, and lit in that."""
    settings.live = True
    settings.light_source = "SKY"
    wing.rotation_euler = (0.4, 0.2, 1.1)
    bpy.context.view_layer.update()
    turned = attributes.read_record(wing).frame
    bpy.context.scene.frame_set(7)
    record = attributes.read_record(wing)
    assert not np.allclose(record.frame, turned)
    np.testing.assert_allclose(np.array(record.frame).reshape(3, 3), read.bake_frame(wing), atol=1e-6)


def test_what_cannot_be_followed_is_said(wing, settings):
    settings.target, settings.side = "TEXTURE", 32
    bpy.ops.neural_gash.bake()
    settings.live = True
    assert "baked to a texture" in live.problem(wing) and not live.status(wing)
    settings.live = False
    assert not live.problem(wing)
    settings.target, settings.bounces = "VERTICES", 2
    wing.data.materials.clear()
    wing.data.materials.append(bpy.data.materials.new("Red"))
    wing.data.materials[0].diffuse_color = (0.9, 0.1, 0.1, 1)
    bpy.context.scene.frame_set(9)
    bpy.ops.neural_gash.bake()
    assert attributes.read_record(wing).colours == 3
    settings.live = True
    assert "in rendered frames only" in live.problem(wing)


def test_modifiers_that_change_the_topology_are_said_and_keep_the_bake(wing, settings):
    settings.live = True
    before = stored(wing)
    wing.modifiers.new("More", "SUBSURF").levels = 1
    bpy.context.view_layer.update()
    assert "change its vertices or faces" in live.problem(wing)
    np.testing.assert_array_equal(stored(wing), before)
    wing.modifiers.clear()
    bpy.context.scene.frame_set(6)
    assert not live.problem(wing) and np.abs(stored(wing) - before).max() > 0.01


def test_in_edit_mode_nothing_is_written(wing, settings):
    settings.live = True
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.context.scene.frame_set(9)
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    same(stored(wing), baked(wing, settings)[0])


def test_deleted_while_live(wing, settings):
    settings.live = True
    bpy.data.objects.remove(wing)
    bpy.context.scene.frame_set(5)
    follow(None)


def test_another_file_while_live(wing, settings, tmp_path):
    settings.live = True
    path = str(tmp_path / "wing.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert not live._followers
    bpy.ops.wm.open_mainfile(filepath=path)
    bpy.context.scene.frame_set(8)
    obj = bpy.data.objects["Wing"]
    assert staleness.status(obj) == staleness.CURRENT


def test_disabled_while_live(wing, settings, addon):
    settings.live = True
    bpy.context.scene.frame_set(3)
    addon.unregister()
    before = stored(wing)
    bpy.context.scene.frame_set(8)
    np.testing.assert_array_equal(stored(wing), before)
    assert not live._followers
    addon.register()
    bpy.context.scene.frame_set(9)
    assert np.abs(stored(wing) - before).max() > 0.01  # the setting is the scene's, so it goes on


def test_slow_updates_take_a_lesser_plan_and_quick_ones_a_better():
    plans = [live.LivePlan("hybrid", rays, 0, 100, 0.001 * rays, 1 / rays) for rays in (2, 4, 8, 16)]
    follower = live._Follower(plans=plans, plan=plans[3], budget=0.02, besides=0.002)

    def updates(times):
        rays = []
        for _ in range(40):
            baked = times * follower.plan.seconds
            follower.seconds = baked + 0.002  # to read and to write
            live._adapt(follower, baked)
            rays.append(follower.plan.rays)
        return rays

    assert set(updates(1.1)) == {16}
    slowed = updates(3.0)  # 16 rays take 48 ms now, and 4 take 12, of 18
    assert slowed[-1] == 4 and slowed == sorted(slowed, reverse=True)
    assert updates(2.1)[-1] == 4  # 8 would be within the budget, but hardly
    assert updates(0.5)[-1] == 16
    assert updates(100)[-1] == 2


@pytest.fixture
def sequence(wing, settings, tmp_path):
    """The wing with the bake of its four frames in a file."""
    settings.sequence_folder = str(tmp_path)
    bpy.context.scene.frame_set(3)
    assert bpy.ops.neural_gash.bake_sequence() == {"FINISHED"}
    return tmp_path / "Wing.prtseq"


def test_a_sequence_plays_every_frame(wing, settings, sequence):
    assert bpy.context.scene.frame_current == 3
    for frame in (3, 1, 4, 2):
        bpy.context.scene.frame_set(frame)
        truth, _ = baked(wing, settings)
        np.testing.assert_allclose(stored(wing), truth, rtol=1e-3, atol=1e-5)
        np.testing.assert_array_equal(open_sequence(sequence).frame(frame)[0], stored(wing))
        assert staleness.status(wing) == staleness.CURRENT
    bpy.context.scene.frame_set(9)  # beyond its end
    assert staleness.status(wing) == staleness.STALE
    np.testing.assert_allclose(stored(wing), open_sequence(sequence).frame(4)[0])


def test_a_sequence_outlives_saving(wing, sequence, tmp_path):
    path = str(tmp_path / "wing.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    bpy.context.scene.frame_set(2)
    assert staleness.status(bpy.data.objects["Wing"]) == staleness.CURRENT


def test_beside_the_file_it_moves_with_it(wing, settings, tmp_path):
    (tmp_path / "here").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "here" / "wing.blend"))
    assert bpy.ops.neural_gash.bake_sequence() == {"FINISHED"}
    bpy.ops.wm.save_mainfile()
    (tmp_path / "here").rename(tmp_path / "there")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "there" / "wing.blend"))
    bpy.context.scene.frame_set(2)
    obj = bpy.data.objects["Wing"]
    assert not live.problem(obj) and staleness.status(obj) == staleness.CURRENT


def test_an_unsaved_file_wants_a_folder(wing, refused):
    assert "Save the .blend file first" in refused(bpy.ops.neural_gash.bake_sequence)
    assert attributes.SEQUENCE not in wing.data


def test_a_lost_file_is_said_and_the_bake_stays(wing, sequence):
    before = stored(wing)
    sequence.unlink()
    bpy.context.scene.frame_set(1)
    assert "is missing; bake it again" in live.problem(wing)
    np.testing.assert_array_equal(stored(wing), before)


@pytest.mark.parametrize("operator", ["bake", "clear"])
def test_a_new_bake_and_clear_end_a_sequence(wing, sequence, operator):
    assert getattr(bpy.ops.neural_gash, operator)() == {"FINISHED"}
    assert attributes.SEQUENCE not in wing.data and sequence.exists()
    bpy.context.scene.frame_set(1)
    assert attributes.has_bake(wing) == (operator == "bake")


def test_a_cancelled_sequence_leaves_nothing(wing, settings, tmp_path):
    settings.sequence_folder = str(tmp_path)
    bpy.context.scene.frame_set(2)
    before = stored(wing)
    baking = bake_sequence(bpy.context, [wing])
    while next(baking) < 0.6:
        pass
    baking.close()
    assert bpy.context.scene.frame_current == 2 and not list(tmp_path.iterdir())
    np.testing.assert_array_equal(stored(wing), before)
    assert attributes.SEQUENCE not in wing.data and not live._suspended


def test_a_scene_that_is_removed_meanwhile(wing, settings, tmp_path):
    settings.sequence_folder = str(tmp_path)
    baking = bake_sequence(bpy.context, [wing])
    next(baking)
    other = bpy.data.scenes.new("Other")
    bpy.data.scenes.remove(bpy.context.scene)
    with pytest.raises(Exception, match="removed|deleted|No object"):
        for _ in baking:
            pass
    assert not list(tmp_path.iterdir()) and not live._suspended and other.name == "Other"


def test_one_that_fails_spares_the_other(wing, make, settings, tmp_path):
    settings.sequence_folder = str(tmp_path)
    other = make(name="Other")
    key = other.modifiers.new("More", "SUBSURF")
    key.show_viewport = key.show_render = False
    key.keyframe_insert("show_viewport", frame=1)
    key.show_viewport = True
    key.keyframe_insert("show_viewport", frame=3)
    wing.select_set(True)
    assert bpy.ops.neural_gash.bake_sequence() == {"FINISHED"}
    assert [path.name for path in tmp_path.iterdir()] == ["Wing.prtseq"]
    assert attributes.SEQUENCE in wing.data and attributes.SEQUENCE not in other.data


def test_textures_are_refused(wing, settings, refused, tmp_path):
    settings.sequence_folder, settings.target = str(tmp_path), "TEXTURE"
    with pytest.raises(RuntimeError, match="baked to vertices"):
        bpy.ops.neural_gash.bake_sequence()
