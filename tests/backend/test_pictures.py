# SPDX-License-Identifier: GPL-3.0-or-later
"""Images on triangles, seen by the patches that triangles are cut into."""
from __future__ import annotations

import numpy as np
import pytest

from neural_gash_addon.backend.patches import Patches
from neural_gash_addon.backend.pictures import Picture

SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
HALVES = np.array([(0, 1, 2), (0, 2, 3)])
RAMP = np.broadcast_to((np.arange(64, dtype=np.float32)[None, :, None] + 0.5) / 64, (64, 64, 3))


def picture(pixels=RAMP, **kwargs):
    given = {"columns": np.arange(3), "channels": np.arange(3), "gain": np.ones(3), "offset": np.zeros(3)} | kwargs
    return Picture(np.array([0, 1]), SQUARE[HALVES][..., :2], pixels, **given)


def test_patches_have_the_colour_of_their_place():
    patches = Patches([(SQUARE, HALVES)], 500)
    assert patches.count > 300
    found = patches.mean(np.full((2, 3), 9.0), [picture()])
    points, _, _ = patches.sample(2 * np.arange(patches.count), 64, np.random.default_rng(0))
    x = points[..., 0]
    inside = (x.min(1) > 0.02) & (x.max(1) < 0.98)   # the image repeats at the square's edges
    np.testing.assert_allclose(found[inside, 0], x.mean(1)[inside], atol=0.02)
    assert np.ptp(found[inside, 0]) > 0.8


def test_lookups_average_to_the_image_and_see_its_parts():
    noise = np.random.default_rng(1).uniform(size=(32, 32, 3)).astype(np.float32)
    seen = picture(noise).lookups()
    np.testing.assert_allclose(seen.reshape(-1, 3).mean(0), noise.mean((0, 1)), atol=0.01)
    changed = noise.copy()
    changed[3:5, 20:22] = 0
    assert not np.array_equal(seen, picture(changed).lookups())


def test_numbers_that_are_not_asked_for_are_left_alone():
    rough = picture(columns=np.array([6]), channels=np.array([0]), gain=np.array([0.5]), offset=np.array([0.25]))
    patches = Patches([(SQUARE, HALVES)], 200)
    plain = np.linspace(0, 1, 14).reshape(2, 7)
    found = patches.mean(plain, [rough])
    np.testing.assert_array_equal(found[:, :6], patches.mean(plain)[:, :6])
    assert found[:, 6].min() >= 0.25 and found[:, 6].max() <= 0.75 and np.ptp(found[:, 6]) > 0.3
    np.testing.assert_array_equal(patches.mean(plain[:, :3], [rough]), patches.mean(plain)[:, :3])


def test_dropping_triangles_keeps_pictures_on_the_rest():
    kept = picture().only(np.array([False, True]))
    assert kept.triangles.tolist() == [0]
    np.testing.assert_array_equal(kept.uv, picture().uv[1:])
    assert picture().only(np.array([False, False])).lookups().size == 0


@pytest.mark.parametrize("budget", [1, 3])
def test_triangles_that_are_not_cut_keep_their_mean(budget):
    many = np.random.default_rng(0).uniform(size=(60, 3, 3))
    patches = Patches([(many.reshape(-1, 3), np.arange(180).reshape(-1, 3))], budget)
    image = Picture(np.arange(60), many[..., :2], RAMP, np.arange(3), np.arange(3), np.ones(3), np.zeros(3))
    values = image.lookups().mean(1)
    np.testing.assert_allclose(patches.mean(values, [image]), patches.mean(values))
