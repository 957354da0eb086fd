# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes that follow their objects while these deform: made anew within a budget of time, or read from a sequence.

The dependency graph says what changed; the fingerprint says whether a bake still fits. What is drawn interactively is
made within the milliseconds that the person gives; frames that are rendered are made as Bake would.
"""
from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import bpy
from bpy.app.handlers import persistent

from ..backend import methods
from ..backend.errors import UserError
from ..backend.geometry import TEXEL, TriangleMesh
from ..backend.live import Live, LivePlan, best
from ..backend.record import BakeRecord
from ..backend.transfer import Transfer
from . import rendered as renders
from .attributes import SEQUENCE, has_bake, read_record, write_transfer
from .deforming import Deforming
from .evaluation import scene_objects, shown_objects
from .frames import rotation_part
from .lighting import light_object
from .playback import forget_files, show_frame
from .read import SELF, fingerprint, read_object, read_occluders, refusal, same_fingerprint
from .reflection import check_attributes, read_reflection

_BESIDES = 0.15  # of the budget, for reading and writing, before any update has been timed
_NEWEST = 0.2    # weight of the newest update in how slow updates are
_ROOM = 0.85     # of the budget that a better plan must keep to, to be taken again: so that plans do not alternate


@dataclass(eq=False)
class _Follower:
    """What is kept of an object from frame to frame. Arrays only."""

    reader: Deforming = field(default_factory=Deforming)
    live: Live | None = None
    plans: list[LivePlan] = field(default_factory=list)
    plan: LivePlan | None = None
    slow: float = 1.0     # how many times as long its plan takes as when it was tried
    besides: float = 0.0  # seconds that an update takes besides: to read and to write
    order: int = 0
    budget: float = 0.0
    seconds: float = 0.0  # the last update took


_followers: dict[int, _Follower] = {}        # by session uid of the object
_problems: dict[int, str] = {}               # why an object is not followed
_shown: dict[int, frozenset[int]] = {}       # session uid of a scene -> its objects that are shown, when last looked at
_LIVE = "Live."  # with which the plan of a bake begins that was made within the budget
_suspended = False                           # something else bakes frame by frame
_rendering = False


def status(obj: bpy.types.Object | None) -> str:
    """How the object is followed, in one sentence; '' where it is not. Reads nothing of the mesh."""
    follower = None if obj is None else _followers.get(obj.session_uid)
    if follower is None or follower.plan is None:
        return ""
    return _sentence(follower.plan, follower.seconds or follower.plan.seconds, follower.budget)


def _sentence(plan: LivePlan, seconds: float, budget: float) -> str:
    """A plan and what it takes, for people."""
    what = f"{plan.rays} rays" if plan.rays else "The network"
    late = ", more than the budget" if seconds > 1.1 * budget else ""
    return (f"{what} at {plan.points:,} points: {1000 * seconds:.0f} ms{late}; error about "
            f"{100 * plan.error:.2g} %.")


def problem(obj: bpy.types.Object | None) -> str:
    """Why the object could not be followed when last it changed; '' where it could."""
    return "" if obj is None else _problems.get(obj.session_uid, "")


@contextmanager
def suspended() -> Iterator[None]:
    """Follow nothing meanwhile."""
    global _suspended
    _suspended = True
    try:
        yield
    finally:
        _suspended = False


def start(scene: bpy.types.Scene) -> None:
    """Choose how to follow each baked object of a scene that is shown, and follow it from now on."""
    forget()
    if _suspended:
        return  # the frame that is set after it has all followed
    depsgraph = bpy.context.evaluated_depsgraph_get()
    for obj in _followed(scene, depsgraph, rendered=False):
        try:
            record = _followable(obj)
            follower = _followers.setdefault(obj.session_uid, _Follower())
            mesh, _ = follower.reader.read(obj, depsgraph)
            _plan(scene, follower, mesh, read_occluders(obj, record.occluders, depsgraph), record.order)
        except UserError as error:
            _problems[obj.session_uid] = str(error)
    follow(scene, depsgraph)


def forget() -> None:
    """Follow nothing any more."""
    _followers.clear()
    _shown.clear()
    _problems.clear()


def follow(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, rendered: bool = False,
           changed: Collection[int] | None = None) -> list[bpy.types.Object]:
    """Bring the bakes of a scene to how their objects stand evaluated; what fits already is left alone.

    Args:
        rendered: as well as Bake would, not within the budget.
        changed: session uids of the objects that changed; all, where not given.
    Returns:
        The objects to which bakes were written.
    """
    written: list[bpy.types.Object] = []
    if not scene.neural_gash.live:
        return written
    for obj in _followed(scene, depsgraph, rendered):
        try:
            if changed is not None and obj.session_uid not in changed and read_record(obj).occluders == SELF:
                continue
            if _update(scene, obj, depsgraph, rendered):
                written.append(obj)
            _problems.pop(obj.session_uid, None)
        except UserError as error:
            _problems[obj.session_uid] = str(error)
    return written


def _followed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, rendered: bool) -> list[bpy.types.Object]:
    """The objects whose bakes follow; of several with the same mesh, the first."""
    found: dict[int, bpy.types.Object] = {}
    for obj in scene_objects(scene, depsgraph) if rendered else scene.objects:
        shown = not obj.evaluated_get(depsgraph).hide_render if rendered else obj.visible_get()
        if has_bake(obj) and SEQUENCE not in obj.data and shown and obj.mode != "EDIT":
            found.setdefault(obj.data.session_uid, obj)
    return list(found.values())


def _followable(obj: bpy.types.Object, rendered: bool = False) -> BakeRecord:
    """The record of a bake that can be made again and again. Raises UserError where it cannot."""
    reason = refusal(obj)
    if reason:
        raise UserError(reason)
    record = read_record(obj)
    if record.domain == TEXEL:
        raise UserError(f"'{obj.name}' is baked to a texture; live updates are for bakes to vertices.")
    if record.lamps:
        raise UserError(f"Lamps light the bake of '{obj.name}'; live updates are for bakes without lamps.")
    if record.colours != 1 and not rendered:
        raise UserError(f"Light bounces in the bake of '{obj.name}'; it is followed in rendered frames only.")
    return record


def _update(scene: bpy.types.Scene, obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, rendered: bool) -> bool:
    """Bake an object again, if it is no longer as it was baked. Raises UserError."""
    before = _followable(obj, rendered)
    began = time.perf_counter()
    now = fingerprint(obj, depsgraph, before.occluders, bounces=before.colours == 3)
    hurried = before.plan.startswith(_LIVE)  # by an update in the window
    if same_fingerprint(now, before.fingerprint) and not (rendered and hurried):
        return False
    follower = _followers.setdefault(obj.session_uid, _Follower())
    if rendered:
        read = read_object(obj, depsgraph)
        mesh, matrix = read.mesh, read.matrix
        transfer = _as_bake(scene, obj, depsgraph, before, mesh)
        if transfer.record.colours != before.colours:
            now = fingerprint(obj, depsgraph, before.occluders, bounces=transfer.record.colours == 3)
    else:
        mesh, matrix = follower.reader.read(obj, depsgraph)
        occluders = read_occluders(obj, before.occluders, depsgraph)
        plan = _plan(scene, follower, mesh, occluders, before.order)
        assert follower.live is not None
        reading = time.perf_counter() - began
        found = follower.live.bake(mesh, occluders, plan)
        took = time.perf_counter() - began
        baked = took - reading
        transfer = Transfer(found, BakeRecord(
            method=plan.method, order=before.order, points=len(mesh.points), domain=mesh.domain,
            rays=(plan.rays or 0) * plan.points, seed=0, seconds=took, error_estimate=plan.error,
            plan=f"{_LIVE} {_sentence(plan, took, follower.budget)}"))
    frame = tuple(float(v) for v in rotation_part(matrix).ravel())
    record = replace(transfer.record, occluders=before.occluders, fingerprint=now, frame=frame)
    write_transfer(obj, mesh.elements, replace(transfer, record=record))
    if frame != before.frame or record.colours != before.colours:
        light_object(scene, obj, depsgraph)
    follower.seconds = time.perf_counter() - began
    if not rendered:
        _adapt(follower, baked)
    return True


def _as_bake(scene: bpy.types.Scene, obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, before: BakeRecord,
             mesh: TriangleMesh) -> Transfer:
    """What the settings give, at the order and with the occluders of the bake before. Raises UserError."""
    settings = scene.neural_gash
    bounces = settings.bounces or before.bounces
    reflection = None
    if bounces and methods.METHODS[settings.method].bounces:
        check_attributes(before.order)
        reflection = read_reflection(obj, before.occluders, depsgraph, bounces)
    return methods.run(methods.bake(mesh, settings.method, before.order, reflection=reflection, whole=True,
                                    occluders=read_occluders(obj, before.occluders, depsgraph), **settings.tracing()))


def _plan(scene: bpy.types.Scene, follower: _Follower, mesh: TriangleMesh, occluders: list, order: int) -> LivePlan:
    """How to bake within the budget; chosen anew where the topology, the order or the budget is another."""
    budget = scene.neural_gash.live_budget
    if follower.live is None or follower.order != order or not follower.live.fits(mesh):
        follower.live, follower.order, follower.plan = Live(mesh, order), order, None
    if follower.plan is None or follower.budget != budget:
        room = (1 - _BESIDES) * budget
        follower.plans = follower.live.tried(mesh, occluders, room)
        follower.plan, follower.budget = best(follower.plans, room), budget
        follower.slow, follower.besides = 1.0, _BESIDES * budget
    return follower.plan


def _adapt(follower: _Follower, baked: float) -> None:
    """Take another plan where updates turn out to be slower than the budget, or where there is room for a better one:
    drawing takes its part of the machine, and so may other programs. baked: seconds of the update that its plan took.
    """
    assert follower.plan is not None
    follower.slow += _NEWEST * (baked / follower.plan.seconds - follower.slow)
    follower.besides += _NEWEST * (follower.seconds - baked - follower.besides)
    room = (follower.budget - follower.besides) / follower.slow
    if follower.plan.seconds > room:
        follower.plan = best(follower.plans, room)
    else:
        better = best(follower.plans, _ROOM * room)
        if better.seconds <= _ROOM * room and better.error < follower.plan.error:
            follower.plan = better


def _animate_again(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph,
                   written: Collection[bpy.types.Object]) -> None:
    """Have what animates objects evaluated once more after their meshes were written to in a new frame.

    A mesh that changed is evaluated again from the originals of the mesh, its shape keys and its objects. In the window
    these hold the values of the frame; but a render has a dependency graph of its own, and they would be those of the
    frame that the window shows. Not while posing: values that a person has not keyed yet would be lost.
    """
    if not written:
        return
    meshes = {obj.data for obj in written}
    changed: set[bpy.types.ID] = {obj for obj in scene_objects(scene, depsgraph) if obj.data in meshes}
    changed |= meshes | {mesh.shape_keys for mesh in meshes if mesh.shape_keys}
    for one in changed:
        one.update_tag(refresh={"TIME"})


def play(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> list[bpy.types.Object]:
    """Show of each object with a sequence the frame that is current; the nearest, beyond its ends. Gives those written.
    """
    shown: set[int] = set()
    written = []
    for obj in scene_objects(scene, depsgraph):
        if obj.type != "MESH" or SEQUENCE not in obj.data or obj.data.session_uid in shown or obj.mode == "EDIT":
            continue
        shown.add(obj.data.session_uid)
        try:
            if show_frame(scene, obj, depsgraph):
                written.append(obj)
            _problems.pop(obj.session_uid, None)
        except UserError as error:
            _problems[obj.session_uid] = str(error)
    return written


@persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Follow what was posed, edited or moved."""
    if not _rendering:
        renders.show_all()
    if _suspended or not scene.neural_gash.live:
        return
    changed = {update.id.original.session_uid for update in depsgraph.updates
               if isinstance(update.id, bpy.types.Object)
               and (update.is_updated_geometry or update.is_updated_transform)}
    if any(isinstance(update.id, (bpy.types.Scene, bpy.types.Collection)) for update in depsgraph.updates):
        shown = frozenset(shown_objects(depsgraph))  # what is hidden or removed is itself no update
        changed |= _shown.get(scene.session_uid, frozenset()) ^ shown
        _shown[scene.session_uid] = shown
    if changed:
        follow(scene, depsgraph, bpy.app.background or _rendering, changed)


