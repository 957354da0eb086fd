# SPDX-License-Identifier: GPL-3.0-or-later
"""The bake against answers that no one here wrote: closed forms, invariances, a brute-force twin."""
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neural_gash_addon.backend import light, methods, metrics, shading
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import CORNER, POINT, TriangleMesh

from . import shapes

SCALES = [(1.0, 0.0), (1e-3, 0.0), (1e4, 0.0), (1.0, 1e4)]


def bake(mesh, **settings):
    settings.setdefault("rays", 1024)
    return methods.run(methods.bake(mesh, **settings))


@pytest.mark.parametrize("order", [2, 3, 5])
@pytest.mark.parametrize("smooth", [True, False])
def test_convex_equals_analytic(order, smooth):
    mesh = TriangleMesh.from_triangles(*shapes.sphere(), smooth=smooth)
    assert mesh.domain == (POINT if smooth else CORNER)
    expected = bake(mesh, method="analytic", order=order, rays=None).coefficients
    for settings in ({"rays": 64}, {"rays": None, "tolerance": 0.01}):
        np.testing.assert_array_equal(bake(mesh, order=order, **settings).coefficients, expected)


@pytest.mark.parametrize(("scale", "shift"), SCALES)
@pytest.mark.parametrize("smooth", [True, False])
def test_closed_box_gives_zero_at_any_scale(scale, shift, smooth):
    positions, triangles = shapes.cube(inside=True, subdivisions=2)
    positions = (positions * scale + shift).astype(np.float32)
    mesh = TriangleMesh.from_triangles(positions, triangles, smooth=smooth)
    assert np.abs(bake(mesh).coefficients).max() < 1e-12


@pytest.mark.parametrize(("scale", "shift"), SCALES)
def test_tilted_closed_box_does_not_leak(scale, shift):
    positions, triangles = shapes.cube(inside=True, subdivisions=2)
    for seed in range(3):
        turned = positions @ Rotation.random(random_state=seed).as_matrix().T
        mesh = TriangleMesh.from_triangles((turned * scale + shift).astype(np.float32), triangles, smooth=False)
        assert np.abs(bake(mesh, rays=256).coefficients).max() < 1e-12


@pytest.mark.parametrize(("scale", "shift"), SCALES)
def test_flat_mesh_has_no_false_shadow(scale, shift):
    positions, triangles = shapes.grid(40)
    for seed in range(3):
        rotation = Rotation.random(random_state=seed).as_matrix()
        placed = ((positions @ rotation.T) * scale + shift).astype(np.float32)
        mesh = TriangleMesh.from_triangles(placed, triangles)
        found = bake(mesh, rays=256).coefficients
        np.testing.assert_array_equal(found, sh.cosine_lobe(mesh.normals, 3).astype(np.float32))


def wedge(angle: float) -> np.ndarray:
    """Transfer (4,) of a floor point at the foot of an infinite wall; the open lune has this angle.

    With w = (s cos p, t, s sin p), s^2 = 1 - t^2, dw = dt dp, the integrals over 0 < p < angle are
    elementary.
    """
    y0, y1 = 0.28209479177387814, 0.4886025119029199
    return np.array([y0 * (1 - np.cos(angle)) / 2, 0.0,
                     y1 * 4 / (3 * np.pi) * (angle / 2 - np.sin(2 * angle) / 4),
                     y1 * 4 / (3 * np.pi) * np.sin(angle) ** 2 / 2])


@pytest.mark.parametrize("degrees", [30, 60, 90, 120, 170])
def test_wedge_equals_its_closed_form(degrees):
    angle, far, near = np.radians(degrees), 1e4, 1.0
    up = np.array([np.cos(angle), 0, np.sin(angle)]) * far
    side = np.array([0, far, 0.0])
    wall = np.array([side, -side, up - side, up + side])
    positions, triangles = wall, np.array([[0, 1, 2], [0, 2, 3]])
    mesh = shapes.at_points((positions, triangles), [[near, 0, 0]] * 64, [[0, 0, 1]] * 64)
    found = bake(mesh, order=2, rays=4096).coefficients.mean(0)
    np.testing.assert_allclose(found, wedge(angle), atol=4e-4)


