# SPDX-License-Identifier: GPL-3.0-or-later
"""What a hostile tester once got through: names in the way, objects that turn, worlds of very different sizes."""
from __future__ import annotations

import math

import numpy as np
import pytest

from .conftest import WEDGE

bpy = pytest.importorskip("bpy")


def _bake():
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def _names(obj):
    return sorted(a.name for a in obj.data.attributes if a.name.startswith("_prt"))


def _light(obj):
    group = next(n for s in obj.material_slots for n in s.material.node_tree.nodes if n.type == "GROUP")
    return np.array([group.inputs[f"L{k}"].default_value for k in range(9)])


def _coefficients(obj):
    from neural_gash_addon.scene.attributes import read_transfer
    return read_transfer(obj)[0]


def test_a_vertex_group_in_the_way_costs_nothing(make, settings, refused, snapshot):
    obj = make()
    settings.order = 2
    _bake()
    obj.vertex_groups.new(name="_prt_1")
    before = snapshot()
    settings.order = 3
    assert "_prt_1" in refused(bpy.ops.neural_gash.bake)
    assert snapshot() == before and _names(obj) == ["_prt_0"]
    obj.vertex_groups.clear()
    _bake()
    assert _names(obj) == ["_prt_0", "_prt_1", "_prt_2"]


@pytest.mark.parametrize("kind", ["FLOAT", "FLOAT_COLOR"])
def test_attributes_of_the_same_kind_of_name_are_kept(make, settings, refused, kind):
    obj = make()
    settings.order = 2
    _bake()
    obj.data.attributes.new("_prt_7", kind, "POINT")
    _bake()
    assert _names(obj) == ["_prt_0", "_prt_7"]
    obj.data.attributes.new("_prt_1", kind, "POINT")
    settings.order = 3
    assert "_prt_1" in refused(bpy.ops.neural_gash.bake)
    bpy.ops.neural_gash.clear()
    assert _names(obj) == ["_prt_1", "_prt_7"]


def test_a_bake_that_lost_an_attribute_is_seen(make, settings, refused):
    from neural_gash_addon.scene import staleness
    obj = make()
    _bake()
    bpy.ops.neural_gash.preview()
    obj.data.attributes.remove(obj.data.attributes["_prt_1"])
    assert staleness.status(obj) == staleness.STALE
    assert "_prt_1" in refused(bpy.ops.neural_gash.preview)
    _bake()
    assert staleness.status(obj) == staleness.CURRENT


def test_light_follows_an_object_that_turns(make, settings):
    obj = make()
    lamp = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    lamp.data.energy, lamp.rotation_euler = 5, (0.5, 0.3, 0)
    bpy.context.scene.collection.objects.link(lamp)
    _bake()
    before = _light(obj)
    obj.rotation_euler = (0.3, 0.5, 1.2)
    bpy.context.view_layer.update()
    turned = _light(obj)
    assert np.abs(turned - before).max() > 0.1
    bpy.ops.neural_gash.read_light()
    np.testing.assert_allclose(_light(obj), turned, atol=1e-6)
    obj.rotation_euler = (0, 0, 0)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(_light(obj), before, atol=1e-5)
    obj.keyframe_insert("rotation_euler", frame=1)
    obj.rotation_euler = (0.3, 0.5, 1.2)
    obj.keyframe_insert("rotation_euler", frame=5)
    bpy.context.scene.frame_set(1)
    bpy.context.scene.frame_set(5)
    np.testing.assert_allclose(_light(obj), turned, atol=1e-5)


def test_an_object_without_a_place_does_not_stop_the_others(make, settings):
    lost = make(name="Lost")
    _bake()
    make(name="Fine")
    lost.rotation_euler.x = math.nan
    bpy.context.view_layer.update()
    _bake()
    settings.light_rotation = 1.0


def _hide_eye(collection):
    bpy.context.view_layer.layer_collection.children[collection.name].hide_viewport = True


def _hide_render(collection):
    collection.hide_render = True


@pytest.mark.parametrize("hide", [_hide_eye, _hide_render])
def test_hidden_collections_neither_shadow_nor_shine(make, settings, hide):
    from neural_gash_addon.scene.world import world_light
    collection = bpy.data.collections.new("Hidden")
    bpy.context.scene.collection.children.link(collection)
    roof = make([(-9, -9, 2), (9, -9, 2), (9, 9, 2), (-9, 9, 2)], [(0, 1, 2, 3)], "Roof")
    lamp = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    for obj in (roof, lamp):
        collection.objects.link(obj)
    bpy.context.scene.collection.objects.unlink(roof)
    thing = make()
    settings.occluders = "VISIBLE"
    _bake()
    shadowed, lit = _coefficients(thing), world_light(bpy.context.scene, 3)
    hide(collection)
    bpy.context.view_layer.update()
    _bake()
    assert np.abs(_coefficients(thing) - shadowed).max() > 0.1
    assert np.abs(lit).max() > 0.1 and np.abs(world_light(bpy.context.scene, 3)).max() == 0


@pytest.mark.parametrize("size", [5.0, 500.0, 50_000.0])
def test_the_size_of_the_world_does_not_matter_to_a_small_object(make, settings, size):
    ground = make([(-size, -size, -0.0101), (size, -size, -0.0101), (size, size, -0.0101), (-size, size, -0.0101)],
                  [(0, 1, 2, 3)], "Ground")
    assert ground.dimensions.x == pytest.approx(2 * size)
    thing = make([tuple(0.01 * np.array(p)) for p in WEDGE[0]], WEDGE[1], smooth=True)
    settings.rays = 1024
    _bake()
    alone = _coefficients(thing)
    settings.occluders = "VISIBLE"
    _bake()
    assert np.abs(_coefficients(thing) - alone).max() > 0.0
    # a ground of 1 m, with half a degree of horizon less, is the truth
    from neural_gash_addon.backend import methods
    from neural_gash_addon.scene.read import read_object, read_occluders
    depsgraph = bpy.context.evaluated_depsgraph_get()
    mesh, ((corners, triangles),) = read_object(thing, depsgraph).mesh, read_occluders(thing, "VISIBLE", depsgraph)
    near = corners * [1 / size, 1 / size, 1]
    truth = methods.run(methods.bake(mesh, rays=4096, occluders=[(near, triangles)], seed=5)).coefficients
    assert np.linalg.norm(_coefficients(thing) - truth) < 0.02 * np.linalg.norm(truth)


def test_a_mesh_in_edit_mode_elsewhere_is_refused(make, settings, refused):
    obj = make()
    twin = bpy.data.objects.new("Twin", obj.data)
    bpy.context.scene.collection.objects.link(twin)
    bpy.context.view_layer.update()
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.context.view_layer.objects.active = twin
    assert "Edit Mode" in refused(bpy.ops.neural_gash.bake)


def test_light_that_is_no_number_is_refused(make, settings):
    from neural_gash_addon.backend.errors import UserError
    from neural_gash_addon.scene.world import world_light
    lamp = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    bpy.context.scene.collection.objects.link(lamp)
    lamp.data.energy = math.inf
    with pytest.raises(UserError, match="not a number"):
        world_light(bpy.context.scene, 3)
