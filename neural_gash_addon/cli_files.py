# SPDX-License-Identifier: GPL-3.0-or-later
"""What the command line opens, chooses in it, and saves."""
from __future__ import annotations

import argparse
import io
from collections.abc import Callable
from contextlib import redirect_stderr
from pathlib import Path

import bpy

from .backend import exchange
from .backend.errors import UserError
from .properties import NeuralGashSettings

_IMPORTERS: dict[str, Callable[[str], object]] = {
    ".obj": lambda path: bpy.ops.wm.obj_import(filepath=path),
    ".ply": lambda path: bpy.ops.wm.ply_import(filepath=path, forward_axis="Y", up_axis="Z"),
    ".stl": lambda path: bpy.ops.wm.stl_import(filepath=path),
    ".glb": lambda path: bpy.ops.import_scene.gltf(filepath=path),
}


def open_file(name: str) -> None:
    """Open a .blend, or import a mesh into an empty file. UserError where that fails."""
    path = Path(name).absolute()
    if not path.is_file():
        raise UserError(f"There is no file '{name}'.")
    suffix = path.suffix.lower()
    try:
        with redirect_stderr(io.StringIO()):  # importers in Python write tracebacks there
            _read(name, path, suffix)
    except RuntimeError as error:
        raise UserError(f"'{name}' cannot be read: {blender_reason(error)}.") from error


def _read(name: str, path: Path, suffix: str) -> None:
    """`open_file` a file that is there; RuntimeError where Blender cannot."""
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


def choose(candidates: list[bpy.types.Object], name: str | None, kind: str) -> bpy.types.Object:
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


def set_number(settings: NeuralGashSettings, name: str, value: float) -> None:
    """Set a number, which the property would silently clamp to its range."""
    kind = settings.bl_rna.properties[name]
    if not kind.hard_min <= value <= kind.hard_max * (1 + 1e-6):  # the ends of float ranges are rounded
        raise UserError(f"The {kind.name.lower()} must be {kind.hard_min:g} to {kind.hard_max:g}, not {value:g}.")
    setattr(settings, name, value)


def save_file(path: Path) -> None:
    """Save the open file at `path` in one step: until then, what was there stays."""
    bpy.context.preferences.filepaths.save_version = 0
    with exchange.atomic(path) as draft:
        try:
            bpy.ops.wm.save_as_mainfile(filepath=str(draft), copy=True, check_existing=False)
        except RuntimeError as error:
            raise UserError(f"'{path}' cannot be written: {blender_reason(error)}.") from error


def blender_reason(error: Exception) -> str:
    """What an operator reported, in one line; of a traceback, the line that names the error."""
    lines = str(error).strip().splitlines()
    if any("Traceback" in line for line in lines):  # Blender adds a last line, of its own place
        lines = [line for line in lines if not line.startswith((" ", "Location:"))][-1:]
    return lines[0].strip().removeprefix("Error: ").rstrip(".")


def check_suffixes(arguments: argparse.Namespace) -> list[Path]:
    """The files that are to be written. UserError where a name ends as no such file does."""
    suffixes = {"out": (".blend",), "npz": (".npz",), "png": (".png", ".exr")}
    outputs = {name: path for name in suffixes if (path := getattr(arguments, name, None)) is not None}
    for name, path in outputs.items():
        if path.suffix.lower() not in suffixes[name]:
            raise UserError(f"--{name} writes {' or '.join(suffixes[name])} files, which '{path}' is not.")
    return list(outputs.values())


def sentence(error: UserError | OSError) -> str:
    """What a person reads of an error."""
    if isinstance(error, UserError):
        return str(error)
    name = error.filename or "a file"  # no room, a name too long, a pipe that closed
    return f"{name} cannot be written: {exchange.reason(error)}."
