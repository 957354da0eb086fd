# SPDX-License-Identifier: GPL-3.0-or-later
"""No rendered frame shows a bake that does not fit: the object's own materials are rendered there instead."""
from __future__ import annotations

import logging
from collections.abc import Mapping

import bpy

from ..backend.errors import UserError
from .attributes import SEQUENCE, has_bake
from .lighting import light_object
from .preview import is_on, preview_off, preview_on
from .staleness import fits

_LOGGER = logging.getLogger(__name__)
_aside: set[int] = set()  # session uids of the objects whose preview is off until their bake fits, or the render ends


def show_what_fits(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, problems: Mapping[int, str]) -> None:
    """Put the previews aside whose bake is to follow its object and does not fit in this frame; show again what does.

    A bake that nothing follows is left as it is: that it is stale is said in the panel, and may be meant.

    Args:
        problems: why objects could not be followed, by their session uids.
    """
    for obj in scene.objects:
        if (not has_bake(obj) or obj.hide_render or obj.library or obj.data.is_editmode
                or not (scene.neural_gash.live or SEQUENCE in obj.data)
                or not (is_on(obj) or obj.session_uid in _aside)):
            continue
        if fits(obj, depsgraph):
            _show(scene, obj)
        elif is_on(obj):
            _LOGGER.warning("Frame %d: the bake of '%s' does not fit, so its own materials are rendered. %s",
                            scene.frame_current, obj.name, problems.get(obj.session_uid, ""))
            _aside.add(obj.session_uid)
            preview_off(obj)


def show_all() -> None:
    """Show all again that was put aside."""
    if not _aside:
        return
    for scene in bpy.data.scenes:
        for obj in scene.objects:
            _show(scene, obj)
    _aside.clear()


def forget() -> None:
    """Another file: nothing is aside."""
    _aside.clear()


def _show(scene: bpy.types.Scene, obj: bpy.types.Object) -> None:
    """Show a bake that was put aside."""
    if obj.session_uid not in _aside:
        return
    _aside.discard(obj.session_uid)
    try:
        preview_on(obj, scene.neural_gash.lobe_shown())
    except UserError as error:
        _LOGGER.warning("The preview of '%s' stays off. %s", obj.name, error)
    light_object(scene, obj)
