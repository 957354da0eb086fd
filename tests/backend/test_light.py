# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np
import pytest

from neural_gash_addon.backend import light, shading
from neural_gash_addon.backend import spherical_harmonics as sh


def grid(height: int, width: int) -> np.ndarray:
    """Directions of texel centres as Cycles looks them up, row 0 at the bottom: (H, W, 3)."""
    u, v = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    phi, elevation = np.meshgrid((0.5 - u) * 2 * np.pi, (v - 0.5) * np.pi)
    return np.stack([np.cos(elevation) * np.cos(phi), np.cos(elevation) * np.sin(phi), np.sin(elevation)], -1)


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (7, 16), (64, 128)])
def test_white_map_of_any_resolution_is_constant(shape):
    projected = light.project_equirect(np.ones((*shape, 3)), 5)
    np.testing.assert_allclose(projected, light.constant(np.ones(3), 5), atol=1e-12)


def test_projection_equals_a_fine_sum_over_each_texel():
    image = np.random.default_rng(0).random((4, 8, 3))
    fine = 128
    d = grid(4 * fine, 8 * fine)
    area = (np.pi / (4 * fine)) * (2 * np.pi / (8 * fine)) * np.sqrt(1 - d[..., 2] ** 2)
    big = image.repeat(fine, 0).repeat(fine, 1)
    expected = np.einsum("hwk,hw,hwc->kc", sh.evaluate(d.reshape(-1, 3), 5).reshape(*d.shape[:2], 25), area, big)
    np.testing.assert_allclose(light.project_equirect(image, 5), expected, atol=2e-5)


def test_projection_finds_every_coefficient():
    d = grid(256, 512)
    offset = 2.0
    for k in (1, 2, 3, 5, 12, 24):
        image = np.repeat((sh.evaluate(d.reshape(-1, 3), 5)[:, k] + offset).reshape(256, 512, 1), 3, 2)
        found = light.project_equirect(image, 5)[:, 0] - light.constant(np.full(3, offset), 5)[:, 0]
        np.testing.assert_allclose(found, np.eye(25)[k], atol=2e-4)


def test_projection_clamps_negative_and_broken_texels():
    image = np.ones((4, 8, 3))
    image[0, 0] = -5
    image[1, 1] = np.nan
    clean = np.where(np.isfinite(image), np.maximum(image, 0), 0)
    np.testing.assert_array_equal(light.project_equirect(image, 3), light.project_equirect(clean, 3))


def test_sun_on_a_facing_plane_is_its_irradiance_over_pi():
    n = np.array([[0.36, 0.48, 0.8]])
    radiance = [shading.radiance(sh.cosine_lobe(n, o), light.sun(n[0], np.array([3.0, 2, 1]), o))[0] for o in (3, 25)]
    np.testing.assert_allclose(radiance[1], np.array([3.0, 2, 1]) / np.pi, rtol=0.01)
    assert abs(radiance[0][0] - 3 / np.pi) < 0.07 * 3 / np.pi  # order 3 is the well-known few percent off


def test_window_keeps_the_mean_light():
    source = light.sun(np.array([0.0, 0, 1]), np.ones(3), 4)
    damped = light.window(source, 4)
    np.testing.assert_array_equal(damped[0], source[0])
    values = sh.evaluate(grid(32, 64).reshape(-1, 3), 4)
    assert (values @ damped).min() > (values @ source).min()