@persistent
def _on_frame(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Follow what is animated, before it is drawn or rendered."""
    if not _suspended:
        written = play(scene, depsgraph) + follow(scene, depsgraph, bpy.app.background or _rendering)
        if _rendering:
            renders.show_what_fits(scene, depsgraph, _problems)
        else:
            renders.show_all()
        _animate_again(scene, depsgraph, written)


@persistent
def _on_load(*_: object) -> None:
    """Another file: nothing known holds."""
    forget()
    forget_files()
    renders.forget()


@persistent
def _on_render(*_: object) -> None:
    """A render begins."""
    global _rendering
    _rendering = True


@persistent
def _on_rendered(*_: object) -> None:
    """It ended, however."""
    global _rendering
    _rendering = False
    if bpy.app.background:
        renders.show_all()  # renders of a window end in a thread of their own: the next update is the window's


@persistent
def _on_save(*_: object) -> None:
    """A file saved in the midst of a render has all its previews; the next frame looks again."""
    renders.show_all()


_HANDLERS = (("depsgraph_update_post", _on_update), ("frame_change_post", _on_frame), ("load_post", _on_load),
             ("save_pre", _on_save), ("render_init", _on_render), ("render_complete", _on_rendered),
             ("render_cancel", _on_rendered))


def register() -> None:
    """Start following."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Stop, and forget."""
    global _rendering
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
    renders.show_all()
    _on_load()
    _rendering = False
