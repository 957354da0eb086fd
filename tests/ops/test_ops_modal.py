# SPDX-License-Identifier: GPL-3.0-or-later
"""The modal bake, driven by made-up events: the module has no window, so its context is stood in for."""
from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from .conftest import CUBE

bpy = pytest.importorskip("bpy")

TIMER = SimpleNamespace(type="TIMER", value="NOTHING")
ESC = SimpleNamespace(type="ESC", value="PRESS")
MOUSE = SimpleNamespace(type="MOUSEMOVE", value="NOTHING")


class Manager:
    """A window manager that counts what it lends."""

    windows = ()

    def __init__(self):
        self.timers, self.handlers, self.bars = 0, 0, 0

    def event_timer_add(self, *_, **__):
        self.timers += 1
        return object()

    def event_timer_remove(self, _):
        self.timers -= 1

    def modal_handler_add(self, _):
        self.handlers += 1

    def progress_begin(self, *_):
        self.bars += 1

    def progress_update(self, _):
        pass

    def progress_end(self):
        self.bars -= 1


class Context:
    """bpy.context with another window manager and workspace."""

    def __init__(self):
        self.window_manager, self.window, self.status = Manager(), None, None
        self.workspace = SimpleNamespace(status_text_set=lambda text: setattr(self, "status", text))

    def __getattr__(self, name):
        return getattr(bpy.context, name)

    @property
    def idle(self):
        """Whether everything lent came back."""
        manager = self.window_manager
        return manager.timers == manager.bars == 0 and self.status is None


@pytest.fixture
def context():
    """A fresh one; nothing may run on after the test."""
    from neural_gash_addon.ops import state
    yield Context()
    assert not state.running


@pytest.fixture
def operator():
    """The logic of the Bake operator outside Blender's operator, with its reports."""
    from neural_gash_addon.ops.bake import Baking

    class Operator(Baking):
        def __init__(self):
            self.reports = []

        def report(self, kind, text):
            self.reports.append((next(iter(kind)), text))

    return Operator()


def _to_the_end(operator, context):
    """Timer events until it answers something else."""
    until = time.monotonic() + 30
    while time.monotonic() < until:
        answer = operator.modal(context, TIMER)
        if answer != {"RUNNING_MODAL"}:
            return answer
        time.sleep(0.005)
    pytest.fail("the bake never ended")


def _endless(monkeypatch):
    """Make bakes go on for ever; gives an event that is set when one is closed."""
    from neural_gash_addon.backend import methods
    closed = threading.Event()

    def bake(*_, **__):
        try:
            while True:
                time.sleep(0.005)
                yield 0.5
        finally:
            closed.set()

    monkeypatch.setattr(methods, "bake", bake)
    return closed


def test_modal_equals_execute(make, settings, operator, context):
    from neural_gash_addon.scene.attributes import read_transfer
    obj = make()
    bpy.ops.neural_gash.bake()
    at_once = read_transfer(obj)[0]
    bpy.ops.neural_gash.clear()
    assert operator.invoke(context, None) == {"RUNNING_MODAL"}
    assert _to_the_end(operator, context) == {"FINISHED"}
    np.testing.assert_array_equal(read_transfer(obj)[0], at_once)
    assert context.idle and [kind for kind, _ in operator.reports] == ["INFO"]


def test_progress_then_esc_leaves_everything(make, settings, operator, context, snapshot, monkeypatch, refused):
    from neural_gash_addon.ops import state
    make()
    closed = _endless(monkeypatch)
    before = snapshot()
    operator.invoke(context, None)
    assert context.status == "Neural GASh: baking Thing, 0 %. Esc cancels"  # before the first tick
    time.sleep(0.1)
    assert operator.modal(context, TIMER) == {"RUNNING_MODAL"}
    assert operator.modal(context, MOUSE) == {"PASS_THROUGH"}
    assert state.running and state.progress == 0.5 and context.status == "Neural GASh: baking Thing, 50 %. Esc cancels"
    assert "running" in refused(bpy.ops.neural_gash.bake)  # no second one beside it
    assert operator.modal(context, ESC) == {"CANCELLED"}
    assert context.idle and snapshot() == before
    assert closed.wait(5)  # the worker stops, too


def _remove(obj):
    bpy.data.objects.remove(obj)


def _edit(obj):
    obj.data.vertices[0].co.x += 0.5


def _subdivide(obj):
    obj.data.clear_geometry()
    obj.data.from_pydata([*CUBE[0]], [], CUBE[1][:5])


