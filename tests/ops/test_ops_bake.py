# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake through bpy.ops: what it writes, and that it equals the library call."""
from __future__ import annotations

import math

import numpy as np
import pytest

from .conftest import CUBE, WEDGE

bpy = pytest.importorskip("bpy")


def _library(obj, order, rays):
    """The coefficients that the backend gives for the object's elements."""
    from neural_gash_addon.backend import methods
    from neural_gash_addon.scene.read import read_object
    mesh = read_object(obj, bpy.context.evaluated_depsgraph_get()).mesh
    return methods.run(methods.bake(mesh, "embree", order, rays=rays)).coefficients[mesh.elements]


@pytest.mark.parametrize("order", [2, 3, 5])
def test_operator_equals_library(make, settings, order):
    from neural_gash_addon.scene.attributes import read_transfer
    obj = make(*WEDGE)
    settings.order = order
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    coefficients, record = read_transfer(obj)
    np.testing.assert_array_equal(coefficients, _library(obj, order, 64))
    assert record.order == order and record.occluders == "SELF" and record.fingerprint


def test_analytic_takes_no_rays(make, settings):
    from neural_gash_addon.scene.attributes import read_transfer
    obj = make(*WEDGE)
    settings.method, settings.occluders = "analytic", "COLLECTION"  # no collection: it would not matter
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    assert read_transfer(obj)[1].rays == 0


@pytest.mark.parametrize("target", ["VERTICES", "TEXTURE"])
def test_the_network_sees_what_stands_around(make, settings, target):
    """A floor with a box right above it is dark, and is open without the box."""
    from neural_gash_addon.scene.attributes import read_record
    box = make([(3 * x, 3 * y, z + 1.1) for x, y, z in CUBE[0]], CUBE[1], "Box")
    corners = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)), -1).reshape(-1, 2)
    floor = make([(x, y, 0) for x, y in corners],
                 [(i, i + 1, i + 10, i + 9) for i in range(71) if i % 9 < 8], "Floor")
    settings.method, settings.target, settings.side, settings.sizing = "gnn", target, 32, "RESOLUTION"
    brightest = {}
    for occluders in ("SELF", "VISIBLE"):
        settings.occluders = occluders
        assert bpy.ops.neural_gash.bake() == {"FINISHED"}
        record = read_record(floor)
        assert (record.method, record.rays, record.error_estimate) == ("gnn", 0, None)
        brightest[occluders] = _first_coefficients(floor)
    assert brightest["SELF"].mean() > 0.27 and brightest["VISIBLE"].mean() < 0.08  # all open: 0.282
    assert box.data.get("neural_gash") is None


def _first_coefficients(obj):
    """Coefficient 0 of each vertex, or of the texels that the floor covers."""
    from neural_gash_addon.scene.attributes import read_transfer
    if not obj.data.uv_layers:
        return read_transfer(obj)[0][:, 0]
    image = next(image for image in bpy.data.images if " PRT 0" in image.name)
    pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(-1, 4)[:, 0]


def test_flat_cube_is_unshadowed_on_each_face(make, settings):
    from neural_gash_addon.backend import spherical_harmonics as sh
    from neural_gash_addon.scene.attributes import read_transfer
    obj = make()
    bpy.ops.neural_gash.bake()
    coefficients, record = read_transfer(obj)
    assert record.domain == "CORNER" and record.points == 24
    normals = np.array([n.vector for n in obj.data.corner_normals])
    np.testing.assert_allclose(coefficients, sh.cosine_lobe(normals, 3), atol=1e-6)


@pytest.mark.parametrize("scale", [(-1, 1, 1), (-2, -3, -0.5), (1, -1, 1)])
def test_negative_scale_is_right(make, settings, scale):
    """A mirrored cube is a cube: nothing of it is in shadow, and its normals point outward."""
    from neural_gash_addon.backend import spherical_harmonics as sh
    from neural_gash_addon.scene.attributes import read_transfer
    obj = make()
    obj.scale = scale
    bpy.ops.neural_gash.bake()
    corners = np.array([obj.data.vertices[loop.vertex_index].co for loop in obj.data.loops])
    outward = np.zeros((24, 3))
    for polygon in obj.data.polygons:  # a face's centre lies in the direction of its normal
        part = list(polygon.loop_indices)
        outward[part] = corners[part].mean(axis=0) * np.sign(scale)
    coefficients, _ = read_transfer(obj)
    np.testing.assert_allclose(coefficients, sh.cosine_lobe(outward, 3), atol=1e-6)


def test_occluders_of_a_collection(make, settings):
    """A roof in a chosen collection shadows a floor; with 'Itself' it does not."""
    from neural_gash_addon.scene.attributes import read_transfer
    roof = make([(-9, -9, 1), (9, -9, 1), (9, 9, 1), (-9, 9, 1)], [(0, 1, 2, 3)], "Roof")
    floor = make([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2, 3)], "Floor")
    roofs = bpy.data.collections.new("Dächer & 屋根")
    bpy.context.scene.collection.children.link(roofs)
    roofs.objects.link(roof)
    bpy.ops.neural_gash.bake()
    alone = read_transfer(floor)[0][:, 0]
    settings.occluders, settings.collection = "COLLECTION", roofs
    bpy.ops.neural_gash.bake()
    under, record = read_transfer(floor)
    assert record.occluders == roofs.name
    assert (under[:, 0] < 0.1 * alone).all()
    settings.occluders = "VISIBLE"
    bpy.ops.neural_gash.bake()
    np.testing.assert_allclose(read_transfer(floor)[0], under, atol=1e-6)


