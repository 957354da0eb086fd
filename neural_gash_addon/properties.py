# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings that a person edits, on the scene: `scene.neural_gash`."""
from __future__ import annotations

import math

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty

from .backend.estimator import MAX_RAYS
from .backend.methods import METHODS, MIN_ORDER, MIN_TOLERANCE
from .backend.spherical_harmonics import MAX_ORDER
from .scene.lighting import apply_light
from .scene.read import SELF, VISIBLE

RAYS, TOLERANCE, COLLECTION = "RAYS", "TOLERANCE", "COLLECTION"


def _light_changed(settings: NeuralGashSettings, _context: bpy.types.Context) -> None:
    """A light slider moved: only the light constants of the previews change."""
    apply_light(settings.id_data)


class NeuralGashSettings(bpy.types.PropertyGroup):
    """Settings of the next bake, and the light of the previews."""

    method: EnumProperty(  # type: ignore[valid-type]
        name="Method", description="How the transfer is computed", default="embree",
        items=[(m.name, m.label, m.description) for m in METHODS.values()])
    order: IntProperty(  # type: ignore[valid-type]
        name="Order", default=3, min=MIN_ORDER, max=MAX_ORDER,
        description="Bands of spherical harmonics: more give crisper shadows and take more memory "
                    "(order n stores n x n numbers for each point)")
    quality: EnumProperty(  # type: ignore[valid-type]
        name="Quality", description="What decides how long to trace", default=TOLERANCE,
        items=[(TOLERANCE, "Tolerance", "Trace until the error is as small as asked for, and no longer"),
               (RAYS, "Rays", "Trace the same number of rays from every point")])
    tolerance: FloatProperty(  # type: ignore[valid-type]
        name="Tolerance", default=0.02, min=MIN_TOLERANCE, max=1.0, soft_min=0.002, soft_max=0.2, precision=4,
        description="Error to reach, as a part of the whole: 0.02 is 2 percent. Half of it takes about two and "
                    "a half times as long")
    rays: IntProperty(  # type: ignore[valid-type]
        name="Rays", default=256, min=1, max=16 * MAX_RAYS, soft_max=MAX_RAYS,
        description="Rays to trace from every point")
    occluders: EnumProperty(  # type: ignore[valid-type]
        name="Occluders", description="What casts shadows on the object", default=SELF,
        items=[(SELF, "Itself", "Only the object shadows itself"),
               (VISIBLE, "Visible Objects", "Everything visible in the viewport and in renders casts shadows"),
               (COLLECTION, "Collection", "The objects of a collection cast shadows")])
    collection: PointerProperty(  # type: ignore[valid-type]
        name="Collection", description="Whose objects cast shadows", type=bpy.types.Collection)
    light_rotation: FloatProperty(  # type: ignore[valid-type]
        name="Rotation", default=0.0, subtype="ANGLE", soft_min=-math.pi, soft_max=math.pi,
        description="Turn the light of the previews about the vertical axis", update=_light_changed)
    light_strength: FloatProperty(  # type: ignore[valid-type]
        name="Strength", default=1.0, min=0.0, soft_max=10.0,
        description="Brighten or dim the light of the previews", update=_light_changed)
    soften: BoolProperty(  # type: ignore[valid-type]
        name="Reduce Ringing", default=False, update=_light_changed,
        description="Damp the dark and bright rings that a small bright light leaves at low orders; "
                    "this also softens the light a little")

    def occluder_mode(self) -> str:
        """'SELF', 'VISIBLE' or the name of the collection; '' where a collection is wanted and none is chosen."""
        if self.occluders != COLLECTION:
            return self.occluders
        return self.collection.name if self.collection else ""


def register() -> None:
    """Make the settings available on every scene."""
    bpy.utils.register_class(NeuralGashSettings)
    bpy.types.Scene.neural_gash = PointerProperty(type=NeuralGashSettings)


def unregister() -> None:
    """Remove them."""
    del bpy.types.Scene.neural_gash
    bpy.utils.unregister_class(NeuralGashSettings)
