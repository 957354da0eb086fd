# SPDX-License-Identifier: GPL-3.0-or-later
"""How many bounces a plan computes: none where there is nothing to compute, and as few as the tolerance allows."""
import numpy as np
import pytest

from neural_gash_addon.backend import bounce, methods
from neural_gash_addon.backend.bounce import LEFT_OUT, MAX_BOUNCES, Bounces, Reflection
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.raycast import Occluders

from .shapes import sphere, torus
from .test_bounce import cornell


def room():
    """The Cornell box as one flat-shaded mesh, and its albedo (F, 3)."""
    parts = cornell()
    first = np.cumsum([0, *(len(p) for (p, _), _ in parts)])
    mesh = TriangleMesh.from_triangles(np.concatenate([p for (p, _), _ in parts]),
                                       np.concatenate([t + n for ((_, t), _), n in zip(parts, first, strict=False)]),
                                       smooth=False)
    return mesh, np.concatenate([np.tile(colour, (len(t), 1)) for (_, t), colour in parts])


def bake(mesh, albedo, bounces=8, **arguments):
    reflection = Reflection(albedo, bounces)
    return methods.run(methods.bake(mesh, **arguments, reflection=reflection)), reflection.solution


@pytest.mark.parametrize("method", ["auto", "embree"])
def test_black_materials_compute_no_bounce(monkeypatch, method):
    monkeypatch.setattr(bounce, "Bounces", None)  # calling it would be an error
    mesh, albedo = room()
    found, _ = bake(mesh, 0 * albedo, method=method, tolerance=0.05)
    assert found.record.bounces == 0 and found.record.colours == 1 and found.coefficients.ndim == 2
    assert ("black" in found.record.plan) == (method == "auto")


def test_a_convex_mesh_computes_no_bounce_and_traces_no_ray(monkeypatch):
    monkeypatch.setattr(methods, "_embree_scene", None)
    mesh = TriangleMesh.from_triangles(*sphere(3))
    found, _ = bake(mesh, np.full((len(mesh.triangles), 3), 0.8), method="auto", tolerance=0.01)
    assert found.record.bounces == found.record.rays == found.record.probe_rays == 0
    assert found.record.plan.endswith("No point sees another surface: no bounce is computed.")


def test_as_few_bounces_as_the_tolerance_allows():
    """What is left out, against all bounces, is no more than its share of the tolerance, and said about right."""
    mesh, albedo = room()
    parts = [(mesh.positions, mesh.triangles)]
    every = Bounces(parts, albedo, Occluders(parts), 3)
    methods.run(every.solve(MAX_BOUNCES, 1e-4))
    whole = every.direct[:, :, None] + every.gathered(every._leaving).reshape(len(every.sides), 9, 3)
    used = []
    for tolerance in (0.3, 0.1, 0.03):
        found, some = bake(mesh, albedo, method="auto", tolerance=tolerance)
        here = some.direct[:, :, None] + some.gathered(some._leaving).reshape(len(some.sides), 9, 3)
        areas = every._areas()
        missing = bounce._size(whole - here, areas) / bounce._size(whole, areas)
        assert missing <= 1.2 * LEFT_OUT * tolerance + 2e-3
        assert missing / 2 < some.left_out < 2 * missing
        assert f"Of 8 bounces asked for, {some.used}" in found.record.plan and found.record.bounces == some.used
        used.append(some.used)
    assert used[0] < used[1] < used[2] < 8


def test_bounces_that_would_not_be_seen_are_not_gathered(monkeypatch):
    monkeypatch.setattr(Bounces, "gather", None)
    mesh = TriangleMesh.from_triangles(*torus())
    found, solution = bake(mesh, np.full((len(mesh.triangles), 3), 0.02), method="auto", tolerance=0.1)
    assert solution.used == 0 and found.record.colours == 1
    assert found.record.plan.endswith("no bounce is computed.")


def test_what_is_not_planned_computes_what_it_did():
    mesh, albedo = room()
    asked, _ = bake(mesh, albedo, bounces=3, method="embree", tolerance=0.2)
    assert asked.record.bounces == 3 and not asked.record.plan
    planned, _ = bake(mesh, albedo, bounces=1, method="auto", tolerance=0.02)
    assert planned.record.bounces == 1 and "Bounces computed: 1 of the 1 asked for." in planned.record.plan
