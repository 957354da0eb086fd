# SPDX-License-Identifier: GPL-3.0-or-later
"""How many bands a plan bakes: as few as the tolerance allows, which is kept over all that were asked for."""
import numpy as np
import pytest

from neural_gash_addon.backend import auto_bake, bands, compare, methods, metrics, plan, sequence, texture
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.bounce import Reflection
from neural_gash_addon.backend.geometry import Surface, TriangleMesh
from neural_gash_addon.backend.texture import alike, merged

from .shapes import cube, sphere, torus
from .test_plan_bounces import room

WAYS = [each.ways for each in methods.candidates().values() if each.ways]


def bake(mesh, order, tolerance=None, method="auto", **arguments):
    return methods.run(methods.bake(mesh, method, order, tolerance=tolerance, **arguments))


def whole(transfer, order):
    """Coefficients (N, K) of all bands that were asked for."""
    found = transfer.coefficients
    out = np.zeros((len(found), order * order, *found.shape[2:]))
    out[:, :found.shape[1]] = found
    return out


def surface(shape):
    """Smooth."""
    mesh = TriangleMesh.from_triangles(*shape)
    return Surface(mesh.positions, mesh.triangles.ravel(), mesh.normals[mesh.triangles.ravel()].astype(np.float32),
                   np.repeat(np.arange(len(mesh.triangles)), 3),
                   np.arange(3 * len(mesh.triangles), dtype=np.int32).reshape(-1, 3), mesh.resolution)


@pytest.fixture(scope="module")
def ring():
    """A torus, and its transfer at order 5 as two traces have it."""
    mesh = TriangleMesh.from_triangles(*torus(sections=48))
    return mesh, [bake(mesh, 5, method="embree", rays=2048, seed=seed).coefficients for seed in (98, 99)]


@pytest.mark.parametrize("shape", ["sphere", "cube"])
@pytest.mark.parametrize(("asked", "tolerance", "order"), [
    (5, 0.1, 3),   # band 4 is 7.7 %, band 3 nothing
    (5, 0.05, 5),
    (5, 0.4, 2),
    (4, 1e-3, 3),
    (3, 0.4, 2),   # band 2 is 34 %
    (3, 0.2, 3),
    (2, 1.0, 2),
])
def test_a_convex_mesh_has_the_bands_that_would_be_seen(shape, asked, tolerance, order):
    mesh = TriangleMesh.from_triangles(*(sphere(3) if shape == "sphere" else cube()), smooth=shape == "sphere")
    found = bake(mesh, asked, tolerance)
    error = metrics.rel_l2(whole(found, asked), sh.cosine_lobe(mesh.normals, asked))
    assert found.record.order == order and found.coefficients.shape[1] == order ** 2
    assert error <= tolerance and found.record.error_estimate == pytest.approx(error, abs=1e-6)
    assert found.record.tolerance == tolerance and found.record.rays == 0
    if asked > 2:
        assert f"order {order} is {'kept' if order == asked else 'enough'}." in found.record.plan


def test_the_sentence_says_what_is_dropped():
    mesh = TriangleMesh.from_triangles(*sphere(2))
    assert "Bands 3 and 4 are 7.7 % of the whole: order 3 is enough." in bake(mesh, 5, 0.1).record.plan
    assert "Band 2 is 34 % of the whole: order 3 is kept." in bake(mesh, 3, 0.1).record.plan
    assert "Bands 2 to 4 are 35 % of the whole: order 2 is enough." in bake(mesh, 5, 0.5).record.plan


def test_dropped_bands_and_what_is_left_wrong_keep_the_tolerance(ring):
    """Over all bands that were asked for, against two references whose noise cancels; and the record says it."""
    mesh, (one, two) = ring
    orders = set()
    for tolerance in (0.5, 0.3, 0.25, 0.2, 0.1):
        for seed in range(2):
            found = bake(mesh, 5, tolerance, seed=seed)
            here = whole(found, 5)
            error = (((here - one) * (here - two)).sum() / (one * two).sum()) ** 0.5
            assert error <= 1.05 * tolerance
            assert error / 1.4 < found.record.error_estimate < 1.4 * error
            orders.add(found.record.order)
    assert len(orders) >= 3 and 5 in orders


