# SPDX-License-Identifier: GPL-3.0-or-later
"""Show Errors: what Compare measured, as colours in the viewport."""
from __future__ import annotations

import bpy

from ..scene.views import has_errors, hide_errors, show_errors, shows_errors


class NEURAL_GASH_OT_show_errors(bpy.types.Operator):
    """Show where the method last compared is wrong, from dark (little) to bright (most), or what was shown before"""

    bl_idname = "neural_gash.show_errors"
    bl_label = "Errors"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """A comparison left errors on a mesh that can be changed, and there is a viewport to show them in."""
        reason, obj = "", context.object
        if not has_errors(obj):
            reason = "No comparison has been made on the active object; press Compare Methods on This Mesh first."
        elif obj.data.library:
            reason = f"'{obj.name}' is linked from another file, where it cannot be changed."
        elif context.area is None or context.area.type != "VIEW_3D":
            reason = "Errors are shown in a 3D Viewport; press it there."
        if reason:
            cls.poll_message_set(reason)
        return not reason

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Toggle."""
        toggle = hide_errors if shows_errors(context.object, context.area.spaces.active) else show_errors
        toggle(context.object, context.screen, context.area)
        return {"FINISHED"}
