# SPDX-License-Identifier: GPL-3.0-or-later
"""Sequences at bad moments and with bad input."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from .moving import bake, quiet, select, stored

bpy = pytest.importorskip("bpy")

from neural_gash_addon.backend import methods  # noqa: E402
from neural_gash_addon.backend.sequence import open_sequence  # noqa: E402
from neural_gash_addon.ops.sequence import Steps, bake_sequence  # noqa: E402
from neural_gash_addon.scene import attributes, live, staleness  # noqa: E402


def test_cut_while_it_plays(sheet, settings, tmp_path, capfd):
    obj = sheet()
    settings.sequence_folder = str(tmp_path)
    select(obj)
    bpy.ops.neural_gash.bake_sequence()
    path = tmp_path / "Sheet.prtseq"
    scene = bpy.context.scene
    scene.frame_set(2)
    data = path.read_bytes()
    with open(path, "r+b") as f:
        f.truncate(100)
    scene.frame_set(3)
    assert "no sequence" in live.problem(obj)
    path.write_bytes(data)
    scene.frame_set(1)
    assert not live.problem(obj)
    quiet(capfd)


def test_live_switched_on_during_a_sequence(sheet, settings, tmp_path):
    obj = sheet()
    bake(obj)
    settings.sequence_folder = str(tmp_path)
    baking = bake_sequence(bpy.context, [obj])
    while next(baking) < 0.5:
        pass
    before = stored(obj)
    settings.live = True
    np.testing.assert_array_equal(stored(obj), before)
    methods.run(baking)


@pytest.mark.parametrize("error", [MemoryError("no"), RuntimeError("no")])
def test_an_error_in_a_frame_ends_the_bake(sheet, settings, tmp_path, monkeypatch, error):
    obj = sheet()
    settings.sequence_folder = str(tmp_path)

    def broken(*_, **__):
        raise error
        yield
    monkeypatch.setattr(methods, "bake", broken)
    steps = Steps(bake_sequence(bpy.context, [obj]))
    steps.start()
    steps.step()
    assert not steps.is_alive() and steps.error is error and not live._suspended


def test_colliding_names(sheet, settings, tmp_path):
    one, two = sheet("A/b"), sheet("A_b")
    two.scale = (2, 1, 1)
    settings.sequence_folder = str(tmp_path)
    select(one, two)
    bpy.ops.neural_gash.bake_sequence()
    files = [obj.data.get("neural_gash_sequence") for obj in (one, two)]
    assert files[0] != files[1] or files[1] is None


def test_each_blend_has_its_own(sheet, settings, tmp_path):
    """Two files with objects of the same name, sequences in the same folder."""
    scene = bpy.context.scene
    select(sheet())
    settings.sequence_folder = "//"
    for name in ("one", "two"):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / f"{name}.blend"))
        scene = bpy.context.scene
        scene.frame_end = 1 if name == "two" else 3
        bpy.context.view_layer.objects.active = bpy.data.objects["Sheet"]
        assert bpy.ops.neural_gash.bake_sequence() == {"FINISHED"}
        bpy.ops.wm.save_mainfile()
    assert sorted(path.name for path in tmp_path.glob("*.prtseq")) == ["one-Sheet.prtseq", "two-Sheet.prtseq"]
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "one.blend"))
    bpy.context.scene.frame_set(3)
    assert staleness.status(bpy.data.objects["Sheet"]) == staleness.CURRENT


def test_disabled_during_a_sequence(sheet, settings, tmp_path, addon, capfd):
    """Nothing is left of it: no file, and the scene at its frame."""
    obj = sheet()
    settings.sequence_folder = str(tmp_path)
    bpy.context.scene.frame_set(2)
    baking = bake_sequence(bpy.context, [obj])
    while next(baking) < 0.5:
        pass
    addon.unregister()
    try:
        baking.close()
        assert not list(tmp_path.iterdir()) and bpy.context.scene.frame_current == 2 and not live._suspended
    finally:
        addon.register()
    quiet(capfd)


def test_twins(sheet, settings, tmp_path):
    one = sheet("One")
    two = bpy.data.objects.new("Two", one.data)
    bpy.context.scene.collection.objects.link(two)
    settings.sequence_folder = str(tmp_path)
    two.modifiers.new("T", "SIMPLE_DEFORM").angle = 2
    select(one, two)
    bpy.ops.neural_gash.bake_sequence()
    bpy.context.scene.frame_set(2)
    assert staleness.status(one) == staleness.CURRENT


def test_deleted_or_renamed_meanwhile(sheet, settings, tmp_path):
    one, two = sheet("One"), sheet("Two")
    settings.sequence_folder = str(tmp_path)
    baking = bake_sequence(bpy.context, [one, two])
    while next(baking) < 0.5:
        pass
    one.name = "Uno"
    bpy.data.objects.remove(two)
    methods.run(baking)
    assert attributes.SEQUENCE in one.data
    for frame, status in ((2, staleness.STALE), (3, staleness.CURRENT)):  # it cast its shadow until then
        bpy.context.scene.frame_set(frame)
        assert not live.problem(one) and staleness.status(one) == status


def test_attribute_in_the_way_of_one(sheet, settings, tmp_path):
    one, two = sheet("One"), sheet("Two")
    one.data.attributes.new("_prt_0", "FLOAT", "POINT")
    settings.sequence_folder = str(tmp_path)
    select(one, two)
    assert bpy.ops.neural_gash.bake_sequence() == {"FINISHED"}
    assert attributes.SEQUENCE in two.data and attributes.SEQUENCE not in one.data
    assert [p.name for p in tmp_path.iterdir()] == ["Two.prtseq"]


def test_folder_that_is_relative(sheet, settings, tmp_path, refused, monkeypatch):
    monkeypatch.chdir(tmp_path)
    obj = sheet()
    select(obj)
    for folder in ("//bakes", "bakes"):
        settings.sequence_folder = folder
        refused(bpy.ops.neural_gash.bake_sequence)
        assert not list(tmp_path.iterdir())
    (tmp_path / "here").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "here" / "a.blend"))
    bpy.context.scene.neural_gash.sequence_folder = "//bakes"
    bpy.ops.neural_gash.bake_sequence()
    assert bpy.data.objects["Sheet"].data["neural_gash_sequence"].startswith("//bakes")


@pytest.mark.parametrize("first,last", [(-2, 1), (2, 2)])
def test_ranges(sheet, settings, tmp_path, first, last):
    obj = sheet()
    scene = bpy.context.scene
    bpy.context.preferences.edit.use_negative_frames = True
    scene.frame_start, scene.frame_end = max(first, 0), last
    scene.frame_start = first
    scene.frame_step = 3
    settings.sequence_folder = str(tmp_path)
    select(obj)
    bpy.ops.neural_gash.bake_sequence()
    for frame in range(scene.frame_start, last + 1):
        scene.frame_set(frame)
        assert staleness.status(obj) == staleness.CURRENT


def test_names_in_many_scripts_have_room(sheet, settings, tmp_path):
    objects = [sheet("漢" * 20 + str(i)) for i in range(2)]
    settings.sequence_folder = str(tmp_path)
    select(*objects)
    bpy.ops.neural_gash.bake_sequence()
    assert len(list(tmp_path.iterdir())) == 2
    bpy.context.scene.frame_set(2)
    assert staleness.status(objects[1]) == staleness.CURRENT


def test_method_chosen_anew_in_each_frame(sheet, settings, tmp_path, monkeypatch):
    obj = sheet()
    settings.sequence_folder = str(tmp_path)
    select(obj)
    real = methods.bake

    def other(mesh, method, *args, **kwargs):
        found = yield from real(mesh, method, *args, **kwargs)
        return replace(found, record=replace(found.record, method=["embree", "hybrid", "gnn"][
            bpy.context.scene.frame_current - 1]))
    monkeypatch.setattr(methods, "bake", other)
    bpy.ops.neural_gash.bake_sequence()
    assert [r.method for r in open_sequence(tmp_path / "Sheet.prtseq").records] == ["embree", "hybrid", "gnn"]
