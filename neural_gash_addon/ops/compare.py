# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that compares all methods on the active mesh: a chart of error against time, and errors as colours."""
from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from bpy.props import StringProperty
from numpy.typing import NDArray

from ..backend import compare, costs
from ..backend.compare import Measurement, Reference, Setting
from ..backend.compare_picture import heat, picture, spread
from ..backend.errors import UserError
from ..backend.geometry import TriangleMesh
from ..backend.methods import METHODS, candidates
from ..backend.neighbours import neighbours
from ..backend.progress import scaled
from ..backend.raycast import Geometry
from ..backend.workers import default_threads
from ..properties import RAYS, NeuralGashSettings
from ..scene.comparison import check_chart, check_errors, save_chart, show, write_chart, write_errors
from ..scene.environments import shipped_environments
from ..scene.read import fingerprint, read_object, read_occluders, same_fingerprint
from .bake import Baking, bake_refusal
from .job import occluder_mode, percent

_RAYS = (2, 8, 32, 128)
_TOLERANCES = (0.1, 0.05, 0.02)  # of the planner
_POINTS = 8192        # of the mesh, or all, at which errors are measured
_ROUNDS = 2
_SEED, _REFERENCE_SEED = 0, 77
_SHARE = 0.5          # of the progress: the reference
_MOST = 0.99          # of the points whose errors the heat map tells apart

Found = tuple[Reference, list[Measurement]]


@dataclass(frozen=True, eq=False)
class _Job:
    """What was read from the scene, and the comparison, not begun."""

    uid: int
    names: list[str]
    mesh: TriangleMesh
    occluders: str
    fingerprint: str
    chosen: Setting
    baking: Generator[float, None, Found]


def _chosen(settings: NeuralGashSettings) -> Setting:
    """What the panel is set to."""
    if not METHODS[settings.method].traces:
        return Setting(settings.method, settings.order)
    by_rays = settings.quality == RAYS
    return Setting(settings.method, settings.order, settings.rays if by_rays else None,
                   None if by_rays else round(settings.tolerance, 6))  # which Blender keeps in 32 bits


def _compared(mesh: TriangleMesh, occluders: Sequence[Geometry], chosen: Setting, lights: Sequence[NDArray]
              ) -> Generator[float, None, Found]:
    """The arrays of it all; never touches bpy."""
    rows = compare.sample(len(mesh.points), _POINTS, _REFERENCE_SEED)
    truth = yield from scaled(compare.reference(mesh, chosen.order, rows, occluders, _REFERENCE_SEED), 0, _SHARE)
    settings = [*compare.settings_of(chosen.order, _RAYS, tolerances=_TOLERANCES), compare.baseline(chosen.order),
                chosen]
    # where the machine is not calibrated yet, not while the planner is timed
    yield from scaled(costs.ways(candidates(), default_threads(), len(mesh.points)), _SHARE, 0)
    work = compare.compare(compare.vertex_bake(mesh, occluders), settings, truth, lights, _ROUNDS, _SEED)
    return truth, (yield from scaled(work, _SHARE, 1 - _SHARE))


class NEURAL_GASH_OT_compare(Baking, bpy.types.Operator):
    """Try every method on the active mesh: draw error against time, and colour the mesh by the chosen method's error"""

    bl_idname = "neural_gash.compare"
    bl_label = "Compare Methods on This Mesh"
    bl_options = {"REGISTER", "UNDO"}

    _doing = "comparing methods on"

    filepath: StringProperty(  # type: ignore[valid-type]
        name="File", default="", subtype="FILE_PATH", options={"SKIP_SAVE"},
        description="Where to save the chart as a PNG picture as well; leave empty to keep it in the .blend file only")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """As Bake."""
        reason = bake_refusal(context)
        if reason:
            cls.poll_message_set(reason)
        return not reason

    def _prepare(self, context: bpy.types.Context,
                 _tiles: Callable[[bpy.types.Object], Path | None] = lambda _: None) -> _Job:
        obj, settings = context.object, context.scene.neural_gash
        depsgraph = context.evaluated_depsgraph_get()
        read = read_object(obj, depsgraph)
        check_errors(obj)
        if self.filepath:
            check_chart(Path(bpy.path.abspath(self.filepath)))
        mode = occluder_mode(obj, settings, [obj])
        chosen = _chosen(settings)
        baking = _compared(read.mesh, read_occluders(obj, mode, depsgraph), chosen,
                           list(shipped_environments().values()))
        return _Job(obj.session_uid, [obj.name], read.mesh, mode, fingerprint(obj, depsgraph, mode), chosen, baking)

    def _finish(self, context: bpy.types.Context, job: _Job, found: Found) -> set[str]:
        truth, measured = found
        obj = next((o for o in bpy.data.objects if o.session_uid == job.uid), None)
        if obj is None:
            raise UserError(f"'{job.names[0]}' was deleted during the comparison.")
        if not same_fingerprint(fingerprint(obj, context.evaluated_depsgraph_get(), job.occluders), job.fingerprint):
            raise UserError(f"'{obj.name}' or what shadows it was changed during the comparison; compare again.")
        shown = next(m for m in measured if m.setting == job.chosen)
        if shown.errors is None:
            raise UserError(shown.refused)
        most = float(np.quantile(shown.errors, _MOST)) or 1.0
        errors = spread(shown.errors, truth.rows, neighbours(job.mesh))
        floor = truth.floor([])["rel_l2"]
        pixels = picture(measured, len(job.mesh.points), floor, f"Methods on '{obj.name}': {len(job.mesh.points):,} "
                         f"points, order {job.chosen.order}", shown, most)
        check_errors(obj)
        image = write_chart(pixels)
        if self.filepath:
            save_chart(image, Path(bpy.path.abspath(self.filepath)))
        write_errors(obj, job.mesh, heat(errors / most))
        show(context, image)
        self.report({"INFO"}, _summary(measured, shown, context.scene.neural_gash.tolerance))
        return {"FINISHED"}


def _summary(measured: Sequence[Measurement], shown: Measurement, tolerance: float) -> str:
    """One sentence: the chosen one, and the quickest that is good enough."""
    text = (f"Compared {sum(bool(m.seconds) for m in measured)} settings; {shown.setting.name}: {shown.median:.2g} s, "
            f"error {percent(shown.rel_l2)}")
    enough = [m for m in measured if m.seconds and (m.rel_l2 <= tolerance or np.isnan(m.rel_l2))]
    if not enough:
        return f"{text}; none of them is within {percent(tolerance)}."
    best = min(enough, key=lambda m: m.median)
    return f"{text}; quickest within {percent(tolerance)}: {best.setting.name}, {best.median:.2g} s."
