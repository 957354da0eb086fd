# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre, sph_harm_y

from neural_gash_addon.backend import spherical_harmonics as sh


def directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_evaluate_agrees_with_scipy():
    d = np.concatenate([directions(500), np.eye(3), -np.eye(3)])
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    values = sh.evaluate(d, 6)
    for band in range(6):
        for m in range(-band, band + 1):
            y = sph_harm_y(band, abs(m), theta, phi) * (-1) ** m  # scipy has the Condon-Shortley phase
            expected = y.real if m == 0 else np.sqrt(2) * (y.real if m > 0 else y.imag)
            np.testing.assert_allclose(values[:, band * (band + 1) + m], expected, atol=1e-12)


def test_first_band_is_y_z_x():
    np.testing.assert_allclose(sh.evaluate(np.array([[0.2, 0.3, 0.933]]), 2)[0, 1:],
                               0.4886025 * np.array([0.3, 0.933, 0.2]), rtol=1e-6)


def _sphere_quadrature(order: int) -> tuple[np.ndarray, np.ndarray]:
    z, w = np.polynomial.legendre.leggauss(2 * order)
    phi = np.arange(4 * order) * 2 * np.pi / (4 * order)
    r = np.sqrt(1 - z * z)
    d = np.stack([np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi)), np.repeat(z[:, None], len(phi), 1)], -1)
    return d.reshape(-1, 3), np.repeat(w, len(phi)) * 2 * np.pi / len(phi)


def test_orthonormal_and_parseval():
    d, w = _sphere_quadrature(6)
    values = sh.evaluate(d, 5)
    np.testing.assert_allclose(values.T @ (w[:, None] * values), np.eye(25), atol=1e-12)
    c = np.random.default_rng(1).normal(size=25)
    assert np.isclose(np.sum(w * (values @ c) ** 2), c @ c)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_rotate_is_rotation_of_the_function(order):
    rng = np.random.default_rng(order)
    d, c = directions(300), rng.normal(size=(order * order, 3))
    for seed in range(5):
        r = Rotation.random(random_state=seed).as_matrix()
        np.testing.assert_allclose(sh.evaluate(d, order) @ sh.rotate(c, r), sh.evaluate(d @ r, order) @ c, atol=1e-11)


def test_rotate_each_equals_rotate():
    rotations = Rotation.random(50, random_state=3).as_matrix()
    c = np.random.default_rng(4).normal(size=(50, 25))
    np.testing.assert_allclose(sh.rotate_each(c, rotations),
                               [sh.rotate(a, r) for a, r in zip(c, rotations, strict=True)], atol=1e-12)


def test_rotations_compose_and_keep_norm():
    a, b = Rotation.random(2, random_state=5).as_matrix()
    c = np.random.default_rng(6).normal(size=25)
    np.testing.assert_allclose(sh.rotate(sh.rotate(c, b), a), sh.rotate(c, a @ b), atol=1e-12)
    assert np.isclose(np.linalg.norm(sh.rotate(c, a)), np.linalg.norm(c))


def test_cosine_lobe_equals_quadrature():
    bands = sh.cosine_lobe_bands(8)
    for band in range(8):
        integral = quad(lambda z, n=band: z * eval_legendre(n, z), 0, 1)[0]
        assert np.isclose(bands[band], 2 * integral, atol=1e-12)  # 1/pi * 2pi * int z P_l(z) dz
    assert not sh.cosine_lobe(np.zeros((1, 3)), 3).any()


def test_hann_window_keeps_the_mean_and_falls():
    w = sh.hann_window(4)
    assert w[0] == 1 and (np.diff(w[[0, 1, 4, 9]]) < 0).all() and w[-1] > 0


def test_order_of_refuses_other_counts():
    assert sh.order_of(25) == 5
    with pytest.raises(ValueError, match="not a number"):
        sh.order_of(10)
