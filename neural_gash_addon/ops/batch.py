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
from ..backend.advice import said
from ..backend.atlas import Placed, place
from ..backend.errors import UserError
from ..backend.progress import scaled
from ..backend.record import BakeRecord
from ..backend.texture import TextureTransfer, alike, merged
from ..backend.transfer import Transfer
from ..properties import NeuralGashSettings
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
    share: bool   # one texture for all that have one
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
    return Batch(jobs, refused, settings.share, _bake(jobs, settings.share, size(settings)))


def _bake(jobs: list[Job], share: bool, sizes: dict) -> Generator[float, None, list[Result]]:
    """The arrays of all jobs, one after another, first to vertices; never touches bpy."""
    results: dict[int, Result] = {}
    finer = {number: job for number, job in enumerate(jobs) if job.texture}
    done = 0.0

    def baked(number: int, bake: Generator[float, None, Transfer | TextureTransfer], part: float
              ) -> Generator[float, None, None]:
        nonlocal done
        try:
            results[number] = yield from scaled(bake, done, part)
        except UserError as error:
            if isinstance(results.get(number), Transfer):  # a texture that cannot be: the vertices are there
                pass
            elif len(jobs) == 1:
                raise
            else:
                results[number] = error
        done += part

    for number, job in enumerate(jobs):
        if job.texture is None:
            yield from baked(number, job.bake(), (_LOOKING if job.finer else 1) / len(jobs))
            found = results[number]
            if job.finer and isinstance(found, Transfer) and found.record.between_missed:
                finer[number] = job.finer
    if share and len(finer) > 1:
        began, part = time.perf_counter(), _PLACING * (1 - done)
        placing = place([job.texture.part for job in finer.values() if job.texture], **sizes)
        places, side = yield from scaled(placing, done, part)
        done, spent = done + part, (time.perf_counter() - began) / len(finer)
        bakes = [_placed(job, placed, side, spent) for job, placed in zip(finer.values(), places, strict=True)]
    else:
        bakes = [_textured(job, sizes) for job in finer.values()]
    part = (1 - done) / max(len(finer), 1)
    for number, bake in zip(finer, bakes, strict=True):
        coarse = results.get(number)
        yield from baked(number, bake, part)
        found = results[number]
        if isinstance(coarse, Transfer) and isinstance(found, TextureTransfer):
            results[number] = _instead(coarse.record, found)
    return [results[number] for number in range(len(jobs))]


def _textured(job: Job, sizes: dict) -> Generator[float, None, Transfer | TextureTransfer]:
    """The bake of an object to a texture of its own."""
    assert job.texture is not None
    began = time.perf_counter()
    (placed,), side = yield from scaled(place([job.texture.part], **sizes), 0, _PLACING)
    spent = time.perf_counter() - began
    return (yield from scaled(_placed(job, placed, side, spent), _PLACING, 1 - _PLACING))


def _instead(vertices: BakeRecord, found: TextureTransfer) -> TextureTransfer:
    """A texture whose record says why it was not left at the vertices, and counts their time."""
    assert vertices.between_error is not None
    record = found.record.also(said(vertices.between_error, vertices.between_missed, found.record.side))
    return replace(found, record=replace(record, seconds=record.seconds + vertices.seconds))


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
            if batch.share and isinstance(result, TextureTransfer):
                owners.append(check(context, job).data)
            baked.append((job.finer if job.finer and isinstance(result, TextureTransfer) else job, result))
        except UserError as error:
            outcomes.append(Outcome(job.name, None, _named(job, error, len(batch.jobs) + len(batch.refused))))
    images: list[bpy.types.Image] = []
    sharing = [job for job, _ in baked if job.texture] if batch.share else []
    if len(sharing) > 1:
        whole = alike([t for _, t in baked if isinstance(t, TextureTransfer)])
        parts = iter(whole)
        baked = [(job, next(parts) if job.texture else t) for job, t in baked]
        options = sharing[0].texture
        assert options is not None
        records = {job.name: {"frame": job.frame, "uv_map": options.uv_map} for job in sharing}
        images = make_images(sharing[0].name, merged(whole), options.folder, options.half, json.dumps(records),
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
