# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy bounces of a texture bake: images of one light's, known to their mesh, and whether they still fit."""
from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend import lobes
from ..backend.errors import UserError
from ..backend.pictures import Picture
from ..backend.record import BakeRecord
from .images import BOUNCED, attach, detach

_STATE = "neural_gash_gloss"     # custom property of the mesh: what its glossy bounces were made of, as JSON
_SHOWN = "neural_gash_gloss_on"  # whether the preview has them in it now: not where the light is another


def light_key(light: NDArray) -> str:
    """What tells a light (K, 3), in the frame of a bake, from any other."""
    size = float(np.abs(light).max(initial=0.0)) or 1.0
    return f"{size:.4g}:" + hashlib.blake2b((np.rint(light / size * 1e4) + 0.0).tobytes(), digest_size=8).hexdigest()


def finish_key(finish: NDArray, pictures: Sequence[Picture]) -> str:
    """What tells how everything reflects, as `read_finish` says it, from any other."""
    parts = [finish, *(picture.lookups() for picture in pictures)]
    return hashlib.blake2b(b"".join(np.rint(part * 1e3).astype(np.int32).tobytes() for part in parts),
                           digest_size=8).hexdigest()


def write_bounces(data: bpy.types.Mesh, images: Sequence[bpy.types.Image], record: BakeRecord, light: NDArray,
                  finish: str, lobe: str) -> None:
    """Make images those of the mesh's glossy bounces, in place of any earlier ones."""
    discard_bounces(data)
    attach(data, images, BOUNCED)
    data[_STATE] = json.dumps({"record": record.to_json(), "light": light_key(light), "finish": finish,
                               "lobe": lobe})


def discard_bounces(data: bpy.types.Mesh) -> None:
    """Remove the glossy bounces of a mesh, if it has any."""
    detach(data, BOUNCED)
    for key in (_STATE, _SHOWN):
        if key in data:
            del data[key]


def has_bounces(data: bpy.types.Mesh) -> bool:
    """Whether the mesh has glossy bounces. Cheap enough to ask while drawing."""
    return isinstance(data.get(_STATE), str)


def bounces_shown(data: bpy.types.Mesh) -> bool:
    """Whether the preview has the glossy bounces in it. Cheap enough to ask while drawing."""
    return bool(data.get(_SHOWN))


def bounces_for(data: bpy.types.Mesh, light: NDArray, lobe: str) -> BakeRecord | None:
    """The record of the mesh's glossy bounces where they are of this light (K, 3) and lobe; for `bounces_shown`."""
    state = _state(data)
    found = None
    if state is not None and state["light"] == light_key(light) and state.get("lobe", lobes.GGX) == lobe:
        try:
            found = BakeRecord.from_json(state["record"])
        except UserError:
            found = None
    if state is not None and bounces_shown(data) != (found is not None):
        data[_SHOWN] = found is not None
    return found


def finish_fits(data: bpy.types.Mesh, finish: str) -> bool:
    """Whether the glossy bounces of a mesh are of these colours and this roughness; True where it has none."""
    state = _state(data)
    return state is None or state["finish"] == finish


def _state(data: bpy.types.Mesh) -> dict | None:
    """What the mesh says of its glossy bounces; None where it has none that can be read."""
    try:
        state = json.loads(data[_STATE]) if has_bounces(data) else None
    except ValueError:
        return None
    return state if isinstance(state, dict) and {"record", "light", "finish"} <= state.keys() else None


def folder_of(images: Sequence[bpy.types.Image]) -> Path | None:
    """Where the files of some images are; None where they are packed."""
    if not images or images[0].packed_file:
        return None
    return Path(bpy.path.abspath(images[0].filepath)).parent
