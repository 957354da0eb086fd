# SPDX-License-Identifier: GPL-3.0-or-later
"""The viewport's own HDRI rotation turns the light of the previews, where the person asks for it.

Blender tells of it by its message bus: a viewport's shading is no data of the scene, so no dependency graph has it.
"""
from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

_OWNER = object()
_known: dict[int, float] = {}  # address of a viewport's space -> its rotation when last seen


def follow_viewport(scene: bpy.types.Scene, anew: bool = False) -> None:
    """Turn the light as the viewport has it whose rotation changed; of several, the last.

    anew: as the first viewport has it, though it has not changed.
    """
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type != "VIEW_3D" or window.scene != scene:
                continue
            space = area.spaces.active
            turned, before = space.shading.studiolight_rotate_z, _known.get(space.as_pointer(), 0.0)
            _known[space.as_pointer()] = turned
            if anew or turned != before:
                scene.neural_gash.light_rotation = -turned  # it turns where the image is looked up, so the light back
                anew = False


def _on_turned() -> None:
    """Some viewport's HDRI was turned."""
    for scene in {window.scene for window in bpy.context.window_manager.windows}:
        if scene.neural_gash.with_viewport:
            follow_viewport(scene)


@persistent
def _on_load(*_: object) -> None:
    """Another file, with viewports of its own; Blender has forgotten who listens."""
    _known.clear()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                _known[area.spaces.active.as_pointer()] = area.spaces.active.shading.studiolight_rotate_z
    _listen()


def _listen() -> None:
    bpy.msgbus.clear_by_owner(_OWNER)
    bpy.msgbus.subscribe_rna(key=(bpy.types.View3DShading, "studiolight_rotate_z"), owner=_OWNER, args=(),
                             notify=_on_turned)


def register() -> None:
    """Start listening."""
    _listen()
    bpy.app.handlers.load_post.append(_on_load)


def unregister() -> None:
    """Stop."""
    bpy.app.handlers.load_post.remove(_on_load)
    bpy.msgbus.clear_by_owner(_OWNER)
    _known.clear()
