# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes of every frame, read from their files as frames are shown."""
from __future__ import annotations

from pathlib import Path

import bpy

from ..backend.errors import UserError
from ..backend.sequence import Sequence, open_sequence
from ..backend.transfer import Transfer
from .attributes import SEQUENCE, read_record, write_transfer
from .lighting import light_object
from .read import refusal, same_fingerprint

_files: dict[Path, tuple[tuple[int, ...], Sequence]] = {}  # path -> which file it was, and what it holds


def show_frame(scene: bpy.types.Scene, obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bool:
    """Write the current frame of an object's sequence to it, the nearest beyond its ends; False if it is there already.

    Raises:
        UserError: the file is missing or damaged, or the mesh is another, or linked from another file.
    """
    reason = refusal(obj)
    if reason:
        raise UserError(reason)
    before = read_record(obj)
    sequence = _sequence(Path(bpy.path.abspath(str(obj.data[SEQUENCE]))))
    coefficients, record = sequence.frame(scene.frame_current)
    if same_fingerprint(record.fingerprint, before.fingerprint):
        return False
    name = obj.data[SEQUENCE]
    write_transfer(obj, sequence.elements, Transfer(coefficients, record))
    obj.data[SEQUENCE] = name
    if (record.frame, record.order, record.colours) != (before.frame, before.order, before.colours):
        light_object(scene, obj, depsgraph)
    return True


def forget_files() -> None:
    """Know no file any more."""
    _files.clear()


def _sequence(path: Path) -> Sequence:
    """A file, its records read once. Raises UserError."""
    try:
        found = path.stat()
    except OSError as error:
        raise UserError(f"The sequence '{path}' is missing; bake it again, or clear the bake.") from error
    written = found.st_mtime_ns, found.st_size, found.st_ino
    if path not in _files or _files[path][0] != written:
        _files[path] = written, open_sequence(path)
    return _files[path][1]
