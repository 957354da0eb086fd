# SPDX-License-Identifier: GPL-3.0-or-later
"""The N-panel: layout only. Nothing here reads a mesh."""
from __future__ import annotations

import math
import textwrap
from functools import lru_cache

import bpy

from ..backend.errors import UserError
from ..backend.methods import METHODS
from ..backend.record import BakeRecord
from ..ops import state
from ..ops.job import percent
from ..ops.preset import PRESETS, preset_in_force
from ..properties import AUTOMATIC, COLLECTION, DENSITY, FIT, RAYS, TEXTURE, VERTICES, NeuralGashSettings
from ..scene import live, staleness
from ..scene.attributes import RECORD, SEQUENCE, has_bake
from ..scene.gloss_bounce import bounces_shown, has_bounces
from ..scene.lighting import HDRI, SKY, problem
from ..scene.preview import is_on
from ..scene.views import COEFFICIENT, shows_errors

_LETTER, _BESIDE = 6, 60  # pixels of a letter, on average, and of what is beside a line of text, at scale 1


@lru_cache(maxsize=64)
def _record(text: str) -> BakeRecord | str:
    """The record in a JSON text, or why it cannot be read; parsed once."""
    try:
        return BakeRecord.from_json(text)
    except UserError as error:
        return str(error)


def _paragraph(column: bpy.types.UILayout, text: str, icon: str = "NONE") -> None:
    """A text in as many lines as the sidebar is wide for; a label alone would lose its middle."""
    region, scale = bpy.context.region, bpy.context.preferences.system.ui_scale
    width = int(region.width / scale - _BESIDE) // _LETTER if region else 0
    for line in textwrap.wrap(text, max(width, 24)):
        column.label(text=line, icon=icon)
        icon = "NONE" if icon == "NONE" else "BLANK1"


class _Panel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Neural GASh"


class NEURAL_GASH_PT_main(_Panel, bpy.types.Panel):
    """Bake, see, light."""

    bl_idname = "NEURAL_GASH_PT_main"
    bl_label = "Neural GASh"

    def draw(self, context: bpy.types.Context) -> None:
        """The one thing to press, or how far it is."""
        layout = self.layout
        obj = context.object
        if state.running:
            layout.progress(factor=state.progress, text=f"Baking: {100 * state.progress:.0f} %")
            layout.label(text="Esc cancels")
            return
        column = layout.column()
        column.scale_y = 1.6
        column.operator("neural_gash.bake", icon="RENDER_STILL")
        row, pressed = layout.row(align=True), preset_in_force(context.scene.neural_gash)
        for preset, (label, _, _) in PRESETS.items():
            row.operator("neural_gash.preset", text=label, depress=preset == pressed).preset = preset
        if obj is not None and obj.type == "MESH" and obj.modifiers:
            layout.operator("neural_gash.bake_applied_copy", icon="DUPLICATE")
        row = layout.row(align=True)
        row.operator("neural_gash.preview", icon="HIDE_OFF" if is_on(obj) else "HIDE_ON", depress=is_on(obj))
        row.operator("neural_gash.clear", icon="TRASH")
        if is_on(obj) and context.space_data and context.space_data.shading.type in ("WIREFRAME", "SOLID"):
            layout.label(text="See it in Material Preview", icon="INFO")
        if has_bake(obj):
            self._readout(layout.box(), obj)

    def _readout(self, box: bpy.types.UILayout, obj: bpy.types.Object) -> None:
        """The last bake in a few lines."""
        record = _record(obj.data[RECORD])
        if isinstance(record, str):
            _paragraph(box.column(align=True), record, "ERROR")
            return
        stale = staleness.status(obj) == staleness.STALE
        box.alert = stale
        box.label(text="Changed since the bake" if stale else "Up to date", icon="ERROR" if stale else "CHECKMARK")
        label = METHODS[record.method].label if record.method in METHODS else record.method
        column = box.column(align=True)
        column.label(text=f"{label}, order {record.order}, {record.points:,} points")
        _paragraph(column, record.plan)
        if record.side:
            column.label(text=f"Texture: {record.side} x {record.side}, UV map {record.uv_map}")
        if record.bounces:
            column.label(text=f"Bounces: {record.bounces}")
        column.label(text=f"Time: {record.seconds:.2f} s")
        if record.rays_per_point >= 0.5:
            column.label(text=f"Rays: {record.rays_per_point:.0f} a point")
        if record.error_estimate is not None:
            column.label(text=f"Estimated error: {percent(record.error_estimate)}")
        if record.lamps:
            column.label(text=f"Lamps: estimated error {percent(record.lamps_error or 0)}")
            _paragraph(column, record.lamps_notice)


