# SPDX-License-Identifier: GPL-3.0-or-later
"""Bad moments in a real window: another file, a closed window, the add-on disabled, while a bake runs and Live is on.

Part of `session.py`, whose module is handed over as `s`.
"""
from __future__ import annotations

import inspect
import sys
import tempfile
import threading

import bpy


def moments(s):
    """All of them."""
    yield from loaded(s)
    yield from closed(s)
    yield from disabled(s, long_bake)
    yield from disabled(s, long_sequence)


def left_behind(s) -> dict:
    """Handlers, timers and threads of the add-on, and modal operators of the windows."""
    functions = {f for name, module in list(sys.modules.items()) if name.startswith(s.ID)
                 for f in vars(module).values() if inspect.isfunction(f)}
    handlers = {name: sum(getattr(h, "__module__", "").startswith(s.ID) for h in getattr(bpy.app.handlers, name))
                for name in dir(bpy.app.handlers) if isinstance(getattr(bpy.app.handlers, name), list)}
    return {"handlers": {name: count for name, count in handlers.items() if count},
            "timers": sum(map(bpy.app.timers.is_registered, functions)),
            "threads": sum(t.name.startswith("neural_gash") for t in threading.enumerate()),
            # None: of a class that is gone; Blender drops it with the next event
            "modal": sum(op is not None for w in bpy.context.window_manager.windows for op in w.modal_operators)}


def long_bake(s, window=None) -> None:
    """A bake of a new ball that does not end by itself, begun in a window."""
    window = window or bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
        bpy.ops.mesh.primitive_monkey_add()
        bpy.context.object.modifiers.new("Subdivision", "SUBSURF").levels = 3
        bpy.ops.object.modifier_apply(modifier="Subdivision")
        settings = window.scene.neural_gash
        settings.method, settings.quality, settings.rays = "embree", "RAYS", s.MANY_RAYS
        s.expect(bpy.ops.neural_gash.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}, "a_long_bake_begins")


def long_sequence(s) -> None:
    """A sequence of the same ball that does not end by itself."""
    with s.in_view():
        settings = bpy.context.scene.neural_gash
        settings.sequence_folder = tempfile.mkdtemp()
        settings.method, settings.quality, settings.rays = "embree", "RAYS", s.MANY_RAYS
        s.expect(bpy.ops.neural_gash.bake_sequence("INVOKE_DEFAULT") == {"RUNNING_MODAL"}, "a_long_sequence_begins")


def gone(s, name: str):
    """The bake stops and leaves nothing."""
    for _ in range(60):
        yield 0.1
        now = left_behind(s)
        if not (now["threads"] or now["modal"] or s.state().running):
            break
    s.expect(not (now["threads"] or now["modal"] or s.state().running), name)


def loaded(s):
    """Another file is opened while a bake runs."""
    before = left_behind(s)
    long_bake(s)
    yield 1.0
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    yield from gone(s, "loading_stops_a_bake")
    s.expect(left_behind(s)["handlers"] == before["handlers"], "loading_keeps_the_handlers")


def closed(s):
    """A second window is opened, a bake begun in it, and the window closed; Live is on meanwhile."""
    with s.in_view():
        bpy.ops.wm.window_new()
    yield 1.0
    first, second = bpy.context.window_manager.windows[:]
    s.expect(first.scene == second.scene, "two_windows")
    second.scene.neural_gash.live = True
    long_bake(s, second)
    yield 1.0
    with bpy.context.temp_override(window=second):
        bpy.ops.wm.window_close()
    yield from gone(s, "closing_its_window_stops_a_bake")
    s.expect(len(bpy.context.window_manager.windows) == 1, "one_window_again")


def disabled(s, begin):
    """The add-on is disabled while a bake runs and Live is on, and enabled again."""
    before = left_behind(s)
    bpy.context.scene.neural_gash.live = True
    begin(s)
    yield 1.0
    state = s.state()
    bpy.ops.preferences.addon_disable(module=s.ID)
    for _ in range(60):
        yield 0.1
        now = left_behind(s)
        if not (now["threads"] or now["modal"]):
            break
    nothing = {"handlers": {}, "timers": 0, "threads": 0, "modal": 0}
    s.expect(now == nothing and not state.running, "disabling_leaves_nothing")
    bpy.context.object.location.x += 1  # what was followed moves
    bpy.context.scene.frame_set(2)
    yield 1.0
    bpy.ops.preferences.addon_enable(module=s.ID)
    yield 0.5
    s.expect(left_behind(s)["handlers"] == before["handlers"], "enabled_again_as_before")
    s.expect(bpy.context.scene.neural_gash.live, "its_settings_are_the_files")
