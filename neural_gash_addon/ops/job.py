# SPDX-License-Identifier: GPL-3.0-or-later
"""One bake of one object: read the scene, bake arrays, write the scene. Operators, CLI and tests share it."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import bpy

from ..backend import methods
from ..backend.errors import UserError
from ..backend.geometry import TriangleMesh
from ..backend.record import BakeRecord
from ..backend.transfer import Transfer
from ..properties import COLLECTION, RAYS, NeuralGashSettings
from ..scene.attributes import write_transfer
from ..scene.lighting import apply_light, take_light
from ..scene.preview import preview_off, preview_on
from ..scene.read import SELF, VISIBLE, fingerprint, read_object, read_occluders, refusal, same_fingerprint


@dataclass(frozen=True, eq=False)
class Job:
    """What was read from the scene, and the bake of it, not begun."""

    uid: int               # of the object; its name may change meanwhile
    name: str
    mesh: TriangleMesh
    baking: methods.Baking
    occluders: str
    fingerprint: str
    frame: tuple[float, ...]


def prepare(context: bpy.types.Context, obj: bpy.types.Object | None, settings: NeuralGashSettings) -> Job:
    """Read the object and what blocks its light. Raises UserError where that cannot be baked."""
    if obj is None:
        raise UserError(refusal(None))
    depsgraph = context.evaluated_depsgraph_get()
    read = read_object(obj, depsgraph)
    method = methods.METHODS[settings.method]
    mode = settings.occluder_mode() if method.traces else SELF
    if not mode:
        raise UserError("Choose the collection whose objects cast shadows.")
    if method.traces and settings.occluders == COLLECTION and mode in (SELF, VISIBLE):
        raise UserError(f"A collection named '{mode}' cannot cast shadows, as the name has another meaning; "
                        "rename it.")
    occluders = read_occluders(obj, mode, depsgraph)
    by_rays = settings.quality == RAYS
    baking = methods.bake(
        read.mesh, settings.method, settings.order, occluders=occluders,
        rays=settings.rays if method.traces and by_rays else None,
        tolerance=settings.tolerance if method.traces and not by_rays else None)
    return Job(obj.session_uid, obj.name, read.mesh, baking, mode, fingerprint(obj, depsgraph, mode), read.frame)


def finish(context: bpy.types.Context, job: Job, transfer: Transfer) -> tuple[BakeRecord, str]:
    """Write the bake, light it from the World and show it.

    Returns:
        The record, and a sentence to warn with ('' where all is well).
    Raises:
        UserError: the object is gone or has changed meanwhile, or holds attributes in the way.
    """
    obj = next((o for o in bpy.data.objects if o.session_uid == job.uid), None)
    if obj is None:
        raise UserError(f"'{job.name}' was deleted while it was being baked.")
    now = fingerprint(obj, context.evaluated_depsgraph_get(), job.occluders)
    if not same_fingerprint(now, job.fingerprint):
        raise UserError(f"'{obj.name}' or what shadows it was changed during the bake; bake again.")
    record = replace(transfer.record, occluders=job.occluders, fingerprint=job.fingerprint, frame=job.frame)
    write_transfer(obj, job.mesh, replace(transfer, record=record))
    warning = ""
    try:
        take_light(context.scene)
    except UserError as error:
        warning = f"{error} The preview keeps the light it had."
    try:
        preview_on(obj)
    except UserError as error:
        preview_off(obj)
        warning = str(error)
    apply_light(context.scene)  # every preview: the World's light may be another now, and twins share the bake
    return record, warning


def bake_object(context: bpy.types.Context, obj: bpy.types.Object | None, settings: NeuralGashSettings,
                progress: Callable[[float], None] | None = None) -> tuple[BakeRecord, str]:
    """The whole bake at once; see `prepare` and `finish`."""
    job = prepare(context, obj, settings)
    return finish(context, job, methods.run(job.baking, progress))


def summary(record: BakeRecord) -> str:
    """One line for the report: points, time, rays, estimated error."""
    text = f"Baked {record.points:,} points in {record.seconds:.2f} s"
    if record.rays:
        text += f", {record.rays_per_point:.0f} rays a point"
    if record.error_estimate is not None:
        text += f", estimated error {percent(record.error_estimate)}"
    return text


def percent(part: float) -> str:
    """A part of 1 in words fit for people."""
    return "below 0.01 %" if part < 1e-4 else f"{100 * part:.2g} %"
