# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes tried at a pilot's points, where meshes are dense: what they say comes true, and plans follow it."""
from dataclasses import replace

import numpy as np
import pytest

from neural_gash_addon.backend import hybrid_bake, methods, metrics, plan, sparse_bake
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.pilot import DENSE, Pilot, look
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.backend.workers import workers

from .shapes import torus


class Case:
    """A torus of 66,000 vertices, smooth, or rough from each vertex to the next."""

    def __init__(self, rough: bool) -> None:
        positions, triangles = torus(sections=364)
        if rough:
            positions = positions * (1 + 0.015 * np.random.default_rng(4).normal(size=(len(positions), 1)))
        self.mesh = TriangleMesh.from_triangles(positions, triangles)
        self.scene = Occluders([(positions, triangles)], self.mesh.resolution)
        self.rows = np.arange(0, len(positions), 16)
        few = replace(self.mesh, points=self.mesh.points[self.rows], normals=self.mesh.normals[self.rows],
                      clearance=self.mesh.clearance[self.rows])
        self.truth = methods.run(methods.bake(few, "embree", 3, rays=1024, seed=99)).coefficients

    def tried(self, tolerance, seed=1, order=3):
        with workers(1, 1) as pool:
            found = methods.run(look(self.mesh, self.scene, order, tolerance, seed, pool, 1))
        return found, methods.run(plan.tried(self.mesh, self.scene, order, found, tolerance, seed, 1))

    def error(self, found):
        return metrics.rel_l2(found.coefficients[self.rows], self.truth)


@pytest.fixture(scope="module")
def smooth():
    return Case(rough=False)


@pytest.fixture(scope="module")
def rough():
    return Case(rough=True)


@pytest.mark.parametrize("tolerance", [0.1, 0.03])
def test_a_hybrid_bake_with_the_rays_that_were_tried_brings_about_the_tolerance(smooth, rough, tolerance):
    rays = {}
    for case in (smooth, rough):
        found, more = case.tried(tolerance)
        assert found.near is None and more.traced > found.traced
        rays[case] = hybrid_bake.expected_rays(more, len(case.mesh.points), tolerance)
        answer = methods.run(methods.bake(case.mesh, "hybrid", 3, rays=rays[case]))
        assert 0.5 < case.error(answer) / tolerance < 1.4 or (rays[case] == 2 and case.error(answer) < tolerance)
    assert rays[smooth] < rays[rough]


def test_a_sparse_bake_takes_the_rays_that_were_tried_or_is_known_to_give_up(smooth, rough):
    points = len(smooth.mesh.points)
    for tolerance in (0.1, 0.03):
        _, found = smooth.tried(tolerance)
        done = methods.run(sparse_bake.bake(smooth.mesh, 3, rays=None, tolerance=tolerance, occluders=(), seed=2,
                                            threads=1, scene=smooth.scene, pilot=found)).record
        expected = sparse_bake.expected_rays(found, points, tolerance)
        assert 0.4 < done.rays / points / expected < 2.5
    assert sparse_bake.expected_rays(rough.tried(0.03)[1], points, 0.03) == np.inf


def test_plans_follow(smooth, rough):
    for case, expected in ((smooth, "sparse"), (rough, "hybrid")):
        found = methods.run(methods.bake(case.mesh, "auto", 3, tolerance=0.05, seed=1, threads=1, scene=case.scene))
        assert found.record.method == expected
        assert 0.3 * 0.05 < case.error(found) < 1.1 * 0.05


def test_fewer_bands_are_those_of_all(rough):
    """What was tried with all bands says of fewer what it would have said, had it been tried with these."""
    _, found = rough.tried(0.1, order=4)
    fewer = found.to_order(2)
    assert fewer.near.traced.shape == fewer.near.taken.shape == fewer.apart.read.shape == (64, 4)
    np.testing.assert_array_equal(fewer.near.taken, found.near.taken[:, :4])
    _, alone = rough.tried(0.1, order=2)
    points = len(rough.mesh.points)
    assert 0.5 < (hybrid_bake.expected_rays(fewer, points, 0.05) / hybrid_bake.expected_rays(alone, points, 0.05)) < 2


def test_points_are_spread_over_all_that_a_pilot_has():
    found = Pilot(0.3, 0.4, 0.03, rays=64, scale=1.0, ray=1e-7, traced=1, varies=0.3, turns=1.0,
                  sample=(np.arange(300), np.zeros((300, 9)), np.zeros((300, 9))))
    some = found.some(DENSE)
    assert len(some) == 64 and some[0] == 0 and some[-1] == 299 and np.diff(some).min() >= 4
    assert len(found.some(10**7)) == 256


def test_nothing_is_tried_of_few_points_nor_in_the_dark(smooth):
    mesh = TriangleMesh.from_triangles(*torus(sections=64))
    scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    with workers(1, 1) as pool:
        few = methods.run(look(mesh, scene, 3, 0.05, 1, pool, 1))
        light = methods.run(look(smooth.mesh, smooth.scene, 3, 0.05, 1, pool, 1))
    assert methods.run(plan.tried(mesh, scene, 3, few, 0.05, 1, 1)) is few
    dark = replace(light, scale=0.0)
    assert methods.run(plan.tried(smooth.mesh, smooth.scene, 3, dark, 0.05, 1, 1)) is dark


def test_leaves_are_not_tried_with_the_network_that_they_would_not_be_asked():
    rng = np.random.default_rng(5)
    corners = rng.uniform(-1, 1, (DENSE // 3 + 1, 1, 3)) + 0.02 * rng.normal(size=(DENSE // 3 + 1, 3, 3))
    mesh = TriangleMesh.from_triangles(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3))
    scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    with workers(1, 1) as pool:
        found = methods.run(look(mesh, scene, 3, 0.2, 1, pool, 1))
    more = methods.run(plan.tried(mesh, scene, 3, found, 0.2, 1, 1))
    assert more.near is None and more.apart is not None
    assert np.isfinite(sh.cosine_lobe(mesh.normals, 3)).all() and np.isfinite(more.apart.read).all()
