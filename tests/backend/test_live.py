# SPDX-License-Identifier: GPL-3.0-or-later
"""A mesh that deforms, baked within a budget."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from neural_gash_addon.backend import methods
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.hybrid_bake import at_once
from neural_gash_addon.backend.live import Live, LivePlan, best

from .shapes import cube, sphere


def fold(angle: float) -> TriangleMesh:
    """A square of 48 x 48 cells with a bend in the middle."""
    line = np.linspace(-1, 1, 49)
    x, y = (a.ravel() for a in np.meshgrid(line, line))
    z = np.maximum(x, 0) * np.sin(angle)
    x = np.where(x > 0, x * np.cos(angle), x)
    corner = np.arange(49 * 49).reshape(49, 49)
    a, b, c, d = (q.ravel() for q in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    return TriangleMesh.from_triangles(np.stack([x, y, z], 1), np.concatenate([np.stack([a, b, c], 1),
                                                                               np.stack([a, c, d], 1)]))


def residual(mesh: TriangleMesh, found: np.ndarray) -> float:
    """SRR against a good bake."""
    truth = methods.run(methods.bake(mesh, "embree", 3, rays=1024, seed=9)).coefficients
    return float(np.square(found - truth).sum() / np.square(sh.cosine_lobe(mesh.normals, 3) - truth).sum())


def test_each_level_follows_the_deformation():
    live = Live(fold(0.3), 3)
    mesh = fold(2.0)
    assert live.fits(mesh)
    errors = [residual(mesh, live.bake(mesh, (), LivePlan("hybrid", 16, level, 0, 0, 0))) for level in (0, 1)]
    assert errors[0] < 0.02 and errors[1] < 0.1, errors


def test_level_0_is_the_bake_itself():
    mesh = fold(1.5)
    found = Live(mesh, 3).bake(mesh, (), LivePlan("hybrid", 8, 0, 0, 0, 0))
    np.testing.assert_array_equal(found, at_once(mesh, (), 3, 8, 0))
    found = Live(mesh, 3).bake(mesh, (), LivePlan("gnn", None, 0, 0, 0, 0))
    np.testing.assert_array_equal(found, methods.run(methods.bake(mesh, "gnn", 3)).coefficients)


def test_at_once_is_the_hybrid_bake_that_follows_its_network():
    """The hybrid bake blends the network's answer in by measurement; where rays are few, it takes nearly all of it."""
    mesh = TriangleMesh.from_triangles(*sphere(3))
    above = (trimesh.creation.icosphere(2).vertices + [0, 0, 2.5], trimesh.creation.icosphere(2).faces)
    quick = at_once(mesh, [above], 3, 4, 0)
    slow = methods.run(methods.bake(mesh, "hybrid", 3, rays=4, occluders=[above])).coefficients
    unshadowed = sh.cosine_lobe(mesh.normals, 3)
    assert np.abs(quick - slow).max() < 0.3 * np.abs(unshadowed - slow).max()
    np.testing.assert_allclose(quick[quick[:, 0] == unshadowed[:, 0]], slow[quick[:, 0] == unshadowed[:, 0]], atol=0.02)


def test_occluders_count_at_every_level():
    mesh = TriangleMesh.from_triangles(*sphere(4))
    live = Live(mesh, 3)
    lid = (np.array([[-9, -9, 1.5], [9, -9, 1.5], [9, 9, 1.5], [-9, 9, 1.5]]), np.array([[0, 1, 2], [0, 2, 3]]))
    top = np.argmax(mesh.points[:, 2])
    for level in range(2):
        plan = LivePlan("hybrid", 16, level, 0, 0, 0)
        assert live.bake(mesh, (), plan)[top, 0] > 0.8 * sh.cosine_lobe(np.array([[0, 0, 1.0]]), 3)[0, 0]
        assert live.bake(mesh, [lid], plan)[top, 0] < 0.05


def test_an_open_mesh_gets_all_light_exactly():
    mesh = TriangleMesh.from_triangles(*sphere(4))
    found = Live(mesh, 3).bake(mesh, (), LivePlan("hybrid", 4, 0, 0, 0, 0))
    np.testing.assert_allclose(found, sh.cosine_lobe(mesh.normals, 3), atol=1e-6)


def test_more_time_gives_less_error(monkeypatch):
    """Time is told by a clock that counts rays, so that the machine does not decide."""
    mesh, ticks = fold(2.0), [0.0]

    def bake(self, mesh, occluders, plan, real=Live.bake):
        found = real(self, mesh, occluders, plan)
        ticks[0] += 1e-6 * plan.points * (plan.rays or 100)
        return found

    monkeypatch.setattr(Live, "bake", bake)
    monkeypatch.setattr("neural_gash_addon.backend.live.time.perf_counter", lambda: ticks[0])
    live = Live(mesh, 3)
    plans = [best(live.tried(mesh, (), seconds), seconds) for seconds in (0.0, 0.004, 0.02, 1.0)]
    assert plans[0].rays == 2 and plans[0].level == 1 and plans[0].seconds > 0  # the quickest, though it is too slow
    assert all(plan.seconds <= seconds for plan, seconds in zip(plans[1:], (0.004, 0.02, 1.0), strict=True))
    errors = [plan.error for plan in plans]
    assert errors == sorted(errors, reverse=True) and errors[-1] < 0.05 < errors[0]
    truth = methods.run(methods.bake(mesh, "embree", 3, rays=2048, seed=7)).coefficients
    for plan in plans:
        found = live.bake(mesh, (), plan)
        true = float(np.square(found - truth).sum() / np.square(truth).sum()) ** 0.5
        assert plan.error == pytest.approx(true, rel=0.25, abs=0.005)


def test_split_normals_are_baked_at_every_point():
    mesh = TriangleMesh.from_triangles(*cube(subdivisions=4), smooth=False)
    live = Live(mesh, 3)
    assert {plan.level for plan in live.tried(mesh, (), 0.0)} == {0}
    np.testing.assert_allclose(live.bake(mesh, (), LivePlan("hybrid", 4, 0, 0, 0, 0)), sh.cosine_lobe(mesh.normals, 3),
                               atol=1e-6)


def test_another_topology_does_not_fit():
    mesh = fold(1.0)
    live = Live(mesh, 3)
    assert not live.fits(replace(mesh, triangles=mesh.triangles[:, ::-1]))
    assert not live.fits(TriangleMesh.from_triangles(*sphere(2)))


def test_without_normals_nothing_is_lit():
    mesh = TriangleMesh.from_triangles(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    live = Live(mesh, 3)
    assert not live.bake(mesh, (), best(live.tried(mesh, (), 1.0), 1.0)).any()
