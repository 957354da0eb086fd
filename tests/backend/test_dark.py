# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes where no light comes in, or hardly any: nothing to be relative to, and little to measure by."""
import numpy as np
import pytest

from neural_gash_addon.backend import methods, metrics, texture
from neural_gash_addon.backend.compare import reference, sample
from neural_gash_addon.backend.geometry import TriangleMesh

from . import shapes
from .test_texture import atlas, surface

TRACING = "auto", "embree", "hybrid", "sparse"


def shell(height, subdivisions=4):
    """A sphere seen from within, but for the cap above a height."""
    positions, triangles = shapes.sphere(subdivisions)
    return TriangleMesh.from_triangles(positions, triangles[positions[triangles, 2].mean(1) < height][:, ::-1])


@pytest.mark.parametrize("method", TRACING)
def test_in_the_dark_few_rays_are_traced_and_no_error_is_claimed(method):
    mesh = shell(2.0, 6)  # of as many points as *sparse* does not bake plainly
    found = methods.run(methods.bake(mesh, method, 3, tolerance=0.01))
    assert np.abs(found.coefficients).max() < 1e-6 and found.record.error_estimate is None
    assert found.record.rays + found.record.probe_rays <= 160 * len(mesh.points)
    if method == "auto":
        assert found.record.plan.startswith("Hardly any light comes in: ")


@pytest.mark.parametrize(("method", "subdivisions", "tolerance"), [
    ("auto", 4, 0.1), ("auto", 4, 0.04), ("embree", 4, 0.04), ("hybrid", 4, 0.1), ("hybrid", 4, 0.04),
    ("sparse", 6, 0.1)])
def test_little_light_is_still_looked_for(method, subdivisions, tolerance):
    """A window of a fortieth of the sphere, which few points face squarely."""
    mesh = shell(0.95, subdivisions)
    truth = methods.run(reference(mesh, 3, sample(len(mesh.points), 1000, 9), seed=9))
    found = methods.run(methods.bake(mesh, method, 3, tolerance=tolerance))
    error, claimed = metrics.rel_l2(found.coefficients[truth.rows], truth.transfer), found.record.error_estimate
    assert error < 1.5 * tolerance and claimed is not None and error < 1.5 * claimed


def test_a_dark_tile_leaves_a_texture_its_error():
    """And one that is not dark, of which it is not known, does not."""
    assert texture._joint([0.1, None], [1.0, 1e-6]) == pytest.approx(0.1, rel=1e-3)
    assert texture._joint([0.1, None], [1.0, 0.1]) is None and texture._joint([None, None], []) is None
    assert texture._joint([0.3, 0.4], [1.0, 1.0]) == pytest.approx(0.125 ** 0.5)


@pytest.mark.parametrize("subdivisions", [0, 1, 2])
def test_a_closed_box_that_is_shaded_smooth_lets_no_light_in(subdivisions):
    """Normals lean up to 55 degrees out of its faces: where rays start must not."""
    mesh = surface(shapes.cube(inside=True, subdivisions=subdivisions))
    result = methods.run(texture.bake(mesh, uv=atlas(mesh, 64).uv, side=64, order=3, rays=64))
    assert max(np.abs(c).max() for c in result.coefficients) < 1e-6
