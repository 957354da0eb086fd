# SPDX-License-Identifier: GPL-3.0-or-later
"""One bake of one object: read the scene, bake arrays, write the scene. Operators, CLI and tests share it."""
from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend import methods
from ..backend.bounce import Reflection
from ..backend.errors import UserError
from ..backend.record import VERSION, BakeRecord
from ..backend.texels import NormalMap
from ..backend.texture import TextureTransfer, remove_tiles
from ..backend.texture import bake as bake_texture
from ..backend.transfer import Transfer
from ..properties import COLLECTION, DENSITY, RAYS, TEXTURE, NeuralGashSettings
from ..scene.attributes import attribute_count, read_record, write_textures, write_transfer
from ..scene.lighting import apply_light, take_light
from ..scene.normal_maps import read_normal_maps
from ..scene.preview import EEVEE_ATTRIBUTES, preview_off, preview_on
from ..scene.read import (
    SELF,
    VISIBLE,
    SceneMesh,
    fingerprint,
    read_albedo,
    read_object,
    read_occluders,
    refusal,
    same_fingerprint,
)
from ..scene.uv_maps import check_room, read_uv


@dataclass(frozen=True, eq=False)
class TextureOptions:
    """How a texture bake is kept."""

    own_uv: bool         # the bake makes its UV map
    uv_map: str          # of the person's, else ''
    folder: Path | None  # None: packed
    half: bool
    tiles: Path | None   # where finished tiles wait for the rest


@dataclass(frozen=True, eq=False)
class Job:
    """What was read from the scene, and the bake of it, not begun."""

    uid: int               # of the object; its name may change meanwhile
    name: str
    read: SceneMesh
    baking: Generator[float, None, Transfer | TextureTransfer]
    occluders: str
    fingerprint: str
    frame: tuple[float, ...]
    texture: TextureOptions | None  # None: to vertices
    bounces: bool          # light was to bounce, so the albedo counts


def prepare(context: bpy.types.Context, obj: bpy.types.Object | None, settings: NeuralGashSettings,
            tiles: Path | None = None) -> Job:
    """Read the object and what blocks its light.

    Args:
        tiles: a folder for the finished tiles of a texture, from which a bake that was killed goes on.
    Raises:
        UserError: that cannot be baked.
    """
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
    rays = settings.rays if method.traces and by_rays else None
    tolerance = settings.tolerance if method.traces and not by_rays else None
    reflection = None
    if method.traces and settings.bounces:
        if settings.target != TEXTURE and attribute_count(3 * settings.order ** 2) > EEVEE_ATTRIBUTES:
            raise UserError(f"With bounces, an order-{settings.order} bake takes more than the {EEVEE_ATTRIBUTES} "
                            "attributes that EEVEE draws; choose order 4 or less, or bake to a texture.")
        reflection = Reflection(read_albedo(obj, mode, depsgraph), settings.bounces)
    texture = None
    uv = None
    baking: Generator[float, None, Transfer | TextureTransfer]
    if settings.target == TEXTURE:
        if settings.uv_map:
            uv = read_uv(obj.data, settings.uv_map)
        folder = Path(bpy.path.abspath(settings.texture_folder)) if settings.texture_folder else None
        if folder is not None and not folder.is_absolute():
            raise UserError("The folder of the textures is beside a .blend file that has not been saved yet; "
                            "save it first, or leave the folder empty.")
        if uv is None:
            check_room(obj.data)
        texture = TextureOptions(uv is None, settings.uv_map, folder, settings.half, tiles)
        dense = settings.sizing == DENSITY and uv is None
        maps = read_normal_maps(obj, depsgraph, read.surface, read.matrix)
        before = fingerprint(obj, depsgraph, mode, uv, reflection is not None)
        baking = bake_texture(
            read.surface, settings.method, settings.order, uv=uv, side=None if dense else settings.side,
            texels_per_metre=settings.texels_per_metre if dense else None, padding=settings.padding, rays=rays,
            tolerance=tolerance, occluders=occluders, normal_maps=maps, folder=tiles,
            key=_key(settings, before, read.matrix, maps), reflection=reflection)
    else:
        before = fingerprint(obj, depsgraph, mode, bounces=reflection is not None)
        baking = methods.bake(read.mesh, settings.method, settings.order, rays=rays, tolerance=tolerance,
                              occluders=occluders, reflection=reflection)
    return Job(obj.session_uid, obj.name, read, baking, mode, before, read.frame, texture,
               reflection is not None)


