# SPDX-License-Identifier: GPL-3.0-or-later
"""Target: Automatic. Vertices where they have what is inside faces, else a texture as large as that needs."""
import numpy as np
import pytest

from tests.backend.shapes import cube, grid, sphere
from tests.backend.test_texture import lookup

bpy = pytest.importorskip("bpy")


@pytest.fixture
def automatic(settings):
    settings.method, settings.quality, settings.tolerance, settings.target = "auto", "TOLERANCE", 0.1, "AUTOMATIC"
    settings.occluders = "VISIBLE"
    return settings


def floor(make, cells, name="Floor"):
    return make(*grid(cells), name=name)


def table(make):
    positions, triangles = cube(subdivisions=0)
    return make(positions * [0.3, 0.3, 0.05] + [0.5, 0.5, 0.08], triangles, name="Table")


def record(obj):
    from neural_gash_addon.scene.attributes import read_record
    return read_record(obj)


def bake(*objects):
    for other in bpy.context.selected_objects:
        other.select_set(False)
    for obj in objects:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = objects[0]
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def test_each_object_gets_what_it_needs(make, automatic):
    coarse, fine = floor(make, 2), floor(make, 60, "Fine")
    fine.location = (3, 0, 0)
    table(make)
    second = table(make)
    second.location = (3, 0, 0)
    bpy.context.view_layer.update()
    bake(coarse, fine)
    found = record(coarse)
    assert found.target == "texture" and 16 <= found.side <= 512
    assert "missed by their corners (" in found.plan and f"a texture of {found.side} has them." in found.plan
    assert len(coarse.data.uv_layers) == 1
    found = record(fine)
    assert found.target == "vertices" and "vertices are enough." in found.plan and found.between_error < 0.125
    assert not fine.data.uv_layers


def test_a_smaller_tolerance_takes_a_larger_texture_that_keeps_to_it(make, automatic):
    """What the texture says between its texels, against rays."""
    from neural_gash_addon.backend import methods, metrics
    from neural_gash_addon.backend.texels import scattered, texel_points
    from neural_gash_addon.ops.batch import prepare_batch
    from neural_gash_addon.scene.read import read_occluders
    coarse, roof = floor(make, 2), table(make)
    roof.location.z = -0.025  # 5 mm above the floor: sharp shadows
    bpy.context.view_layer.update()
    sides = []
    for tolerance in (0.1, 0.005):
        automatic.tolerance = tolerance
        batch = prepare_batch(bpy.context, [coarse], automatic)
        found, = methods.run(batch.baking)
        surface = batch.jobs[0].read.surface
        sample = scattered(surface, 1000, np.random.default_rng(4))
        points = texel_points(surface, sample)
        occluders = read_occluders(coarse, "VISIBLE", bpy.context.evaluated_depsgraph_get())
        exact = methods.run(methods.bake(points, "embree", 3, rays=2048, seed=3, occluders=occluders)).coefficients
        uv = np.einsum("nc,ncx->nx", sample.barycentric, found.uv[surface.corners[sample.faces]])
        assert metrics.rel_l2(lookup(found, uv), exact) <= 1.4 * tolerance
        sides.append(found.record.side)
    assert sides[0] < sides[1]


def test_a_convex_mesh_and_one_that_is_fine_enough_stay_at_their_vertices(make, automatic):
    ball = make(*sphere(3), name="Ball")
    bake(ball)
    assert record(ball).target == "vertices" and record(ball).between_error is None


@pytest.mark.parametrize("given, why", [
    ({"method": "embree"}, "only the method Automatic"), ({"method": "auto", "quality": "RAYS"}, "no tolerance"),
    ({"method": "analytic"}, "only the method Automatic"), ({"live": True}, "Live is on")])
def test_without_a_plan_to_a_tolerance_it_is_vertices_and_says_so(make, automatic, given, why):
    coarse = floor(make, 2)
    table(make)
    for name, value in given.items():
        setattr(automatic, name, value)
    bake(coarse)
    assert record(coarse).target == "vertices" and not coarse.data.uv_layers
    assert why in record(coarse).plan and why in automatic.target_note()
    automatic.target = "VERTICES"
    bake(coarse)
    assert why not in record(coarse).plan and automatic.target_note() == ""


