# SPDX-License-Identifier: GPL-3.0-or-later
"""The lamps of a batch of bakes, read once for all objects that are shown."""
from __future__ import annotations

import bpy

from ..backend.lamps import Lamps
from ..properties import NeuralGashSettings
from ..scene.lamps import is_shown, read_lamps


class LampReader:
    """What lights the objects of a batch."""

    def __init__(self, context: bpy.types.Context, settings: NeuralGashSettings) -> None:
        self._tracing = settings.tracing() or {"tolerance": settings.tolerance}
        self._depsgraph = context.evaluated_depsgraph_get()
        self._known: dict[int, Lamps] = {}  # session uid of an object that is hidden, or 0 of all others

    def of(self, obj: bpy.types.Object) -> Lamps:
        """The lamps of an object. Raises UserError as `read_lamps`."""
        uid = 0 if is_shown(obj, self._depsgraph) else obj.session_uid
        if uid not in self._known:
            self._known[uid] = Lamps(*read_lamps(obj, self._depsgraph), **self._tracing)
        return self._known[uid]
