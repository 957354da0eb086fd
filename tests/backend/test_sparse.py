# SPDX-License-Identifier: GPL-3.0-or-later
"""The sparse bake: reconstruction against a plain twin, the error it reports, and what it saves."""
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from neural_gash_addon.backend import embree_bake, hybrid_bake, methods, metrics, sparse_bake
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.pilot import look
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.backend.workers import workers

from .shapes import sphere, torus


def bake(mesh, **arguments):
    return methods.run(methods.bake(mesh, **arguments))


@pytest.fixture(scope="module")
def dense():
    """A torus of 66,000 vertices, which shadows itself inside."""
    return TriangleMesh.from_triangles(*torus(sections=364))


@pytest.fixture(scope="module")
def reference(dense):
    """A thinned-out reference: every 16th point, 1024 rays, a seed of its own."""
    rows = np.arange(0, len(dense.points), 16)
    few = replace(dense, points=dense.points[rows], normals=dense.normals[rows], clearance=dense.clearance[rows])
    return rows, bake(few, method="embree", rays=1024, seed=99).coefficients


def test_reconstruction_equals_a_plain_loop():
    rng = np.random.default_rng(3)
    points, normals = rng.normal(size=(60, 3)), rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    samples, wanted = np.arange(0, 60, 4), np.array([1, 2, 18, 33, 59])
    values = rng.normal(size=(len(samples), 4)).astype(np.float32)
    found = sparse_bake.Samples.at(points[samples], normals[samples], values).read(
        sparse_bake.beside(samples, wanted), points[wanted], normals[wanted])
    for row, i in enumerate(wanted):
        before = sum(1 for s in samples if s < i)
        first = min(max(before - 4, 0), len(samples) - 8)
        total, weights = np.zeros(4), 0.0
        distances = []
        for j in range(first, first + 8):
            away = points[samples[j]] - points[i]
            turn = max(1 - normals[samples[j]] @ normals[i], 0)
            distances.append(away @ away + 8 * (away @ normals[i]) ** 2 + 0.2 ** 2 * turn)
        for j, d in zip(range(first, first + 8), distances, strict=True):
            w = 1 / (d + 0.05 * np.mean(distances)) ** 2
            total, weights = total + w * values[j], weights + w
        np.testing.assert_allclose(found[row], total / weights, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("tolerance", [0.1, 0.03])
def test_error_is_within_the_tolerance_and_said_honestly(dense, reference, tolerance):
    rows, truth = reference
    found = bake(dense, method="sparse", tolerance=tolerance)
    error = metrics.rel_l2(found.coefficients[rows], truth)
    assert error <= 1.25 * tolerance
    assert error / 1.5 <= found.record.error_estimate <= 1.5 * error


def test_far_fewer_rays_than_a_bake_of_every_vertex(dense):
    every = bake(dense, method="embree", tolerance=0.03).record
    some = bake(dense, method="sparse", tolerance=0.03).record
    assert some.rays + some.probe_rays < every.rays / 4


def test_what_a_plan_gives_up_is_baked_the_cheaper_way(dense, monkeypatch):
    """With a pilot that expects the hybrid to need less than half of the rays, by that; else, and without, plainly."""
    scene = Occluders([(dense.positions, dense.triangles)])
    with workers(1) as pool:
        seen = methods.run(look(dense, scene, 3, 0.05, 0, pool, 1))
        seen = methods.run(hybrid_bake.tried(dense, scene, 3, seen, 0.05, 0, pool, 1))  # as it is where that was not
    known = {"rays": None, "tolerance": 0.05, "occluders": (), "seed": 0, "threads": 1, "scene": scene}
    plainly, few = (methods.run(module.bake(dense, 3, pilot=seen, **known)) for module in (embree_bake, hybrid_bake))

    def give_up(self, *_):
        yield 0.0

    monkeypatch.setattr(sparse_bake._Work, "refine", give_up)
    found = methods.run(sparse_bake.bake(dense, 3, pilot=seen, **known))
    assert found.record.method == "sparse" and found.record.rays < plainly.record.rays / 2
    np.testing.assert_array_equal(found.coefficients, few.coefficients)
    tried = methods.run(sparse_bake.bake(dense, 3, pilot=replace(seen, near=None), **known))
    np.testing.assert_array_equal(tried.coefficients, few.coefficients)
    points = len(dense.points)
    assert tried.record.probe_rays == found.record.probe_rays + seen.near.rays * 64 * (points // 1024)
    smooth_nowhere = replace(seen, near=replace(seen.near, taken=seen.near.traced))
    for pilot in (smooth_nowhere, None):
        found = methods.run(sparse_bake.bake(dense, 3, pilot=pilot, **known))
        assert found.record.rays >= 0.9 * plainly.record.rays


def test_where_more_samples_do_not_help_it_gives_up(dense, monkeypatch):
    """As where what is left is the noise of few rays: not a round more than tells that, nor an error where all are."""
    scene = Occluders([(dense.positions, dense.triangles)])
    with workers(1) as pool:
        seen = methods.run(look(dense, scene, 3, 0.05, 0, pool, 1))
    counts = []

    def error(self, *_):
        counts.append(len(self.samples))
        return 0.048

    monkeypatch.setattr(sparse_bake._Work, "_error", error)
    known = {"rays": None, "tolerance": 0.05, "occluders": (), "seed": 0, "threads": 1, "scene": scene}
    found = methods.run(sparse_bake.bake(dense, 3, pilot=seen, **known))
    assert 1 < len(counts) < 8 and counts[-1] < len(dense.points) / 2
    assert found.record.rays > 2 * len(dense.points)  # of every point
    for samples, before in ((50_000, [(20_000, 0.5), (50_000, 0.4)]), (20, [(5, 1.0), (10, 0.9), (20, 1e6)])):
        work = SimpleNamespace(_lit=np.arange(60_000), samples=np.arange(samples))
        assert np.isfinite(sparse_bake._Work._wanted(work, before, 1e-4, True))
    work = SimpleNamespace(_lit=np.arange(9), samples=np.arange(9), _values=np.zeros((9, 4), np.float32))
    assert sparse_bake._Work._wanted(work, [(9, 0.5)], 0.1, True) == np.inf
    assert not len(sparse_bake._Work._to_close(work))


def test_points_few_enough_are_all_traced():
    mesh = TriangleMesh.from_triangles(*torus())
    found = bake(mesh, method="sparse", rays=64)
    assert found.record.rays == 64 * len(mesh.points)


def test_a_convex_mesh_is_exact_and_a_closed_one_dark():
    positions, triangles = sphere(6)
    open_sky = TriangleMesh.from_triangles(positions, triangles)
    found = bake(open_sky, method="sparse", tolerance=0.05)
    np.testing.assert_allclose(found.coefficients, sh.cosine_lobe(open_sky.normals, 3), atol=1e-6)
    closed = bake(TriangleMesh.from_triangles(positions, triangles[:, ::-1]), method="sparse", rays=16)
    assert np.abs(closed.coefficients).max() < 1e-5


def test_points_without_a_normal_get_nothing():
    positions, triangles = torus()
    mesh = TriangleMesh.from_triangles(np.vstack([positions, [[9, 9, 9]]]), triangles)
    assert not bake(mesh, method="sparse", tolerance=0.1).coefficients[-1].any()