def test_bake_lights_from_the_world_and_shows(make, settings):
    from neural_gash_addon.scene.lighting import current_light
    from neural_gash_addon.scene.preview import is_on
    world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.2, 0.4, 0.8, 1)
    bpy.context.scene.world = world
    obj = make()
    bpy.ops.neural_gash.bake()
    assert is_on(obj)
    light = current_light(bpy.context.scene, 3)
    np.testing.assert_allclose(light[0], np.array([0.2, 0.4, 0.8]) * math.sqrt(4 * math.pi), rtol=1e-5)
    np.testing.assert_allclose(light[1:], 0, atol=1e-9)


def test_unreadable_world_still_bakes_under_a_white_sky(make, settings, tmp_path):
    from neural_gash_addon.scene.attributes import has_bake
    from neural_gash_addon.scene.lighting import current_light
    world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    nodes = world.node_tree
    texture = nodes.nodes.new("ShaderNodeTexEnvironment")
    image = bpy.data.images.new("lost", 4, 2)
    image.source, image.filepath = "FILE", str(tmp_path / "missing.hdr")
    texture.image = image
    nodes.links.new(texture.outputs[0], nodes.nodes["Background"].inputs["Color"])
    bpy.context.scene.world = world
    obj = make()
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    assert has_bake(obj)
    np.testing.assert_allclose(current_light(bpy.context.scene, 2)[0], math.sqrt(4 * math.pi), rtol=1e-6)


def test_bake_again_replaces(make, settings):
    from neural_gash_addon.scene.attributes import read_transfer
    obj = make()
    for order in (5, 2):
        settings.order = order
        bpy.ops.neural_gash.bake()
    assert read_transfer(obj)[0].shape == (24, 4)
    assert sorted(a.name for a in obj.data.attributes if a.name.startswith("_prt_")) == ["_prt_0"]


def test_modifiers_that_change_topology_offer_a_copy(make, settings, refused, snapshot):
    from neural_gash_addon.scene.attributes import has_bake, read_transfer
    obj = make()
    obj.modifiers.new("Subdivision", "SUBSURF")
    before = snapshot()
    assert "copy" in refused(bpy.ops.neural_gash.bake)
    assert snapshot() == before
    assert bpy.ops.neural_gash.bake_applied_copy() == {"FINISHED"}
    copy = bpy.context.object
    assert copy != obj and not has_bake(obj) and len(obj.modifiers) == 1
    assert len(read_transfer(copy)[0]) == len(copy.data.loops) and not copy.modifiers


def test_failed_applied_copy_leaves_nothing(make, settings, refused, snapshot):
    obj = make()
    obj.modifiers.new("Subdivision", "SUBSURF")
    obj.scale = (0, 0, 0)
    bpy.context.view_layer.update()
    before = snapshot()
    assert "scale" in refused(bpy.ops.neural_gash.bake_applied_copy)
    assert snapshot() == before


def test_survives_save_and_load(make, settings, tmp_path):
    from neural_gash_addon.scene.attributes import read_transfer
    from neural_gash_addon.scene.lighting import current_light
    obj = make(*WEDGE, name="Ünïcode '\"\\/ 名")
    bpy.ops.neural_gash.bake()
    settings.light_rotation = 0.7
    coefficients, record = read_transfer(obj)
    light, name = current_light(bpy.context.scene, 3), obj.name
    path = str(tmp_path / "baked.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    again, same = read_transfer(bpy.data.objects[name])
    np.testing.assert_array_equal(again, coefficients)
    assert same == record
    np.testing.assert_array_equal(current_light(bpy.context.scene, 3), light)
    bpy.context.scene.neural_gash.light_rotation = 1.0  # the sliders still act


def test_one_undo_step(make, settings):
    from neural_gash_addon.scene.attributes import has_bake
    from neural_gash_addon.scene.preview import is_on
    bpy.context.preferences.edit.use_global_undo = True
    obj = make(name="Undone")
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.neural_gash.bake()
    bpy.ops.ed.undo_push(message="bake")  # called from Python, operators push none themselves
    assert has_bake(obj)
    if not bpy.ops.ed.undo.poll() or bpy.ops.ed.undo() != {"FINISHED"}:
        pytest.skip("no undo without a window here")
    obj = bpy.data.objects["Undone"]
    assert not has_bake(obj) and not is_on(obj) and not obj.material_slots
    assert "neural_gash_light" not in bpy.context.scene


def test_report_is_one_line(make, settings):
    from neural_gash_addon.ops.batch import bake_object
    from neural_gash_addon.ops.job import percent, summary
    record, warning = bake_object(bpy.context, make(*WEDGE), settings)
    assert not warning
    line = summary(record)
    assert "\n" not in line and "rays a point" in line and "estimated error" in line and " s" in line
    assert percent(0.0123) == "1.2 %" and percent(1e-9) == "below 0.01 %"


def test_progress_rises_to_one(make, settings):
    from neural_gash_addon.ops.batch import bake_object
    seen = []
    bake_object(bpy.context, make(*CUBE), settings, seen.append)
    assert seen and seen == sorted(seen) and seen[0] >= 0 and seen[-1] <= 1