def test_those_that_want_a_texture_can_share_one(make, automatic):
    from neural_gash_addon.scene import preview, staleness
    objects = [floor(make, 2), floor(make, 60, "Fine"), floor(make, 2, "Other")]
    for number, obj in enumerate(objects):
        obj.location = (3 * number, 0, 0)
        table(make).location = obj.location
    bpy.context.view_layer.update()
    automatic.share = True
    bake(*objects)
    records = [record(obj) for obj in objects]
    assert [found.target for found in records] == ["texture", "vertices", "texture"]
    assert records[0].side == records[2].side and len(bpy.data.images) == 3
    assert all(f"a texture of {records[0].side} has them." in records[i].plan for i in (0, 2))
    assert all(staleness.status(obj) == staleness.CURRENT and preview.is_on(obj) for obj in objects)
    bake(objects[0])  # alone it has one of its own
    assert record(objects[0]).target == "texture"


def test_your_own_uv_map_is_baked_to(make, automatic):
    coarse = floor(make, 2)
    table(make)
    layer = coarse.data.uv_layers.new(name="Mine")
    for corner, loop in zip(layer.uv, coarse.data.loops, strict=True):
        corner.vector = coarse.data.vertices[loop.vertex_index].co.xy
    automatic.uv_map = "Mine"
    bake(coarse)
    assert (record(coarse).target, record(coarse).uv_map) == ("texture", "Mine")
    assert [layer.name for layer in coarse.data.uv_layers] == ["Mine"]


def test_a_sequence_has_its_vertices(make, automatic, tmp_path, monkeypatch):
    from neural_gash_addon.ops import job
    coarse = floor(make, 2)
    table(make)
    bake(coarse)
    monkeypatch.setattr(job, "read_normal_maps", None)  # nothing of a texture is read in each frame
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 2
    automatic.sequence_folder = str(tmp_path)
    assert bpy.ops.neural_gash.bake_sequence() == {"FINISHED"}
    assert record(coarse).target == "vertices" and not coarse.data.uv_layers and not bpy.data.images


def test_the_panel_shows_what_the_target_needs(make, settings):
    from .test_ops_registration import _draw
    make()
    settings.target, settings.method, settings.quality = "AUTOMATIC", "auto", "TOLERANCE"
    shown = _draw("settings")
    assert {"target", "uv_map", "padding", "share", "half", "texture_folder"} <= set(shown)
    assert not {"sizing", "side", "texels_per_metre"} & set(shown) and shown.count("tolerance") == 1
    settings.method = "embree"
    assert "uv_map" not in _draw("settings") and "only the method" in " ".join(_draw("settings"))
    settings.target = "TEXTURE"
    assert {"sizing", "side", "uv_map"} <= set(_draw("settings"))
    settings.target = "VERTICES"
    assert "uv_map" not in _draw("settings")


def test_where_no_uv_map_has_room_it_is_vertices(make, automatic):
    coarse = floor(make, 2)
    table(make)
    while len(coarse.data.uv_layers) < 8:
        coarse.data.uv_layers.new()
    before = [layer.name for layer in coarse.data.uv_layers]
    bake(coarse)
    assert record(coarse).target == "vertices" and "a texture would have them." in record(coarse).plan
    assert [layer.name for layer in coarse.data.uv_layers] == before


def test_a_bake_that_ends_elsewhere_leaves_one_record(make, automatic):
    """From a texture to vertices and back, as a change of the target by hand does."""
    from neural_gash_addon.scene import staleness
    coarse = floor(make, 2)
    roof = table(make)
    bake(coarse)
    assert record(coarse).target == "texture"
    roof.location.z = 50
    bpy.context.view_layer.update()
    bake(coarse)
    assert record(coarse).target == "vertices" and staleness.status(coarse) != staleness.STALE
    roof.location.z = 0
    bpy.context.view_layer.update()
    bake(coarse)
    assert record(coarse).target == "texture" and staleness.status(coarse) != staleness.STALE
    bpy.ops.neural_gash.clear()
    assert not coarse.data.uv_layers and not np.any(["neural_gash" in a.name for a in coarse.data.attributes])
