# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that bakes what glossy surfaces show of each other, for the light as it is."""
from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from bpy.props import IntProperty
from numpy.typing import NDArray

from ..backend import spherical_harmonics as sh
from ..backend.errors import UserError
from ..backend.gloss_bounce import Finish, bake
from ..backend.record import BakeRecord
from ..backend.texture import TextureTransfer
from ..scene import staleness
from ..scene.attributes import has_bake, read_record
from ..scene.gloss import can_gloss
from ..scene.gloss_bounce import finish_key, folder_of, write_bounces
from ..scene.images import bake_images, make_images
from ..scene.lighting import current_light, light_object
from ..scene.normal_maps import read_normal_maps
from ..scene.preview import is_glossy, preview_on, turn_since
from ..scene.read import read_finish, read_object, read_occluders
from ..scene.uv_maps import read_uv
from . import state
from .bake import Baking

_TURNED = 1e-3  # of the turn since the bake: what cannot be seen
_MOST_HALF = 2e4  # of a bright light's; three times as much, as beside a chart, still fits 16 bits


@dataclass(frozen=True, eq=False)
class _Job:
    """What was read from the scene, and the bake of it, not begun."""

    uid: int
    names: list[str]
    record: BakeRecord
    light: NDArray   # (K, 3) in the frame of the bake
    finish: str  # `finish_key`
    lobe: str
    baking: Generator[float, None, TextureTransfer]


def _refusal(obj: bpy.types.Object | None) -> str:
    """Why there can be no glossy bounces; '' where there can."""
    if state.running:
        return "A bake is running; press Esc to cancel it."
    if obj is None or not has_bake(obj):
        return "Bake the object to a texture first." if obj else "No object is active; click a baked object."
    if obj.library or obj.data.library:
        return f"'{obj.name}' is linked from another file, where a bake cannot be stored."
    return ""


class NEURAL_GASH_OT_bake_gloss(Baking, bpy.types.Operator):
    """Bake what glossy surfaces show of each other under the light as it is, for the glossy preview"""

    bl_idname = "neural_gash.bake_gloss"
    bl_label = "Bake Glossy Bounces"
    bl_options = {"REGISTER", "UNDO"}

    bounces: IntProperty(  # type: ignore[valid-type]
        name="Bounces", default=1, min=1, max=8,
        description="How often light bounces from surface to surface before it is seen")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is a bake."""
        reason = _refusal(context.object)
        if reason:
            cls.poll_message_set(reason)
        return not reason

    def _prepare(self, context: bpy.types.Context,
                 _tiles: Callable[[bpy.types.Object], Path | None] = lambda _: None) -> _Job:
        obj = context.object
        record = read_record(obj)
        if not can_gloss(record):
            raise UserError("Glossy bounces need a bake to a texture, without bounces and lamps; bake one first.")
        if not staleness.same(obj, record, context.evaluated_depsgraph_get()):
            raise UserError(f"'{obj.name}' or what shadows it was changed since its bake; bake it again first.")
        if np.abs(turn_since(obj, record) - np.eye(3)).max() > _TURNED:
            raise UserError(f"'{obj.name}' was turned since its bake; bake it again first.")
        depsgraph = context.evaluated_depsgraph_get()
        read = read_object(obj, depsgraph)
        finish, pictures = read_finish(obj, record.occluders, depsgraph)
        light = sh.rotate(current_light(context.scene, record.order), turn_since(obj, record))
        lobe = context.scene.neural_gash.lobe
        baking = bake(read.surface, read_uv(obj.data, record.uv_map), record, light,
                      Finish(finish[:, :3], finish[:, 3:6], finish[:, 6], lobe, pictures), bounces=self.bounces,
                      occluders=read_occluders(obj, record.occluders, depsgraph),
                      normal_maps=read_normal_maps(obj, depsgraph, read.surface, read.matrix))
        return _Job(obj.session_uid, [obj.name], record, light, finish_key(finish, pictures), lobe, baking)

    def _finish(self, context: bpy.types.Context, job: _Job, transfer: TextureTransfer) -> set[str]:
        obj = next((o for o in bpy.data.objects if o.session_uid == job.uid), None)
        if obj is None:
            raise UserError(f"'{job.names[0]}' was deleted while it was being baked.")
        if read_record(obj) != job.record or not staleness.same(obj, job.record, context.evaluated_depsgraph_get()):
            raise UserError(f"'{obj.name}' or what shadows it was changed during the bake; bake again.")
        images = bake_images(obj.data, job.record)
        half = images[0].use_half_precision and all(np.abs(c).max() < _MOST_HALF for c in transfer.coefficients)
        made = make_images(obj.name, transfer, folder_of(images), half, label="prt_gloss", owners=[obj.data])
        write_bounces(obj.data, made, transfer.record, job.light, job.finish, job.lobe)
        context.scene.neural_gash.gloss = True
        if not is_glossy(obj):
            preview_on(obj, context.scene.neural_gash.lobe_shown())
        light_object(context.scene, obj)
        self.report({"INFO"}, f"Baked {transfer.record.bounces} glossy bounce"
                    f"{'s' if transfer.record.bounces > 1 else ''} in {transfer.record.seconds:.2f} s.")
        return {"FINISHED"}