class NEURAL_GASH_PT_light(_Panel, bpy.types.Panel):
    """The light of the previews."""

    bl_idname = "NEURAL_GASH_PT_light"
    bl_label = "Light"
    bl_parent_id = "NEURAL_GASH_PT_main"

    def draw(self, context: bpy.types.Context) -> None:
        """Where it comes from, and the live sliders."""
        layout = self.layout
        layout.use_property_split = True
        settings = context.scene.neural_gash
        layout.prop(settings, "light_source")
        if settings.light_source == HDRI:
            layout.prop(settings, "hdri")
        if settings.light_source == SKY:
            layout.prop(settings, "sky")
        else:
            layout.operator("neural_gash.read_light", icon="FILE_REFRESH")
        if problem(context.scene):
            _paragraph(layout.column(align=True), problem(context.scene), "ERROR")
        layout.prop(settings, "light_rotation", slider=True)
        layout.prop(settings, "with_viewport")
        layout.prop(settings, "light_strength")
        obj = context.object
        record = _record(obj.data[RECORD]) if has_bake(obj) else ""
        if isinstance(record, BakeRecord) and record.lamps:
            layout.prop(settings, "lamps_strength")
        layout.prop(settings, "soften")
        layout.prop(settings, "gloss")
        if settings.gloss:
            layout.prop(settings, "lobe")
        if settings.gloss and has_bake(obj):
            layout.operator("neural_gash.bake_gloss", icon="SHADING_RENDERED")
            if has_bounces(obj.data) and not bounces_shown(obj.data):
                layout.label(text="Glossy bounces are of another light or lobe: not shown", icon="ERROR")


