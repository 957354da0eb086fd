# SPDX-License-Identifier: GPL-3.0-or-later
"""The mouse on the panel: buttons are found by what Blender says of the one below the pointer, pressed and dragged.

Part of `session.py`, whose names are handed over as `s`.
"""
from __future__ import annotations

import bpy

_STEP = 9       # pixels between two looks: rows are 20 high
_SETTLE = 0.03  # seconds for an event to be handled


def panel(s):
    """Window, area and region of the N-panel."""
    window, area, _ = s.view3d()
    return window, area, next(r for r in area.regions if r.type == "UI")


def below(s) -> str:
    """What the button below the pointer does, or which property it edits; '' where there is none."""
    window, area, region = panel(s)
    with bpy.context.temp_override(window=window, area=area, region=region):
        for copy, options in ((bpy.ops.ui.copy_python_command_button, {}),
                              (bpy.ops.ui.copy_data_path_button, {"full_path": True})):
            if copy.poll():
                copy(**options)
                return str(bpy.context.window_manager.clipboard)
    return ""


def found(s, wanted: str, places: list):
    """Put into `places` where in the panel a button is of which Blender says `wanted`."""
    window, _, region = panel(s)
    column = region.x + region.width // 2
    for row in range(region.y + region.height - 20, region.y + 10, -_STEP):
        window.event_simulate("MOUSEMOVE", "NOTHING", x=column, y=row)
        yield _SETTLE
        window.event_simulate("MOUSEMOVE", "NOTHING", x=column + 1, y=row)
        yield _SETTLE
        if wanted in below(s):
            places.append((column, row))
            break
    s.expect(len(places) == 1, f"found_{wanted}")


def click(s, wanted: str):
    """Press a button of the panel."""
    yield from drag(s, wanted, 0)


def drag(s, wanted: str, width: int, during=lambda: None):
    """Drag a slider of the panel to the right, by some pixels; `during()` is called at each step."""
    places: list = []
    yield from found(s, wanted, places)
    window = panel(s)[0]
    for x, y in places:
        window.event_simulate("LEFTMOUSE", "PRESS", x=x, y=y)
        yield _SETTLE
        for move in range(4, width + 1, 4):
            window.event_simulate("MOUSEMOVE", "NOTHING", x=x + move, y=y)
            yield _SETTLE
            during()
        window.event_simulate("LEFTMOUSE", "RELEASE", x=x + width, y=y)
        yield _SETTLE
