# SPDX-License-Identifier: GPL-3.0-or-later
"""The same jobs without a window: `blender --command neural_gash …`, `python -m neural_gash_addon …`."""
from __future__ import annotations

import argparse
import hashlib
import io
import json
import math
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from dataclasses import asdict
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from .backend import exchange, methods, shading
from .backend.errors import UserError
from .backend.lobes import GGX, PHONG
from .backend.transfer import Transfer
from .ops.batch import finish_batch, prepare_batch
from .ops.job import summary
from .properties import (
    COLLECTION,
    DENSITY,
    FIT,
    RAYS,
    RESOLUTION,
    TEXTURE,
    TOLERANCE,
    VERTICES,
    NeuralGashSettings,
)
from .scene import lighting
from .scene.attributes import has_bake, read_record
from .scene.gloss import can_gloss
from .scene.preview import preview_on
from .scene.read import make_applied_copy
from .scene.render import render_preview, silent_blender
from .scene.views import LIT
from .scene.world import file_light, rotated_light

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
_LOBES = [lobe.lower() for lobe in (GGX, PHONG)]

_IMPORTERS: dict[str, Callable[[str], object]] = {
    ".obj": lambda path: bpy.ops.wm.obj_import(filepath=path),
    ".ply": lambda path: bpy.ops.wm.ply_import(filepath=path, forward_axis="Y", up_axis="Z"),
    ".stl": lambda path: bpy.ops.wm.stl_import(filepath=path),
    ".glb": lambda path: bpy.ops.import_scene.gltf(filepath=path),
}


def _parser() -> argparse.ArgumentParser:
    """The one argument parser."""
    parser = argparse.ArgumentParser(
        prog="neural_gash", description="Bake and relight precomputed radiance transfer.",
        epilog="Exit codes: 0 done; 1 failed inside; 2 bad input or usage; 130 interrupted.")
    commands = parser.add_subparsers(dest="command", required=True)

    bake = commands.add_parser("bake", help="bake a mesh object of a file",
                               epilog=parser.epilog)
    bake.add_argument("input", metavar="INPUT", help=".blend, .obj, .ply, .glb or .stl")
    bake.add_argument("--object", metavar="NAME", action="append", dest="objects",
                      help="which object; needed where the file has several meshes. Give it again to bake several "
                           "together, which shadow each other")
    bake.add_argument("--method", choices=list(methods.METHODS), default="auto", metavar="METHOD",
                      help="; ".join(f"{m.name}: {m.label}" for m in methods.METHODS.values()) + " (auto)")
    bake.add_argument("--order", type=int, default=3, help="bands of spherical harmonics, 2 to 5 (3)")
    quality = bake.add_mutually_exclusive_group()
    quality.add_argument("--rays", type=int, help="rays from every point")
    quality.add_argument("--tolerance", type=float, default=0.02, help="relative L2 error to reach (0.02)")
    bake.add_argument("--occluders", default="self", metavar="self|visible|COLLECTION",
                      help="what casts shadows on the object (self)")
    bake.add_argument("--bounces", type=int, default=0, help="how often light may bounce between surfaces, at most (0)")
    bake.add_argument("--texture", type=_side, metavar="SIDE",
                      help="bake to a texture of SIDE x SIDE texels instead; '50/m': so many texels a metre; 'fit': as "
                           "large as the tolerance needs (0.02 with --rays)")
    bake.add_argument("--padding", type=int, metavar="TEXELS", help="around each part of the UV map of --texture (2)")
    bake.add_argument("--share", action="store_true", help="one texture for all objects, with --texture")
    bake.add_argument("--uv-map", metavar="NAME", default="", help="of the mesh, for --texture; else one is made")
    bake.add_argument("--textures", metavar="FOLDER", type=Path, help="write the textures as .exr there, not into OUT")
    bake.add_argument("--half", action="store_true", help="textures of 16 bits a channel instead of 32")
    bake.add_argument("--gloss", choices=_LOBES, help="show what materials mirror, with this lobe; with --texture, "
                      "without --bounces, and best with --order 5")
    bake.add_argument("--out", metavar="OUT.blend", type=Path, help="save the file with the bake in it")
    bake.add_argument("--npz", metavar="OUT.npz", type=Path, help="save points and coefficients")
    bake.add_argument("--png", metavar="OUT.png", type=Path,
                      help="render the object as baked; the scene's camera where there is one (.exr: linear, 32 bits)")
    bake.add_argument("--applied-copy", action="store_true",
                      help="bake a copy with its modifiers applied, where those change the vertices")
    bake.add_argument("--json", action="store_true", help="print the record as one line of JSON, one for each object")

    relight = commands.add_parser("relight", help="render or evaluate a baked file under another light",
                                  epilog=parser.epilog)
    relight.add_argument("input", metavar="INPUT", help="baked .blend or .npz")
    relight.add_argument("--object", metavar="NAME", help="which object; needed where several are baked")
    relight.add_argument("--hdri", metavar="FILE", type=Path,
                         help="equirectangular image; else the light that the file has chosen")
    relight.add_argument("--rotation", type=float, default=0.0, metavar="DEG", help="about the vertical axis (0)")
    relight.add_argument("--strength", type=float, default=1.0, help="factor on the light (1)")
    relight.add_argument("--gloss", choices=_LOBES, help="show what materials mirror, with this lobe (of a texture)")
    relight.add_argument("--png", metavar="OUT.png", type=Path,
                         help="render (a .blend only; .exr: linear, 32 bits)")
    relight.add_argument("--npz", metavar="OUT.npz", type=Path, help="save radiance (N, 3), albedo 1 (a .npz only)")
    relight.add_argument("--json", action="store_true", help="print a summary as one line of JSON")
    return parser


