# SPDX-License-Identifier: GPL-3.0-or-later
"""What the previews show beside the bake under the light: what the bake holds, and where a comparison found errors."""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend import light as sh_light
from ..backend import spherical_harmonics as sh
from ..backend.record import BakeRecord
from .comparison import ERRORS
from .preview import turn_since

LIT, OCCLUSION, COEFFICIENT = "LIT", "OCCLUSION", "COEFFICIENT"
_SHADING = "neural_gash_shading"     # custom properties of a screen: how its viewports were shaded before errors
_ACTIVE = "neural_gash_active_color"  # custom property of a mesh: the colours that were active before its errors


def view_light(obj: bpy.types.Object, record: BakeRecord, view: str, coefficient: int,
               depsgraph: bpy.types.Depsgraph | None = None) -> NDArray[np.float64]:
    """The light (K, 3), in world axes, under which the preview of `obj` shows a part of its bake.

    Ambient occlusion is a white sky of radiance 1. A coefficient k is a light of that one alone, of the bake's own
    axes, red where the coefficient is positive and blue where it is negative, and as strong as the white sky:
    sqrt(4 pi) times the coefficient is shown, so that of k = 0 the ambient occlusion is. No light where the bake
    has no such coefficient.
    """
    terms = record.order ** 2
    if view == OCCLUSION:
        return sh_light.constant(np.ones(3), record.order)
    light = np.zeros((terms, 3))
    if coefficient < terms:
        light[coefficient] = np.sqrt(4 * np.pi) * np.array([1.0, 0.0, -1.0])
    return sh.rotate(light, turn_since(obj, record, depsgraph).T)


def has_errors(obj: bpy.types.Object | None) -> bool:
    """Whether a comparison left its errors on the mesh."""
    return isinstance(data := obj and obj.data, bpy.types.Mesh) and ERRORS in data.color_attributes


def shows_errors(obj: bpy.types.Object | None, space: bpy.types.Space | None) -> bool:
    """Whether a viewport shows the errors of a comparison on `obj`. Cheap enough to ask while drawing."""
    return (space is not None and space.type == "VIEW_3D" and obj is not None and has_errors(obj)
            and (space.shading.type, space.shading.color_type) == ("SOLID", "VERTEX")
            and obj.data.color_attributes.active_color_name == ERRORS)


def show_errors(obj: bpy.types.Object, screen: bpy.types.Screen, area: bpy.types.Area) -> None:
    """Show the errors of a comparison on `obj` in a viewport: Solid shading, coloured by the attribute."""
    shading, colours = area.spaces.active.shading, obj.data.color_attributes
    if (shading.type, shading.color_type) != ("SOLID", "VERTEX"):  # else it may show another object's errors
        screen[_key(screen, area)] = f"{shading.type} {shading.color_type}"
    if colours.active_color_name != ERRORS:
        obj.data[_ACTIVE] = colours.active_color_name
    shading.type, shading.color_type = "SOLID", "VERTEX"
    colours.active_color_name = ERRORS


def hide_errors(obj: bpy.types.Object, screen: bpy.types.Screen, area: bpy.types.Area) -> None:
    """Give a viewport and the mesh of `obj` back what they showed before `show_errors`.

    A viewport that showed errors before anybody asked for them here gets Blender's own Solid shading.
    """
    shading = area.spaces.active.shading
    shading.type, shading.color_type = screen.pop(_key(screen, area), "SOLID MATERIAL").split()
    active = obj.data.pop(_ACTIVE, "")
    if active in obj.data.color_attributes:
        obj.data.color_attributes.active_color_name = active


def _key(screen: bpy.types.Screen, area: bpy.types.Area) -> str:
    """The custom property of a screen that keeps how one of its viewports was shaded."""
    return f"{_SHADING} {list(screen.areas).index(area)}"
