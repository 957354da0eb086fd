# SPDX-License-Identifier: GPL-3.0-or-later
"""Draft, Good, Final: how good the next bake is to be, in one click."""
from __future__ import annotations

import math

import bpy
from bpy.props import EnumProperty

from ..backend.methods import METHODS
from ..properties import TOLERANCE, NeuralGashSettings

# Errors to reach, as parts of the whole. Half the error takes some two and a half times as long, so from one to the
# next it is about eight and six times; less on small meshes, where rays are not what takes time.
PRESETS = {"DRAFT": ("Draft", 0.1, "quick, to look at while working"),
           "GOOD": ("Good", 0.02, "for most scenes"),
           "FINAL": ("Final", 0.005, "for close looks and strong lights")}


def in_force(settings: NeuralGashSettings) -> str:
    """Which preset the settings are; '' for a tolerance of one's own, or rays."""
    if settings.quality == TOLERANCE:
        for name, (_, tolerance, _) in PRESETS.items():
            if math.isclose(settings.tolerance, tolerance, rel_tol=1e-5):  # Blender keeps float32
                return name
    return ""


class NEURAL_GASH_OT_preset(bpy.types.Operator):
    """Set how good the next bake is to be"""

    bl_idname = "neural_gash.preset"
    bl_label = "Preset"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}

    preset: EnumProperty(  # type: ignore[valid-type]
        name="Preset", description="How good the next bake is to be", default="GOOD",
        items=[(name, label, f"Errors of {100 * tolerance:g} percent: {text}")
               for name, (label, tolerance, text) in PRESETS.items()])

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """Of the button that is pointed at."""
        _, tolerance, text = PRESETS[properties.preset]
        return f"Bake until errors are {100 * tolerance:g} percent of the whole: {text}"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The method can be told how exact to be."""
        method = METHODS[context.scene.neural_gash.method]
        if not method.traces:
            cls.poll_message_set(f"The method '{method.label}' is as exact as it is; there is nothing to set.")
        return method.traces

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Set the tolerance."""
        settings = context.scene.neural_gash
        settings.quality, settings.tolerance = TOLERANCE, PRESETS[self.preset][1]
        return {"FINISHED"}