def _edit_mode(obj):
    bpy.ops.object.mode_set(mode="EDIT")


@pytest.mark.parametrize("change", [_remove, _edit, _subdivide, _edit_mode])
def test_changes_meanwhile_are_one_sentence(change, make, settings, operator, context):
    obj = make(name="Changed")
    data = obj.data
    operator.invoke(context, None)
    change(obj)
    assert _to_the_end(operator, context) == {"CANCELLED"}
    assert len(operator.reports) == 1 and operator.reports[0][0] == "ERROR" and "Changed" in operator.reports[0][1]
    assert context.idle and "neural_gash" not in data
    if bpy.context.object and bpy.context.object.mode == "EDIT":
        bpy.ops.object.mode_set(mode="OBJECT")


def test_renamed_moved_and_deselected_meanwhile_is_baked(make, settings, operator, context):
    from neural_gash_addon.scene.attributes import read_transfer
    obj = make()
    operator.invoke(context, None)
    obj.name, obj.location, obj.rotation_euler = "Another", (5, 0, 0), (0, 0, 1)
    make(name="New active")
    assert _to_the_end(operator, context) == {"FINISHED"}
    assert np.allclose(read_transfer(obj)[1].frame, np.eye(3).ravel())  # as it stood when it was read


def test_another_file_meanwhile(make, settings, operator, context):
    """Blender cancels the operator itself then; even if it did not, nothing of the new file is touched."""
    make(name="Lost")
    operator.invoke(context, None)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    make(name="Other")
    assert _to_the_end(operator, context) == {"CANCELLED"}
    assert "Lost" in operator.reports[0][1] and "neural_gash" not in bpy.data.objects["Other"].data


def test_saved_meanwhile(make, settings, operator, context, tmp_path):
    """The file has no part of the bake; the bake ends as ever."""
    make()
    operator.invoke(context, None)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert _to_the_end(operator, context) == {"FINISHED"} and context.idle
    assert "neural_gash" in bpy.data.objects["Thing"].data
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    data = bpy.data.objects["Thing"].data
    assert "neural_gash" not in data and not any(name.startswith("_prt_") for name, _ in data.attributes.items())


@pytest.mark.parametrize("what", ["moved", "edited"])
def test_undone_meanwhile(make, settings, operator, context, what):
    """What was undone moved the object, which changes no bake, or its vertices, which does."""
    obj = make()
    bpy.ops.ed.undo_push(message="made")
    if what == "moved":
        obj.location.x = 3
    else:
        obj.data.vertices[0].co.x += 0.5
    bpy.ops.ed.undo_push(message=what)
    operator.invoke(context, None)
    bpy.ops.ed.undo()
    assert _to_the_end(operator, context) == ({"FINISHED"} if what == "moved" else {"CANCELLED"})
    assert context.idle and len(operator.reports) == 1
    assert ("neural_gash" in bpy.data.objects["Thing"].data) == (what == "moved")


def test_a_failing_worker_is_reported(make, settings, operator, context, monkeypatch, snapshot):
    from neural_gash_addon.backend import methods

    def bake(*_, **__):
        yield 0.1
        raise MemoryError("no memory left")

    monkeypatch.setattr(methods, "bake", bake)
    make()
    before = snapshot()
    operator.invoke(context, None)
    assert _to_the_end(operator, context) == {"CANCELLED"}
    assert "no memory left" in operator.reports[0][1] and snapshot() == before and context.idle


def test_unregistering_stops_the_worker(make, settings, operator, context, monkeypatch, addon):
    closed = _endless(monkeypatch)
    make()
    operator.invoke(context, None)
    addon.unregister()
    assert closed.wait(5)
    addon.register()


def test_esc_takes_the_applied_copy_away(make, settings, context, snapshot, monkeypatch):
    from neural_gash_addon.ops.bake import Baking
    from neural_gash_addon.ops.bake import NEURAL_GASH_OT_bake_applied_copy as Copy
    members = {name: vars(Copy)[name] for name in ("_copy", "_begin", "_undo", "_select")}
    operator = type("Operator", (Baking,), {**members, "report": lambda *_: None})()
    make().modifiers.new("Subdivision", "SUBSURF")
    closed = _endless(monkeypatch)
    before = snapshot()
    operator.invoke(context, None)
    assert len(bpy.data.objects) == 2
    assert operator.modal(context, ESC) == {"CANCELLED"}
    assert snapshot() == before and closed.wait(5)
