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
from .read import same_fingerprint

_files: dict[str, tuple[float, Sequence]] = {}  # path -> when the file was written, and the file


def show_frame(scene: bpy.types.Scene, obj: bpy.types.Object) -> bool:
    """Write the current frame of an object's sequence to it, the nearest beyond its ends; False if it is there already.

    Raises:
        UserError: the file is missing or damaged, or the mesh is another.
    """
    before = read_record(obj)
    sequence = _sequence(str(obj.data[SEQUENCE]))
    coefficients, record = sequence.frame(scene.frame_current)
    if same_fingerprint(record.fingerprint, before.fingerprint):
        return False
    name = obj.data[SEQUENCE]
    write_transfer(obj, sequence.elements, Transfer(coefficients, record))
    obj.data[SEQUENCE] = name
    if record.frame != before.frame or record.colours != before.colours:
        light_object(scene, obj)
    return True


def forget_files() -> None:
    """Hold no file any more."""
    _files.clear()


def _sequence(name: str) -> Sequence:
    """The file that a mesh names, mapped once. Raises UserError."""
    path = Path(bpy.path.abspath(name))
    try:
        written = path.stat().st_mtime
    except OSError as error:
        raise UserError(f"The sequence '{path}' is missing; bake it again, or clear the bake.") from error
    if name not in _files or _files[name][0] != written:
        _files[name] = written, open_sequence(path)
    return _files[name][1]
