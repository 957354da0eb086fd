# SPDX-License-Identifier: GPL-3.0-or-later
"""The hybrid bake: equivariance, its limit, its measured error, neighbours, and its slow twin."""
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from neural_gash_addon.backend import hybrid, hybrid_bake, methods, metrics, texture, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.estimator import BlockedEstimator
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.raycast import Occluders

from . import shapes
from .test_texture import lookup, surface


def knot():
    """A mesh that shadows itself."""
    t = np.linspace(0, 2 * np.pi, 220, endpoint=False)
    a = np.linspace(0, 2 * np.pi, 18, endpoint=False)
    spine = np.stack([(2 + np.cos(3 * t)) * np.cos(2 * t), (2 + np.cos(3 * t)) * np.sin(2 * t), np.sin(3 * t)], 1)
    tangent = np.roll(spine, -1, 0) - np.roll(spine, 1, 0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    ring = np.cos(a)[None, :, None] * side[:, None] + np.sin(a)[None, :, None] * up[:, None]
    positions = (spine[:, None] + 0.55 * ring).reshape(-1, 3)
    i, j = (g.ravel() for g in np.meshgrid(np.arange(220), np.arange(18), indexing="ij"))
    p = [((i + di) % 220) * 18 + (j + dj) % 18 for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1))]
    triangles = np.concatenate([np.stack([p[0], p[1], p[2]], 1), np.stack([p[0], p[2], p[3]], 1)])
    mesh = TriangleMesh.from_triangles(positions, triangles)
    outward = np.einsum("nx,nx->n", mesh.normals, (positions - np.repeat(spine, 18, 0))).mean() > 0
    return mesh if outward else TriangleMesh.from_triangles(positions, triangles[:, ::-1])


@pytest.fixture(scope="module")
def case():
    """A mesh, its unshadowed transfer, and its transfer with many rays."""
    mesh = knot()
    return mesh, sh.cosine_lobe(mesh.normals, 3), bake(mesh, "embree", 2048, seed=5).coefficients


def bake(mesh, method="hybrid", rays=8, order=3, **settings):
    return methods.run(methods.bake(mesh, method, order, rays=rays, **settings))


def run(points, normals, blocked, unshadowed, rays=4, network=None, threads=2):
    """`hybrid.filtered` of points as they are."""
    places, normals = hybrid.placed(points, normals)
    with ThreadPoolExecutor(threads) as pool:
        return hybrid.filtered(places, normals, hybrid.curves(places), blocked.astype(np.float32),
                               unshadowed.astype(np.float32), rays, network or weights.load_hybrid(), pool)


def slowly(points, normals, blocked, unshadowed, rays, network):
    """`hybrid.filtered`, block by block and pair by pair, as its docstring says."""
    order = sh.order_of(blocked.shape[1])
    places, normals = hybrid.placed(points, normals)
    now = blocked.astype(float).copy()
    now[:, 1:] -= now[:, :1] * unshadowed[:, 1:] / unshadowed[:, :1]
    for curve, layers in zip(hybrid.curves(places), network, strict=True):
        out = now.copy()
        for start in range(0, len(curve), hybrid.SIZE):
            fresh = curve[start:start + hybrid.SIZE]
            block = fresh if len(fresh) == hybrid.SIZE else curve[-hybrid.SIZE:]
            if not now[block, 0].any():
                continue
            centre = places[block].mean(0)
            size = np.sqrt(np.mean([np.sum((places[i] - centre) ** 2) for i in block]))
            x = np.array([0.5 * np.log(size), 2 * np.sum(normals[block].mean(0) ** 2), 4 * now[block, 0].mean(),
                          0.5 * np.log(now[block, 0].var() + 1e-6), 0.5 * np.log(now[block, 1:4].var(0).sum() + 1e-6),
                          0.5 * np.log(rays), np.log(len(block)) - 3])
            for number, layer in enumerate(layers):
                x = x @ layer.weight + layer.bias
                x = np.maximum(x, 0) if number + 1 < len(layers) else x
            distance, plane, facing, first, second, *own = np.exp(np.clip(x, -6, 12))[:5 + order]
            own = np.repeat(own, 2 * np.arange(order) + 1) * (64 + rays) / 64
            for i in fresh:
                sums, total = own * now[i], own.copy()
                for j in block:
                    away, gap = (places[j] - places[i]) / size, now[i, :4] - now[j, :4]
                    form = (distance * away @ away + plane * (normals[i] @ away) ** 2
                            + facing * (1 - normals[i] @ normals[j]) + first * gap[0] ** 2 + second * gap[1:] @ gap[1:])
                    sums, total = sums + np.exp(-form) * now[j], total + np.exp(-form)
                out[i] = sums / total
        now = out
    now[:, 1:] += now[:, :1] * unshadowed[:, 1:] / unshadowed[:, :1]
    return now


