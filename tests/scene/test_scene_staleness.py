# SPDX-License-Identifier: GPL-3.0-or-later
"""A bake says when it no longer fits."""
import pytest

bpy = pytest.importorskip("bpy")

from neural_gash_addon.scene import attributes, staleness  # noqa: E402


@pytest.fixture(autouse=True)
def watching():
    """The handlers, registered for one test."""
    def handlers():
        h = bpy.app.handlers
        return [len(x) for x in (h.depsgraph_update_post, h.load_post, h.undo_post, h.redo_post)]
    before = handlers()
    staleness.register()
    yield
    staleness.unregister()
    assert handlers() == before and not bpy.app.timers.is_registered(staleness._compare_changed)


def _status(obj):
    bpy.context.view_layer.update()
    return staleness.status(obj)


def test_turning_is_not_stale_but_stretching_is(make):
    obj = make.cube()
    assert _status(obj) == staleness.status(None) == "NONE"
    make.bake(obj)
    assert _status(obj) == "CURRENT"
    obj.rotation_euler, obj.location = (1, 2, 3), (4, 5, 6)
    assert _status(obj) == "CURRENT"
    obj.scale = (1, 1, 1.1)
    assert _status(obj) == "STALE" and not staleness.check(obj)
    obj.scale = (1, 1, 1)
    assert _status(obj) == "CURRENT" and staleness.check(obj)
    obj.modifiers.new("Finer", "SUBSURF")
    assert _status(obj) == "STALE"
    attributes.clear(obj)
    assert _status(obj) == "NONE"


def test_occluders_that_move_make_it_stale(make):
    obj, other = make.cube(), make.cube("Other")
    make.bake(obj, occluders="VISIBLE")
    assert _status(obj) == "CURRENT"
    other.location.x = 3
    assert _status(obj) == "STALE"
    gone = bpy.data.collections.new("Gone")
    make.bake(obj, occluders="Gone")
    assert _status(obj) == "CURRENT"
    bpy.data.collections.remove(gone)
    assert _status(obj) == "STALE"


def test_after_loading_another_file(make, tmp_path):
    obj = make.cube()
    make.bake(obj)
    obj.scale.x = 2
    assert _status(obj) == "STALE"
    path = str(tmp_path / "stale.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    assert not staleness._known
    assert _status(bpy.data.objects["Cube"]) == "STALE"


def test_comparing_and_lighting_change_nothing_that_would_compare_again(make):
    import numpy as np

    from neural_gash_addon.scene import preview
    obj = make.cube()
    obj.data.materials.append(None)
    make.bake(obj)
    preview.preview_on(obj)
    bpy.context.view_layer.update()
    staleness._changed.clear()
    preview.update_light(obj, np.ones((9, 3)))
    bpy.context.view_layer.update()
    assert obj.session_uid not in staleness._changed
    obj.hide_set(True)  # so that comparing makes a scene of its own
    bpy.context.view_layer.update()
    staleness._changed.clear()
    staleness._changed.add(obj.session_uid)
    staleness._compare_changed()
    bpy.context.view_layer.update()
    assert obj.session_uid not in staleness._changed


def test_changes_are_noted_and_compared_when_the_timer_comes(make):
    obj, far = make.cube(), make.cube("Far")
    make.bake(obj)
    make.bake(far)
    staleness._compare_changed()
    bpy.context.view_layer.update()
    staleness._changed.clear()
    obj.scale.x = 2
    bpy.context.view_layer.update()
    assert staleness._changed == {obj.session_uid}
    staleness._known[far.session_uid] = "as it was"
    staleness._compare_changed()
    assert staleness._known[obj.session_uid] == "STALE"
    assert staleness._known[far.session_uid] == "as it was"  # nothing there changed, so nothing was read
    assert not staleness._changed
