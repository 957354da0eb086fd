# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: read the scene, call the backend, write the result."""
import bpy

from . import state
from .bake import NEURAL_GASH_OT_bake, NEURAL_GASH_OT_bake_applied_copy
from .compare import NEURAL_GASH_OT_compare
from .confidence import NEURAL_GASH_OT_show_confidence
from .gloss_bounce import NEURAL_GASH_OT_bake_gloss
from .preset import NEURAL_GASH_OT_preset
from .preview import NEURAL_GASH_OT_clear, NEURAL_GASH_OT_preview, NEURAL_GASH_OT_read_light
from .sequence import NEURAL_GASH_OT_bake_sequence
from .view import NEURAL_GASH_OT_show_errors

CLASSES = (NEURAL_GASH_OT_bake, NEURAL_GASH_OT_bake_applied_copy, NEURAL_GASH_OT_clear, NEURAL_GASH_OT_preview,
           NEURAL_GASH_OT_read_light, NEURAL_GASH_OT_bake_gloss, NEURAL_GASH_OT_compare, NEURAL_GASH_OT_preset,
           NEURAL_GASH_OT_show_errors, NEURAL_GASH_OT_bake_sequence, NEURAL_GASH_OT_show_confidence)


def register() -> None:
    """Register the operators."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Unregister them, and stop a bake that runs."""
    state.abandon()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
