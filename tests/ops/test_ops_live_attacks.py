# SPDX-License-Identifier: GPL-3.0-or-later
"""Live and sequences at bad moments and with bad input."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from neural_gash_addon.backend import methods  # noqa: E402
from neural_gash_addon.backend.sequence import open_sequence  # noqa: E402
from neural_gash_addon.ops.sequence import Steps, bake_sequence  # noqa: E402
from neural_gash_addon.scene import attributes, live, read, staleness  # noqa: E402

LINE = np.linspace(-1, 1, 9)
SHEET = [(x, y, 0.0) for y in LINE for x in LINE]
FACES = [(j * 9 + i, j * 9 + i + 1, (j + 1) * 9 + i + 1, (j + 1) * 9 + i) for j in range(8) for i in range(8)]


@pytest.fixture
def sheet(make, settings):
    """sheet(name): one that folds up by a shape key, from frame 1 to frame 3; not baked."""
    def build(name="Sheet"):
        obj = make(SHEET, FACES, name, smooth=True)
        obj.shape_key_add(name="Basis")
        key = obj.shape_key_add(name="Up")
        for point, (x, y, _) in zip(key.data, SHEET, strict=True):
            point.co = (0.35 * x, y, 0.9 * x) if x > 0 else (x, y, 0)
        for frame, value in ((1, 0.0), (3, 1.0)):
            key.value = value
            key.keyframe_insert("value", frame=frame)
        return obj
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, 3
    scene.frame_set(1)
    return build


def stored(obj):
    """(E, K) as the attributes have it."""
    return attributes.read_transfer(obj)[0]


def truth(obj, settings):
    """(N, K) of the object as it stands."""
    mesh = read.read_object(obj, bpy.context.evaluated_depsgraph_get()).mesh
    return methods.run(methods.bake(mesh, settings.method, settings.order, **settings.tracing())).coefficients


def select(*objects):
    for obj in objects:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = objects[0]


def bake(*objects):
    select(*objects)
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def quiet(capfd):
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err, out + err


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
