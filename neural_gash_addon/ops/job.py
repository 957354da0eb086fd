# SPDX-License-Identifier: GPL-3.0-or-later
"""One bake of one object: read the scene, bake arrays, write the scene. Operators, CLI and tests share it."""
from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend import methods
from ..backend.atlas import Part, check_area, check_part
from ..backend.errors import UserError
from ..backend.exchange import check_folder
from ..backend.geometry import Surface
from ..backend.lamps import Lamps
from ..backend.raycast import Geometry
from ..backend.record import VERSION, BakeRecord
from ..backend.resolution import fitting_side
from ..backend.texels import NormalMap
from ..backend.texture import TextureTransfer, remove_tiles
from ..backend.texture import bake as bake_texture
from ..backend.transfer import Transfer
from ..properties import AUTOMATIC, COLLECTION, DENSITY, FIT, TEXTURE, NeuralGashSettings
from ..scene.attributes import read_record, write_textures, write_transfer
from ..scene.lighting import apply_light, take_light
from ..scene.normal_maps import read_normal_maps
from ..scene.preview import preview_off, preview_on
from ..scene.read import (
    SELF,
    VISIBLE,
    SceneMesh,
    fingerprint,
    group_mode,
    is_group,
    read_object,
    read_occluders,
    refusal,
    same_fingerprint,
)
from ..scene.reflection import check_attributes, read_reflection
from ..scene.uv_maps import check_room, read_uv
from .lamps import LampReader


@dataclass(frozen=True, eq=False)
class TextureOptions:
    """How a texture bake is kept."""

    part: Part           # what gets room in the texture
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
    bake: Callable[..., Generator[float, None, Transfer | TextureTransfer]]  # a texture's takes uv= and side=
    occluders: str
    fingerprint: str
    key: str               # the fingerprint, and all else that tells it from other bakes
    frame: tuple[float, ...]
    texture: TextureOptions | None  # None: to vertices
    bounces: bool          # light was to bounce, so the albedo counts
    lamps: Lamps | None    # what lights it besides, if that was wanted
    note: str = ""         # why Automatic means vertices, for the record
    finer: Job | None = None  # to a texture, if vertices miss what is inside faces: see `prepare`


def prepare(context: bpy.types.Context, obj: bpy.types.Object | None, settings: NeuralGashSettings,
            tiles: Path | None = None, group: Sequence[bpy.types.Object] = (), lamps: LampReader | None = None,
            movable: bool = True) -> Job:
    """Read the object and what blocks its light.

    Where the target is automatic and a plan is to keep to a tolerance, the job is to vertices, and has one to a texture
    beside it, for what they may miss; unless the mesh can have no texture.

    Args:
        tiles: a folder for the finished tiles of a texture, from which a bake that was killed goes on.
        group: the objects that are baked together with it. lamps: of them, if they are to be baked too.
        movable: whether an automatic target may be a texture.
    Raises:
        UserError: that cannot be baked.
    """
    if obj is None:
        raise UserError(refusal(None))
    read = read_object(obj, context.evaluated_depsgraph_get())
    mode = occluder_mode(obj, settings, group) if methods.METHODS[settings.method].sees else SELF
    occluders = read_occluders(obj, mode, context.evaluated_depsgraph_get())
    prepared = partial(_prepared, context, obj, settings, read, mode, occluders,
                       lit=lamps.of(obj) if lamps is not None else None)
    if settings.target == TEXTURE:
        return prepared(to_texture=True, tiles=tiles)
    job = replace(prepared(to_texture=False), note=settings.target_note())
    if settings.target == AUTOMATIC and not job.note and movable:
        try:
            finer = prepared(to_texture=True, tiles=tiles)
        except UserError:  # no room for a UV map, for instance: then vertices it is
            return job
        return replace(job, finer=finer, key=json.dumps({**json.loads(job.key), "finer": finer.key}, sort_keys=True))
    return job