def test_constant_light_gives_ambient_occlusion_of_a_cap():
    """A disc of half-angle a overhead hides sin(a)^2 of the cosine-weighted hemisphere."""
    ring = np.linspace(0, 2 * np.pi, 257)[:-1]
    half = np.radians(35)
    disc = np.concatenate([[[0, 0, 1.0]], np.stack([np.cos(ring) * np.tan(half), np.sin(ring) * np.tan(half),
                                                    np.ones(256)], 1)])
    triangles = np.stack([np.zeros(256), 1 + np.arange(256), 1 + (np.arange(256) + 1) % 256], 1).astype(int)
    mesh = shapes.at_points((disc, triangles), [[0, 0, 0.0]] * 32, [[0, 0, 1.0]] * 32)
    found = shading.radiance(bake(mesh, rays=4096).coefficients, light.constant(np.ones(3), 3))
    np.testing.assert_allclose(found.mean(0), 1 - np.sin(half) ** 2, atol=5e-4)
    assert (found >= 0).all() and (found <= 1 + 1e-6).all()


def test_rotating_mesh_and_light_together_changes_nothing():
    positions, triangles = shapes.torus()
    rotation = Rotation.random(random_state=2).as_matrix()
    sky = light.project_equirect(np.random.default_rng(0).random((8, 16, 3)), 4)
    still = bake(TriangleMesh.from_triangles(positions, triangles), order=4).coefficients
    turned = bake(TriangleMesh.from_triangles(positions @ rotation.T, triangles), order=4).coefficients
    error = metrics.rel_l2(shading.radiance(turned, sh.rotate(sky, rotation)), shading.radiance(still, sky))
    assert error < 0.005


def _brute_force(mesh: TriangleMesh, order: int, rays: int) -> np.ndarray:
    """The definition: uniform directions over the sphere, every ray against every triangle (Moller-Trumbore)."""
    rng = np.random.default_rng(7)
    a, b, c = (mesh.positions[mesh.triangles[:, i]] for i in range(3))
    e1, e2 = b - a, c - a
    out = np.zeros((len(mesh.points), order * order))
    for i, (p, n) in enumerate(zip(mesh.points, mesh.normals, strict=True)):
        d = rng.normal(size=(rays, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        d = d[d @ n > 0]
        h = np.cross(d[:, None], e2[None])
        det = np.einsum("fi,rfi->rf", e1, h)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (p + 1e-5 * n) - a
            u = np.einsum("fi,rfi->rf", s, h) / det
            q = np.cross(s, e1)
            v = d @ q.T / det
            t = np.einsum("fi,fi->f", e2, q) / det
        hit = ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6)).any(1)
        weight = np.where(hit, 0.0, d @ n) / np.pi * (4 * np.pi / rays)
        out[i] = weight @ sh.evaluate(d, order)
    return out


def test_bake_equals_brute_force_twin():
    mesh = TriangleMesh.from_triangles(*shapes.torus(sections=12))
    rays = 10000
    expected = _brute_force(mesh, 3, rays)
    found = bake(mesh, rays=1024).coefficients
    # plain Monte Carlo's relative error is sqrt(8 / rays): its squared weights 16 cos^2 sum Y^2 average
    # to 1.9 against |T|^2 = 0.21
    assert metrics.rel_l2(found, expected) < 1.2 * np.sqrt(8 / rays)
    # ... and the mean of 72 points' 9 coefficients' stays within 4 of its standard errors: no bias
    assert np.abs((found - expected).mean(0)).max() < 4 * np.sqrt(1.9 / 9 / rays / len(found))


def test_flat_cube_on_its_corners_is_right():
    mesh = TriangleMesh.from_triangles(*shapes.cube(subdivisions=0), smooth=False)
    assert mesh.domain == CORNER and len(mesh.points) == 24
    np.testing.assert_array_equal(bake(mesh, rays=64).coefficients,
                                  sh.cosine_lobe(mesh.normals, 3).astype(np.float32))


def test_other_objects_cast_shadows():
    positions, triangles = shapes.grid(5)
    lid = (positions + [0, 0, 0.3], triangles)
    mesh = TriangleMesh.from_triangles(positions, triangles)
    alone, covered = (bake(mesh, occluders=o, rays=256).coefficients[:, 0].mean() for o in ((), (lid,)))
    assert covered < 0.7 * alone
