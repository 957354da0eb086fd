# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panel shows of a running bake. Lives with the program, not with the file."""
from __future__ import annotations

import bpy

running = False
progress = 0.0


def start() -> None:
    """A bake begins."""
    global running, progress
    running, progress = True, 0.0


def stop() -> None:
    """It ended, however."""
    global running
    running = False


def redraw(context: bpy.types.Context) -> None:
    """Have the panels drawn again."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
