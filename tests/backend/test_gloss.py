# SPDX-License-Identifier: GPL-3.0-or-later
"""Triple products and lobes against closed forms, slow twins, quadrature and invariances."""
from math import factorial

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre

from neural_gash_addon.backend import gloss, light, lobes
from neural_gash_addon.backend import spherical_harmonics as sh

from .test_spherical_harmonics import directions


def transferred_slowly(transfer, sky):
    """PRTT's equation 2 as it is written, and the pi that our transfer lacks."""
    return np.pi * np.einsum("ijk,ni,jc->nkc", gloss.tripling_tensor(sh.order_of(len(sky))), transfer, sky)


def wigner_3j(l1, l2, l3, m1, m2, m3):
    """Racah's formula."""
    if m1 + m2 + m3 or not abs(l1 - l2) <= l3 <= l1 + l2:
        return 0.0
    f = factorial
    total = 0.0
    for t in range(max(0, l2 - l3 - m1, l1 - l3 + m2), min(l1 + l2 - l3, l1 - m1, l2 + m2) + 1):
        total += (-1) ** t / (f(t) * f(l3 - l2 + m1 + t) * f(l3 - l1 - m2 + t) * f(l1 + l2 - l3 - t)
                              * f(l1 - m1 - t) * f(l2 + m2 - t))
    triangle = f(l1 + l2 - l3) * f(l1 - l2 + l3) * f(-l1 + l2 + l3) / f(l1 + l2 + l3 + 1)
    spread = f(l1 + m1) * f(l1 - m1) * f(l2 + m2) * f(l2 - m2) * f(l3 + m3) * f(l3 - m3)
    return (-1) ** (l1 - l2 - m3) * (triangle * spread) ** 0.5 * total


def gaunt_tensor(order):
    """The tripling tensor from Gaunt's integrals of complex harmonics, turned to the real ones."""
    index = [(band, m) for band in range(order) for m in range(-band, band + 1)]
    complex_tensor = np.zeros((len(index),) * 3)
    for i, (l1, m1) in enumerate(index):
        for j, (l2, m2) in enumerate(index):
            for k, (l3, m3) in enumerate(index):
                if m1 + m2 + m3 == 0:
                    norm = np.sqrt((2 * l1 + 1) * (2 * l2 + 1) * (2 * l3 + 1) / (4 * np.pi))
                    complex_tensor[i, j, k] = (norm * wigner_3j(l1, l2, l3, 0, 0, 0)
                                               * wigner_3j(l1, l2, l3, m1, m2, m3))
    u = np.zeros((len(index), len(index)), complex)  # real harmonic = u @ complex harmonics
    for i, (band, m) in enumerate(index):
        centre, a = band * (band + 1), abs(m)
        if m == 0:
            u[i, i] = 1
        else:
            u[i, centre + a] = (-1) ** a / np.sqrt(2) * (1 if m > 0 else -1j)
            u[i, centre - a] = 1 / np.sqrt(2) * (1 if m > 0 else 1j)
    real = np.einsum("ai,bj,ck,ijk->abc", u, u, u, complex_tensor, optimize=True)
    assert np.abs(real.imag).max() < 1e-13
    return real.real


@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_tensor_equals_gaunts_integrals(order):
    tensor = gloss.tripling_tensor(order)
    np.testing.assert_allclose(tensor, gaunt_tensor(order), atol=1e-13)
    for axes in ((1, 0, 2), (2, 1, 0), (0, 2, 1)):
        np.testing.assert_allclose(tensor, tensor.transpose(axes), atol=1e-15)
    np.testing.assert_allclose(tensor[0], sh.normalisation(0, 0) * np.eye(order * order), atol=1e-14)
    with pytest.raises(ValueError, match="read-only"):
        tensor[0, 0, 0] = 1


def test_rectangular_tensor_is_part_of_the_larger():
    np.testing.assert_allclose(gloss.tripling_tensor(3, 5), gloss.tripling_tensor(5)[:9, :, :9], atol=1e-14)
    assert not gloss.tripling_tensor(3, 7)[:, 25:].any()  # bands 5 and up reach no product of two of three bands