def _side(text: str) -> tuple[str, float]:
    """What decides the size of a texture, and the number of texels that does."""
    try:
        if text == "fit":
            return FIT, 0
        return (DENSITY, float(text[:-2])) if text.endswith("/m") else (RESOLUTION, int(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"'{text}' is no number of texels, nor one a metre like '50/m', "
                                         "nor 'fit'") from error


def main(argv: Sequence[str]) -> int:
    """Run a command line; the exit code."""
    try:
        arguments = _parser().parse_args(argv)
    except SystemExit as end:  # argparse has said why
        return int(end.code or 0)
    try:
        _check_outputs(arguments)
        with silent_blender():
            data, text = _COMMANDS[arguments.command](arguments)
        for entry in data:
            if "error" in entry:
                print(f"neural_gash: {entry['error']}", file=sys.stderr)
        print("\n".join(json.dumps(entry, sort_keys=True) for entry in data) if arguments.json else text, flush=True)
    except UserError as error:
        print(f"neural_gash: {error}", file=sys.stderr)
        return BAD_INPUT
    except OSError as error:  # no room, a name too long, a pipe that closed
        name = error.filename or "a file"
        print(f"neural_gash: {name} cannot be written: {exchange.reason(error)}.", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("neural_gash: interrupted", file=sys.stderr)
        return INTERRUPTED
    return BAD_INPUT if any("error" in entry for entry in data) else OK


def _bake(arguments: argparse.Namespace) -> tuple[list[dict], str]:
    """`bake`."""
    if arguments.texture is None and (arguments.uv_map or arguments.textures or arguments.half or arguments.share
                                      or arguments.padding is not None):
        raise UserError("--uv-map, --textures, --padding, --half and --share belong to a bake with --texture.")
    if arguments.uv_map and arguments.texture[0] == DENSITY:
        raise UserError("With --uv-map a texture has no texels per metre; give --texture a number of texels, or fit.")
    if arguments.gloss and (arguments.texture is None or arguments.bounces):
        raise UserError("--gloss belongs to a bake with --texture and without --bounces.")
    if not methods.METHODS[arguments.method].traces and (arguments.rays is not None or arguments.bounces):
        raise UserError(f"The method '{arguments.method}' traces nothing; leave out --rays and --bounces.")
    if arguments.npz is not None and len(arguments.objects or ()) > 1:
        raise UserError("--npz holds the points of one object; bake several one by one.")
    if arguments.texture is not None and arguments.npz is not None:
        raise UserError("--npz holds the points of a bake to vertices; a texture's are in its .exr files (--textures).")
    _open(arguments.input)
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH"]
    objects = [_choose(meshes, name, "mesh") for name in dict.fromkeys(arguments.objects or [None])]
    settings = bpy.context.scene.neural_gash
    settings.method = arguments.method
    _set(settings, "order", arguments.order)
    settings.quality = TOLERANCE if arguments.rays is None else RAYS
    if arguments.rays is not None:
        _set(settings, "rays", arguments.rays)
    _set(settings, "tolerance", arguments.tolerance)
    if arguments.occluders.upper() in ("SELF", "VISIBLE"):
        settings.occluders = arguments.occluders.upper()
    else:
        settings.occluders = COLLECTION
        settings.collection = bpy.data.collections.get(arguments.occluders)
        if settings.collection is None:
            raise UserError(f"There is no collection named '{arguments.occluders}' in the file.")
    _set(settings, "bounces", arguments.bounces)
    if arguments.texture is not None:
        settings.target = TEXTURE
        settings.sizing, size = arguments.texture
        if settings.sizing != FIT:
            _set(settings, "side" if settings.sizing == RESOLUTION else "texels_per_metre", size)
        _set(settings, "padding", 2 if arguments.padding is None else arguments.padding)
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
    batch = prepare_batch(bpy.context, objects, settings, partial(_tiles, arguments))
    results = methods.run(batch.baking, _progress_bar())
    outcomes = finish_batch(bpy.context, batch, results)
    for outcome in outcomes:
        if outcome.record is not None and outcome.sentence:
            print(f"neural_gash: {outcome.sentence}", file=sys.stderr)
    if arguments.npz:
        (job,), (transfer,), (outcome,) = batch.jobs, results, outcomes
        assert isinstance(transfer, Transfer) and outcome.record is not None
        exchange.save_npz(arguments.npz.absolute(), job.read.mesh, Transfer(transfer.coefficients, outcome.record))
    if arguments.png:
        baked = {outcome.name for outcome in outcomes if outcome.record is not None}
        render_preview([o for o in objects if o.name in baked], arguments.png.absolute(),
                       camera=bpy.context.scene.camera)
    if arguments.out:
        _save(arguments.out.absolute())
    return ([{"object": o.name, "error": o.sentence} if o.record is None else {"object": o.name, **asdict(o.record)}
             for o in outcomes],
            "\n".join(f"{o.name}: {summary(o.record)}." for o in outcomes if o.record is not None))


def _tiles(arguments: argparse.Namespace, obj: bpy.types.Object) -> Path | None:
    """Beside the first output: finished tiles of a large texture, from which a killed bake goes on."""
    output = next((p for p in (arguments.textures, arguments.out, arguments.npz, arguments.png) if p is not None), None)
    if arguments.texture is None or output is None:
        return None
    clean = "".join(c if c.isalnum() else "_" for c in obj.name)
    if clean != obj.name:  # others' names may be the same but for what was replaced
        clean += "-" + hashlib.blake2b(obj.name.encode(), digest_size=4).hexdigest()
    return output.absolute().parent / f".{output.stem}-{clean}.tiles"


def _relight(arguments: argparse.Namespace) -> tuple[list[dict], str]:
    """`relight`."""
    suffix = Path(arguments.input).suffix.lower()
    if not math.isfinite(arguments.rotation) or not 0 <= arguments.strength < math.inf:
        raise UserError("The rotation must be a number of degrees, and the strength one of 0 or more.")
    turn = (math.radians(arguments.rotation), arguments.strength)
    if suffix == ".npz":
        if arguments.png or arguments.object:
            raise UserError("A .npz has no mesh to render; give the .blend for --png, or --npz for numbers.")
        if arguments.gloss:
            raise UserError("A .npz has no materials that could mirror; --gloss is for a .blend.")
        if arguments.hdri is None:
            raise UserError("A .npz has no World; give the light with --hdri.")
        arrays, record = exchange.load_npz(Path(arguments.input))
        light = rotated_light(file_light(arguments.hdri, record.order), *turn)
        radiance = shading.radiance(arrays["transfer"], light).astype(np.float32)
        if arguments.npz:
            exchange.write_npz(arguments.npz.absolute(), positions=arrays["positions"], radiance=radiance, light=light)
        name = Path(arguments.input).name
    elif suffix == ".blend":
        if arguments.npz:
            raise UserError("--npz relights a .npz; bake with --npz to get one.")
        _open(arguments.input)
        obj = _choose([o for o in bpy.context.scene.objects if has_bake(o)], arguments.object, "baked")
        record = read_record(obj)
        if arguments.gloss and not can_gloss(record):
            raise UserError(f"--gloss needs a bake to a texture without bounces, which that of '{obj.name}' is not.")
        scene = bpy.context.scene
        if arguments.hdri is None:
            lighting.take_light(scene)
        else:
            scene.neural_gash.hdri = str(arguments.hdri.absolute())
            scene.neural_gash.light_source = lighting.HDRI
            if lighting.problem(scene):
                raise UserError(lighting.problem(scene))
        scene.neural_gash.light_rotation = turn[0]
        _set(scene.neural_gash, "light_strength", turn[1])
        scene.neural_gash.view = LIT
        preview_on(obj, arguments.gloss.upper() if arguments.gloss else "")
        lighting.light_object(scene, obj)
        if arguments.png:
            render_preview([obj], arguments.png.absolute(), camera=scene.camera)
        light, name = lighting.current_light(scene, record.order), obj.name
    else:
        raise UserError(f"'{arguments.input}' is neither a .blend nor a .npz.")
    return [{"object": name, "light": light.tolist()}], f"{name}: relit."


def _check_outputs(arguments: argparse.Namespace) -> None:
    """UserError, before anything is computed, where its outcome could not be kept."""
    suffixes = {"out": (".blend",), "npz": (".npz",), "png": (".png", ".exr")}
    outputs = {name: path for name in suffixes if (path := getattr(arguments, name, None)) is not None}
    if not outputs and not arguments.json and getattr(arguments, "textures", None) is None:
        options = "--out, --npz, --png or --json" if arguments.command == "bake" else "--png, --npz or --json"
        raise UserError(f"Nothing of this would be kept; add {options}.")
    for name, path in outputs.items():
        if path.suffix.lower() not in suffixes[name]:
            raise UserError(f"--{name} writes {' or '.join(suffixes[name])} files, which '{path}' is not.")
        exchange.check_writable(path.absolute())


_COMMANDS = {"bake": _bake, "relight": _relight}


def _open(name: str) -> None:
    """Open a .blend, or import a mesh into an empty file. UserError where that fails."""
    path = Path(name).absolute()
    if not path.is_file():
        raise UserError(f"There is no file '{name}'.")
    suffix = path.suffix.lower()
    try:
        with redirect_stderr(io.StringIO()):  # importers in Python write tracebacks there
            _read(name, path, suffix)
    except RuntimeError as error:
        raise UserError(f"'{name}' cannot be read: {_reason(error)}.") from error


def _read(name: str, path: Path, suffix: str) -> None:
    """`_open` a file that is there; RuntimeError where Blender cannot."""
    if suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
    elif suffix in _IMPORTERS:
        bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
        _IMPORTERS[suffix](str(path))
        world = bpy.data.worlds.new("Sky")  # a mesh file has no light; a white sky shows its shape
        world.color = (1, 1, 1)
        bpy.context.scene.world = world
        bpy.context.view_layer.objects.active = None  # the importer's choice, not a person's
        if suffix == ".ply":
            _shade_smooth()
    else:
        raise UserError(f"'{name}' is none of .blend, .obj, .ply, .glb, .stl.")


def _shade_smooth() -> None:
    """PLY has no faces' shading: vertex normals mean smooth, and so do none."""
    for mesh in bpy.data.meshes:
        if not mesh.has_custom_normals:
            mesh.shade_smooth()


def _choose(candidates: list[bpy.types.Object], name: str | None, kind: str) -> bpy.types.Object:
    """The object of this name, or the only one, or the active one."""
    if name is not None:
        obj = bpy.context.scene.objects.get(name)
        if obj is None:
            raise UserError(f"There is no object named '{name}' in the scene.")
        return obj
    active = bpy.context.view_layer.objects.active
    if active in candidates:
        return active
    if len(candidates) == 1:
        return candidates[0]
    if not candidates:
        raise UserError(f"The file has no {kind} object.")
    names = ", ".join(sorted(o.name for o in candidates)[:8])
    raise UserError(f"The file has several {kind} objects; choose one with --object: {names}.")


def _set(settings: NeuralGashSettings, name: str, value: float) -> None:
    """Set a number, which the property would silently clamp to its range."""
    kind = settings.bl_rna.properties[name]
    if not kind.hard_min <= value <= kind.hard_max * (1 + 1e-6):  # the ends of float ranges are rounded
        raise UserError(f"The {kind.name.lower()} must be {kind.hard_min:g} to {kind.hard_max:g}, not {value:g}.")
    setattr(settings, name, value)


def _save(path: Path) -> None:
    """Save the open file at `path` in one step: until then, what was there stays."""
    bpy.context.preferences.filepaths.save_version = 0
    with exchange.atomic(path) as draft:
        try:
            bpy.ops.wm.save_as_mainfile(filepath=str(draft), copy=True, check_existing=False)
        except RuntimeError as error:
            raise UserError(f"'{path}' cannot be written: {_reason(error)}.") from error


def _progress_bar() -> Callable[[float], None] | None:
    """A bar on a terminal; None elsewhere."""
    if not sys.stderr.isatty():
        return None

    def show(share: float) -> None:
        end = "\n" if share >= 1 else ""
        print(f"\rbaking [{'#' * round(40 * share):<40}] {100 * share:3.0f} %", end=end, file=sys.stderr, flush=True)

    return show


def _reason(error: Exception) -> str:
    """What an operator reported, in one line; of a traceback, the line that names the error."""
    lines = str(error).strip().splitlines()
    if any("Traceback" in line for line in lines):  # Blender adds a last line, of its own place
        lines = [line for line in lines if not line.startswith((" ", "Location:"))][-1:]
    return lines[0].strip().removeprefix("Error: ").rstrip(".")


_command = None


def register() -> None:
    """Make `blender --command neural_gash …` known."""
    global _command
    _command = bpy.utils.register_cli_command("neural_gash", main)


def unregister() -> None:
    """Forget it."""
    bpy.utils.unregister_cli_command(_command)
