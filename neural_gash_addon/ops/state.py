# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panel shows of a running bake. Lives with the program, not with the file."""
from __future__ import annotations

import bpy

running = False
progress = 0.0
_worker = None  # of the bake that runs; it has cancel()


def start(worker) -> None:
    """A bake begins."""
    global running, progress, _worker
    running, progress, _worker = True, 0.0, worker


def stop() -> None:
    """It ended, however."""
    global running, _worker
    running, _worker = False, None


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