def test_equals_its_slow_twin():
    mesh = TriangleMesh.from_triangles(*shapes.torus(sections=20))
    lobe = sh.cosine_lobe(mesh.normals, 3)
    blocked = lobe - bake(mesh, "embree", 4).coefficients
    assert len(blocked) % hybrid.SIZE  # there is a rest
    found = run(mesh.points, mesh.normals, blocked, lobe)
    np.testing.assert_allclose(found, slowly(mesh.points, mesh.normals, blocked, lobe, 4, weights.load_hybrid()),
                               atol=1e-4)
    assert np.abs(found - blocked).max() > 0.01


def test_every_point_is_in_one_block_and_blocks_are_compact():
    mesh = knot()
    places, _ = hybrid.placed(mesh.points, mesh.normals)
    for curve in hybrid.curves(places):
        rows = hybrid.blocks(curve)
        assert rows.shape == (-(-len(places) // hybrid.SIZE), hybrid.SIZE)
        assert np.array_equal(np.unique(rows), np.arange(len(places)))
        inside = places[curve[:len(curve) // hybrid.SIZE * hybrid.SIZE].reshape(-1, hybrid.SIZE)]
        assert np.median(np.ptp(inside, axis=1).max(1)) < 0.25  # all of it: 1 across


@pytest.mark.parametrize(("rays", "factor"), [(2, 0.35), (8, 0.4), (32, 0.6)])
def test_takes_most_of_the_noise_away(case, rays, factor):
    mesh, unshadowed, truth = case
    plain, better = (metrics.srr(bake(mesh, m, rays).coefficients, truth, unshadowed) for m in ("embree", "hybrid"))
    assert better < factor * plain


@pytest.mark.parametrize("count", [6, 7, 1, 4096, 4097, 4099])
def test_points_between_others_see_as_much_and_differ_from_an_even_sky_alike(count):
    rng = np.random.default_rng(count)
    unshadowed = sh.cosine_lobe(_unit(rng.normal(size=(count, 3))), 3)
    some = rng.normal(size=(-(-count // 2), 9)).astype(np.float32)
    with ThreadPoolExecutor(2) as pool:
        found = hybrid.between(some, unshadowed.astype(np.float32), pool)
    for i in range(count):
        beside = [i] if i % 2 == 0 else [j for j in (i - 1, i + 1) if j < count]
        share = np.mean([some[j // 2, 0] for j in beside])
        differs = np.mean([some[j // 2] - some[j // 2, 0] * unshadowed[j] / unshadowed[j, 0] for j in beside], axis=0)
        np.testing.assert_allclose(found[i], share * unshadowed[i] / unshadowed[i, 0] + differs, atol=1e-5)


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_one_ray_a_point_is_two_from_every_other_one_and_better_than_two_from_each_without_the_network(case):
    mesh, unshadowed, truth = case
    one, two = bake(mesh, rays=1), bake(mesh, "embree", 2)
    assert one.record.rays == len(mesh.points)
    assert metrics.srr(one.coefficients, truth, unshadowed) < 0.5 * metrics.srr(two.coefficients, truth, unshadowed)
    ball = TriangleMesh.from_triangles(*shapes.sphere())
    assert len(ball.points) >= hybrid_bake.FEWEST
    np.testing.assert_allclose(bake(ball, rays=1).coefficients, sh.cosine_lobe(ball.normals, 3), atol=1e-6)


def test_with_many_rays_the_traced_value_stays(case):
    mesh, unshadowed, truth = case
    for order in (2, 5):
        plain, better = (bake(mesh, m, 4096, order).coefficients for m in ("embree", "hybrid"))
        assert metrics.rel_l2(better, plain) < 0.004
    few, many = (metrics.rel_l2(bake(mesh, "hybrid", r).coefficients, truth) for r in (16, 1024))
    assert many < 0.25 * few


def test_turning_the_mesh_turns_the_answer(case):
    mesh, _, _ = case
    q, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    lobe = sh.cosine_lobe(mesh.normals, 4)
    blocked = lobe - bake(mesh, "embree", 4, 4).coefficients
    straight = run(mesh.points, mesh.normals, blocked, lobe)
    turned = run(5 * mesh.points @ q.T + 100, mesh.normals @ q.T, _each_turned(blocked, q),
                 sh.cosine_lobe(mesh.normals @ q.T, 4))
    np.testing.assert_allclose(turned, _each_turned(straight, q), atol=1e-4)


def _each_turned(values, rotation):
    return sh.rotate_each(values, np.broadcast_to(rotation, (len(values), 3, 3)))


def test_convex_shapes_are_exact_and_all_blocked_is_exact():
    ball = TriangleMesh.from_triangles(*shapes.sphere())
    found = bake(ball, rays=2)
    np.testing.assert_allclose(found.coefficients, sh.cosine_lobe(ball.normals, 3), atol=1e-6)
    assert found.record.error_estimate == 0
    inside = TriangleMesh.from_triangles(ball.positions, ball.triangles[:, ::-1])  # seen from within: no sky at all
    assert np.abs(bake(inside, rays=2).coefficients).max() < 1e-4


def test_threads_and_the_order_of_points_do_not_matter(case):
    mesh, _, _ = case
    one, two = (bake(mesh, rays=4, threads=t).coefficients for t in (1, 2))
    np.testing.assert_allclose(one, two, atol=1e-5)
    bent = mesh.positions + 0.1 * mesh.positions[:, :1] ** 2  # no two of its points are equally far out
    mesh = TriangleMesh.from_triangles(bent, mesh.triangles)
    lobe = sh.cosine_lobe(mesh.normals, 3)
    blocked = lobe - bake(mesh, "embree", 4).coefficients
    shuffle = np.random.default_rng(0).permutation(len(mesh.points))
    first = run(mesh.points, mesh.normals, blocked, lobe)
    second = run(mesh.points[shuffle], mesh.normals[shuffle], blocked[shuffle], lobe[shuffle], threads=1)
    np.testing.assert_allclose(second, first[shuffle], atol=1e-5)


@pytest.mark.parametrize("wrong", [lambda blocked: np.full_like(blocked, 0.1), lambda blocked: 3 * blocked])
def test_a_network_that_errs_is_not_followed(case, monkeypatch, wrong):
    mesh, unshadowed, truth = case
    monkeypatch.setattr(hybrid_bake, "filtered", lambda places, normals, curves, blocked, *_: wrong(blocked))
    plain, found = (metrics.srr(bake(mesh, m, 16).coefficients, truth, unshadowed) for m in ("embree", "hybrid"))
    assert found < 1.1 * plain


def test_error_is_measured_and_a_tolerance_is_met(case):
    mesh, _, truth = case
    for seed in range(3):
        found = bake(mesh, rays=8, seed=seed)
        true = metrics.rel_l2(found.coefficients, truth)
        assert 0.6 < found.record.error_estimate / true < 1.5
    for tolerance in (0.1, 0.03):
        met = methods.run(methods.bake(mesh, "hybrid", 3, tolerance=tolerance))
        assert metrics.rel_l2(met.coefficients, truth) < 1.4 * tolerance
    easy, hard = (methods.run(methods.bake(mesh, "hybrid", 3, tolerance=t)).record.rays for t in (0.1, 0.02))
    assert easy < hard


def test_the_measured_error_is_not_of_shares_that_were_chosen_to_lessen_it():
    """What a network of mere noise moves is as often nearer as not; few points seem to say that some of it is."""
    rng = np.random.default_rng(0)
    work = SimpleNamespace(_order=3, unshadowed=np.ones((400, 9)))
    points = np.arange(0, 400, 10)
    found, chosen, true = [], [], []
    for _ in range(300):
        traced, taken = (rng.normal(size=(400, 9)).astype(np.float32) for _ in range(2))  # of the truth, which is 0
        taken = traced + 0.3 * taken
        one, two = rng.normal(size=(2, len(points), 9))
        blocked, here = hybrid_bake._Work.blended(work, traced, taken, points, one, two)
        found.append(((here - one) * (here - two)).sum(1).mean())
        chosen.append(((blocked[points] - one) * (blocked[points] - two)).sum(1).mean())
        true.append(np.square(blocked).sum(1).mean())
    scatter = np.std(found) / 300 ** 0.5
    assert abs(np.mean(found) - np.mean(true)) < 3 * scatter
    assert np.mean(chosen) < np.mean(found)  # the twin that the shares were chosen by


def test_the_samples_nets_are_independent_of_the_bakes_and_of_each_other(case):
    mesh, _, truth = case
    scene = Occluders([(mesh.positions, mesh.triangles)])
    every = np.arange(len(mesh.points))
    alike = []
    for seed in range(4):
        estimator = BlockedEstimator(mesh, scene, 3, seed, 8, spare=True)
        errors = []
        for one, rows in ((estimator, every), (estimator.apart(every, np.random.default_rng([seed, 1])),
                                               np.arange(2 * len(every)))):
            local = one.turned_here(rows, one.means(rows, one.summed(rows, 0, 8), 0, 8))
            errors += [found - (sh.cosine_lobe(mesh.normals, 3) - truth)
                       for found in np.split(local, len(rows) // len(every))]
        alike.append([(errors[i] * errors[j]).sum() / np.square(errors[i]).sum() for i, j in ((0, 1), (0, 2), (1, 2))])
    assert np.abs(np.mean(alike, axis=0)).max() < 0.05  # two that are one have 1


def bent_sheet(points):
    """A curl that shadows itself, of so many points and as many more as make its rows whole."""
    t, x = np.meshgrid(np.linspace(0, 5, -(-points // 8)), np.linspace(-1, 1, 8), indexing="ij")
    positions = np.stack([x, (1 + t / 8) * np.cos(t), (1 + t / 8) * np.sin(t)], -1).reshape(-1, 3)
    i, j = (g.ravel() for g in np.meshgrid(np.arange(len(t) - 1), np.arange(7), indexing="ij"))
    a, b, c, d = i * 8 + j, i * 8 + j + 1, (i + 1) * 8 + j + 1, (i + 1) * 8 + j
    return TriangleMesh.from_triangles(positions, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def refuse(*_):
    raise AssertionError("the network was asked")


@pytest.mark.parametrize(("rays", "traced"), [(2, 4), (8, 16), (40, 64), (64, 64), (100, 100)])
def test_of_few_points_more_rays_are_traced_and_no_network_is_asked(monkeypatch, rays, traced):
    mesh = bent_sheet(hybrid_bake.FEWEST - 8)
    monkeypatch.setattr(hybrid_bake, "filtered", refuse)
    found = bake(mesh, rays=rays)
    assert found.record.rays == traced * len(mesh.points)
    np.testing.assert_allclose(found.coefficients, bake(mesh, "embree", traced).coefficients, atol=1e-6)


def wires(count=40):
    """Thin prisms in all directions, about each other."""
    rng, parts = np.random.default_rng(0), []
    for number in range(count):
        one = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn = np.arange(6) * np.pi / 3
        ring = np.stack([0.01 * np.cos(turn), 0.01 * np.sin(turn), np.zeros(6)], 1)
        rings = np.concatenate([(ring + [0, 0, z]) @ one.T for z in (-1, -0.3, 0.3, 1)]) + rng.normal(size=3) * 0.2
        k, i = (g.ravel() for g in np.meshgrid(np.arange(3), np.arange(6), indexing="ij"))
        a, b, c, d = 6 * k + i, 6 * k + (i + 1) % 6, 6 * k + 6 + (i + 1) % 6, 6 * k + 6 + i
        parts.append((rings, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]) + 24 * number))
    return TriangleMesh.from_triangles(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def test_evenness_is_that_of_the_normals_of_blocks():
    normals = np.repeat(np.eye(3), hybrid.SIZE, 0)
    assert hybrid.evenness(normals) == pytest.approx(1)
    assert hybrid.evenness(np.tile(np.eye(3), (hybrid.SIZE, 1))) == pytest.approx(1 / 3, abs=0.01)
    normals[1::2] *= -1
    assert hybrid.evenness(normals) == 0


def test_of_wires_more_rays_are_traced_and_no_network_is_asked(monkeypatch):
    """A larger error than plain rays in the same time is what the network would have."""
    mesh = wires()
    monkeypatch.setattr(hybrid_bake, "filtered", refuse)
    assert len(mesh.points) >= hybrid_bake.FEWEST
    found = bake(mesh, rays=4)
    assert found.record.rays == 8 * len(mesh.points)
    np.testing.assert_allclose(found.coefficients, bake(mesh, "embree", 8).coefficients, atol=1e-6)
    assert bake(mesh, rays=None, tolerance=0.2).record.error_estimate <= 0.2
    with pytest.raises(AssertionError, match="asked"):  # frames that come one after another keep to their rays
        hybrid_bake.at_once(mesh, [], 3, 2, 0)


def test_of_more_points_the_network_is_asked(monkeypatch):
    monkeypatch.setattr(hybrid_bake, "filtered", refuse)
    with pytest.raises(AssertionError, match="asked"):
        bake(bent_sheet(hybrid_bake.FEWEST))


def test_of_few_points_the_error_is_measured_too_and_a_tolerance_is_met():
    mesh = bent_sheet(400)
    truth = bake(mesh, "embree", 2048, seed=5).coefficients
    for seed in range(3):
        found = bake(mesh, seed=seed)
        assert 0.6 < found.record.error_estimate / metrics.rel_l2(found.coefficients, truth) < 1.5
    met = methods.run(methods.bake(mesh, "hybrid", 3, tolerance=0.05))
    assert metrics.rel_l2(met.coefficients, truth) < 1.4 * 0.05


def test_texels_learn_from_the_grid():
    mesh = surface(shapes.torus())
    truth = methods.run(texture.bake(mesh, "embree", 3, side=64, rays=1024, seed=8))
    found = {m: methods.run(texture.bake(mesh, m, 3, uv=truth.uv, side=64, rays=4)) for m in ("embree", "hybrid")}
    uv = np.random.default_rng(0).uniform(0.1, 0.9, (500, 2))
    error = {m: metrics.rel_l2(lookup(f, uv), lookup(truth, uv)) for m, f in found.items()}
    assert error["hybrid"] < 0.6 * error["embree"]


def test_split_normals_learn_from_their_own_side():
    """Flat shaded: where four faces meet there are four points in one place; each goes on facing as it does."""
    smooth = knot()
    mesh = TriangleMesh.from_triangles(smooth.positions, smooth.triangles, smooth=False)
    assert mesh.domain == "CORNER"
    truth = bake(mesh, "embree", 1024, seed=5).coefficients
    unshadowed = sh.cosine_lobe(mesh.normals, 3)
    plain, better = (metrics.srr(bake(mesh, m, 4).coefficients, truth, unshadowed) for m in ("embree", "hybrid"))
    assert better < 0.5 * plain


@pytest.mark.parametrize("positions", [
    [(0, 0, 0), (1, 0, 0), (0, 1, 0)],                                      # one triangle
    [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 0), (5, 5, 5)],                # duplicate and isolated points
    [(0, 0, 0), (1e-30, 0, 0), (0, 1e-30, 0)], [(1e9, 0, 0), (1e9 + 256, 0, 0), (1e9, 256, 0)]])
def test_odd_meshes_give_finite_answers(positions):
    triangles = [(0, 1, 2)] if len(positions) < 5 else [(0, 1, 2), (3, 2, 1)]
    mesh = TriangleMesh.from_triangles(np.array(positions, float), np.array(triangles))
    assert np.isfinite(bake(mesh, rays=2).coefficients).all()


def test_points_in_one_place_give_finite_answers():
    same, up = np.zeros((3, 3)), np.tile([0.0, 0.0, 1.0], (3, 1))
    lobe = sh.cosine_lobe(up, 3)
    assert np.isfinite(run(same, up, lobe * [[0.1], [0.5], [0.9]], lobe, rays=2)).all()


@pytest.mark.parametrize("harm", ["missing", "cut", "altered", "no checksum"])
def test_weights_that_are_not_the_trained_ones_are_refused_by_name(tmp_path, harm):
    path = tmp_path / weights.HYBRID
    weights.save_hybrid(path, weights.load_hybrid())
    assert all(np.array_equal(a.weight, b.weight) for one, two in zip(
        weights.load_hybrid(path), weights.load_hybrid(), strict=True) for a, b in zip(one, two, strict=True))
    data = path.read_bytes()
    if harm == "missing":
        path.unlink()
    elif harm == "cut":
        path.write_bytes(data[:-5])
    elif harm == "altered":
        path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    else:
        (tmp_path / weights.CHECKSUMS).unlink()
    with pytest.raises(UserError, match="hybrid.safetensors"):
        weights.load(path)


def test_equals_the_torch_module_that_trained_it(case):
    torch = pytest.importorskip("torch", reason="needs torch, which only training does")
    from training.hybrid import Filter
    mesh, unshadowed, _ = case
    model = Filter()
    with torch.no_grad():
        for module, layers in zip(model.passes, weights.load_hybrid(), strict=True):
            for linear, layer in zip((m for m in module if hasattr(m, "weight")), layers, strict=True):
                linear.weight.copy_(torch.from_numpy(layer.weight.T.copy()))
                linear.bias.copy_(torch.from_numpy(layer.bias.copy()))
        blocked = (unshadowed - bake(mesh, "embree", 4).coefficients).astype(np.float32)
        places, normals = hybrid.placed(mesh.points, mesh.normals)
        expected = model(*(torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in (places, normals)),
                         [torch.from_numpy(curve) for curve in hybrid.curves(places)], torch.from_numpy(blocked),
                         torch.from_numpy(unshadowed.astype(np.float32)), 4)[-1].numpy()
    found = run(mesh.points, mesh.normals, blocked, unshadowed, network=model.network())
    np.testing.assert_allclose(found, expected, atol=1e-5)
