# SPDX-License-Identifier: GPL-3.0-or-later
"""The light of a scene's previews: taken from the World once, then only turned and scaled."""
from __future__ import annotations

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ..backend import light as sh_light
from ..backend import spherical_harmonics as sh
from ..backend.errors import UserError
from .attributes import has_bake, read_record
from .frames import as_array, bake_frame
from .preview import is_glossy, is_on, preview_on, update_light
from .views import LIT, view_light
from .world import rotated_light, world_light

_turns: dict[int, bytes] = {}  # session uid of an object -> its rotation when its preview was last lit for turning
_LIGHT = "neural_gash_light"  # custom property of the scene: (K, 3) of the highest order, flat


def take_light(scene: bpy.types.Scene) -> None:
    """Project the scene's World and suns, and keep the coefficients with the scene.

    Raises:
        UserError: the World is made of something that cannot be read as light.
    """
    store_light(scene, world_light(scene, sh.MAX_ORDER))


def store_light(scene: bpy.types.Scene, light: np.ndarray) -> None:
    """Keep light (K, 3) of the highest order, in world axes, as the light of the scene's previews."""
    scene[_LIGHT] = light.ravel().tolist()


def current_light(scene: bpy.types.Scene, order: int) -> np.ndarray:
    """The light (K, 3) of the previews, as the sliders have it; a white sky before any was taken."""
    stored = scene.get(_LIGHT)
    if stored is None or len(stored) != 3 * sh.MAX_ORDER ** 2:
        light = sh_light.constant(np.ones(3), sh.MAX_ORDER)
    else:
        light = np.array(stored, dtype=np.float64).reshape(-1, 3)
    settings = scene.neural_gash
    light = rotated_light(light[:order * order], settings.light_rotation, settings.light_strength)
    return sh_light.window(light, order) if settings.soften else light


def apply_light(scene: bpy.types.Scene) -> None:
    """Light every preview in the scene. Damaged bakes keep the light they have."""
    for obj in scene.objects:
        if is_on(obj):
            light_object(scene, obj)


@persistent
def _on_change(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Turn the light of previews whose object was turned: it is kept in the frame of the bake."""
    for update in depsgraph.updates:
        if isinstance(update.id, bpy.types.Object) and update.is_updated_transform:
            obj = update.id.original
            if not is_on(obj) or not np.isfinite(as_array(obj.matrix_world)).all():
                continue
            turned = bake_frame(obj).round(6).tobytes()
            if turned != _turns.get(obj.session_uid):  # lighting it changes its material, which is a change again
                _turns[obj.session_uid] = turned
                light_object(scene, obj)


def register() -> None:
    """Start following objects that turn."""
    bpy.app.handlers.depsgraph_update_post.append(_on_change)
    bpy.app.handlers.frame_change_post.append(_on_change)
    bpy.app.handlers.load_post.append(_on_load)


def unregister() -> None:
    """Stop."""
    bpy.app.handlers.depsgraph_update_post.remove(_on_change)
    bpy.app.handlers.frame_change_post.remove(_on_change)
    bpy.app.handlers.load_post.remove(_on_load)
    _turns.clear()


def show_gloss(scene: bpy.types.Scene) -> None:
    """Make the previews in a scene glossy or dull, as its settings have it."""
    for obj in scene.objects:
        if is_on(obj) and has_bake(obj) and not obj.library:
            try:
                preview_on(obj, scene.neural_gash.lobe_shown())
            except UserError:
                continue  # a damaged bake keeps the preview it has; the panel says so
    apply_light(scene)


@persistent
def _on_load(*_: object) -> None:
    """The images of glossy previews are not saved: fill them again."""
    for scene in bpy.data.scenes:
        for obj in scene.objects:
            if is_glossy(obj):
                light_object(scene, obj)


def light_object(scene: bpy.types.Scene, obj: bpy.types.Object) -> None:
    """Light the preview of one object, where it is on."""
    try:
        record, view = read_record(obj), scene.neural_gash.view
        if view == LIT:
            update_light(obj, current_light(scene, record.order))
        else:
            update_light(obj, view_light(obj, record, view, scene.neural_gash.coefficient), tint=0.0)
    except UserError:
        return  # the panel says that the bake is damaged
