# SPDX-License-Identifier: GPL-3.0-or-later
"""The lamps of a batch of bakes, as its settings have them traced."""
from __future__ import annotations

import bpy

from ..backend.lamps import Lamps
from ..properties import CHEAPEST, NETWORK, PATHS, TEXTURE, NeuralGashSettings
from ..scene.lamps import LitScenes

_LEARNED = {CHEAPEST: None, PATHS: False, NETWORK: True}


class LampReader:
    """What lights the objects of a batch; one for all that see the same, which share its preparations."""

    def __init__(self, depsgraph: bpy.types.Depsgraph, settings: NeuralGashSettings) -> None:
        self._how = {**(settings.tracing() or {"tolerance": settings.tolerance}),
                     "learned": _LEARNED[settings.lamps_by],
                     "order": settings.order if settings.gloss and settings.target == TEXTURE else 1}
        self._scenes = LitScenes(depsgraph)
        self._known: dict[str, Lamps] = {}

    def of(self, obj: bpy.types.Object) -> Lamps:
        """The lamps of an object. Raises UserError as `read_lamps`."""
        scene, key, notice = self._scenes.of(obj)
        return self._known.setdefault(key, Lamps(scene, key, notice, **self._how))
