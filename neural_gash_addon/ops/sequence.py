# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake Sequence: every frame of the scene's range, one file for each object, shown as the frames are."""
from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import bpy

from ..backend.errors import UserError
from ..backend.exchange import check_folder
from ..backend.progress import scaled
from ..backend.sequence import SUFFIX, Writer
from ..backend.transfer import Transfer
from ..properties import TEXTURE
from ..scene.attributes import SEQUENCE
from ..scene.live import suspended
from .bake import Baking, Worker, bake_refusal, targets
from .batch import Outcome
from .job import Job, finish, prepare, recorded

_TURN = 0.04  # seconds of work between two looks at the window


class Steps(Worker):
    """A bake that sets the scene's frames, so on the main thread: a piece of it whenever the window has time."""

    def start(self) -> None:
        """Nothing runs beside."""
        self._alive = True

    def is_alive(self) -> bool:
        """Whether it has not ended."""
        return self._alive

    def step(self) -> None:
        """A piece of the work."""
        until = time.perf_counter() + _TURN
        try:
            while time.perf_counter() < until:
                self.progress = next(self._baking)
        except StopIteration as end:
            self.results, self._alive = end.value, False
        except Exception as error:  # noqa: BLE001  as in `Worker`: the operator reports it, and gives all back
            self.error, self._alive = error, False

    def cancel(self) -> None:
        """Stop, and give the scene its frame back."""
        self._baking.close()
        self._alive = False


@dataclass(frozen=True, eq=False)
class SequenceBatch:
    """As `Batch`: what is baked, and how."""

    names: list[str]
    baking: Generator[float, None, list[Outcome]]


def bake_sequence(context: bpy.types.Context, objects: list[bpy.types.Object]
                  ) -> Generator[float, None, list[Outcome]]:
    """Bake objects in all frames of the scene's range; at the end, show the current one.

    Yields:
        The share that is done. `close()` leaves no file, and the scene at the frame where it was.
    Returns:
        What became of each object.
    Raises:
        UserError: none could be baked.
    """
    scene, settings, its = context.scene, context.scene.neural_gash, context.scene.session_uid
    current, first, count = scene.frame_current, scene.frame_start, scene.frame_end - scene.frame_start + 1
    chosen = settings.sequence_folder
    folder = _folder(chosen)
    uids = {obj.session_uid: obj.name for obj in objects}
    group = set(uids)  # these shadow each other, also where one cannot be baked
    outcomes: list[Outcome] = []
    paths: dict[int, Path] = {}
    owners: dict[int | str, str] = {}  # of each mesh and file, the object that is baked to it
    for obj in objects:
        path = _file(folder, obj)
        mesh, file = obj.data.session_uid, str(path).casefold()
        if mesh in owners or file in owners:
            outcomes.append(Outcome(obj.name, None, (
                f"'{obj.name}' has the same mesh as '{owners[mesh]}' and shows its bake; make the mesh single-user to "
                "bake it by itself.") if mesh in owners else (
                f"'{obj.name}' would have the same file as '{owners[file]}'; rename one of them.")))
            del uids[obj.session_uid]
            continue
        owners[mesh] = owners[file] = obj.name
        paths[obj.session_uid] = path  # also where the object is renamed meanwhile
    writers: dict[int, Writer] = {}
    last: dict[int, tuple[Job, Transfer]] = {}

    def frame(uid: int, number: int) -> Generator[float, None, None]:
        """Bake one object in one frame."""
        obj = _object(uid, uids[uid])
        together = [o for o in bpy.data.objects if o.session_uid in group]
        job = prepare(context, obj, _scene(its).neural_gash, group=together, movable=False)
        found = yield from job.bake(whole=True)  # what other frames will want is not known; one order for all
        assert isinstance(found, Transfer)
        transfer = replace(found, record=recorded(context, job, obj, found))
        if uid not in writers:
            writers[uid] = Writer(paths[uid], first, count, job.read.mesh)
        writers[uid].add(job.read.mesh, transfer)
        last[uid] = job, transfer

    try:
        with suspended():
            for number in range(count):
                _scene(its).frame_set(first + number)  # looked up each time: undo replaces it
                for place, uid in enumerate(list(uids)):
                    try:
                        share = 1 / (count * len(objects))
                        yield from scaled(frame(uid, number), number / count + place * share, share)
                    except UserError as error:
                        outcomes.append(Outcome(uids[uid], None, f"'{uids[uid]}', frame {first + number}: {error}"))
                        del uids[uid]
                if not uids:
                    raise UserError(outcomes[-1].sentence)
            for uid, name in uids.items():
                try:
                    record, warning = finish(context, *last[uid])
                    writers[uid].end()
                except UserError as error:
                    if len(uids) == 1:
                        raise
                    outcomes.append(Outcome(name, None, f"'{name}': {error}"))
                    continue
                outcomes.append(Outcome(name, record, warning))
                written, beside = str(paths[uid]), chosen.startswith("//")
                _object(uid, name).data[SEQUENCE] = (
                    written if chosen and not beside else bpy.path.relpath(written))
        return outcomes
    finally:
        for writer in writers.values():
            writer.discard()
        with suppress(UserError):
            _scene(its).frame_set(current)  # and what is shown with it


