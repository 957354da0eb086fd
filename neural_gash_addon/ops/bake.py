# SPDX-License-Identifier: GPL-3.0-or-later
"""The Bake operator: at once from scripts, in the background of an open window."""
from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ..backend.errors import UserError
from ..backend.methods import METHODS, run
from ..scene import machine
from ..scene.read import make_applied_copy, refusal
from . import state
from .batch import Outcome, finish_batch, prepare_batch
from .job import summary

_TICK = 0.05  # seconds between looks at the worker: Esc is answered within one


class Worker(threading.Thread):
    """Drives a bake over arrays alone; never touches bpy."""

    def __init__(self, baking: Generator[float, None, object]) -> None:
        super().__init__(name="neural_gash_bake", daemon=True)
        self._baking = baking
        self._cancelled = threading.Event()
        self.progress = 0.0
        self.results: object = None
        self.error: Exception | None = None

    def run(self) -> None:
        """Thread body."""
        try:
            while not self._cancelled.is_set():
                self.progress = next(self._baking)
        except StopIteration as end:
            self.results = end.value
        except Exception as error:  # noqa: BLE001  handed to the main thread, which reports it
            self.error = error
        finally:
            self._baking.close()

    def cancel(self) -> None:
        """Ask to stop; does not wait."""
        self._cancelled.set()


