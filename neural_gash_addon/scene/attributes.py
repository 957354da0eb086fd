# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a bake lives on a mesh: attributes `_prt_0`, `_prt_1`, … or images, and the record beside them.

Attribute i holds numbers 4i..4i+3 of a point as red, green, blue, alpha of a FLOAT_COLOR: float32,
signed, exact, and four of them for one of the 14 attributes that EEVEE can draw. The leading
underscore makes the glTF exporter carry them. A point's numbers are its coefficients; coloured
ones are K times red, green and blue. The irradiance from lamps, where those were baked too, is the red, green and
blue of one more, `_prt_lamps`.
"""
from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import UserError
from ..backend.geometry import POINT, TEXEL
from ..backend.record import BakeRecord
from ..backend.spherical_harmonics import MAX_ORDER
from ..backend.texture import TextureTransfer
from ..backend.transfer import Transfer
from .gloss_bounce import discard_bounces
from .images import attach, bake_images, detach, make_images
from .uv_maps import check_room, remove_own_uv, write_own_uv

RECORD = "neural_gash"  # custom property on the mesh
SEQUENCE = "neural_gash_sequence"  # another: the file that holds its bake of every frame of an animation
PREFIX = "_prt_"
CHANNELS = 4
LAMPS = f"{PREFIX}lamps"
_OURS = re.compile(rf"{PREFIX}(\d+|lamps)")  # chosen as 'the' colour by Blender, not by a person


def attribute_count(terms: int) -> int:
    """How many attributes the numbers of a point take."""
    return -(-terms // CHANNELS)


def attribute_names(record: BakeRecord) -> list[str]:
    """The attributes of a bake to vertices."""
    return [f"{PREFIX}{i}" for i in range(attribute_count(record.terms))] + ([LAMPS] if record.lamps else [])


def has_bake(obj: bpy.types.Object | None) -> bool:
    """Whether the object's mesh carries a bake. Cheap enough to ask while drawing."""
    return obj is not None and obj.type == "MESH" and isinstance(obj.data.get(RECORD), str)


def write_transfer(obj: bpy.types.Object, elements: NDArray[np.int32], transfer: Transfer) -> None:
    """Store a bake on the object's mesh in place of any earlier one.

    Args:
        elements: (E,) of the mesh as it was read from `obj` for this bake.
        transfer: coefficients (N, K) of its points, and their record.
    Raises:
        UserError: the mesh has changed since it was read, is in Edit Mode, or has attributes of
            these names that no bake made.
    """
    data = obj.data
    _check_mode(obj)
    domain = transfer.record.domain
    if len(elements) != len(data.vertices if domain == POINT else data.loops):
        raise UserError(f"'{obj.name}' was changed while it was being baked; bake again.")
    names = attribute_names(transfer.record)
    there = {*data.attributes.keys(), *obj.vertex_groups.keys()}  # groups share the name space
    taken = sorted((set(names) - set(_own_attributes(data))) & there)
    if taken:
        raise UserError(f"'{obj.name}' has an attribute or vertex group '{taken[0]}' that no bake of it made; "
                        "rename or remove it to bake.")
    discard(data)
    chosen = _chosen_attributes(data)
    terms = transfer.record.terms
    flat = transfer.coefficients.reshape(len(transfer.coefficients), terms)
    parts = [flat[:, start:start + CHANNELS] for start in range(0, terms, CHANNELS)]
    if transfer.irradiance is not None:
        parts.append(transfer.irradiance)
    values = np.zeros((len(elements), CHANNELS), np.float32)
    for name, part in zip(names, parts, strict=True):
        width = part.shape[1]
        values[:, :width] = part[elements]
        values[:, width:] = 0
        attribute = data.attributes.new(name, "FLOAT_COLOR", domain)
        attribute.data.foreach_set("color", values.ravel())
    _choose_attributes(data, chosen)
    data[RECORD] = transfer.record.to_json()
    data.update_tag()


def write_textures(obj: bpy.types.Object, transfer: TextureTransfer, *, own_uv: bool, folder: Path | None, half: bool,
                   images: Sequence[bpy.types.Image] = ()) -> None:
    """Store a texture bake on the object's mesh in place of any earlier bake.

    Args:
        own_uv: the UVs are an atlas of the bake's own, which becomes a UV map of the mesh.
        folder, half: see `images.make_images`. images: of a texture that is shared, instead.
    Raises:
        UserError: as `write_transfer`, or the files or the UV map cannot be made; nothing has changed then.
    """
    data = obj.data
    _check_mode(obj)
    if len(transfer.uv) != len(data.loops):
        raise UserError(f"'{obj.name}' was changed while it was being baked; bake again.")
    if own_uv:
        check_room(data)
    images = images or make_images(obj.name, transfer, folder, half, owners=[data])
    discard(data, keep_uv=not own_uv)  # it may be the one that is baked to
    uv_map = write_own_uv(data, transfer.uv) if own_uv else transfer.record.uv_map
    attach(data, images)
    data[RECORD] = replace(transfer.record, uv_map=uv_map).to_json()
    data.update_tag()


