# SPDX-License-Identifier: GPL-3.0-or-later
"""The light of a scene's previews: kept with the scene as coefficients, which follow where it is taken from.

The dependency graph says when the World, a lamp or an image changed; an update then costs a projection of what is
new, and a few numbers for each preview. Nothing is polled.
"""
from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ..backend import light as sh_light
from ..backend import spherical_harmonics as sh
from ..backend.errors import UserError
from .attributes import has_bake, read_record
from .frames import bake_frame, world_matrix
from .preview import is_glossy, is_on, preview_on, update_light
from .views import LIT, view_light
from .world import checked, current_depsgraph, file_light, forget_image, rotated_light, suns_light, world_light

WORLD, HDRI, SUNS, SKY = "WORLD", "HDRI", "SUNS", "SKY"  # where light is taken from

_turns: dict[int, bytes] = {}  # session uid of an object -> its rotation when its preview was last lit
_problems: dict[int, str] = {}  # session uid of a scene -> why its light cannot be read
_LIGHT = "neural_gash_light"  # custom property of the scene: (K, 3) of the highest order, flat


def take_light(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Project the light that the scene's settings choose, and keep the coefficients with the scene.

    Args:
        depsgraph: of the scene, evaluated, where a handler has one.
    Raises:
        UserError: the World is made of something that cannot be read as light, or so is the chosen file.
    """
    try:
        light = _chosen_light(scene, depsgraph)
    except UserError as error:
        _problems[scene.session_uid] = str(error)
        raise
    _problems.pop(scene.session_uid, None)
    store_light(scene, light)


def _chosen_light(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None) -> np.ndarray:
    """(K, 3) of the highest order."""
    settings = scene.neural_gash
    if settings.light_source == HDRI:
        if not settings.hdri:
            raise UserError("Choose the image file that lights the previews.")
        return checked(file_light(Path(bpy.path.abspath(settings.hdri)), sh.MAX_ORDER))
    if settings.light_source == SKY:
        return checked(sh_light.constant(np.array(settings.sky), sh.MAX_ORDER))
    if settings.light_source == SUNS:
        return checked(suns_light(depsgraph or current_depsgraph(scene), sh.MAX_ORDER))
    return world_light(scene, sh.MAX_ORDER, depsgraph)


def follow_light(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Take the light again, and light every preview in the scene if it is another.

    Where it cannot be read, the previews keep the light they have, and `problem` says why.
    """
    before = scene.get(_LIGHT)
    before = None if before is None else before[:]
    try:
        take_light(scene, depsgraph)
    except UserError:
        return
    if before is None or before != scene[_LIGHT][:]:
        apply_light(scene, depsgraph)


def problem(scene: bpy.types.Scene) -> str:
    """Why the light of the previews could not be followed when last it changed; '' where it could."""
    return _problems.get(scene.session_uid, "")


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


def apply_light(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Light every preview in the scene. Damaged bakes keep the light they have."""
    for obj in scene.objects:
        if is_on(obj):
            light_object(scene, obj, depsgraph)


@persistent
def _on_change(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Turn the light of previews whose object was turned: it is kept in the frame of the bake."""
    if _LIGHT not in scene:
        return  # as below; and the white sky that lights previews before any was taken is the same however it is turned
    for update in depsgraph.updates:
        if isinstance(update.id, bpy.types.Object) and update.is_updated_transform:
            obj = update.id.original
            if not is_on(obj) or not np.isfinite(world_matrix(obj, depsgraph)).all():
                continue
            if _turned(obj, depsgraph) != _turns.get(obj.session_uid):  # lighting it is a change of its material again
                light_object(scene, obj, depsgraph)


@persistent
def _on_light(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Follow the World, the suns and the image of the World, where a preview shows them."""
    if _LIGHT not in scene or scene.neural_gash.light_source not in (WORLD, SUNS):
        return  # a scene from which no light was taken may yet have objects of one from which it was
    # as evaluated: the original of a preview's material may have been removed by a handler before this one
    changed = [update.id for update in depsgraph.updates]
    if not any(map(_may_light, changed)):
        return
    for image in changed:
        if isinstance(image, bpy.types.Image):
            forget_image(image.original)
    if any(map(is_on, scene.objects)):
        follow_light(scene, depsgraph)


def _may_light(changed: bpy.types.ID) -> bool:
    """Whether a change of this may be one of the light; scenes and collections hide lamps and change Worlds."""
    return (isinstance(changed, (bpy.types.World, bpy.types.Light, bpy.types.Image, bpy.types.Scene,
                                 bpy.types.Collection))
            or isinstance(changed, bpy.types.Object) and changed.type in ("LIGHT", "EMPTY"))  # empties make instances


def register() -> None:
    """Start following objects that turn, and the light."""
    bpy.app.handlers.depsgraph_update_post.extend((_on_change, _on_light))
    bpy.app.handlers.frame_change_post.extend((_on_change, _on_light))
    bpy.app.handlers.load_post.append(_on_load)


def unregister() -> None:
    """Stop."""
    for handlers in (bpy.app.handlers.depsgraph_update_post, bpy.app.handlers.frame_change_post):
        handlers.remove(_on_change)
        handlers.remove(_on_light)
    bpy.app.handlers.load_post.remove(_on_load)
    _turns.clear()
    _problems.clear()
    forget_image()


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
    """Another file: forget the one before. The images of glossy previews are not saved: fill them again."""
    _problems.clear()
    forget_image()
    for scene in bpy.data.scenes:
        for obj in scene.objects:
            if is_glossy(obj):
                light_object(scene, obj)


def _turned(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None) -> bytes:
    """The rotation of an object, to compare."""
    return bake_frame(obj, depsgraph).round(6).tobytes()


def light_object(scene: bpy.types.Scene, obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Light the preview of one object, where it is on. depsgraph: of the frame that is meant (`world_matrix`)."""
    if np.isfinite(world_matrix(obj, depsgraph)).all():
        _turns[obj.session_uid] = _turned(obj, depsgraph)
    try:
        record, view = read_record(obj), scene.neural_gash.view
        if view == LIT:
            update_light(obj, current_light(scene, record.order), lamps=scene.neural_gash.lamps_strength,
                         depsgraph=depsgraph)
        else:
            light = view_light(obj, record, view, scene.neural_gash.coefficient, depsgraph)
            update_light(obj, light, tint=0.0, lamps=0.0, depsgraph=depsgraph)
    except UserError:
        return  # the panel says that the bake is damaged
