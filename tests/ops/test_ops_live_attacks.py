# SPDX-License-Identifier: GPL-3.0-or-later
"""Live and sequences at bad moments and with bad input."""
from __future__ import annotations

import numpy as np
import pytest

from .moving import bake, quiet, select, stored, truth

bpy = pytest.importorskip("bpy")

from neural_gash_addon.scene import live, preview, rendered, staleness  # noqa: E402


def test_nan_and_zero_scale(sheet, settings, capfd):
    obj = sheet()
    bake(obj)
    settings.live = True
    before = stored(obj)
    obj.data.shape_keys.key_blocks["Up"].data[3].co.z = float("nan")
    bpy.context.scene.frame_set(2)
    assert "not numbers" in live.problem(obj)
    np.testing.assert_array_equal(stored(obj), before)
    obj.data.shape_keys.key_blocks["Up"].data[3].co.z = 0
    obj.scale = (0, 0, 0)
    bpy.context.scene.frame_set(3)
    assert "scale of zero" in live.problem(obj)
    obj.scale = (1, 1, 1)
    obj.location.x = float("nan")
    bpy.context.scene.frame_set(2)
    assert live.problem(obj)
    obj.location.x = 0
    bpy.context.scene.frame_set(3)
    assert not live.problem(obj)
    settings.live = False
    obj.scale = (float("nan"), 1, 1)
    settings.live = True
    assert live.problem(obj)
    quiet(capfd)


def test_edit_mode_of_a_twin(sheet, settings, tmp_path, capfd):
    obj = sheet()
    bake(obj)
    twin = bpy.data.objects.new("Twin", obj.data)
    bpy.context.scene.collection.objects.link(twin)
    settings.sequence_folder = str(tmp_path)
    for way in ("live", "sequence"):
        if way == "live":
            settings.live = True
        else:
            settings.live = False
            select(obj)
            twin.select_set(False)
            bpy.ops.neural_gash.bake_sequence()
        bpy.context.scene.frame_set(1)
        bpy.context.view_layer.objects.active = twin
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.context.scene.frame_set(2)
        bpy.context.scene.frame_set(3)
        bpy.ops.object.mode_set(mode="OBJECT")
        bpy.context.scene.frame_set(2)
        stored(obj)
    quiet(capfd)


def test_undo_and_redo(sheet, settings, capfd):
    obj = sheet()
    bake(obj)
    settings.live = True
    bpy.ops.ed.undo_push(message="one")
    bpy.context.scene.frame_set(3)
    bpy.ops.ed.undo_push(message="two")
    bpy.context.scene.frame_set(2)
    bpy.ops.ed.undo_push(message="three")
    for step in (bpy.ops.ed.undo, bpy.ops.ed.undo, bpy.ops.ed.redo):
        step()
        obj, scene = bpy.data.objects["Sheet"], bpy.context.scene
        scene.frame_set(scene.frame_current)
        assert staleness.status(obj) == staleness.CURRENT
    quiet(capfd)


def test_two_scenes(sheet, settings, capfd):
    obj = sheet()
    bake(obj)
    other = bpy.data.scenes.new("Second")
    other.collection.objects.link(obj)
    settings.live = True
    other.frame_set(3)
    bpy.context.scene.frame_set(2)
    np.testing.assert_allclose(stored(obj), truth(obj, settings), atol=1e-6)
    other.neural_gash.live = True
    other.neural_gash.method = "analytic"
    other.frame_set(1)
    bpy.context.scene.frame_set(3)
    np.testing.assert_allclose(stored(obj), truth(obj, settings), atol=1e-6)
    bpy.data.scenes.remove(other)
    bpy.context.scene.frame_set(1)
    quiet(capfd)


def test_motion_blur_and_subframes(sheet, settings, tmp_path, capfd):
    obj = sheet()
    bake(obj)
    settings.live = True
    scene = bpy.context.scene
    scene.frame_set(1, subframe=0.5)
    np.testing.assert_allclose(stored(obj), truth(obj, settings), atol=1e-6)
    camera = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    camera.location = (0, 0, 4)
    scene.collection.objects.link(camera)
    scene.camera, scene.render.engine, scene.cycles.samples = camera, "CYCLES", 1
    scene.render.resolution_x = scene.render.resolution_y = 16
    scene.render.use_motion_blur = True
    scene.render.filepath = str(tmp_path / "m")
    scene.frame_set(1)
    bpy.ops.render.render(animation=True)
    scene.frame_set(2)
    np.testing.assert_allclose(stored(obj), truth(obj, settings), atol=1e-6)
    quiet(capfd)