def _prepared(context: bpy.types.Context, obj: bpy.types.Object, settings: NeuralGashSettings, read: SceneMesh,
              mode: str, occluders: Sequence[Geometry], *, to_texture: bool, tiles: Path | None = None,
              lit: Lamps | None) -> Job:
    """The job of one target. Raises UserError: that cannot be baked."""
    depsgraph = context.evaluated_depsgraph_get()
    method = methods.METHODS[settings.method]
    quality = settings.tracing()
    reflection = None
    if method.bounces and settings.bounces:
        if not to_texture:
            check_attributes(settings.order)
        reflection = read_reflection(obj, mode, depsgraph, settings.bounces)
    bake: Callable[..., Generator[float, None, Transfer | TextureTransfer]]
    texture = None
    if to_texture:
        maps = read_normal_maps(obj, depsgraph, read.surface, read.matrix)
        what = {"method": settings.method, "order": settings.order, "occluders": occluders, "normal_maps": maps}
        texture = _texture_options(obj, settings, read.surface, tiles, what)
        before = fingerprint(obj, depsgraph, mode, texture.part.uv, reflection is not None)
        key = _key(settings, before, read.matrix, maps, lit)
        bake = partial(bake_texture, read.surface, **what, **quality, folder=tiles, reflection=reflection, key=key,
                       lamps=lit, whole=settings.gloss)  # metals show the high bands, which dull surfaces do not
    else:
        before = fingerprint(obj, depsgraph, mode, bounces=reflection is not None)
        key = _key(settings, before, read.matrix, (), lit)
        bake = partial(methods.bake, read.mesh, settings.method, settings.order, **quality, occluders=occluders,
                       reflection=reflection, lamps=lit)
    return Job(obj.session_uid, obj.name, read, bake, mode, before, key, read.frame, texture,
               reflection is not None, lit)


def occluder_mode(obj: bpy.types.Object, settings: NeuralGashSettings, group: Sequence[bpy.types.Object]) -> str:
    """What shadows the object. Raises UserError where that is not clear."""
    mode = settings.occluder_mode()
    if not mode:
        raise UserError("Choose the collection whose objects cast shadows.")
    if settings.occluders == COLLECTION and (mode in (SELF, VISIBLE) or is_group(mode)):
        raise UserError(f"A collection named '{mode}' cannot cast shadows, as the name has another meaning; "
                        "rename it.")
    return group_mode(group or [obj]) if mode == SELF else mode


def _texture_options(obj: bpy.types.Object, settings: NeuralGashSettings, surface: Surface, tiles: Path | None,
                     what: dict) -> TextureOptions:
    """How the texture of an object is laid out and kept; what: the arguments of its trials."""
    uv = read_uv(obj.data, settings.uv_map) if settings.uv_map else None
    folder = Path(bpy.path.abspath(settings.texture_folder)) if settings.texture_folder else None
    if folder is not None and not folder.is_absolute():
        if not settings.texture_folder.startswith("//"):
            raise UserError(f"'{folder}' is no whole path of a folder for the textures; begin it with // to have it "
                            "beside the .blend file.")
        raise UserError("The folder of the textures is beside a .blend file that has not been saved yet; "
                        "save it first, or leave the folder empty.")
    if folder is not None:
        check_folder(folder)
    if uv is None:
        check_room(obj.data)
    trial = partial(fitting_side, surface, error=settings.tolerance, **what) if _fits(settings) else None
    part = Part(surface, uv, trial, obj.name)
    check_part(part)  # here, as a texture that is shared is placed for all objects at once
    check_area(part)
    return TextureOptions(part, uv is None, settings.uv_map, folder, settings.half, tiles)


def size(settings: NeuralGashSettings) -> dict:
    """The arguments of `atlas.place` that say how large a texture is."""
    dense = settings.sizing == DENSITY and not settings.uv_map  # a UV map that is there has no metres
    dense = dense and not _fits(settings)
    return {"side": None if dense or _fits(settings) else settings.side,
            "texels_per_metre": settings.texels_per_metre if dense else None, "padding": settings.padding}


def _fits(settings: NeuralGashSettings) -> bool:
    """Whether a texture is as large as the tolerance asks for."""
    return settings.sizing == FIT or settings.target == AUTOMATIC


