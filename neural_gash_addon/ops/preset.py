# SPDX-License-Identifier: GPL-3.0-or-later
"""Draft, Good and Final: tolerances by name."""
from __future__ import annotations

import math

import bpy
from bpy.props import EnumProperty

from ..backend.methods import METHODS
from ..properties import TOLERANCE, NeuralGashSettings

# Medians of the chart (docs/chart.md, order 3). Ray traced needs some 20 rays a point for 0.1, and the first 32 are all
# but free, so a looser draft would save nothing. 0.02 takes some 150 rays and twice the time; relit, it is 1.6 % off,
# which few see. 0.005 takes some 1,000 rays and eight times the time of 64; relit, its 0.4 % are about a step of an
# 8-bit picture.
PRESETS = {"DRAFT": ("Draft", 0.1, "Quick, to look at: an error of 10 percent, seen as soft noise in shadows"),
           "GOOD": ("Good", 0.02, "For work: an error of 2 percent, hard to see"),
           "FINAL": ("Final", 0.005, "For what is kept: half a percent; takes some five times as long as Good")}


def preset_in_force(settings: NeuralGashSettings) -> str:
    """The preset that the settings are; '' with rays, a method that traces none, or a tolerance of one's own."""
    if settings.quality != TOLERANCE or not METHODS[settings.method].traces:
        return ""
    return next((name for name, (_, tolerance, _) in PRESETS.items()
                 if math.isclose(settings.tolerance, tolerance, rel_tol=1e-6)), "")  # the setting is a float32


class NEURAL_GASH_OT_preset(bpy.types.Operator):
    """Set the error that bakes are traced to"""

    bl_idname = "neural_gash.preset"
    bl_label = "Quality"
    bl_options = {"REGISTER", "UNDO"}

    preset: EnumProperty(  # type: ignore[valid-type]
        name="Quality", description="Which error to trace to", default="GOOD",
        items=[(name, label, description) for name, (label, _, description) in PRESETS.items()])

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for methods that trace rays."""
        traces = METHODS[context.scene.neural_gash.method].traces
        if not traces:
            cls.poll_message_set("The method traces no rays, so there is no tolerance to set.")
        return traces

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """The preset's own hover text."""
        return PRESETS[properties.preset][2]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Set quality and tolerance."""
        settings = context.scene.neural_gash
        settings.quality, settings.tolerance = TOLERANCE, PRESETS[self.preset][1]
        return {"FINISHED"}
