# SPDX-License-Identifier: GPL-3.0-or-later
"""The bake of the command line, of the file that is open."""
from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import bpy

from .backend import exchange, methods
from .backend.errors import UserError
from .backend.transfer import Transfer
from .cli_files import choose, save_file, set_number
from .ops.batch import Batch, Outcome, finish_batch, prepare_batch
from .properties import (
    AUTOMATIC,
    CHEAPEST,
    COLLECTION,
    DENSITY,
    FIT,
    NETWORK,
    RAYS,
    RESOLUTION,
    TEXTURE,
    TOLERANCE,
    VERTICES,
)
from .scene.read import make_applied_copy
from .scene.render import render_preview
from .scene.views import LIT


def check_bake(arguments: argparse.Namespace) -> None:
    """UserError where arguments of `bake` do not go together."""
    if arguments.texture is None and (arguments.uv_map or arguments.textures or arguments.half or arguments.share
                                      or arguments.padding is not None):
        raise UserError("--uv-map, --textures, --padding, --half and --share belong to a bake with --texture.")
    if arguments.texture is not None and arguments.texture[0] == AUTOMATIC and arguments.textures and not (
            arguments.out or arguments.png):
        raise UserError("--textures keeps nothing where --texture auto bakes to vertices; add --out or --png.")
    if arguments.uv_map and arguments.texture[0] == DENSITY:
        raise UserError("With --uv-map a texture has no texels per metre; give --texture a number of texels, or fit.")
    if arguments.gloss and (arguments.texture is None or arguments.bounces):
        raise UserError("--gloss belongs to a bake with --texture and without --bounces.")
    method = methods.METHODS[arguments.method]
    if arguments.rays is not None and not method.traces:
        raise UserError(f"The method '{arguments.method}' takes no number of rays; leave out --rays.")
    if arguments.bounces and not method.bounces:
        raise UserError(f"The method '{arguments.method}' follows no light that bounces; leave out --bounces.")
    if arguments.texture is not None and arguments.npz is not None:
        raise UserError("--npz holds the points of a bake to vertices; a texture's are in its .exr files (--textures).")


def choose_meshes(names: Sequence[str] | None) -> list[bpy.types.Object]:
    """The mesh objects of these names in the open file; without names, the one that is meant."""
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH"]
    wanted: Sequence[str | None] = names or [None]
    return [choose(meshes, name, "mesh") for name in dict.fromkeys(wanted)]


def prepare_bake(arguments: argparse.Namespace, objects: list[bpy.types.Object],
                 ) -> tuple[list[bpy.types.Object], Batch]:
    """What will be baked of the open file (its copies, with --applied-copy), and the bake, not begun.

    Raises:
        UserError: a setting is out of its range, or none of the objects can be baked.
    """
    settings = bpy.context.scene.neural_gash
    settings.method = arguments.method
    set_number(settings, "order", arguments.order)
    settings.quality = TOLERANCE if arguments.rays is None else RAYS
    if arguments.rays is not None:
        set_number(settings, "rays", arguments.rays)
    set_number(settings, "tolerance", arguments.tolerance)
    if arguments.occluders.upper() in ("SELF", "VISIBLE"):
        settings.occluders = arguments.occluders.upper()
    else:
        settings.occluders = COLLECTION
        settings.collection = bpy.data.collections.get(arguments.occluders)
        if settings.collection is None:
            raise UserError(f"There is no collection named '{arguments.occluders}' in the file.")
    set_number(settings, "bounces", arguments.bounces)
    settings.lamps = arguments.lamps or arguments.lamps_network
    settings.lamps_by = NETWORK if arguments.lamps_network else CHEAPEST
    if arguments.texture is not None:
        sizing, size = arguments.texture
        settings.target, settings.sizing = (AUTOMATIC, FIT) if sizing == AUTOMATIC else (TEXTURE, sizing)
        if settings.sizing != FIT:
            set_number(settings, "side" if settings.sizing == RESOLUTION else "texels_per_metre", size)
        set_number(settings, "padding", 2 if arguments.padding is None else arguments.padding)
        settings.share, settings.uv_map, settings.half = arguments.share, arguments.uv_map, arguments.half
        settings.texture_folder = str(arguments.textures.absolute()) if arguments.textures else ""
    else:
        settings.target = VERTICES
    settings.view = LIT
    if arguments.gloss:
        settings.gloss, settings.lobe = True, arguments.gloss.upper()
    if arguments.applied_copy:
        objects = [make_applied_copy(obj, bpy.context.evaluated_depsgraph_get()) for obj in objects]
        bpy.context.view_layer.update()
    return objects, prepare_batch(bpy.context, objects, settings, partial(_tiles, arguments))


def finish_bake(arguments: argparse.Namespace, objects: Sequence[bpy.types.Object], batch: Batch,
                progress: Callable[[float], None] | None) -> list[Outcome]:
    """Bake what `prepare_bake` gave, and write --npz, --png and --out.

    Args:
        progress: called with the share done (0 to 1).
    Returns:
        Of each object: its record, and what to warn of.
    Raises:
        UserError, OSError: nothing could be baked, or the outcome not be kept.
    """
    results = methods.run(batch.baking, progress)
    outcomes = finish_batch(bpy.context, batch, results)
    if arguments.npz:
        (job,), (transfer,), (outcome,) = batch.jobs, results, outcomes
        assert isinstance(transfer, Transfer) and outcome.record is not None
        exchange.save_npz(arguments.npz.absolute(), job.read.mesh, replace(transfer, record=outcome.record))
    if arguments.png:
        baked = {outcome.name for outcome in outcomes if outcome.record is not None}
        render_preview([o for o in objects if o.name in baked], arguments.png.absolute(),
                       camera=bpy.context.scene.camera)
    if arguments.out:
        save_file(arguments.out.absolute())
    return outcomes


def _tiles(arguments: argparse.Namespace, obj: bpy.types.Object) -> Path | None:
    """Beside the first output: finished tiles of a large texture, from which a killed bake goes on."""
    output = next((p for p in (arguments.textures, arguments.out, arguments.npz, arguments.png) if p is not None), None)
    if arguments.texture is None or output is None:
        return None
    return output.absolute().parent / f".{output.stem}-{clean_name(obj.name)}.tiles"


def clean_name(name: str) -> str:
    """A name of an object that may be part of a file's: different for different ones."""
    clean = "".join(c if c.isalnum() else "_" for c in name)
    if clean != name:  # others' names may be the same but for what was replaced
        clean += "-" + hashlib.blake2b(name.encode(), digest_size=4).hexdigest()
    return clean
