# SPDX-License-Identifier: GPL-3.0-or-later
"""What a pilot's points say of rays that are wanted, and of the error of a bake."""
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from neural_gash_addon.backend import embree_bake, hybrid, hybrid_bake, methods, metrics
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.pilot import Pilot, look, noise_beside
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.backend.workers import workers

from .shapes import sphere, torus


def bumpy():
    positions, triangles = sphere(5)
    return positions * (1 + 0.2 * np.sin(9 * positions).prod(1, keepdims=True)), triangles


def heap():
    """Balls through each other: shadows with edges."""
    rng, (positions, triangles) = np.random.default_rng(3), sphere(4)
    return (np.concatenate([positions + 1.2 * rng.normal(size=3) for _ in range(6)]),
            np.concatenate([triangles + n * len(positions) for n in range(6)]))


def piloted(mesh, tolerance, seed=1):
    scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    with workers(1, 1) as pool:
        return scene, methods.run(look(mesh, scene, 3, tolerance, seed, pool, 1))


def seen(noise=0.03, varies=0.1, turns=1.0):
    return Pilot(0.3, 0.4, noise, rays=64, scale=1.0, ray=1e-7, traced=1, sample=(), varies=varies, turns=turns)


@pytest.mark.parametrize("shape", [torus(sections=128), bumpy(), heap()], ids=["torus", "bumpy", "heap"])
@pytest.mark.parametrize("tolerance", [0.05, 0.02, 0.01])
def test_the_rays_expected_bring_about_the_tolerance(shape, tolerance):
    mesh = TriangleMesh.from_triangles(*shape)
    truth = methods.run(methods.bake(mesh, "embree", 3, rays=2048, seed=9)).coefficients
    _, found = piloted(mesh, tolerance)
    rays = hybrid_bake.expected_rays(found, len(mesh.points), tolerance)
    answer = methods.run(methods.bake(mesh, "hybrid", 3, rays=rays)).coefficients
    assert 0.5 < metrics.rel_l2(answer, truth) / tolerance < 1.5


def test_an_error_too_small_to_tell_is_said_to_be_as_large_as_can_be_told():
    """Traces are the truth and noise: of the truth itself nothing, or less than nothing, is left but their noise."""
    rng, points = np.random.default_rng(2), np.arange(128)
    truth = rng.normal(size=(128, 9))
    for _ in range(60):
        one, two = (truth + 0.1 * rng.normal(size=truth.shape) for _ in range(2))
        found = Pilot(0.3, 0.4, 0.1, 16, 1.0, 1e-7, 1, (points, one, two), 0.1, 1.0, 2 * truth)
        noise = (0.1 ** 4 * 128 * 9) ** 0.25 / 128 ** 0.5 / 3  # of the root of the sum of products, relative
        assert 0.5 * noise < found.error_of(truth) < 3 * noise
        large = truth + 0.5 * rng.normal(size=truth.shape)
        assert found.error_of(large) == pytest.approx(metrics.rel_l2(large, truth), rel=0.2)


def test_fewer_rays_are_expected_where_neighbours_tell_more_and_never_more_than_plain_ones():
    rays = hybrid_bake.expected_rays
    few = rays(seen(), 10_000, 0.02)
    assert few < rays(seen(), 10_000, 0.01) < rays(seen(noise=0.1), 10_000, 0.01)
    assert rays(seen(varies=0.02), 10_000, 0.02) < few < rays(seen(varies=0.5), 10_000, 0.02)
    assert rays(seen(turns=0.3), 10_000, 0.02) < few
    assert rays(seen(), 1_000_000, 0.02) <= few <= rays(seen(), 1000, 0.02)
    worst = seen(varies=9.0)
    assert worst.needed_rays(0.02) <= rays(worst, 10_000, 0.02) < 1.5 * worst.needed_rays(0.02)
    assert rays(seen(noise=np.inf, varies=np.inf), 10_000, 0.02) == hybrid_bake.MAX_RAYS


