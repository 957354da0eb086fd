# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy radiance against brute-force integration of light * visibility * cosine * lobe, rays by Mitsuba 3.

The lobe is sampled directly, with nothing band-limited but the light. So what separates the two is
the cut-off of the product after five bands and of the transfer before it; with 16 bands from the
same visibility the difference all but goes.
"""
import numpy as np
import pytest

from neural_gash_addon.backend import gloss, light, lobes, methods, sampling
from neural_gash_addon.backend import spherical_harmonics as sh

from . import shapes
from .test_gloss import transferred_slowly
from .test_spherical_harmonics import directions

ORDER, HIGH = 5, 16
POINTS = 48
EXPONENTS = (1, 10, 50)


def sky() -> np.ndarray:
    """(K, 3): a blue gradient, a warm window, a small bright one; unwindowed."""
    image = np.zeros((64, 128, 3))
    image[:] = np.linspace(0.1, 1, 64)[:, None, None] * np.array([0.5, 0.7, 1.0])
    image[34:46, 20:40] += np.array([8.0, 5.0, 2.0])
    image[50:54, 90:95] += 40
    return light.project_equirect(image, ORDER)


def in_front(normals: np.ndarray) -> np.ndarray:
    """A view direction above each point's horizon, by 0.2 at least."""
    v = directions(len(normals), 5)
    v *= np.sign((v * normals).sum(1, keepdims=True))
    v = 0.2 * normals + v
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def lobe_directions(mirrored: np.ndarray, exponent: float, count: int) -> np.ndarray:
    """(N, count, 3) directions distributed as the Phong lobe about each mirrored view."""
    u = (sampling.owen_scramble(sampling.sobol2(count), np.uint32([[11, 12]])) + 0.5) / 2**32
    z = u[:, 0] ** (1 / (exponent + 1))
    r, phi = np.sqrt(1 - z * z), 2 * np.pi * u[:, 1]
    local = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
    frames = sampling.frames(mirrored, np.random.default_rng(2).uniform(0, 7, len(mirrored)))
    return np.einsum("nij,rj->nri", frames, local)


def brute_force(normals, mirrored, sky, exponent, visible, count=4096) -> np.ndarray:
    """B (N, 3) = int L(w) V(w) max(n.w, 0) lobe(w) dw, by sampling the lobe."""
    w = lobe_directions(mirrored, exponent, count)
    cosine = np.maximum(np.einsum("nri,ni->nr", w, normals), 0)
    arriving = (sh.evaluate(w.reshape(-1, 3), ORDER) @ sky).reshape(*w.shape)
    return np.einsum("nr,nrc->nc", cosine * visible(w, cosine > 0), arriving) / count


def pipeline(transfer, sky, view, normals, exponent) -> np.ndarray:
    order = sh.order_of(transfer.shape[1])
    return gloss.reflected_radiance(gloss.transferred(transfer, sky), view, normals,
                                    lobes.phong_attenuation(exponent, order))


def rms(x) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_unshadowed(exponent):
    normals, lamp = directions(100, 1), sky()
    view = in_front(normals)
    expected = brute_force(normals, gloss.mirrored(view, normals), lamp, exponent, lambda w, wanted: 1.0)
    errors = [rms(pipeline(sh.cosine_lobe(normals, order), lamp, view, normals, exponent) - expected) / rms(expected)
              for order in (ORDER, 9, HIGH)]
    assert errors[0] < {1: 0.006, 10: 0.10, 50: 0.25}[exponent]  # what five bands keep of the product
    assert errors[1] < 0.1 * errors[0] and errors[2] < 1e-3


@pytest.fixture(scope="module")
def mitsuba():
    mi = pytest.importorskip("mitsuba", reason="needs mitsuba, a development dependency, for independent visibility")
    mi.set_variant("scalar_rgb")
    return mi


