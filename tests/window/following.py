# SPDX-License-Identifier: GPL-3.0-or-later
"""What previews and bakes follow on their own in a real window: lamps, the World, the viewport, and deforming meshes.

Part of `session.py`, whose names are handed over as `s`.
"""
from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np


def following(s):
    """All of it."""
    yield from followed(s)
    yield from turned(s)
    yield from lived(s)


def followed(s):
    """The sun is turned, the World made brighter, and both undone: the preview follows on its own."""
    sun = next(o for o in bpy.data.objects if o.type == "LIGHT")
    strength = bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"]
    first = s.light()
    with s.in_view():
        bpy.ops.ed.undo_push(message="Before the sun is turned")
    for angle in np.linspace(0.6, -0.9, 9)[1:]:
        sun.rotation_euler[0] = float(angle)
        yield 0.1
    turned = s.light()
    s.expect(not np.allclose(turned, first), "a_sun_is_followed")
    strength.default_value = 8.0
    yield 0.3
    s.expect(not np.allclose(s.light(), turned), "the_world_is_followed")
    yield 2
    yield from s.picture("6b_followed")
    with s.in_view():
        bpy.ops.ed.undo_push(message="Sun turned")
    s.press("Z", ctrl=True)
    yield 1.0
    s.expect(np.allclose(s.light(), first, atol=1e-5), "undo_takes_the_light_back")
    s.view3d()[1].spaces.active.shading.type = "SOLID"


def turned(s):
    """The HDRI of the viewport is turned by its own option: the light of the preview turns with it."""
    before = s.light()
    s.settings().with_viewport = True
    shading = s.view3d()[1].spaces.active.shading
    shading.studiolight_rotate_z = 0.7
    yield 0.5
    s.expect(abs(s.settings().light_rotation + 0.7) < 1e-5, "the_viewport_turns_the_light")
    s.expect(not np.allclose(s.light(), before), "and_the_preview")
    s.settings().with_viewport = False
    shading.studiolight_rotate_z = 0.0
    yield 0.5
    s.expect(abs(s.settings().light_rotation + 0.7) < 1e-5, "only_where_asked_for")
    s.settings().light_rotation = 0.0
    yield 0.2


def lived(s):
    """Live: what a modifier does to the head is followed while a value is dragged, and while the animation plays."""
    live, staleness = (sys.modules[f"{s.ID}.scene.{name}"] for name in ("live", "staleness"))
    head, scene = s.suzanne(), bpy.context.scene
    twist = head.modifiers.new("Twist", "SIMPLE_DEFORM")
    twist.deform_method, twist.angle = "TWIST", 0.0
    s.settings().live = True
    yield 1.0
    s.expect("ms; error about" in live.status(head) and not live.problem(head), "live_says_what_it_does")
    s.facts["live"] = live.status(head)
    took, before = [], s.coefficients()
    for angle in np.linspace(0.1, 1.6, 12):
        twist.angle = float(angle)
        yield 0.05
        took.append(live._followers[head.session_uid].seconds)
        s.expect(not np.array_equal(s.coefficients(), before), "live_follows_a_drag")
        before = s.coefficients()
    s.facts["live_drag_ms"] = round(1000 * float(np.median(took)), 1)
    yield 1.0
    s.expect(staleness.status(head) == staleness.CURRENT, "live_is_up_to_date")
    yield from s.picture("6c_live")
    for frame, angle in ((1, 0.0), (24, 1.6)):
        twist.angle = angle
        twist.keyframe_insert("angle", frame=frame)
    scene.frame_start, scene.frame_end = 1, 24
    with s.in_view():
        bpy.ops.screen.animation_play()
    seen = set()
    until = time.perf_counter() + 3
    while time.perf_counter() < until:
        seen.add(s.coefficients().tobytes())
        yield 0.05
    with s.in_view():
        bpy.ops.screen.animation_cancel()
    s.facts["live_frames_seen"] = len(seen)
    s.expect(len(seen) > 2, "live_follows_playback")  # software GL draws few frames a second
    yield from rendered(s, head)
    s.settings().live = False
    head.modifiers.remove(twist)
    head.animation_data_clear()
    scene.frame_set(1)
    with s.in_view():
        bpy.ops.ed.undo_push(message="Live over")
    s.expect(bpy.ops.neural_gash.bake() == {"FINISHED"}, "baked_after_live")
    yield 0.5


def rendered(s, head):
    """An animation rendered from the open window, whose second frame cannot be followed: own materials there only."""
    scene, live = bpy.context.scene, sys.modules[f"{s.ID}.scene.live"]
    aside = sys.modules[f"{s.ID}.scene.rendered"]
    more = head.modifiers.new("More", "SUBSURF")
    more.levels = more.render_levels = 1
    for frame, shown in ((1, False), (2, True), (3, False)):
        more.show_viewport = more.show_render = shown
        for path in ("show_viewport", "show_render"):
            more.keyframe_insert(path, frame=frame)
    frames = scene.frame_start, scene.frame_end
    scene.frame_start, scene.frame_end = 1, 3
    scene.frame_set(1)
    engine, scene.render.engine, scene.cycles.samples = scene.render.engine, "CYCLES", 1
    locked, scene.render.use_lock_interface = scene.render.use_lock_interface, True
    scene.render.resolution_x = scene.render.resolution_y = 32
    kind, scene.render.image_settings.file_format = scene.render.image_settings.file_format, "PNG"
    materials = []

    def note(*_):
        materials.append([slot.material and slot.material.name for slot in head.material_slots])

    with tempfile.TemporaryDirectory() as folder:
        path, scene.render.filepath = scene.render.filepath, str(Path(folder) / "frame")
        bpy.app.handlers.render_post.append(note)
        try:
            with s.in_view():
                s.expect("RUNNING_MODAL" in bpy.ops.render.render("INVOKE_DEFAULT", animation=True), "render_begins")
            until = time.perf_counter() + 120
            while (bpy.app.is_job_running("RENDER") or len(materials) < 3) and time.perf_counter() < until:
                yield 0.2
        finally:
            bpy.app.handlers.render_post.remove(note)
        s.facts["rendered_materials"] = materials
        s.expect(len(list(Path(folder).iterdir())) == 3, "three_frames_rendered")
        scene.render.filepath = path
    own = ["PRT preview" not in str(names) for names in materials]
    s.expect(own == [False, True, False], "own_materials_where_it_cannot_follow")
    yield 1.0
    for window in bpy.context.window_manager.windows[1:]:  # the picture's
        with bpy.context.temp_override(window=window):
            bpy.ops.wm.window_close()
    yield 0.5
    slots = [slot.material and slot.material.name for slot in head.material_slots]
    s.expect("PRT preview" in str(slots) and not aside._aside, "the_preview_is_back")
    scene.render.use_lock_interface, scene.render.engine = locked, engine
    scene.render.image_settings.file_format = kind
    scene.frame_start, scene.frame_end = frames
    head.modifiers.remove(more)
    scene.frame_set(1)
    yield 1.0
    s.expect(not live.problem(head), "followed_again_after_the_render")
