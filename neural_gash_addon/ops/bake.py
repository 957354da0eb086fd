# SPDX-License-Identifier: GPL-3.0-or-later
"""The Bake operator: at once from scripts, in the background of an open window."""
from __future__ import annotations

import threading

import bpy

from ..backend.errors import UserError
from ..backend.methods import METHODS
from ..backend.transfer import Transfer
from ..scene.read import make_applied_copy, refusal
from . import state
from .job import Job, bake_object, finish, prepare, summary

_TICK = 0.05  # seconds between looks at the worker: Esc is answered within one


class Worker(threading.Thread):
    """Drives a bake over arrays alone; never touches bpy."""

    def __init__(self, job: Job) -> None:
        super().__init__(name="neural_gash_bake", daemon=True)
        self._baking = job.baking
        self._cancelled = threading.Event()
        self.progress = 0.0
        self.transfer: Transfer | None = None
        self.error: Exception | None = None

    def run(self) -> None:
        """Thread body."""
        try:
            while not self._cancelled.is_set():
                self.progress = next(self._baking)
        except StopIteration as end:
            self.transfer = end.value
        except Exception as error:  # noqa: BLE001  handed to the main thread, which reports it
            self.error = error
        finally:
            self._baking.close()

    def cancel(self) -> None:
        """Ask to stop; does not wait."""
        self._cancelled.set()


class NEURAL_GASH_OT_bake(bpy.types.Operator):
    """Bake how light reaches every point of the active mesh, and show it lit by the World"""

    bl_idname = "neural_gash.bake"
    bl_label = "Bake"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Not while another bake runs, nor for what cannot be baked."""
        reason = "A bake is running; press Esc to cancel it." if state.running else refusal(context.object)
        if not reason and METHODS[context.scene.neural_gash.method].traces \
                and not context.scene.neural_gash.occluder_mode():
            reason = "Choose the collection whose objects cast shadows."
        if reason:
            cls.poll_message_set(reason)
        return not reason

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Bake at once."""
        try:
            return self._report(*bake_object(context, context.object, context.scene.neural_gash))
        except UserError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Read the scene, and bake beside the window."""
        try:
            job = prepare(context, context.object, context.scene.neural_gash)
        except UserError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._job, self._worker = job, Worker(job)
        self._timer = context.window_manager.event_timer_add(_TICK, window=context.window)
        context.window_manager.modal_handler_add(self)
        context.window_manager.progress_begin(0, 100)
        state.start()
        self._worker.start()
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show progress; cancel on Esc; write once at the end."""
        if event.type == "ESC" and event.value == "PRESS":
            self.cancel(context)
            self.report({"INFO"}, "Bake cancelled.")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if self._worker.is_alive():
            state.progress = self._worker.progress
            context.window_manager.progress_update(100 * state.progress)
            context.workspace.status_text_set(f"Baking {self._job.name}: {100 * state.progress:.0f} %   (Esc cancels)")
            state.redraw(context)
            return {"RUNNING_MODAL"}
        self._end(context)
        if self._worker.transfer is None:
            self.report({"ERROR"}, f"The bake failed: {self._worker.error}")
            return {"CANCELLED"}
        try:
            return self._report(*finish(context, self._job, self._worker.transfer))
        except UserError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Stop without a trace; Blender calls it too, when the window or the file closes."""
        self._worker.cancel()
        self._end(context)

    def _end(self, context: bpy.types.Context) -> None:
        """Give back timer, status line and progress."""
        state.stop()
        manager = context.window_manager
        manager.event_timer_remove(self._timer)
        manager.progress_end()
        if context.workspace:
            context.workspace.status_text_set(None)
        state.redraw(context)

    def _report(self, record, warning: str) -> set[str]:
        self.report({"INFO"}, f"{summary(record)}.")
        if warning:
            self.report({"WARNING"}, warning)
        return {"FINISHED"}


class NEURAL_GASH_OT_bake_applied_copy(bpy.types.Operator):
    """Make a copy of the object with its modifiers applied, and bake that; the object itself stays as it is"""

    bl_idname = "neural_gash.bake_applied_copy"
    bl_label = "Bake an Applied Copy"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """As Bake; and there must be modifiers to apply."""
        reason = refusal(context.object)
        if state.running:
            reason = "A bake is running; press Esc to cancel it."
        elif not reason and not context.object.modifiers:
            reason = f"'{context.object.name}' has no modifiers to apply."
        if reason:
            cls.poll_message_set(reason)
        return not reason

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Copy and select, then bake at once."""
        return self._copy_and_bake(context, "EXEC_DEFAULT")

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Copy and select, then bake beside the window."""
        return self._copy_and_bake(context, "INVOKE_DEFAULT")

    def _copy_and_bake(self, context: bpy.types.Context, how: str) -> set[str]:
        try:
            copy = make_applied_copy(context.object, context.evaluated_depsgraph_get())
        except UserError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for obj in context.selected_objects:
            obj.select_set(False)
        copy.select_set(True)
        context.view_layer.objects.active = copy
        bpy.ops.neural_gash.bake(how)
        return {"FINISHED"}