@pytest.fixture(scope="module")
def ring(mitsuba, tmp_path_factory):
    """A torus, points on its facets, and what gives V (N, R) from directions (N, R, 3) there, where wanted (N, R)."""
    trimesh = pytest.importorskip("trimesh")
    positions, triangles = shapes.torus(10.0, 4.5)
    ply = trimesh.Trimesh(positions, triangles, process=False)
    path = tmp_path_factory.mktemp("ring") / "ring.ply"
    ply.export(path)
    scene = mitsuba.load_dict({"type": "scene", "ring": {"type": "ply", "filename": str(path)}})
    rng = np.random.default_rng(0)
    faces = rng.choice(len(triangles), POINTS, p=ply.area_faces / ply.area_faces.sum())
    points = (positions[triangles[faces]] * rng.dirichlet(np.full(3, 4.0), POINTS)[:, :, None]).sum(1)
    normals = np.asarray(ply.face_normals)[faces]

    def visible(w: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        out = np.zeros(w.shape[:2])
        for i, (p, n) in enumerate(zip(points, normals, strict=True)):
            origin = mitsuba.Point3f(*(p + 1e-4 * n))
            rows = np.flatnonzero(wanted[i])
            out[i, rows] = [not scene.ray_test(mitsuba.Ray3f(origin, mitsuba.Vector3f(*d)))
                            for d in w[i, rows].tolist()]
        return out

    return shapes.at_points((positions, triangles), points, normals), visible


@pytest.fixture(scope="module")
def blocked_bands(ring):
    """Transfer (N, HIGH**2) from Mitsuba's visibility: the exact unshadowed part less the blocked."""
    mesh, visible = ring
    count = 16384
    w = np.einsum("nij,rj->nri", sampling.frames(mesh.normals, np.arange(POINTS)),
                  sampling.hemisphere_sets(1, count, 3)[0])
    blocked = 1 - visible(w, np.ones(w.shape[:2], bool))
    part = [sh.evaluate(d, HIGH).T @ b / count for d, b in zip(w, blocked, strict=True)]
    return sh.cosine_lobe(mesh.normals, HIGH) - np.array(part)


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_shadowed(ring, blocked_bands, exponent):
    mesh, visible = ring
    lamp, view = sky(), in_front(mesh.normals)
    expected = brute_force(mesh.normals, gloss.mirrored(view, mesh.normals), lamp, exponent, visible)
    baked = methods.run(methods.bake(mesh, order=ORDER, rays=4096)).coefficients
    found = pipeline(baked, lamp, view, mesh.normals, exponent)
    scale = rms(expected)
    slow = gloss.reflected_radiance(transferred_slowly(blocked_bands[:, :ORDER * ORDER], lamp), view, mesh.normals,
                                    lobes.phong_attenuation(exponent, ORDER))
    high = pipeline(blocked_bands, lamp, view, mesh.normals, exponent)
    limit = rms(slow - high)  # what is cut off after five bands
    assert rms(high - expected) < 0.01 * scale            # the formulae, their scale and their sign
    assert rms(found - slow) < 0.004 * scale              # Embree and one matrix, beside Mitsuba and the tensor
    assert rms(found - expected) < 1.05 * limit + 0.005 * scale
    assert limit < {1: 0.03, 10: 0.15, 50: 0.3}[exponent] * scale
    unshadowed = pipeline(sh.cosine_lobe(mesh.normals, ORDER), lamp, view, mesh.normals, exponent)
    assert rms(found - expected) < 0.75 * rms(unshadowed - expected)  # and it is about shadows


@pytest.mark.parametrize("roughness", [0.1, 0.2, 0.3])
def test_ggx_is_the_renderers_at_normal_incidence(mitsuba, roughness):
    """The attenuation from Mitsuba's sampling density of a rough conductor, which ends at the horizon."""
    alpha = roughness ** 2
    bsdf = mitsuba.load_dict({"type": "roughconductor", "distribution": "ggx", "alpha": alpha,
                              "sample_visible": False})
    surface = mitsuba.SurfaceInteraction3f()
    surface.wi = mitsuba.Vector3f(0, 0, 1)
    nodes, weights = np.polynomial.legendre.leggauss(2000)
    theta = 0.25 * np.pi * (nodes + 1)
    density = np.array([bsdf.pdf(mitsuba.BSDFContext(), surface, mitsuba.Vector3f(np.sin(t), 0, np.cos(t)))
                        for t in theta])
    measure = 0.25 * np.pi * weights * 2 * np.pi * np.sin(theta) * density
    expected = np.polynomial.legendre.legvander(np.cos(theta), ORDER - 1).T @ measure
    below = alpha ** 2 / (1 + alpha ** 2)  # the part of the lobe that is under the horizon
    assert abs(expected[0] - (1 - below)) < 1e-4
    np.testing.assert_allclose(lobes.ggx_attenuation(roughness, ORDER), expected, atol=below + 1e-4)
