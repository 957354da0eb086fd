# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects as they stand evaluated, also those that the window does not evaluate."""
from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import bpy


@contextmanager
def evaluated(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Iterator[bpy.types.Object]:
    """`obj` evaluated: modifiers, shape keys, armature, parents and constraints done.

    The dependency graph leaves out what is disabled in viewports or excluded from the view layer,
    and may leave hidden geometry unevaluated; such an object is evaluated in a scene made for it.
    """
    if obj.visible_get(view_layer=depsgraph.view_layer):
        yield obj.evaluated_get(depsgraph)
        return
    with revealed([obj], depsgraph) as (own_depsgraph, copies):
        yield copies[0].evaluated_get(own_depsgraph)


@contextmanager
def revealed(objects: Iterable[bpy.types.Object], depsgraph: bpy.types.Depsgraph,
             ) -> Iterator[tuple[bpy.types.Depsgraph, list[bpy.types.Object]]]:
    """Visible copies of `objects` in a temporary scene at the same frame: its depsgraph, and the copies.

    Nothing of the person's scene is switched on for it, so nothing is left to switch off.
    """
    scene = bpy.data.scenes.new("neural_gash evaluation")
    copies: list[bpy.types.Object] = []
    try:
        scene.frame_current = depsgraph.scene.frame_current
        scene.frame_subframe = depsgraph.scene.frame_subframe
        for obj in objects:
            copy = obj.copy()
            copies.append(copy)
            copy.hide_viewport = False
            scene.collection.objects.link(copy)
        layer = scene.view_layers[0]
        layer.update()
        yield layer.depsgraph, copies
    finally:
        for copy in copies:
            bpy.data.objects.remove(copy)
        bpy.data.scenes.remove(scene)


def scene_objects(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> list[bpy.types.Object]:
    """The objects of a scene, then those of which it has instances alone, as of a collection that is not in it."""
    found = dict.fromkeys(scene.objects)
    found.update(dict.fromkeys(one.original for one in depsgraph.ids if isinstance(one, bpy.types.Object)))
    return list(found)


def shown_objects(depsgraph: bpy.types.Depsgraph) -> set[int]:
    """Session uids of the objects that the viewport shows and a render of the depsgraph's view layer would.

    The dependency graph lists objects of hidden collections too; but what is animated is in a render right there only.
    """
    layer = depsgraph.view_layer
    rendered: set[int] = set()
    front = [layer.layer_collection]
    while front:
        place = front.pop()
        if place.exclude or place.collection.hide_render:
            continue
        rendered |= {o.session_uid for o in place.collection.objects if not o.evaluated_get(depsgraph).hide_render}
        front += place.children
    return {o.session_uid for o in layer.objects if o.session_uid in rendered and o.visible_get(view_layer=layer)}