def test_what_varies_is_that_of_points_beside_each_other_without_noise():
    """Beside a trace of so many rays that there is none."""
    mesh = TriangleMesh.from_triangles(*bumpy())
    _, rough = piloted(mesh, 0.2)
    points = rough.sample[0]
    truth = methods.run(methods.bake(mesh, "embree", 3, rays=2048, seed=9)).coefficients[points].astype(float)
    unshadowed = sh.cosine_lobe(mesh.normals[points], 3)
    steps = np.diff(hybrid.levelled(unshadowed - truth, unshadowed, -1), axis=0)
    assert rough.varies == pytest.approx((np.square(steps).sum(1).mean() / np.square(truth).sum(1).mean()) ** 0.5,
                                         rel=0.1)
    steps = np.diff(mesh.normals[points], axis=0)
    assert rough.turns == pytest.approx(np.square(steps).sum(1).mean() ** 0.5)


def test_levelling_is_undone_by_its_inverse_and_leaves_nothing_of_an_even_sky():
    rng = np.random.default_rng(0)
    unshadowed = sh.cosine_lobe(rng.normal(size=(50, 3)) / 2, 3).astype(np.float32)
    blocked = rng.normal(size=(50, 9)).astype(np.float32)
    np.testing.assert_allclose(hybrid.levelled(hybrid.levelled(blocked, unshadowed, -1), unshadowed, 1), blocked,
                               atol=1e-5)
    normals = rng.normal(size=(50, 3))
    unshadowed = sh.cosine_lobe(normals / np.linalg.norm(normals, axis=1, keepdims=True), 3)
    assert np.abs(hybrid.levelled(0.3 * unshadowed, unshadowed, -1)[:, 1:]).max() < 1e-6


def test_the_noise_of_other_rays_follows_the_law():
    mesh = TriangleMesh.from_triangles(*bumpy())
    scene, found = piloted(mesh, 0.02)
    truth = methods.run(methods.bake(mesh, "embree", 3, rays=4096, seed=9)).coefficients
    for rays in (32, 80, 96, 128, 256):
        plain = methods.run(methods.bake(mesh, "embree", 3, rays=rays, seed=2)).coefficients
        assert found.noise_of(rays) == pytest.approx(metrics.rel_l2(plain, truth), rel=0.25)
    assert noise_beside(64, 128) == pytest.approx(2 ** -0.75)


def test_a_sample_of_few_rays_says_the_error_of_many_as_the_noise_of_both_is_known():
    """Beside what the sample alone says: as right in the mean, and far less scattered."""
    rng = np.random.default_rng(0)
    points, rays, sample_rays = np.arange(0, 400, 4), 256, 64
    work = SimpleNamespace(_sample_rays=sample_rays, unshadowed=np.full((400, 9), 2.0))
    rough = 1 / noise_beside(sample_rays, rays)  # the sample's noise, where the bake's is 1
    said, alone, true = [], [], []
    for _ in range(300):
        traced = rng.normal(size=(400, 9)).astype(np.float32)  # of the truth, which is 0
        answer = (0.7 * traced)[points]
        one, two = rough * rng.normal(size=(2, len(points), 9))
        said.append(hybrid_bake._Work.error(work, answer, traced, rays, points, one, two))
        work._sample_rays = rays  # as if it had as many
        alone.append(hybrid_bake._Work.error(work, answer, traced, rays, points, one, two))
        work._sample_rays = sample_rays
        true.append(float(np.square(answer).sum(1).mean() / 36) ** 0.5)
    said, alone, true = (np.square(each) for each in (said, alone, true))
    assert abs(said.mean() / true.mean() - 1) < 0.05 and abs(alone.mean() / true.mean() - 1) < 0.2
    assert np.std(said) < 0.5 * np.std(alone)


@pytest.mark.parametrize("wish", [{"rays": 32, "tolerance": None}, {"rays": None, "tolerance": 0.02}])
def test_a_plain_bake_measures_its_error_at_the_pilots_points(wish):
    mesh = TriangleMesh.from_triangles(*bumpy())
    truth = methods.run(methods.bake(mesh, "embree", 3, rays=2048, seed=9)).coefficients
    scene, found = piloted(mesh, 0.02)
    baked = methods.run(embree_bake.bake(mesh, 3, **wish, occluders=(), seed=3, threads=1, scene=scene, pilot=found))
    assert baked.record.probe_rays == 0
    assert baked.record.error_estimate == pytest.approx(metrics.rel_l2(baked.coefficients, truth), rel=0.2)
    dark = replace(found, unshadowed=np.zeros_like(found.unshadowed), sample=(found.sample[0],
                                                                             *np.zeros_like(found.sample[1:])))
    assert dark.error_of(baked.coefficients) is None
