# SPDX-License-Identifier: GPL-3.0-or-later
"""UV maps of a mesh as arrays, and the one that a texture bake makes for itself."""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import UserError

OWN_NAME = "PRT"
_OWN = "neural_gash_uv"   # custom property of the mesh: name of the UV map that a bake made
_MOST = 8                 # UV maps that Blender keeps on a mesh


def read_uv(data: bpy.types.Mesh, name: str) -> NDArray[np.float32]:
    """(C, 2) of each face corner. Raises UserError where there is no such UV map."""
    if data.is_editmode:  # which keeps them elsewhere
        raise UserError(f"The mesh '{data.name}' is in Edit Mode; leave it first.")
    layer = data.uv_layers.get(name)
    if layer is None or len(layer.uv) != len(data.loops):
        raise UserError(f"The mesh '{data.name}' has no UV map named '{name}'.")
    uv = np.empty((len(layer.uv), 2), np.float32)
    layer.uv.foreach_get("vector", uv.ravel())
    return uv


def check_room(data: bpy.types.Mesh) -> None:
    """UserError where the mesh has as many UV maps as it can, and none that a bake made."""
    if len(data.uv_layers) >= _MOST and own_uv_name(data) not in data.uv_layers:  # a person may have removed it
        raise UserError(f"The mesh '{data.name}' has {_MOST} UV maps, and Blender keeps no more; "
                        "remove one, or bake to one of them.")


def own_uv_name(data: bpy.types.Mesh) -> str:
    """Name of the UV map that a bake made, which may be gone; '' where none did."""
    return str(data.get(_OWN, ""))


def write_own_uv(data: bpy.types.Mesh, uv: NDArray) -> str:
    """Store an atlas (C, 2) in a UV map of its own, which becomes neither active nor rendered; its name."""
    remove_own_uv(data)
    active, rendered = data.uv_layers.active, next((u for u in data.uv_layers if u.active_render), None)
    names = active and active.name, rendered and rendered.name
    layer = data.uv_layers.new(name=OWN_NAME, do_init=False)
    layer.uv.foreach_set("vector", np.ascontiguousarray(uv, dtype=np.float32).ravel())
    own = layer.name
    if names[0]:
        data.uv_layers.active = data.uv_layers[names[0]]
    if names[1]:
        data.uv_layers[names[1]].active_render = True
    mark_own_uv(data, own)
    return own


def mark_own_uv(data: bpy.types.Mesh, name: str) -> None:
    """Say that a bake made the UV map of this name; '': none."""
    if name:
        data[_OWN] = name


def remove_own_uv(data: bpy.types.Mesh) -> None:
    """Remove the UV map that a bake made, if there is one."""
    if _OWN not in data:
        return
    layer = data.uv_layers.get(own_uv_name(data))
    if layer is not None:
        data.uv_layers.remove(layer)
    del data[_OWN]