@pytest.mark.parametrize("order", [1, 3, 4, 5])
def test_fast_equals_slow(order):
    rng = np.random.default_rng(order)
    transfer, sky = rng.normal(size=(1000, order * order)), rng.normal(size=(order * order, 3))
    expected = transferred_slowly(transfer, sky)
    scale = np.abs(expected).max()
    found = gloss.transferred(transfer, sky)
    assert found.shape == (1000, order * order, 3) and found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-6 * scale)
    out = np.full_like(found, np.nan)
    strided = np.repeat(transfer, 2, axis=1)[:, ::2]
    assert gloss.transferred(strided, sky, out) is out
    np.testing.assert_array_equal(out, found)
    assert gloss.transferred(transfer[:0], sky).shape == (0, order * order, 3)
    with pytest.raises(ValueError, match="out must be"):
        gloss.transferred(transfer, sky, out[:-1])


def test_many_points_equal_few():
    rng = np.random.default_rng(7)
    transfer, sky = rng.normal(size=((1 << 16) + 300, 9)).astype(np.float32), rng.normal(size=(9, 3))
    found = gloss.transferred(transfer, sky)
    np.testing.assert_allclose(found[-400:], gloss.transferred(transfer[-400:], sky), atol=1e-5)
    d = directions(len(transfer))
    radiance = gloss.reflected_radiance(found, d, d, np.ones(3))
    np.testing.assert_allclose(radiance[-400:], gloss.reflected_radiance(found[-400:], d[-400:], d[-400:], np.ones(3)))


@pytest.mark.parametrize(("order", "light_order"), [(3, 3), (5, 5), (4, 2), (3, 5)])
def test_product_of_functions(order, light_order):
    rng = np.random.default_rng(order)
    high = order + light_order - 1  # enough for the whole product
    transfer, sky = rng.normal(size=(4, order * order)), rng.normal(size=(light_order ** 2, 3))
    padded = np.zeros((4, high * high))
    padded[:, :order * order] = transfer
    d = directions(100)
    expected = np.pi * (sh.evaluate(d, order) @ transfer.T)[:, :, None] * (sh.evaluate(d, light_order) @ sky)[:, None]
    found = np.einsum("dk,nkc->dnc", sh.evaluate(d, high), gloss.transferred(padded, sky))
    np.testing.assert_allclose(found, expected, atol=2e-6 * np.abs(expected).max())
    # and what fewer bands keep of it is its projection
    np.testing.assert_allclose(gloss.transferred(transfer, sky), gloss.transferred(padded, sky)[:, :order * order],
                               atol=1e-6 * np.abs(expected).max())


EXPONENTS = [0, 1, 7.5, 100, 5000]


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_phong_equals_quadrature(exponent):
    edge = max(0.0, 1 - 40 / (exponent + 1))  # where nearly all of a sharp lobe lies
    expected = [(exponent + 1) * sum(quad(lambda t, b=band: t ** exponent * eval_legendre(b, t), *limits,
                                          epsabs=1e-13, epsrel=1e-12)[0] for limits in ((0, edge), (edge, 1)))
                for band in range(7)]
    np.testing.assert_allclose(lobes.phong_attenuation(exponent, 7), expected, atol=1e-11)


def test_phong_takes_arrays_and_a_mirror():
    many = lobes.phong_attenuation(np.array([EXPONENTS, EXPONENTS]), 5)
    assert many.shape == (2, len(EXPONENTS), 5)
    np.testing.assert_array_equal(many[1, 2], lobes.phong_attenuation(7.5, 5))
    np.testing.assert_array_equal(lobes.phong_attenuation(np.inf, 5), np.ones(5))
    assert (np.diff(many, axis=1) >= -1e-15)[..., :2].all()


@pytest.mark.parametrize("roughness", [0.05, 0.1, 0.2, 0.3])
def test_a_phong_lobe_is_as_wide_as_half_vectors_make_it(roughness):
    """Half vectors h ~ cos(h)**N cos(h) with N = 2/alpha**2 - 2: the mean of 1 - cos of the angle between r and w."""
    power = 2 / roughness ** 4 - 2
    weight, spread = (quad(lambda h, f=f: f(h) * np.cos(h) ** (power + 1) * np.sin(h), 0, np.pi / 2,
                           points=[roughness ** 2, 5 * roughness ** 2])[0]
                      for f in (lambda h: 1, lambda h: 1 - np.cos(2 * h)))
    spread /= weight
    found = 1 - lobes.attenuation(roughness, 2, lobes.PHONG)[1]
    assert abs(found / spread - 1) < 2 * roughness ** 4 + 1e-6   # alike as long as the lobe is narrow


