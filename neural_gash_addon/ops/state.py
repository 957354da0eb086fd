# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panel shows of a running bake. Lives with the program, not with the file."""
from __future__ import annotations

from collections.abc import Callable

import bpy

running = False
progress = 0.0
_worker = None  # of the bake that runs; it has cancel()
_give_back: Callable[[], None] | None = None  # what its operator has of the window: timer, progress, status line


def start(worker, give_back: Callable[[], None]) -> None:
    """A bake begins."""
    global running, progress, _worker, _give_back
    running, progress, _worker, _give_back = True, 0.0, worker, give_back


def stop() -> None:
    """It ended, however."""
    global running, _worker, _give_back
    if _give_back is not None:
        _give_back()
    running, _worker, _give_back = False, None, None


def abandon() -> None:
    """The add-on goes: stop the worker, which no operator will hear of any more."""
    if _worker is not None:
        _worker.cancel()
    stop()


def redraw(context: bpy.types.Context) -> None:
    """Have the panels drawn again; not the views beside them, which may be heavy."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()
