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


@pytest.mark.parametrize("given", [{"method": "embree"}, {"method": "auto", "quality": "RAYS"},
                                   {"method": "analytic"}])
def test_without_a_plan_to_a_tolerance_it_is_vertices(make, automatic, given):
    coarse = floor(make, 2)
    table(make)
    for name, value in given.items():
        setattr(automatic, name, value)
    bake(coarse)
    assert record(coarse).target == "vertices" and not coarse.data.uv_layers


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
