# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene as points: blue noise by area, in farthest point order, closer on emitters."""
import numpy as np
import pytest
from scipy.spatial import cKDTree

from neural_gash_addon.backend import scene_points as points
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.lit_scene import LitScene

from . import shapes
from .test_irradiance import ceiling, quad, scene_of, textured_box


def slow_farthest(places, count, weights):
    """All distances to all that were chosen, every time."""
    chosen = [int(np.square(places - places.mean(0)).sum(1).argmin())]
    while len(chosen) < count:
        square = np.square(places[:, None] - places[chosen]).sum(2) * weights[:, None]
        chosen.append(int(square.min(1).argmax()))
    return chosen


@pytest.mark.parametrize("count", [1, 17, 700, 1500])
def test_farthest_equals_a_slow_twin(count):
    rng = np.random.default_rng(count)
    # on a lattice of 2**-7 all distances are exact, and ties are rare enough by the power of seven numbers
    places = np.rint(rng.uniform(-1, 1, (count, 6)) * 128) / 128
    weights = rng.choice([1.0, 4.0], count)
    some = min(count, 60)
    found = points.farthest(places, some, weights)
    assert len(found) == len(set(found.tolist())) == some
    distance = [(np.square(places[k] - places[found[:i]]).sum(1).min() * weights[k]) for i, k in enumerate(found) if i]
    twin = slow_farthest(places, some, weights)
    expected = [(np.square(places[k] - places[twin[:i]]).sum(1).min() * weights[k]) for i, k in enumerate(twin) if i]
    assert distance == pytest.approx(expected)


def test_points_lie_on_their_surfaces_and_tell_what_is_there():
    scene = textured_box()
    found = points.scene_points(scene, 800)
    assert found.shape == (800, 12) and found.dtype == np.float32 and np.isfinite(found).all()
    assert np.linalg.norm(found[:, 3:6], axis=1) == pytest.approx(1, abs=1e-5)
    away = np.abs(np.einsum("nx,fx->nf", found[:, :3].astype(float), scene.normals)
                  - (scene.corners[:, 0] * scene.normals).sum(1))
    alike = found[:, 3:6] @ scene.normals.T > 0.999
    assert np.where(alike, away, 9).min(1).max() < 1e-5
    light = found[:, 9:].any(1)
    assert found[light, 9:] == pytest.approx(np.tile([6, 5, 4], (light.sum(), 1)))
    assert found[light, 2] == pytest.approx(0.49) and found[light, 5] == pytest.approx(-1)
    floor = (found[:, 2] < -0.499)
    assert np.ptp(found[floor, 6]) > 0.5                      # stripes, not their mean
    assert found[found[:, 0] < -0.499, 6] == pytest.approx(0.8)


def test_density_is_by_area_and_higher_on_emitters():
    small, large, light = (quad((x, 0, 0), (x + s, 0, 0), (x + s, s, 0), (x, s, 0))
                           for x, s in ((0, 1), (5, 3), (20, 1)))
    scene = scene_of((*small, 0.5, 0), (*large, 0.5, 0), (*light, 0.5, 1))
    found = points.scene_points(scene, 3000)
    share = np.array([((found[:, 0] > low) & (found[:, 0] < low + 4)).mean() for low in (-0.5, 4.5, 19.5)])
    area = np.array([1, 9, points.EMITTERS ** 2])
    assert share == pytest.approx(area / area.sum(), rel=0.1)


def test_lamps_without_a_body_have_points_where_they_are_part_of_the_room():
    """Area lights: one below the ceiling, one beyond the wall."""
    room = scene_of((*shapes.cube(inside=True), 0.5, 0))
    lamp = np.array([[-0.1, -0.1, 0.4], [-0.1, 0.1, 0.4], [0.1, 0.1, 0.4], [0.1, -0.1, 0.4]])
    corners = np.concatenate([lamp, lamp + [3, 0, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32) + len(room.positions)
    lit = LitScene(np.concatenate([room.positions, corners]), np.concatenate([room.triangles, triangles]),
                   np.concatenate([room.albedo, np.zeros((4, 3))]),
                   np.concatenate([room.emission, np.full((4, 3), 7.0)]), bodiless=4)
    found = points.scene_points(lit, 600)
    shining = found[:, 9:].any(1)
    assert 34 <= shining.sum() < 50  # 34 by area; the rim of a small patch has some more
    assert found[shining, 2] == pytest.approx(0.4) and np.abs(found[shining, :2]).max() < 0.101
    assert found[shining, 9:] == pytest.approx(7) and not found[shining, 6:9].any()


def test_any_first_points_are_blue_noise():
    scene = scene_of((*shapes.cube(inside=True), 0.5, 0))
    found = points.scene_points(scene, 2000)
    rng = np.random.default_rng(0)
    for count in (250, 500, 1000, 2000):
        first = found[:count, :3].astype(float)
        near = cKDTree(first).query(first, 2)[0][:, 1]
        spacing = np.sqrt(6 / count)
        chance = rng.uniform(-0.5, 0.5, (count, 3))
        chance[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
        random = cKDTree(chance).query(chance, 2)[0][:, 1]
        assert near.min() > 0.5 * spacing and random.min() < 0.1 * spacing  # hexagons have 1.07
        gaps = cKDTree(first).query(rng.permutation(chance), 1)[0]
        assert gaps.max() < 1.05 * spacing                       # and no holes


def test_both_sides_of_a_plate_have_points():
    thin = shapes.cube(subdivisions=0)
    scene = scene_of((thin[0] * [1, 1, 1e-3], thin[1], 0.5, 0))
    found = points.scene_points(scene, 400)
    up = found[:, 5] > 0.5
    down = found[:, 5] < -0.5
    assert up.sum() == pytest.approx(200, abs=25) and down.sum() == pytest.approx(200, abs=25)


def test_odd_scenes():
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]])
    found = points.scene_points(scene_of((*triangle, 0.5, 1)), 50)
    assert found.shape == (50, 12) and (found[:, :2].sum(1) <= 1 + 1e-6).all() and (found[:, :2] >= 0).all()
    flat = scene_of((np.zeros((3, 3)), triangle[1], 0.5, 1))
    assert points.scene_points(flat, 50).shape == (0, 12)       # nothing has an area
    with np.errstate(all="raise"):
        mixed = scene_of((*ceiling(0.5, 1), 0.5, 1), (np.ones((3, 3)), triangle[1], 0.5, 1))
        assert np.isfinite(points.scene_points(mixed, 64)).all()
    far = points.scene_points(scene_of((triangle[0] + 1e6, triangle[1], 0.5, 1)), 20)
    assert len(np.unique(far[:, :3], axis=0)) > 1
    with pytest.raises(UserError):
        points.scene_points(scene_of((triangle[0] + np.inf, triangle[1], 0.5, 1)), 20)