def _check_mode(obj: bpy.types.Object) -> None:
    """UserError in Edit Mode, also that of another object with the same mesh."""
    if obj.data.is_editmode:
        raise UserError(f"'{obj.name}' is in Edit Mode, which would discard the bake; "
                        "leave Edit Mode and bake again.")


def read_transfer(obj: bpy.types.Object) -> tuple[NDArray[np.float32], BakeRecord]:
    """The bake on the object's mesh: (E, K) or (E, K, 3) of each vertex or face corner, and the record.

    Raises:
        UserError: there is no bake, or it is damaged.
    """
    record = read_record(obj)
    data = obj.data
    if record.domain == TEXEL:
        raise UserError(f"'{obj.name}' is baked to textures, not to its vertices.")
    check_whole(data, record)
    elements = len(data.vertices if record.domain == POINT else data.loops)
    columns = []
    for index in range(attribute_count(record.terms)):
        values = np.empty((elements, CHANNELS), np.float32)
        data.attributes[f"{PREFIX}{index}"].data.foreach_get("color", values.ravel())
        columns.append(values)
    found = np.concatenate(columns, axis=1)[:, :record.terms]
    return found if record.colours == 1 else found.reshape(elements, -1, record.colours), record


def check_whole(data: bpy.types.Mesh, record: BakeRecord) -> None:
    """UserError unless the mesh still has all attributes or images of its bake."""
    if record.domain == TEXEL:
        bake_images(data, record)
        return
    elements = len(data.vertices if record.domain == POINT else data.loops)
    for name in attribute_names(record):
        attribute = data.attributes.get(name)
        whole = (attribute is not None and attribute.data_type == "FLOAT_COLOR"
                 and attribute.domain == record.domain and len(attribute.data) == elements)
        if not whole:
            raise UserError(f"The bake of '{data.name}' has lost its attribute '{name}'; bake again.")


def read_record(obj: bpy.types.Object) -> BakeRecord:
    """The record of the bake on the object's mesh. Raises UserError where there is none or it is damaged."""
    if not has_bake(obj):
        raise UserError(f"'{obj.name}' has not been baked." if obj else "No object is active.")
    return BakeRecord.from_json(obj.data[RECORD])


def clear(obj: bpy.types.Object) -> None:
    """Remove the bake from the object's mesh, and nothing else."""
    discard(obj.data)


def discard(data: bpy.types.Mesh, keep_uv: bool = False) -> None:
    """`clear` for a mesh. Without a record nothing is removed, as nothing says who made it.

    keep_uv: leave the UV map that the bake made, which stays the bake's.
    """
    if RECORD not in data:
        return
    chosen = _chosen_attributes(data)
    for name in _own_attributes(data):
        data.attributes.remove(data.attributes[name])  # by name: removing moves the others in memory
    _choose_attributes(data, chosen)
    if not keep_uv:
        remove_own_uv(data)
    detach(data)
    discard_bounces(data)
    del data[RECORD]
    data.pop(SEQUENCE, None)
    data.update_tag()


def _own_attributes(data: bpy.types.Mesh) -> list[str]:
    """Names of the attributes that the bake on a mesh made: as many as its record says, of the kind that bakes make."""
    if RECORD not in data:
        return []
    try:
        record = BakeRecord.from_json(data[RECORD])
        names = [] if record.domain == TEXEL else attribute_names(record)
    except UserError:
        names = [*(f"{PREFIX}{i}" for i in range(attribute_count(3 * MAX_ORDER ** 2))), LAMPS]
    return [name for name in names
            if name in data.attributes and data.attributes[name].data_type == "FLOAT_COLOR"]


def _chosen_attributes(data: bpy.types.Mesh) -> tuple[str, str, str]:
    """Names of the attributes that are active, painted on, and rendered as 'the' vertex colour."""
    attributes = data.attributes
    active = attributes.active
    return active.name if active else "", attributes.active_color_name, attributes.default_color_name


def _choose_attributes(data: bpy.types.Mesh, chosen: tuple[str, str, str]) -> None:
    """Restore what `_chosen_attributes` gave: Blender makes a mesh's first colour attribute all three."""
    attributes = data.attributes
    active, painted, rendered = chosen
    attributes.active_color_name = painted if not _OURS.fullmatch(painted) else ""
    attributes.default_color_name = rendered if not _OURS.fullmatch(rendered) else ""
    if active in attributes:
        attributes.active = attributes[active]