class NEURAL_GASH_PT_view(_Panel, bpy.types.Panel):
    """What the bake holds."""

    bl_idname = "NEURAL_GASH_PT_view"
    bl_label = "View"
    bl_parent_id = "NEURAL_GASH_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """One click for each view."""
        layout, settings, obj = self.layout, context.scene.neural_gash, context.object
        column = layout.column(align=True)
        column.enabled = is_on(obj)
        column.prop(settings, "view", expand=True)
        if settings.view == COEFFICIENT:
            column.prop(settings, "coefficient")
            band = math.isqrt(settings.coefficient)
            record = _record(obj.data[RECORD]) if has_bake(obj) else ""
            if isinstance(record, BakeRecord) and band >= record.order:
                layout.label(text=f"The bake has coefficients 0 to {record.order ** 2 - 1}", icon="ERROR")
            else:
                layout.label(text=f"l = {band}, m = {settings.coefficient - band * (band + 1)}")
        layout.operator("neural_gash.show_confidence")
        layout.operator("neural_gash.show_errors", depress=shows_errors(obj, context.space_data))


class NEURAL_GASH_PT_settings(_Panel, bpy.types.Panel):
    """What the next bake does."""

    bl_idname = "NEURAL_GASH_PT_settings"
    bl_label = "Settings"
    bl_parent_id = "NEURAL_GASH_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """All of them."""
        layout = self.layout
        layout.use_property_split = True
        settings = context.scene.neural_gash
        layout.prop(settings, "method")
        layout.prop(settings, "order")
        if METHODS[settings.method].traces:
            layout.prop(settings, "quality", expand=True)
            layout.prop(settings, "rays" if settings.quality == RAYS else "tolerance")
        if METHODS[settings.method].sees:
            layout.prop(settings, "occluders")
            if settings.occluders == COLLECTION:
                layout.prop(settings, "collection")
        if METHODS[settings.method].bounces:
            layout.prop(settings, "bounces")
        layout.prop(settings, "lamps")
        if settings.lamps:
            layout.prop(settings, "lamps_by")
        if settings.lamps and not METHODS[settings.method].traces:
            layout.prop(settings, "tolerance")
        layout.prop(settings, "target", expand=True)
        if settings.target_note():
            _paragraph(layout.column(align=True), settings.target_note(), "INFO")
        elif settings.target != VERTICES:
            self._texture(layout, settings, context.object)

    def _texture(self, layout: bpy.types.UILayout, settings: NeuralGashSettings, obj: bpy.types.Object | None) -> None:
        """What a texture has beside."""
        if obj is not None and obj.type == "MESH":
            layout.prop_search(settings, "uv_map", obj.data, "uv_layers")
        if settings.target == TEXTURE:
            layout.prop(settings, "sizing", expand=True)
        if settings.target == AUTOMATIC:
            pass  # the tolerance, which is above, decides
        elif settings.sizing == FIT:
            traces = METHODS[settings.method].traces
            if not (settings.quality != RAYS if traces else settings.lamps):  # else it is above already
                layout.prop(settings, "tolerance")
        else:
            layout.prop(settings, "texels_per_metre" if settings.sizing == DENSITY and not settings.uv_map else "side")
        if not settings.uv_map:
            layout.prop(settings, "padding")
        layout.prop(settings, "share")
        layout.prop(settings, "half")
        layout.prop(settings, "texture_folder")


class NEURAL_GASH_PT_animation(_Panel, bpy.types.Panel):
    """Meshes that deform."""

    bl_idname = "NEURAL_GASH_PT_animation"
    bl_label = "Animation"
    bl_parent_id = "NEURAL_GASH_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Follow while posing, or bake every frame."""
        layout, settings, obj = self.layout, context.scene.neural_gash, context.object
        row = layout.row(align=True)
        row.prop(settings, "live", toggle=True, icon="PLAY")
        row.prop(settings, "live_budget")
        if live.problem(obj):
            _paragraph(layout.column(align=True), live.problem(obj), "ERROR")
        elif settings.live and live.status(obj):
            _paragraph(layout.column(align=True), live.status(obj), "CHECKMARK")
        if state.running:
            return
        layout.operator("neural_gash.bake_sequence", icon="RENDER_ANIMATION")
        column = layout.column()
        column.use_property_split = True
        column.prop(settings, "sequence_folder")
        if obj is not None and obj.type == "MESH" and isinstance(obj.data.get(SEQUENCE), str):
            _paragraph(layout.column(align=True), f"Plays {obj.data[SEQUENCE]}", "FILE_MOVIE")


class NEURAL_GASH_PT_compare(_Panel, bpy.types.Panel):
    """Which method is best here."""

    bl_idname = "NEURAL_GASH_PT_compare"
    bl_label = "Compare"
    bl_parent_id = "NEURAL_GASH_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, _context: bpy.types.Context) -> None:
        """A button, and where to look afterwards."""
        if state.running:
            return
        self.layout.operator("neural_gash.compare", icon="GRAPH")
        column = self.layout.column(align=True)
        column.label(text="Chart: in the Image Editor", icon="INFO")
        column.label(text="Errors: in View", icon="BLANK1")


CLASSES = (NEURAL_GASH_PT_main, NEURAL_GASH_PT_light, NEURAL_GASH_PT_view, NEURAL_GASH_PT_settings,
           NEURAL_GASH_PT_animation, NEURAL_GASH_PT_compare)


def register() -> None:
    """Register the panels."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Unregister them."""
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
