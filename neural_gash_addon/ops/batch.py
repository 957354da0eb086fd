# SPDX-License-Identifier: GPL-3.0-or-later
"""One or several objects baked in one go, each by itself or all to one texture; a failure of one spares the rest."""
from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import bpy

from ..backend import methods
from ..backend.advice import missed, said
from ..backend.atlas import Placed, place
from ..backend.errors import UserError
from ..backend.progress import scaled
from ..backend.record import BakeRecord
from ..backend.texture import TextureTransfer, alike, merged
from ..backend.transfer import Transfer
from ..properties import TEXTURE, NeuralGashSettings
from ..scene.images import make_images, remove_unused
from ..scene.lamps import LitScenes
from .job import Job, check, finish, prepare, size
from .lamps import LampReader

_PLACING, _LOOKING = 0.1, 0.2  # of the progress
Result = Transfer | TextureTransfer | UserError


@dataclass(frozen=True)
class Outcome:
    """What became of one object."""

    name: str
    record: BakeRecord | None  # None: it was not baked
    sentence: str              # why not, or what to warn of; '' where all is well


@dataclass(frozen=True, eq=False)
class Batch:
    """What was read from the scene, and the bake of it, not begun."""

    jobs: list[Job]
    refused: list[Outcome]
    shared: bool  # one texture for all
    baking: Generator[float, None, list[Result]]

    @property
    def names(self) -> list[str]:
        """Of the objects that are baked."""
        return [job.name for job in self.jobs]


def prepare_batch(context: bpy.types.Context, objects: Sequence[bpy.types.Object | None], settings: NeuralGashSettings,
                  tiles: Callable[[bpy.types.Object], Path | None] = lambda _: None) -> Batch:
    """Read the objects and what blocks their light.

    Args:
        tiles: where the finished tiles of an object's texture wait, so that a bake that was killed goes on.
    Raises:
        UserError: none of them can be baked.
    """
    jobs: list[Job] = []
    refused: list[Outcome] = []
    meshes: dict[int, str] = {}
    group = [obj for obj in objects if obj is not None and obj.type == "MESH"]
    lamps = LampReader(context.evaluated_depsgraph_get(), settings) if settings.lamps else None
    for obj in objects:
        if obj is not None and obj.data is not None and obj.data.session_uid in meshes:
            refused.append(Outcome(obj.name, None, f"'{obj.name}' has the same mesh as "
                                   f"'{meshes[obj.data.session_uid]}' and shows its bake; make the mesh single-user "
                                   "to bake it by itself."))
            continue
        try:
            jobs.append(prepare(context, obj, settings, None if obj is None else tiles(obj), group, lamps))
        except UserError as error:
            refused.append(Outcome("" if obj is None else obj.name, None, _named(obj, error, len(objects))))
            continue
        assert obj is not None
        meshes[obj.data.session_uid] = obj.name
    if not jobs:
        raise UserError(refused[0].sentence)
    shared = settings.target == TEXTURE and settings.share and len(jobs) > 1
    return Batch(jobs, refused, shared, _bake(jobs, shared, size(settings)))


def _bake(jobs: list[Job], shared: bool, sizes: dict) -> Generator[float, None, list[Result]]:
    """The arrays of all jobs, one after another; never touches bpy."""
    results: list[Result] = []
    done = 0.0
    if shared:
        began = time.perf_counter()
        placing = place([job.texture.part for job in jobs if job.texture], **sizes)
        places, side = yield from scaled(placing, 0, _PLACING)
        done, spent = _PLACING, (time.perf_counter() - began) / len(jobs)
        bakes = [_placed(job, placed, side, spent) for job, placed in zip(jobs, places, strict=True)]
    else:
        bakes = [_textured(job, sizes) if job.texture else job.bake() if job.finer is None else _automatic(job, sizes)
                 for job in jobs]
    for number, bake in enumerate(bakes):
        share = (1 - done) / len(jobs)
        try:
            results.append((yield from scaled(bake, done + number * share, share)))
        except UserError as error:
            if len(jobs) == 1:
                raise
            results.append(error)
    return results


