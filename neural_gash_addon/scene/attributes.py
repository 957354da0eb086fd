# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a bake lives on a mesh: attributes `_prt_0`, `_prt_1`, … and the record beside them.

Attribute i holds coefficients 4i..4i+3 as red, green, blue, alpha of a FLOAT_COLOR: float32,
signed, exact, and four of them for one of the 14 attributes that EEVEE can draw. The leading
underscore makes the glTF exporter carry them.
"""
from __future__ import annotations

import re

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import UserError
from ..backend.geometry import POINT, TriangleMesh
from ..backend.record import BakeRecord
from ..backend.transfer import Transfer

RECORD = "neural_gash"  # custom property on the mesh
PREFIX = "_prt_"
CHANNELS = 4
_OURS = re.compile(rf"{PREFIX}\d+")


def attribute_count(order: int) -> int:
    """How many attributes the order**2 coefficients take."""
    return -(-order * order // CHANNELS)


def has_bake(obj: bpy.types.Object | None) -> bool:
    """Whether the object's mesh carries a bake. Cheap enough to ask while drawing."""
    return obj is not None and obj.type == "MESH" and isinstance(obj.data.get(RECORD), str)


def write_transfer(obj: bpy.types.Object, mesh: TriangleMesh, transfer: Transfer) -> None:
    """Store a bake on the object's mesh in place of any earlier one.

    Args:
        mesh: the mesh as it was read from `obj` for this bake.
        transfer: coefficients (N, K) of its points, and their record.
    Raises:
        UserError: the mesh has changed since it was read, is in Edit Mode, or has attributes of
            these names that no bake made.
    """
    data = obj.data
    if obj.mode == "EDIT":
        raise UserError(f"'{obj.name}' is in Edit Mode, which would discard the bake; "
                        "leave Edit Mode and bake again.")
    if len(mesh.elements) != len(data.vertices if mesh.domain == POINT else data.loops):
        raise UserError(f"'{obj.name}' was changed while it was being baked; bake again.")
    count = attribute_count(transfer.record.order)
    if RECORD not in data:
        taken = [n for n in (f"{PREFIX}{i}" for i in range(count)) if n in data.attributes]
        if taken:
            raise UserError(f"'{obj.name}' has an attribute '{taken[0]}' that no bake of it made; "
                            "rename or remove it to bake.")
    discard(data)
    chosen = _chosen_attributes(data)
    terms = transfer.coefficients.shape[1]
    values = np.zeros((len(mesh.elements), CHANNELS), np.float32)
    for index in range(count):
        part = transfer.coefficients[:, CHANNELS * index:CHANNELS * (index + 1)]
        width = min(CHANNELS, terms - CHANNELS * index)
        values[:, :width] = part[mesh.elements]
        values[:, width:] = 0
        attribute = data.attributes.new(f"{PREFIX}{index}", "FLOAT_COLOR", mesh.domain)
        attribute.data.foreach_set("color", values.ravel())
    _choose_attributes(data, chosen)
    data[RECORD] = transfer.record.to_json()
    data.update_tag()


def read_transfer(obj: bpy.types.Object) -> tuple[NDArray[np.float32], BakeRecord]:
    """The bake on the object's mesh: (E, K) coefficients of each vertex or face corner, and the record.

    Raises:
        UserError: there is no bake, or it is damaged.
    """
    record = read_record(obj)
    data = obj.data
    elements = len(data.vertices if record.domain == POINT else data.loops)
    columns = []
    for index in range(attribute_count(record.order)):
        attribute = data.attributes.get(f"{PREFIX}{index}")
        whole = (attribute is not None and attribute.data_type == "FLOAT_COLOR"
                 and attribute.domain == record.domain and len(attribute.data) == elements)
        if not whole:
            raise UserError(f"The bake of '{obj.name}' has lost its attribute '{PREFIX}{index}'; bake again.")
        values = np.empty((elements, CHANNELS), np.float32)
        attribute.data.foreach_get("color", values.ravel())
        columns.append(values)
    return np.concatenate(columns, axis=1)[:, :record.order ** 2], record


def read_record(obj: bpy.types.Object) -> BakeRecord:
    """The record of the bake on the object's mesh. Raises UserError where there is none or it is damaged."""
    if not has_bake(obj):
        raise UserError(f"'{obj.name}' has not been baked." if obj else "No object is active.")
    return BakeRecord.from_json(obj.data[RECORD])


def clear(obj: bpy.types.Object) -> None:
    """Remove the bake from the object's mesh, and nothing else."""
    discard(obj.data)


def discard(data: bpy.types.Mesh) -> None:
    """`clear` for a mesh. Without a record nothing is removed, as nothing says who made it."""
    if RECORD not in data:
        return
    chosen = _chosen_attributes(data)
    for name in [a.name for a in data.attributes if _OURS.fullmatch(a.name) and a.data_type == "FLOAT_COLOR"]:
        data.attributes.remove(data.attributes[name])  # by name: removing moves the others in memory
    _choose_attributes(data, chosen)
    del data[RECORD]
    data.update_tag()


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