def _key(settings: NeuralGashSettings, shape: str, matrix: NDArray, maps: Sequence[NormalMap], lamps: Lamps | None
         ) -> str:
    """What tells a bake from any other, in one text."""
    digest = hashlib.blake2b(np.round(matrix, 6).tobytes(), digest_size=16)
    for normal_map in maps:
        digest.update(normal_map.image.tobytes() + normal_map.uv.tobytes()
                      + f"{normal_map.strength} {normal_map.extension}".encode())
    chosen = {name: getattr(settings, name) for name in
              ("method", "order", "quality", "rays", "tolerance", "sizing", "side", "texels_per_metre", "padding",
               "bounces", "share", "gloss")}
    return json.dumps({"version": VERSION, "shape": shape, "place": digest.hexdigest(),
                       "lamps": "" if lamps is None else f"{lamps.key} {lamps.learned} {lamps.order}",
                       **chosen}, sort_keys=True)


def check(context: bpy.types.Context, job: Job) -> bpy.types.Object:
    """The object of a job. Raises UserError where it is gone, or has changed since it was read."""
    obj = next((o for o in bpy.data.objects if o.session_uid == job.uid), None)
    if obj is None:
        raise UserError(f"'{job.name}' was deleted while it was being baked.")
    uv_map = job.texture.uv_map if job.texture else ""
    now = fingerprint(obj, context.evaluated_depsgraph_get(), job.occluders,
                      read_uv(obj.data, uv_map) if uv_map else None, job.bounces)
    if not same_fingerprint(now, job.fingerprint):
        raise UserError(f"'{obj.name}' or what shadows it was changed during the bake; bake again.")
    return obj


def recorded(context: bpy.types.Context, job: Job, obj: bpy.types.Object, transfer: Transfer | TextureTransfer
             ) -> BakeRecord:
    """The record of what a job baked, with what only the scene knows."""
    uv_map = job.texture.uv_map if job.texture else ""
    now = job.fingerprint
    if job.bounces and transfer.record.colours == 1:  # nothing bounced: no colour counts
        now = fingerprint(obj, context.evaluated_depsgraph_get(), job.occluders,
                          read_uv(obj.data, uv_map) if uv_map else None)
    return replace(transfer.record, occluders=job.occluders, fingerprint=now, frame=job.frame, uv_map=uv_map,
                   plan=f"{transfer.record.plan} {job.note}".strip())


def finish(context: bpy.types.Context, job: Job, transfer: Transfer | TextureTransfer,
           images: Sequence[bpy.types.Image] = ()) -> tuple[BakeRecord, str]:
    """Write the bake, light it from the World and show it.

    Args:
        images: of a texture that the object shares; its own are made where not given.
    Returns:
        The record, and a sentence to warn with ('' where all is well).
    Raises:
        UserError: the object is gone or has changed meanwhile, holds attributes in the way, or files
            cannot be written.
    """
    obj = check(context, job)
    record = recorded(context, job, obj, transfer)
    if isinstance(transfer, TextureTransfer):
        assert job.texture is not None
        if job.texture.own_uv:
            now = fingerprint(obj, context.evaluated_depsgraph_get(), job.occluders, transfer.uv.astype(np.float32),
                              record.colours == 3)
            record = replace(record, fingerprint=now)
        write_textures(obj, replace(transfer, record=record), own_uv=job.texture.own_uv, folder=job.texture.folder,
                       half=job.texture.half, images=images)
        if job.texture.tiles is not None:
            remove_tiles(job.texture.tiles)
    else:
        write_transfer(obj, job.read.mesh.elements, replace(transfer, record=record))
    record = read_record(obj)
    warning = ""
    try:
        take_light(context.scene)
    except UserError as error:
        warning = f"{error} The preview keeps the light it had."
    try:
        preview_on(obj, context.scene.neural_gash.lobe_shown())
    except UserError as error:
        preview_off(obj)
        warning = str(error)
    apply_light(context.scene)  # every preview: the World's light may be another now, and twins share the bake
    if record.single_faces:
        alone = (f"{record.single_faces:,} of the faces of '{obj.name}' could not be unwrapped with their neighbours; "
                 "each has a place of its own in the UV map.")
        warning = f"{warning} {alone}" if warning else alone
    if record.lamps_notice:
        warning = f"{warning} {record.lamps_notice}".strip()
    return record, warning


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
    if record.lamps:
        text += (f"; lamps with {record.lamps_rays / max(record.points, 1):.0f} paths a point"
                 f", estimated error {percent(record.lamps_error or 0)}")
    return text


def percent(part: float) -> str:
    """A part of 1 in words fit for people."""
    return "below 0.01 %" if part < 1e-4 else f"{100 * part:.2g} %"