def test_roughness_gives_every_exponent():
    for exponent in EXPONENTS:
        np.testing.assert_allclose(lobes.phong_exponent((2 * exponent + 1) ** -0.25), exponent, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(lobes.phong_exponent([-1.0, 0.0, 1.0, 2.0]), [np.inf, np.inf, 0, 0])
    np.testing.assert_array_equal(lobes.attenuation([0.0, 0.4], 5), lobes.ggx_attenuation([0.0, 0.4], 5))


def ggx_moment(roughness, band):
    """E[P_l(cos 2 theta_h)] for half vectors of density D(h) cos(theta_h)."""
    alpha2 = max(roughness, 1e-3) ** 4

    def integrand(s):  # theta_h = alpha sinh(s), so that the peak is as wide as the tail
        theta = min(alpha2 ** 0.5 * np.sinh(s), np.pi / 2)
        c = np.cos(theta)
        d = alpha2 / (np.pi * (c * c * (alpha2 - 1) + 1) ** 2)
        return 2 * np.pi * d * c * np.sin(theta) * eval_legendre(band, np.cos(2 * theta)) * np.cosh(s) * alpha2 ** 0.5

    return quad(integrand, 0, np.arcsinh(np.pi / 2 / alpha2 ** 0.5), epsabs=1e-11, epsrel=1e-11, limit=200)[0]


@pytest.mark.parametrize("roughness", [0.05, 0.1, 0.2317, 0.5, 0.7501, 0.9, 1.0])
def test_ggx_equals_quadrature(roughness):
    expected = [ggx_moment(roughness, band) for band in range(7)]
    np.testing.assert_allclose(lobes.ggx_quadrature(np.array([roughness]), 7)[0], expected, atol=1e-9)


def test_ggx_equals_legendre_functions_of_the_second_kind():
    # the density is alpha^2/4pi / (A - B cos)^2, so a_l = l (Q_{l-1}(x) - x Q_l(x)), x = (1+alpha^2)/(1-alpha^2)
    roughness = np.linspace(0.2, 0.85, 40)
    alpha2 = roughness ** 4
    x = (1 + alpha2) / (1 - alpha2)
    q = [-0.5 * np.log(alpha2)]
    q.append(x * q[0] - 1)
    for band in range(1, 4):
        q.append(((2 * band + 1) * x * q[band] - band * q[band - 1]) / (band + 1))
    expected = np.stack([np.ones_like(x)] + [band * (q[band - 1] - x * q[band]) for band in range(1, 5)], 1)
    np.testing.assert_allclose(lobes.ggx_quadrature(roughness, 5), expected, atol=1e-10)


@pytest.mark.parametrize("order", [3, 5, 9])
def test_ggx_table(order):
    fine = np.linspace(0, 1, 10007)
    found = lobes.ggx_attenuation(fine, order)
    assert np.abs(found - lobes.ggx_quadrature(fine, order)).max() < 1e-6
    np.testing.assert_allclose(found[0], 1, atol=1e-14)
    np.testing.assert_allclose(found[-1], np.eye(order)[0], atol=1e-14)
    assert np.diff(found, axis=0).max() < 1e-14 and np.diff(found, axis=1).max() < 1e-14
    np.testing.assert_array_equal(lobes.ggx_attenuation(np.array([-0.5, 2.0]), order), found[[0, -1]])
    assert lobes.ggx_attenuation(0.3, order).shape == (order,)


@pytest.mark.parametrize("exponent", [1.0, 20.0, 500.0])
def test_lobe_convolves(exponent):
    """The attenuation against the integral of a function times the lobe."""
    order = 5
    f = np.random.default_rng(9).normal(size=order * order)
    z, weights = np.polynomial.legendre.leggauss(400)
    z, weights = 0.5 * (z + 1), 0.5 * weights  # the lobe's hemisphere
    phi = np.arange(24) * 2 * np.pi / 24
    r = np.sqrt(1 - z * z)[:, None]
    local = np.stack(np.broadcast_arrays(r * np.cos(phi), r * np.sin(phi), z[:, None]), -1).reshape(-1, 3)
    weight = np.repeat(weights * (exponent + 1) * z ** exponent / 24, 24)
    for seed in range(3):
        turn = Rotation.random(random_state=seed).as_matrix()
        expected = weight @ (sh.evaluate(local @ turn.T, order) @ f)
        bands = np.repeat(lobes.phong_attenuation(exponent, order), 2 * np.arange(order) + 1)
        assert np.isclose(sh.evaluate(turn[:, 2][None], order)[0] @ (bands * f), expected, atol=1e-9)


def test_mirrored():
    n, v = directions(50, 1), directions(50, 2)
    r = gloss.mirrored(v, n)
    np.testing.assert_allclose((r * n).sum(1), (v * n).sum(1), atol=1e-12)
    np.testing.assert_allclose(np.cross(r + v, n), 0, atol=1e-12)
    np.testing.assert_allclose(gloss.mirrored(n, n), n, atol=1e-15)


def test_rotation_of_everything_changes_nothing():
    rng = np.random.default_rng(3)
    transfer, sky = rng.normal(size=(60, 25)), rng.normal(size=(25, 3))
    normals, view = directions(60, 1), directions(60, 2)
    bands = lobes.ggx_attenuation(rng.random(60), 5)
    before = gloss.reflected_radiance(gloss.transferred(transfer, sky), view, normals, bands)
    for seed in range(3):
        turn = Rotation.random(random_state=seed).as_matrix()
        turned = gloss.transferred(sh.rotate(transfer.T, turn).T, sh.rotate(sky, turn))
        after = gloss.reflected_radiance(turned, view @ turn.T, normals @ turn.T, bands)
        np.testing.assert_allclose(after, before, atol=1e-5 * np.abs(before).max())


@pytest.mark.parametrize("order", [2, 3, 4, 5])
def test_white_sky_gives_between_nothing_and_all(order):
    normals, view = directions(2000, 1), directions(2000, 2)
    view *= np.sign((view * normals).sum(1, keepdims=True))  # in front
    coefficients = gloss.transferred(sh.cosine_lobe(normals, order), light.constant(np.ones(3), order))
    many = [lobes.phong_attenuation(n, order) for n in (0, 1, 5, 50, np.inf)]
    many += [lobes.ggx_attenuation(r, order) for r in (0.0, 0.2, 0.5, 1.0)]
    most = 1 if order in (2, 5) else 17 / 16  # the cosine cut off after l = 2 peaks there, for a mirror
    for bands in many:
        found = gloss.reflected_radiance(coefficients, view, normals, bands)
        assert found.min() > 0 and found.max() < most + 1e-6
        if bands[2:].max(initial=0) < 0.5:
            assert found.max() < 1
    # the widest lobe sees the mean of the cosine over the sphere, a quarter
    np.testing.assert_allclose(found, 0.25, atol=1e-6)


def test_dark_where_nothing_arrives():
    d = directions(10)
    dark = gloss.transferred(np.zeros((10, 9)), np.ones((9, 3)))
    assert not gloss.reflected_radiance(dark, d, d, np.ones(3)).any()


@pytest.mark.parametrize("count", [1, 5000])
def test_channels_for_a_shader_are_radiance_and_products(count):
    rng = np.random.default_rng(8)
    transfer, light = rng.normal(size=(count, 25)).astype(np.float32), rng.normal(size=(25, 3))
    out = np.full((20, count, 4), np.nan, np.float32)
    gloss.lit_channels(transfer, light, 4, out)
    numbers = out.transpose(1, 0, 2).reshape(count, 80)
    np.testing.assert_allclose(numbers[:, :3], transfer @ light, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(numbers[:, 3:78].reshape(count, 25, 3), gloss.transferred(transfer, light), rtol=1e-4,
                               atol=1e-3)
    assert not numbers[:, 78:].any()