def _textured(job: Job, sizes: dict) -> Generator[float, None, Transfer | TextureTransfer]:
    """The bake of an object to a texture of its own."""
    assert job.texture is not None
    began = time.perf_counter()
    (placed,), side = yield from scaled(place([job.texture.part], **sizes), 0, _PLACING)
    spent = time.perf_counter() - began
    return (yield from scaled(_placed(job, placed, side, spent), _PLACING, 1 - _PLACING))


def _automatic(job: Job, sizes: dict) -> Generator[float, None, Transfer | TextureTransfer]:
    """The bake of an object to vertices; and to a texture, where they miss what is inside faces."""
    assert job.finer is not None
    found = yield from scaled(job.bake(), 0, _LOOKING)
    wrong, tolerance = found.record.between_error, found.record.tolerance
    if wrong is None or tolerance is None or not missed(wrong, tolerance):
        return found
    finer = yield from scaled(_textured(job.finer, sizes), _LOOKING, 1 - _LOOKING)
    record = finer.record.also(said(wrong, tolerance, finer.record.side))
    return replace(finer, record=replace(record, seconds=record.seconds + found.record.seconds))


def _placed(job: Job, placed: Placed, side: int, spent: float
            ) -> Generator[float, None, Transfer | TextureTransfer]:
    """The bake of an object whose place in a texture is known; its record counts the time that took."""
    found = yield from job.bake(uv=placed.uv, side=side)
    return replace(found, record=replace(found.record, seconds=found.record.seconds + spent,
                                         single_faces=placed.single_faces))


def finish_batch(context: bpy.types.Context, batch: Batch, results: Sequence[Result]) -> list[Outcome]:
    """Write the bakes, and what became of each object.

    Raises:
        UserError: nothing was baked.
    """
    outcomes = list(batch.refused)
    baked: list[tuple[Job, Transfer | TextureTransfer]] = []
    owners: list[bpy.types.Mesh] = []
    lit = LitScenes(context.evaluated_depsgraph_get())
    for job, result in zip(batch.jobs, results, strict=True):
        try:
            if isinstance(result, UserError):
                raise result
            if job.lamps is not None and lit.of(check(context, job))[1] != job.lamps.key:
                raise UserError(f"The lamps of '{job.name}', or what they light, were changed during the bake; bake "
                                "again.")
            if batch.shared:
                owners.append(check(context, job).data)
            baked.append((job.finer if job.finer and isinstance(result, TextureTransfer) else job, result))
        except UserError as error:
            outcomes.append(Outcome(job.name, None, _named(job, error, len(batch.jobs) + len(batch.refused))))
    images: list[bpy.types.Image] = []
    if batch.shared and baked:
        whole = alike([t for _, t in baked if isinstance(t, TextureTransfer)])
        baked = [(job, part) for (job, _), part in zip(baked, whole, strict=True)]
        options = baked[0][0].texture
        assert options is not None
        records = {job.name: {"frame": job.frame, "uv_map": options.uv_map} for job, _ in baked}
        images = make_images(baked[0][0].name, merged(whole), options.folder, options.half, json.dumps(records),
                             owners=owners)
    for job, transfer in baked:
        try:
            outcomes.append(Outcome(job.name, *finish(context, job, transfer, images)))
        except UserError as error:
            outcomes.append(Outcome(job.name, None, _named(job, error, len(batch.jobs) + len(batch.refused))))
    remove_unused(images)
    if all(outcome.record is None for outcome in outcomes):
        raise UserError(outcomes[-1].sentence)
    return outcomes


def _named(thing: bpy.types.Object | Job | None, error: UserError, count: int) -> str:
    """Why one of `count` objects was not baked; it must be clear which."""
    sentence = str(error)
    return sentence if thing is None or count == 1 or f"'{thing.name}'" in sentence else f"'{thing.name}': {sentence}"


def bake_object(context: bpy.types.Context, obj: bpy.types.Object | None, settings: NeuralGashSettings,
                progress: Callable[[float], None] | None = None) -> tuple[BakeRecord, str]:
    """The whole bake of one object at once: its record, and a sentence to warn with."""
    batch = prepare_batch(context, [obj], settings)
    outcome, = finish_batch(context, batch, methods.run(batch.baking, progress))
    assert outcome.record is not None
    return outcome.record, outcome.sentence
