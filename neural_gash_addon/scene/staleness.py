# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether a bake still fits its object, known without work while the panel draws.

The dependency graph says which objects changed; half a second after the last change a timer
compares the fingerprints of those that are baked. In background there are no timers, so `status`
compares at once.
"""
from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from ..backend.errors import UserError
from ..backend.record import BakeRecord
from .attributes import check_whole, has_bake, read_record
from .gloss_bounce import finish_fits, finish_key, has_bounces
from .lamps import LitScenes
from .preview import is_preview
from .read import SELF, fingerprint, read_finish, same_fingerprint
from .uv_maps import read_uv

CURRENT, STALE, NONE = "CURRENT", "STALE", "NONE"
_DELAY = 0.5  # seconds

_known: dict[int, str] = {}    # session uid of an object -> CURRENT or STALE, as last compared
_changed: set[int] = set()     # session uids to compare again
_comparing = False             # the timer is at work; changes seen now are its own


def status(obj: bpy.types.Object | None) -> str:
    """'CURRENT', 'STALE' or 'NONE' (no bake). Reads no geometry while a window is open."""
    if obj is None or not has_bake(obj):
        return NONE
    uid = obj.session_uid
    if bpy.app.background:
        check(obj)
    elif uid not in _known and uid not in _changed:
        _changed.add(uid)
        _schedule()
    return _known.get(uid, CURRENT)


def check(obj: bpy.types.Object, lit: LitScenes | None = None) -> bool:
    """Compare the object with its bake now: whether the bake still fits. Main thread only. lit: see `same`."""
    current = fits(obj, bpy.context.evaluated_depsgraph_get(), lit)
    _known[obj.session_uid] = CURRENT if current else STALE
    _changed.discard(obj.session_uid)
    return current


def fits(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, lit: LitScenes | None = None) -> bool:
    """Whether the bake of an object is whole, and of the object as it stands evaluated."""
    try:
        record = read_record(obj)
        check_whole(obj.data, record)
        return same(obj, record, depsgraph, lit) and _gloss_fits(obj, record, depsgraph)
    except UserError:  # changed so far that it could not be baked again as it was
        return False


def same(obj: bpy.types.Object, record: BakeRecord, depsgraph: bpy.types.Depsgraph, lit: LitScenes | None = None
         ) -> bool:
    """Whether the object's shape, what shadows it and what lights it are those of a bake.

    Args:
        lit: of the depsgraph, where several objects are compared.
    Raises:
        UserError: as `fingerprint` and `read_lamps`.
    """
    uv = read_uv(obj.data, record.uv_map) if record.uv_map else None
    now = fingerprint(obj, depsgraph, record.occluders, uv, record.colours == 3)
    return (same_fingerprint(now, record.fingerprint)
            and (not record.lamps or (lit or LitScenes(depsgraph)).of(obj)[1] == record.lamps))


def register() -> None:
    """Start watching."""
    bpy.app.handlers.depsgraph_update_post.append(_on_update)
    bpy.app.handlers.load_post.append(_on_load)
    bpy.app.handlers.undo_post.append(_on_undo)
    bpy.app.handlers.redo_post.append(_on_undo)


def unregister() -> None:
    """Stop watching, and forget."""
    bpy.app.handlers.depsgraph_update_post.remove(_on_update)
    bpy.app.handlers.load_post.remove(_on_load)
    bpy.app.handlers.undo_post.remove(_on_undo)
    bpy.app.handlers.redo_post.remove(_on_undo)
    if bpy.app.timers.is_registered(_compare_changed):
        bpy.app.timers.unregister(_compare_changed)
    _on_load()


@persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Note what changed; the comparing waits until changes pause."""
    uids = {update.id.original.session_uid for update in depsgraph.updates
            if isinstance(update.id, bpy.types.Object)
            and (update.is_updated_geometry or update.is_updated_transform)}
    if any(isinstance(update.id, bpy.types.Light)
           or isinstance(update.id, bpy.types.Material) and not is_preview(update.id)
           for update in depsgraph.updates):
        uids.update(obj.session_uid for obj in scene.objects if _reflects(obj))
    if uids:
        _changed.update(uids)
        if not (bpy.app.background or _comparing):
            _schedule()


@persistent
def _on_load(*_: object) -> None:
    """Another file: nothing known holds."""
    _known.clear()
    _changed.clear()


@persistent
def _on_undo(*_: object) -> None:
    """Shapes and bakes may both have gone back: compare all again."""
    _changed.update(_known)
    if not bpy.app.background:
        _schedule()


def _schedule() -> None:
    """(Re)start the wait."""
    if bpy.app.timers.is_registered(_compare_changed):
        bpy.app.timers.unregister(_compare_changed)
    bpy.app.timers.register(_compare_changed, first_interval=_DELAY)


def _compare_changed() -> None:
    """Timer: compare each baked object that changed, or whose occluders may have."""
    global _comparing
    layer = bpy.context.view_layer
    _comparing = True
    try:
        layer.update()
        lit = LitScenes(layer.depsgraph)
        changed = set(_changed)
        waiting = set()
        for obj in bpy.context.scene.objects:
            if not has_bake(obj):
                continue
            if obj.mode == "EDIT":  # its mesh is still the one from before
                waiting |= changed & {obj.session_uid}
            elif obj.session_uid in changed or _has_occluders(obj):
                check(obj, lit)
        layer.update()  # reading a hidden object tags it as changed; heeding that would never end
        _changed.clear()
        _changed.update(waiting)
    finally:
        _comparing = False
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def _gloss_fits(obj: bpy.types.Object, record: BakeRecord, depsgraph: bpy.types.Depsgraph) -> bool:
    """Whether the glossy bounces, if there are any, are of the materials as they are."""
    return not has_bounces(obj.data) or finish_fits(
        obj.data, finish_key(*read_finish(obj, record.occluders, depsgraph)))


def _reflects(obj: bpy.types.Object) -> bool:
    """Whether the bake depends on materials, or on lamps and so on all."""
    try:
        record = read_record(obj) if has_bake(obj) else None
        return record is not None and (has_bounces(obj.data) or record.colours == 3
                                       or bool(record.uv_map or record.lamps))
    except UserError:
        return False


def _has_occluders(obj: bpy.types.Object) -> bool:
    """Whether the bake depends on other objects too."""
    try:
        record = read_record(obj)
        return record.occluders != SELF or bool(record.lamps)
    except UserError:
        return False