def _key(settings: NeuralGashSettings, shape: str, matrix: NDArray, maps: Sequence[NormalMap]) -> str:
    """What tells a texture bake from any other, in one text."""
    digest = hashlib.blake2b(np.round(matrix, 6).tobytes(), digest_size=16)
    for normal_map in maps:
        digest.update(normal_map.image.tobytes() + normal_map.uv.tobytes() + str(normal_map.strength).encode())
    chosen = {name: getattr(settings, name) for name in
              ("method", "order", "quality", "rays", "tolerance", "sizing", "side", "texels_per_metre", "padding",
               "bounces")}
    return json.dumps({"version": VERSION, "shape": shape, "place": digest.hexdigest(), **chosen}, sort_keys=True)


def finish(context: bpy.types.Context, job: Job, transfer: Transfer | TextureTransfer) -> tuple[BakeRecord, str]:
    """Write the bake, light it from the World and show it.

    Returns:
        The record, and a sentence to warn with ('' where all is well).
    Raises:
        UserError: the object is gone or has changed meanwhile, holds attributes in the way, or files
            cannot be written.
    """
    obj = next((o for o in bpy.data.objects if o.session_uid == job.uid), None)
    if obj is None:
        raise UserError(f"'{job.name}' was deleted while it was being baked.")
    depsgraph = context.evaluated_depsgraph_get()
    uv_map = job.texture.uv_map if job.texture else ""
    now = fingerprint(obj, depsgraph, job.occluders, read_uv(obj.data, uv_map) if uv_map else None,
                      job.bounces)
    if not same_fingerprint(now, job.fingerprint):
        raise UserError(f"'{obj.name}' or what shadows it was changed during the bake; bake again.")
    if job.bounces and transfer.record.colours == 1:  # nothing bounced: no colour counts
        now = fingerprint(obj, depsgraph, job.occluders, read_uv(obj.data, uv_map) if uv_map else None)
    record = replace(transfer.record, occluders=job.occluders, fingerprint=now, frame=job.frame, uv_map=uv_map)
    if isinstance(transfer, TextureTransfer):
        assert job.texture is not None
        if job.texture.own_uv:
            now = fingerprint(obj, depsgraph, job.occluders, transfer.uv.astype(np.float32), record.colours == 3)
            record = replace(record, fingerprint=now)
        write_textures(obj, replace(transfer, record=record), own_uv=job.texture.own_uv, folder=job.texture.folder,
                       half=job.texture.half)
        if job.texture.tiles is not None:
            remove_tiles(job.texture.tiles)
    else:
        write_transfer(obj, job.read.mesh, replace(transfer, record=record))
    record = read_record(obj)
    warning = ""
    try:
        take_light(context.scene)
    except UserError as error:
        warning = f"{error} The preview keeps the light it had."
    try:
        preview_on(obj, context.scene.neural_gash.gloss)
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
    what = f"{record.side} x {record.side} texels" if record.side else f"{record.points:,} points"
    text = f"Baked {what} in {record.seconds:.2f} s"
    if record.bounces:
        text += f", {record.bounces} bounce{'s' if record.bounces > 1 else ''}"
    if record.rays:
        text += f", {record.rays_per_point:.0f} rays a point"
    if record.error_estimate is not None:
        text += f", estimated error {percent(record.error_estimate)}"
    return text


def percent(part: float) -> str:
    """A part of 1 in words fit for people."""
    return "below 0.01 %" if part < 1e-4 else f"{100 * part:.2g} %"
