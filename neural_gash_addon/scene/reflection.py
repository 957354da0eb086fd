# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake to be made needs to know of the materials that light bounces off."""
from __future__ import annotations

import bpy

from ..backend.bounce import Reflection
from ..backend.errors import UserError
from .attributes import attribute_count
from .preview import EEVEE_ATTRIBUTES
from .read import read_finish


def read_reflection(obj: bpy.types.Object, mode: str, depsgraph: bpy.types.Depsgraph, bounces: int) -> Reflection:
    """The albedo of an object and of its occluders (`read_occluders`), for some bounces. Raises UserError."""
    finish, pictures = read_finish(obj, mode, depsgraph)
    return Reflection(finish[:, :3], bounces, pictures)


def check_attributes(order: int) -> None:
    """UserError where a bake with bounces to vertices takes more attributes than EEVEE draws."""
    if attribute_count(3 * order ** 2) > EEVEE_ATTRIBUTES:
        raise UserError(f"With bounces, an order-{order} bake takes more than the {EEVEE_ATTRIBUTES} "
                        "attributes that EEVEE draws; choose order 4 or less, or bake to a texture.")
