# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that shows how sure the bake is of each point."""
from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend import spherical_harmonics as sh
from ..backend.compare_picture import heat
from ..backend.doubt import doubt
from ..backend.errors import UserError
from ..backend.geometry import TEXEL, TriangleMesh
from ..backend.methods import METHODS
from ..backend.record import BakeRecord
from ..scene import staleness
from ..scene.attributes import has_bake, read_record, read_transfer
from ..scene.comparison import check_errors, write_errors
from ..scene.read import read_object, read_occluders
from ..scene.views import show_errors
from .bake import Baking, bake_refusal
from .job import percent

_MOST = 0.99  # of the points whose errors the heat map tells apart


@dataclass(frozen=True, eq=False)
class _Job:
    """What was read from the scene, and the work, not begun."""

    uid: int
    names: list[str]
    mesh: TriangleMesh
    record: BakeRecord
    energy: float
    baking: Generator[float, None, NDArray[np.float64]]


def _quality(record: BakeRecord) -> dict[str, Any]:
    """How long a bake was traced: to its tolerance, or with as many rays as it took."""
    if not METHODS[record.method].traces:
        return {}
    if record.tolerance is not None:
        return {"tolerance": record.tolerance}
    return {"rays": max(1, round(record.rays_per_point))}


class NEURAL_GASH_OT_show_confidence(Baking, bpy.types.Operator):
    """Bake the active mesh again with other rays and turned axes, and show where the two differ: dark is sure"""

    bl_idname = "neural_gash.show_confidence"
    bl_label = "Confidence"
    bl_options = {"REGISTER", "UNDO"}

    _doing = "baking again"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is a bake to vertices, of direct light."""
        reason, obj = bake_refusal(context), context.object
        if not reason and not has_bake(obj):
            reason = f"'{obj.name}' has not been baked."
        if reason:
            cls.poll_message_set(reason)
        return not reason

    def _prepare(self, context: bpy.types.Context,
                 _tiles: Callable[[bpy.types.Object], Path | None] = lambda _: None) -> _Job:
        obj = context.object
        record = read_record(obj)
        if record.domain == TEXEL or record.colours != 1 or record.method not in METHODS:
            raise UserError(f"Confidence is for bakes to vertices without bounces, which that of '{obj.name}' is not.")
        check_errors(obj)
        depsgraph = context.evaluated_depsgraph_get()
        if not staleness.same(obj, record, depsgraph):
            raise UserError(f"'{obj.name}' has changed since the bake; bake it first.")
        read = read_object(obj, depsgraph)
        values, _ = read_transfer(obj)
        baked = np.zeros((len(read.mesh.points), record.order ** 2), np.float32)
        baked[read.mesh.elements] = values
        # the bake's own axes: the object may have been turned since
        work = doubt(read.mesh, _in_world(baked, record, read.frame), record.method,
                     read_occluders(obj, record.occluders, depsgraph), record.seed + 1, **_quality(record))
        energy = float(np.sqrt(np.square(baked).sum(1).mean())) or 1.0
        return _Job(obj.session_uid, [obj.name], read.mesh, record, energy, work)

    def _finish(self, context: bpy.types.Context, job: _Job, found: NDArray[np.float64]) -> set[str]:
        obj = next((o for o in bpy.data.objects if o.session_uid == job.uid), None)
        if obj is None:
            raise UserError(f"'{job.names[0]}' was deleted meanwhile.")
        most = float(np.quantile(found, _MOST)) or 1.0
        write_errors(obj, job.mesh, heat(found / most))
        if context.area is not None and context.area.type == "VIEW_3D":
            show_errors(obj, context.screen, context.area)
        error = float(np.sqrt(np.square(found).mean())) / job.energy
        self.report({"INFO"}, f"Standard error {percent(error)} of the whole; the brightest points have "
                              f"{percent(most / job.energy)}.")
        return {"FINISHED"}


def _in_world(baked: NDArray, record: BakeRecord, frame: tuple[float, ...]) -> NDArray:
    """Coefficients (N, K) of a bake in the axes of the world, for an object that stands in another frame now."""
    turn = np.array(frame).reshape(3, 3) @ np.array(record.frame).reshape(3, 3).T
    if np.allclose(turn, np.eye(3), atol=1e-6):
        return baked
    return sh.rotate_each(baked, np.broadcast_to(turn, (len(baked), 3, 3)))