@pytest.mark.parametrize("method", ["embree", "hybrid"])
def test_what_is_left_is_met_by_tracing(ring, monkeypatch, method):
    """Each method that goes on from the pilot, at the order to which that was cut."""
    mesh, (one, two) = ring

    def forced(found, points, order, tolerance, ways):
        chosen = bands.chosen(3, order, tolerance, [found.beyond(n) for n in range(order)])
        return auto_bake.Plan(method, tolerance=chosen.left, reason="So."), chosen

    monkeypatch.setattr(auto_bake, "traced_bands", forced)
    found = bake(mesh, 5, 0.25)
    here = whole(found, 5)
    error = (((here - one) * (here - two)).sum() / (one * two).sum()) ** 0.5
    dropped = (one[:, 9:] * two[:, 9:]).sum() / (one * two).sum()
    assert found.record.method == method and found.record.order == 3
    assert dropped ** 0.5 < error <= 0.25
    assert found.record.error_estimate == pytest.approx(error, rel=0.15)


def test_a_pilot_that_was_cut_is_one_of_the_lower_order(ring):
    mesh, _ = ring
    found = methods.run(auto_bake.planned(mesh, 5, None, 0.01, [], 3, 1, None, False, methods.candidates())).pilot
    lower = methods.run(auto_bake.planned(mesh, 3, None, 0.01, [], 3, 1, None, False, methods.candidates())).pilot
    cut = found.to_order(3)
    for name in ("blocked", "most_blocked", "noise", "scale"):
        assert getattr(cut, name) == pytest.approx(getattr(lower, name), rel=1e-6)
    np.testing.assert_allclose(cut.sample[1], lower.sample[1], atol=1e-9)
    assert cut.to_order(3).beyond(3) == (0, 0) and found.without_shadows(5) == (found.blocked, found.most_blocked)


def test_the_pilot_sees_each_band_as_a_reference_does(ring):
    mesh, (one, two) = ring
    found = methods.run(auto_bake.planned(mesh, 5, None, 0.05, [], 0, 1, None, False, methods.candidates())).pilot
    energy = (one * two).sum(0)
    for order in (1, 2, 3, 4):
        true = (energy[order ** 2:].sum() / energy.sum()) ** 0.5
        share, most = found.beyond(order)
        assert share == pytest.approx(true, rel=0.15) and most > share


def test_nothing_is_dropped_where_that_was_not_asked_for(ring):
    mesh, _ = ring
    ball = TriangleMesh.from_triangles(*sphere(2))
    for found in (bake(mesh, 5, rays=4), bake(ball, 5, rays=4), bake(ball, 5, 0.4, whole=True),
                  bake(mesh, 5, 0.5, whole=True), bake(mesh, 5, 0.5, method="embree")):
        assert found.record.order == 5 and found.coefficients.shape[1] == 25
        assert "order" not in found.record.plan


def test_bounces_are_computed_at_the_order_that_is_baked():
    """A room of light colours: the bands that are dropped are a smaller part of all light than of direct light."""
    mesh, albedo = room()
    albedo = np.maximum(albedo, 0.85)
    found = bake(mesh, 5, 0.5, reflection=Reflection(albedo, 8))
    terms = found.record.order ** 2
    assert terms in (9, 16) and found.coefficients.shape == (len(mesh.points), terms, 3)
    truth = bake(mesh, 5, method="embree", rays=256, reflection=Reflection(albedo, 8)).coefficients
    direct = bake(mesh, 5, method="embree", rays=256).coefficients
    assert np.linalg.norm(whole(found, 5) - truth) <= 0.5 * np.linalg.norm(truth)
    part = [np.linalg.norm(values[:, terms:]) / np.linalg.norm(values) for values in (truth, direct)]
    assert 0.1 < part[0] < 0.95 * part[1]