def test_record_is_rubbish(sheet, settings, capfd):
    obj = sheet()
    bake(obj)
    settings.live = True
    obj.data["neural_gash"] = "rubbish"
    bpy.context.scene.frame_set(2)
    assert "unreadable" in live.problem(obj)
    obj.data["neural_gash"] = 5
    obj.data["neural_gash_sequence"] = 7
    bpy.context.scene.frame_set(3)
    quiet(capfd)


def test_linked(sheet, settings, tmp_path, capfd):
    obj = sheet()
    settings.sequence_folder = str(tmp_path)
    select(obj)
    bpy.ops.neural_gash.bake_sequence()
    path = str(tmp_path / "lib.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(path, link=True) as (a, b):
        b.objects = ["Sheet"]
    obj = bpy.data.objects["Sheet"]
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.scene.neural_gash.live = True
    bpy.context.scene.frame_set(2)
    new = obj.override_create()
    bpy.context.scene.collection.objects.link(new)
    bpy.context.scene.frame_set(3)
    quiet(capfd)


@pytest.mark.parametrize("overridden", [False, True])
def test_a_linked_sequence_is_left_as_it_is(sheet, settings, tmp_path, caplog, overridden):
    """Blender lets nothing be stored in what is linked; renders say where the bake does not fit."""
    sheet()
    settings.sequence_folder = str(tmp_path)
    bpy.ops.neural_gash.bake_sequence()
    first = stored(bpy.data.objects["Sheet"])
    path = str(tmp_path / "lib.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(path, link=True) as (_, found):
        found.objects = ["Sheet"]
    scene, obj = bpy.context.scene, bpy.data.objects["Sheet"]
    if overridden:
        obj = obj.override_create()
    scene.collection.objects.link(obj)
    scene.frame_set(1)
    assert staleness.status(obj) == staleness.CURRENT
    scene.frame_set(3)
    assert staleness.status(obj) == staleness.STALE and "make" in live.problem(obj)
    np.testing.assert_array_equal(stored(obj), first)
    scene.camera = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.render.filepath, scene.frame_end = str(tmp_path / "r"), 3
    scene.frame_set(1)
    bpy.ops.render.render(animation=True)
    said = [record.message for record in caplog.records if "does not fit" in record.message]
    assert len(said) == 1 and said[0].startswith("Frame 2:")
    assert ("own materials" if overridden else "shadows are wrong") in said[0]
    assert preview.is_on(obj) and not rendered._aside


def test_a_problem_stays_said_while_others_change(sheet, make, settings):
    obj = sheet()
    bake(obj)
    other = make(name="Other")
    settings.live = True
    obj.modifiers.new("More", "SUBSURF").levels = 1
    bpy.context.view_layer.update()
    assert live.problem(obj)
    other.location.x = 5
    bpy.context.view_layer.update()
    assert "change its vertices" in live.problem(obj)


@pytest.mark.parametrize("where", ["fingerprint", "write_transfer"])
def test_a_frame_change_during_an_update(sheet, settings, monkeypatch, capfd, where):
    """By another add-on's handler or a script: before anything was read, and before it is written."""
    obj = sheet()
    bake(obj)
    settings.live = True
    real, again = getattr(live, where), []

    def busy(*args, **kwargs):
        if not again:
            again.append(bpy.context.scene.frame_current)
            bpy.context.scene.frame_set(3)
        return real(*args, **kwargs)
    monkeypatch.setattr(live, where, busy)
    bpy.context.scene.frame_set(2)
    assert again == [2] and bpy.context.scene.frame_current == 3
    monkeypatch.setattr(live, where, real)
    bpy.context.scene.frame_set(3)
    np.testing.assert_allclose(stored(obj), truth(obj, settings), atol=1e-6)
    assert staleness.status(obj) == staleness.CURRENT and not live.problem(obj)
    quiet(capfd)
