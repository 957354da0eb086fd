# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes where no light comes in, or hardly any: nothing to be relative to, and little to measure by."""
import numpy as np
import pytest

from neural_gash_addon.backend import methods, metrics, texture
from neural_gash_addon.backend.geometry import TriangleMesh

from . import shapes
from .test_texture import atlas, surface

TRACING = "auto", "embree", "hybrid", "sparse"


def shell(height):
    """A sphere seen from within, but for the cap above a height."""
    positions, triangles = shapes.sphere(4)
    return TriangleMesh.from_triangles(positions, triangles[positions[triangles, 2].mean(1) < height][:, ::-1])


@pytest.mark.parametrize("method", TRACING)
def test_in_the_dark_few_rays_are_traced_and_no_error_is_claimed(method):
    mesh = shell(2.0)
    found = methods.run(methods.bake(mesh, method, 3, tolerance=0.01))
    assert np.abs(found.coefficients).max() < 1e-6 and found.record.error_estimate is None
    assert found.record.rays + found.record.probe_rays <= 160 * len(mesh.points)
    if method == "auto":
        assert found.record.plan.startswith("Hardly any light comes in: ")


@pytest.mark.parametrize("method", TRACING)
def test_little_light_is_still_looked_for(method):
    """A window of a hundredth of the sphere, which few points face squarely."""
    mesh = shell(0.95)
    truth = methods.run(methods.bake(mesh, "embree", 3, rays=4096, seed=9)).coefficients
    for tolerance in (0.1, 0.04):
        found = methods.run(methods.bake(mesh, method, 3, tolerance=tolerance))
        error, claimed = metrics.rel_l2(found.coefficients, truth), found.record.error_estimate
        assert error < 1.5 * tolerance and claimed is not None and error < 1.5 * claimed


@pytest.mark.parametrize("subdivisions", [0, 1, 2])
def test_a_closed_box_that_is_shaded_smooth_lets_no_light_in(subdivisions):
    """Normals lean up to 55 degrees out of its faces: where rays start must not."""
    mesh = surface(shapes.cube(inside=True, subdivisions=subdivisions))
    result = methods.run(texture.bake(mesh, uv=atlas(mesh, 64).uv, side=64, order=3, rays=64))
    assert max(np.abs(c).max() for c in result.coefficients) < 1e-6
