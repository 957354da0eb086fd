# SPDX-License-Identifier: GPL-3.0-or-later
"""Clear, Preview and Read Again (the light)."""
from __future__ import annotations

import bpy

from ..backend.errors import UserError
from ..scene.attributes import clear, has_bake
from ..scene.lighting import apply_light, light_object, take_light
from ..scene.preview import is_on, preview_off, preview_on
from ..scene.world import forget_image
from . import state


def _refusal(obj: bpy.types.Object | None) -> str:
    """Why there is nothing to show or clear on `obj`; '' where there is."""
    if state.running:
        return "A bake is running; press Esc to cancel it."
    if obj is None:
        return "No object is active; click a baked object to make it the active one."
    if not has_bake(obj) and not is_on(obj):  # a preview may outlive its bake, and must still go off
        return f"'{obj.name}' has not been baked."
    if obj.library or obj.data.library:
        return f"'{obj.name}' is linked from another file, where it cannot be changed."
    return ""


class NEURAL_GASH_OT_clear(bpy.types.Operator):
    """Remove the bake from the active object and give its materials back"""

    bl_idname = "neural_gash.clear"
    bl_label = "Clear"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is a bake, on a mesh that can be changed."""
        reason = _refusal(context.object)
        if not reason and context.object.mode == "EDIT":
            reason = f"'{context.object.name}' is in Edit Mode; leave it to clear the bake."
        if reason:
            cls.poll_message_set(reason)
        return not reason

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove attributes, record and the previews of every object that shares the mesh."""
        for obj in bpy.data.objects:
            if obj.data == context.object.data and not obj.library:
                preview_off(obj)
        clear(context.object)
        return {"FINISHED"}


class NEURAL_GASH_OT_preview(bpy.types.Operator):
    """Show the baked shading, or give the original materials back"""

    bl_idname = "neural_gash.preview"
    bl_label = "Preview"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is a bake to show, or a preview to end."""
        reason = _refusal(context.object)
        if reason:
            cls.poll_message_set(reason)
        return not reason

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Toggle."""
        obj = context.object
        if is_on(obj):
            preview_off(obj)
            return {"FINISHED"}
        try:
            preview_on(obj, context.scene.neural_gash.lobe_shown())
        except UserError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        light_object(context.scene, obj)
        return {"FINISHED"}


class NEURAL_GASH_OT_read_light(bpy.types.Operator):
    """Read the light of the previews again, also the pixels of its image, which may have been painted on"""

    bl_idname = "neural_gash.read_light"
    bl_label = "Read Again"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Forget what is known, and project it again; the sliders turn and scale the result."""
        forget_image()
        try:
            take_light(context.scene)
        except UserError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        apply_light(context.scene)
        return {"FINISHED"}