def _scene(uid: int) -> bpy.types.Scene:
    """The scene by its session uid. Raises UserError where it is gone."""
    scene = next((s for s in bpy.data.scenes if s.session_uid == uid), None)
    if scene is None:
        raise UserError("The scene was removed while its frames were being baked.")
    return scene


def _object(uid: int, name: str) -> bpy.types.Object:
    """An object by its session uid. Raises UserError where it is gone."""
    obj = next((o for o in bpy.data.objects if o.session_uid == uid), None)
    if obj is None:
        raise UserError(f"'{name}' was deleted while it was being baked.")
    return obj


def _folder(chosen: str) -> Path:
    """Where sequences are written. Raises UserError where nothing can be."""
    if not chosen and not bpy.data.filepath:
        raise UserError("Save the .blend file first, or choose a folder: the sequence is kept in a file beside it.")
    folder = Path(bpy.path.abspath(chosen or "//"))
    if not folder.is_absolute():
        raise UserError(f"'{chosen}' is no whole path of a folder for the sequence; begin it with // to have it beside "
                        "the .blend file, and save that first.")
    check_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _file(folder: Path, obj: bpy.types.Object) -> Path:
    """The file of an object's sequence: of this .blend, so that another with such an object has its own."""
    blend = Path(bpy.data.filepath).stem
    name = bpy.path.clean_name(obj.name)
    return folder / f"{f'{bpy.path.clean_name(blend)}-' if blend else ''}{name}{SUFFIX}"


class NEURAL_GASH_OT_bake_sequence(Baking, bpy.types.Operator):
    """Bake the active mesh and other selected ones in every frame of the scene, into a file; playback reads it"""

    bl_idname = "neural_gash.bake_sequence"
    bl_label = "Bake Sequence"
    bl_options = {"REGISTER", "UNDO"}

    _doing = "baking all frames of"
    _worker_type = Steps

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """As Bake; and to vertices."""
        reason = bake_refusal(context)
        if not reason and context.scene.neural_gash.target == TEXTURE:
            reason = "A sequence is baked to vertices; choose them as the target."
        if not reason and context.scene.neural_gash.lamps:
            reason = "A sequence is baked without lamps; switch Lamps off in the settings."
        if reason:
            cls.poll_message_set(reason)
        return not reason

    def _prepare(self, context: bpy.types.Context, tiles=None) -> SequenceBatch:
        """Nothing is read yet: each frame is, in its turn."""
        objects = targets(context)
        _folder(context.scene.neural_gash.sequence_folder)
        return SequenceBatch([obj.name for obj in objects], bake_sequence(context, objects))

    def _finish(self, context: bpy.types.Context, batch, results) -> set[str]:
        """All is written already."""
        return self._report(results)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """As Bake; a piece of the work at each tick."""
        assert isinstance(self._worker, Steps)
        if event.type == "TIMER" and self._worker.is_alive():
            self._worker.step()
        return super().modal(context, event)
