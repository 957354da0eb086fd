# SPDX-License-Identifier: GPL-3.0-or-later
"""Incident radiance times the cosine, in spherical harmonics: closed forms."""
import numpy as np
import pytest

from neural_gash_addon.backend import spherical_harmonics as sh

from . import shapes
from .test_irradiance import UP, ceiling, run, scene_of, textured_box

NORMALS = np.array([[0, 0, 1.0], [1, 0, 0], [0, -1, 0]])
PLACES = np.array([[0.1, 0.2, -0.5], [-0.5, 0.1, -0.2], [0.1, 0.5, 0.2]])  # on the sides that face so


@pytest.mark.parametrize(("albedo", "straight", "radiance"), [(0.0, True, 2.0), (0.6, False, 1.2), (0.6, True, 3.2)])
def test_even_light_is_the_cosine_lobe(albedo, straight, radiance):
    scene = scene_of((*shapes.cube(inside=True), albedo, 2.0))
    found = run(scene, PLACES, NORMALS, 16384, depth=2, straight=straight, order=5)
    expected = np.pi * radiance * sh.cosine_lobe(NORMALS, 5)
    for channel in range(3):
        assert np.abs(found.harmonics[..., channel] - expected).max() < 0.04 * expected[:, 0].max()


def test_a_small_emitter_is_its_irradiance_from_its_direction():
    scene = scene_of((*ceiling(0.01, 3.0), 0.0, (100, 200, 400)))
    points = np.array([[0, 0, 0], [1.0, -2, 0]])
    found = run(scene, points, np.repeat(UP, 2, 0), 2048, order=5)
    ways = [0, 0, 3] - points
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    expected = sh.evaluate(ways, 5)[:, :, None] * found.values[:, None]
    assert np.abs(found.harmonics - expected).max() < 0.02 * np.abs(expected).max()


def test_its_first_is_the_irradiance_and_paths_are_the_same():
    plain = run(textured_box(), PLACES, NORMALS, 256)
    found = run(textured_box(), PLACES, NORMALS, 256, order=3)
    assert plain.harmonics is None and found.harmonics.shape == (3, 9, 3)
    np.testing.assert_array_equal(found.values, plain.values)
    np.testing.assert_allclose(found.harmonics[:, 0] / sh.normalisation(0, 0), found.values, rtol=1e-5)


def test_straight_and_reflected_add_up():
    whole = run(textured_box(), PLACES, NORMALS, 8192, order=3).harmonics
    straight = run(textured_box(), PLACES, NORMALS, 8192, depth=1, order=3).harmonics
    reflected = run(textured_box(), PLACES, NORMALS, 8192, straight=False, order=3).harmonics
    assert np.abs(straight + reflected - whole).max() < 0.03 * np.abs(whole).max()


def test_points_without_normals_have_none():
    found = run(textured_box(), PLACES, 0 * NORMALS, 64, order=3)
    assert found.harmonics.shape == (3, 9, 3) and not found.harmonics.any()