class Baking:
    """What the Bake operators share. They differ in what is baked."""

    _doing = "baking"  # what the status line says of it
    _worker_type: type[Worker] = Worker

    if TYPE_CHECKING:  # the operator's own
        def report(self, type: set[str], message: str) -> None: ...

    def _begin(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """The objects to bake, the active one first. Raises UserError."""
        return targets(context)

    def _prepare(self, context: bpy.types.Context,
                 tiles: Callable[[bpy.types.Object], Path | None] = lambda _: None):
        """What is to be baked, read from the scene. Raises UserError."""
        return prepare_batch(context, self._begin(context), context.scene.neural_gash, tiles)

    def _finish(self, context: bpy.types.Context, batch, results) -> set[str]:
        """Write the results and report. Raises UserError."""
        return self._report(finish_batch(context, batch, results))

    def _undo(self, context: bpy.types.Context) -> None:
        """Take `_begin` back, as nothing came of it."""

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Bake at once."""
        try:
            batch = self._prepare(context)
            return self._finish(context, batch, run(batch.baking))
        except UserError as error:
            return self._fail(context, error)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Read the scene, and bake beside the window."""
        try:
            batch = self._prepare(context, _tiles)
        except UserError as error:
            return self._fail(context, error)
        self._batch, self._worker = batch, self._worker_type(batch.baking)
        context.window_manager.modal_handler_add(self)
        context.window_manager.progress_begin(0, 100)
        timer = context.window_manager.event_timer_add(_TICK, window=context.window)
        state.start(self._worker, partial(_give_back, context, timer))
        self._say(context)
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
            self._say(context)
            state.redraw(context)
            return {"RUNNING_MODAL"}
        state.stop()
        state.redraw(context)
        if self._worker.results is None:
            return self._fail(context, self._worker.error or UserError("The bake was stopped."))
        try:
            return self._finish(context, self._batch, self._worker.results)
        except UserError as error:
            return self._fail(context, error)

    def cancel(self, context: bpy.types.Context) -> None:
        """Stop without a trace; Blender calls it too, when the window or the file closes."""
        self._worker.cancel()
        state.stop()
        state.redraw(context)
        self._undo(context)

    def _say(self, context: bpy.types.Context) -> None:
        """The status line while it works."""
        if context.workspace:
            names = self._batch.names
            what = names[0] if len(names) == 1 else f"{len(names)} objects"
            context.workspace.status_text_set(
                f"Neural GASh: {self._doing} {what}, {100 * state.progress:.0f} %. Esc cancels")

    def _fail(self, context: bpy.types.Context, error: Exception) -> set[str]:
        """Say why there is no bake, and leave everything as it was."""
        self._undo(context)
        self.report({"ERROR"}, str(error) if isinstance(error, UserError) else f"The bake failed: {error!r}.")
        return {"CANCELLED"}

    def _report(self, outcomes: list[Outcome]) -> set[str]:
        """Say how the bake of each object went, in one line."""
        several = len(outcomes) > 1
        for outcome in outcomes:
            if outcome.record is not None:
                self.report({"INFO"}, f"{outcome.name}: {summary(outcome.record)}." if several else
                            f"{summary(outcome.record)}.")
            if outcome.sentence:
                self.report({"WARNING"}, outcome.sentence)
        return {"FINISHED"}


def _give_back(context: bpy.types.Context, timer: bpy.types.Timer) -> None:
    """Timer, progress and status line of a bake that ended."""
    context.window_manager.event_timer_remove(timer)
    context.window_manager.progress_end()
    if context.workspace:
        context.workspace.status_text_set(None)


def targets(context: bpy.types.Context) -> list[bpy.types.Object]:
    """What Bake bakes: the active object, and with it the other selected meshes if it is selected."""
    active = context.object
    if active is None or not active.select_get():
        return [active]
    return [active, *(o for o in context.selected_objects if o != active and o.type == "MESH")]


def _tiles(obj: bpy.types.Object) -> Path | None:
    """Where an extension may keep the tiles of a texture that is being baked; None where this is none."""
    folder = machine.folder()
    if folder is None:
        return None
    name = hashlib.blake2b(f"{bpy.data.filepath}|{obj.name}".encode(), digest_size=8).hexdigest()
    return folder / "tiles" / name


def bake_refusal(context: bpy.types.Context) -> str:
    """Why no bake can begin now; '' where one can."""
    if state.running:
        return "A bake is running; press Esc to cancel it."
    settings = context.scene.neural_gash
    if METHODS[settings.method].sees and not settings.occluder_mode():
        return refusal(context.object) or "Choose the collection whose objects cast shadows."
    return refusal(context.object)


class NEURAL_GASH_OT_bake(Baking, bpy.types.Operator):
    """Bake how light reaches every point of the active mesh and other selected ones, and show it lit by the World"""

    bl_idname = "neural_gash.bake"
    bl_label = "Bake"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Not while another bake runs, nor for what cannot be baked."""
        reason = bake_refusal(context)
        if reason:
            cls.poll_message_set(reason)
        return not reason


class NEURAL_GASH_OT_bake_applied_copy(Baking, bpy.types.Operator):
    """Make a copy of the object with its modifiers applied, and bake that; the object itself stays as it is"""

    bl_idname = "neural_gash.bake_applied_copy"
    bl_label = "Bake an Applied Copy"
    bl_options = {"REGISTER", "UNDO"}

    _copy = 0  # session uid of the copy: pointers do not outlast an undo meanwhile

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """As Bake; and there must be modifiers to apply."""
        reason = bake_refusal(context)
        if not reason and not context.object.modifiers:
            reason = f"'{context.object.name}' has no modifiers to apply."
        if reason:
            cls.poll_message_set(reason)
        return not reason

    def _begin(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """The copy, selected and active in the original's place."""
        self._original = context.object.session_uid
        self._selected = {obj.session_uid for obj in context.selected_objects}
        copy = make_applied_copy(context.object, context.evaluated_depsgraph_get())
        self._copy = copy.session_uid
        self._select(context, {copy.session_uid}, copy.session_uid)
        return [copy]

    def _undo(self, context: bpy.types.Context) -> None:
        """Remove the copy and select what was selected."""
        copy = next((o for o in bpy.data.objects if self._copy and o.session_uid == self._copy), None)
        if copy is None:
            return
        data = copy.data
        bpy.data.objects.remove(copy)
        if not data.users:
            bpy.data.meshes.remove(data)
        self._select(context, self._selected, self._original)

    @staticmethod
    def _select(context: bpy.types.Context, selected: set[int], active: int) -> None:
        """Select the objects with these session uids, and no others."""
        context.view_layer.update()  # what was made or removed just now
        for obj in context.view_layer.objects:
            obj.select_set(obj.session_uid in selected)
            if obj.session_uid == active:
                context.view_layer.objects.active = obj