@pytest.mark.parametrize("shape", ["sphere", "torus"])
def test_all_tiles_of_a_texture_have_one_order(monkeypatch, tmp_path, shape):
    monkeypatch.setattr(texture, "_TILE", 1 << 10)
    where = surface(sphere(3) if shape == "sphere" else torus(sections=24))
    tolerance = 0.1 if shape == "sphere" else 0.25
    wish = {"side": 64, "tolerance": tolerance, "folder": tmp_path / "tiles"}
    work = texture.bake(where, "auto", 5, **wish)
    while not list((tmp_path / "tiles").glob("*.json")):
        next(work)
    work.close()  # and goes on
    found = methods.run(texture.bake(where, "auto", 5, **wish))
    order = found.record.order
    assert len(found.coefficients) > 2 and order in ((3,) if shape == "sphere" else (3, 4))
    assert {c.shape[1] for c in found.coefficients} == {order ** 2}
    assert found.record.tolerance == tolerance and f"order {order} is enough." in found.record.plan
    held = methods.run(texture.bake(where, "auto", 5, uv=found.uv, side=64, tolerance=tolerance, whole=True,
                                    folder=tmp_path / "tiles"))  # no tile of the other order is taken
    assert {c.shape[1] for c in held.coefficients} == {25}
    truth = methods.run(texture.bake(where, "embree", 5, uv=found.uv, side=64, rays=1024))
    error = metrics.rel_l2(sh.padded(np.concatenate(found.coefficients), 25), np.concatenate(truth.coefficients))
    assert error <= tolerance and found.record.error_estimate == pytest.approx(error, rel=0.25)


def test_one_texture_of_several_objects_has_the_highest_order():
    parts = [methods.run(texture.bake(surface(sphere(1)), "analytic", order, side=32)) for order in (3, 5)]
    low, high = alike(parts)
    assert low.record.order == high.record.order == merged([low, high]).record.order == 5
    np.testing.assert_array_equal(low.coefficients[0][:, :9], parts[0].coefficients[0])
    assert low.coefficients[0].shape[1] == 25 and not low.coefficients[0][:, 9:].any()
    assert high is parts[1]


def test_a_comparison_counts_what_was_dropped():
    mesh = TriangleMesh.from_triangles(*sphere(3))
    truth = methods.run(compare.reference(mesh, 5, np.arange(len(mesh.points)), rays=16))
    chosen = compare.Setting("auto", 5, tolerance=0.1)
    found = methods.run(compare.compare(compare.vertex_bake(mesh), [chosen, compare.baseline(5)], truth, [], 1))[0]
    assert found.rel_l2 == pytest.approx(0.0766, abs=1e-4) and found.errors.shape == (len(mesh.points),)


def test_a_sequence_refuses_frames_of_another_order(tmp_path):
    mesh = TriangleMesh.from_triangles(*sphere(1))
    writer = sequence.Writer(tmp_path / "a.prtseq", 1, 2, mesh)
    writer.add(mesh, bake(mesh, 5, 0.1))
    with pytest.raises(Exception, match="one file"):
        writer.add(mesh, bake(mesh, 5, 0.1, whole=True))
    writer.discard()


def test_fewer_bands_are_taken_where_they_take_no_more_time_and_the_tolerance_has_room(ring):
    mesh, _ = ring
    found = methods.run(auto_bake.planned(mesh, 5, None, 0.1, [], 0, 1, None, False, methods.candidates())).pilot
    lowered = 0
    for points in (1000, 200_000):
        for tolerance in (0.5, 0.25, 0.2, 0.18, 0.15, 0.05):
            chosen, kept = plan.traced_bands(found, points, 5, tolerance, WAYS)
            assert chosen.seconds <= plan.cheapest(found, points, tolerance, WAYS).seconds
            assert kept.dropped ** 2 + (1 - kept.dropped ** 2) * kept.left ** 2 <= tolerance ** 2 * (1 + 1e-9)
            assert kept.dropped <= plan.bands.MOST_DROPPED * tolerance
            lowered += kept.order < 5
    assert 2 <= lowered < 10
