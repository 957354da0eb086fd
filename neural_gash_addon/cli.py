# SPDX-License-Identifier: GPL-3.0-or-later
"""The same jobs without a window: `blender --command neural_gash …`, `python -m neural_gash_addon …`."""
from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import bpy
import numpy as np

from . import farm
from .backend import exchange, methods, shading
from .backend.errors import UserError
from .backend.lobes import GGX, PHONG
from .cli_bake import check_bake, choose_meshes, finish_bake, prepare_bake
from .cli_files import check_suffixes, choose, open_file, sentence, set_number
from .ops.job import summary
from .properties import AUTOMATIC, DENSITY, FIT, RESOLUTION
from .scene import lighting
from .scene.attributes import has_bake, read_record
from .scene.gloss import can_gloss
from .scene.preview import preview_on
from .scene.render import render_preview, silent_blender
from .scene.views import LIT
from .scene.world import file_light, rotated_light

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
_LOBES = [lobe.lower() for lobe in (GGX, PHONG)]


def _parser() -> argparse.ArgumentParser:
    """The one argument parser."""
    parser = argparse.ArgumentParser(
        prog="neural_gash", description="Bake and relight precomputed radiance transfer.",
        epilog="Exit codes: 0 done; 1 failed inside; 2 bad input or usage; 130 interrupted.")
    commands = parser.add_subparsers(dest="command", required=True)

    bake = commands.add_parser("bake", help="bake a mesh object of a file, or many on many machines",
                               epilog=parser.epilog)
    bake.add_argument("inputs", metavar="INPUT", nargs="+", help=".blend, .obj, .ply, .glb or .stl")
    bake.add_argument("--object", metavar="NAME", action="append", dest="objects",
                      help="which object; needed where the file has several meshes. Give it again to bake several "
                           "together, which shadow each other")
    bake.add_argument("--method", choices=list(methods.METHODS), default="auto", metavar="METHOD",
                      help="; ".join(f"{m.name}: {m.label}" for m in methods.METHODS.values()) + " (auto)")
    bake.add_argument("--order", type=int, default=3, help="bands of spherical harmonics, 2 to 5 (3); with "
                      "auto and a tolerance at most so many, as those that would not be seen are left out")
    quality = bake.add_mutually_exclusive_group()
    quality.add_argument("--rays", type=int, help="rays from every point")
    quality.add_argument("--tolerance", type=float, default=0.02, help="relative L2 error to reach (0.02)")
    bake.add_argument("--occluders", default="self", metavar="self|visible|COLLECTION",
                      help="what casts shadows on the object (self)")
    bake.add_argument("--bounces", type=int, default=0, help="how often light may bounce between surfaces, at most (0)")
    bake.add_argument("--lamps", action="store_true", help="bake the light of lamps and emissive materials "
                      "too, to the tolerance or with as many paths as --rays")
    bake.add_argument("--lamps-network", action="store_true", help="as --lamps, but what surfaces reflect is a "
                      "network's (PyTorch) whatever its error; --lamps takes it where it keeps to the tolerance and is "
                      "quicker")
    bake.add_argument("--texture", type=_side, metavar="SIDE",
                      help="bake to a texture of SIDE x SIDE texels instead; '50/m': so many texels a metre; 'fit': as "
                           "large as the tolerance needs (0.02 with --rays); 'auto': so where vertices miss shadows "
                           "inside faces, else to vertices")
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
    many = bake.add_argument_group(
        "many bakes", "Several INPUTs, --frames or --shard bake each object of each file at each frame by itself, "
        "but those that are up to date, and print a line of JSON for each. {file}, {object} and {frame} in the names "
        "of outputs stand for those of each.")
    many.add_argument("--frames", type=farm.frame_list, metavar="FRAMES", help="such as 1-10 or 1-10,20: bake the mesh "
                      "as it is then")
    many.add_argument("--shard", type=farm.shard, metavar="I/N", help="only every Nth bake, from the Ith on")

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
        if text in ("fit", "auto"):
            return FIT if text == "fit" else AUTOMATIC, 0
        return (DENSITY, float(text[:-2])) if text.endswith("/m") else (RESOLUTION, int(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"'{text}' is no number of texels, nor one a metre like '50/m', "
                                         "nor 'fit' or 'auto'") from error


def main(argv: Sequence[str]) -> int:
    """Run a command line; the exit code."""
    try:
        arguments = _parser().parse_args(argv)
    except SystemExit as end:  # argparse has said why
        return int(end.code or 0)
    try:
        if arguments.command == "bake" and farm.is_wanted(arguments):
            return _farm(arguments)
        _check_outputs(arguments)
        with silent_blender():
            data, text = _COMMANDS[arguments.command](arguments)
        for entry in data:
            if "error" in entry:
                print(f"neural_gash: {entry['error']}", file=sys.stderr)
        print("\n".join(json.dumps(entry, sort_keys=True) for entry in data) if arguments.json else text, flush=True)
    except (UserError, OSError) as error:
        print(f"neural_gash: {sentence(error)}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("neural_gash: interrupted", file=sys.stderr)
        return INTERRUPTED
    return BAD_INPUT if any("error" in entry for entry in data) else OK


def _farm(arguments: argparse.Namespace) -> int:
    """`bake` of many: a line as soon as each is done; the exit code."""
    check_bake(arguments)
    check_suffixes(arguments)
    code = OK
    entries = farm.bake_all(arguments, _progress_bar())
    while True:
        with silent_blender():
            entry = next(entries, None)
        if entry is None:
            return code
        if "error" in entry:
            code = BAD_INPUT
        for word in entry.keys() & {"error", "warning"}:
            print(f"neural_gash: {entry['file']}: {entry[word]}", file=sys.stderr)
        print(json.dumps(entry, sort_keys=True), flush=True)


def _bake(arguments: argparse.Namespace) -> tuple[list[dict], str]:
    """`bake` of one file, all its objects together."""
    check_bake(arguments)
    if arguments.npz is not None and len(arguments.objects or ()) > 1:
        raise UserError("--npz holds the points of one object; bake several one by one.")
    open_file(arguments.inputs[0])
    outcomes = finish_bake(arguments, *prepare_bake(arguments, choose_meshes(arguments.objects)), _progress_bar())
    for outcome in outcomes:
        if outcome.record is not None and outcome.sentence:
            print(f"neural_gash: {outcome.sentence}", file=sys.stderr)
    return ([{"object": o.name, "error": o.sentence} if o.record is None else {"object": o.name, **asdict(o.record)}
             for o in outcomes],
            "\n".join(f"{o.name}: {summary(o.record)}." for o in outcomes if o.record is not None))


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
        radiance = shading.radiance(arrays["transfer"], light)
        radiance = (radiance + arrays.get("irradiance", 0) / np.pi).astype(np.float32)
        if arguments.npz:
            exchange.write_npz(arguments.npz.absolute(), positions=arrays["positions"], radiance=radiance, light=light)
        name = Path(arguments.input).name
    elif suffix == ".blend":
        if arguments.npz:
            raise UserError("--npz relights a .npz; bake with --npz to get one.")
        open_file(arguments.input)
        obj = choose([o for o in bpy.context.scene.objects if has_bake(o)], arguments.object, "baked")
        record = read_record(obj)
        if arguments.gloss and not can_gloss(record):
            raise UserError("--gloss needs a texture without bounces, and with lamps one that was baked with --gloss; "
                            f"the bake of '{obj.name}' is not.")
        scene = bpy.context.scene
        if arguments.hdri is None:
            lighting.take_light(scene)
        else:
            scene.neural_gash.hdri = str(arguments.hdri.absolute())
            scene.neural_gash.light_source = lighting.HDRI
            if lighting.problem(scene):
                raise UserError(lighting.problem(scene))
        scene.neural_gash.light_rotation = turn[0]
        set_number(scene.neural_gash, "light_strength", turn[1])
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
    outputs = check_suffixes(arguments)
    if not outputs and not arguments.json and getattr(arguments, "textures", None) is None:
        options = "--out, --npz, --png or --json" if arguments.command == "bake" else "--png, --npz or --json"
        raise UserError(f"Nothing of this would be kept; add {options}.")
    for path in outputs:
        exchange.check_writable(path.absolute())


_COMMANDS = {"bake": _bake, "relight": _relight}




def _progress_bar() -> Callable[[float], None] | None:
    """A bar on a terminal; None elsewhere."""
    if not sys.stderr.isatty():
        return None

    def show(share: float) -> None:
        end = "\n" if share >= 1 else ""
        print(f"\rbaking [{'#' * round(40 * share):<40}] {100 * share:3.0f} %", end=end, file=sys.stderr, flush=True)

    return show


_command = None


def register() -> None:
    """Make `blender --command neural_gash …` known."""
    global _command
    _command = bpy.utils.register_cli_command("neural_gash", main)


def unregister() -> None:
    """Forget it."""
    bpy.utils.unregister_cli_command(_command)
