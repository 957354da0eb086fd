# SPDX-License-Identifier: GPL-3.0-or-later
"""The pyramid of voxels and what cones read of it, against what closed forms and a slow twin say."""
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neural_gash_addon.backend import cones, conformal, gnn
from neural_gash_addon.backend import voxels as pooling
from neural_gash_addon.backend.voxels import FINEST, Pyramid

from . import shapes

MIXED = [shapes.torus(), shapes.cube(subdivisions=0), shapes.grid(2)]


def dense(level):
    """(x, y, z, 4) all of a level's voxels, kept or not."""
    every = np.arange(np.prod(level.shape), dtype=np.int32)
    some = np.flatnonzero(level.filled(every))
    out = np.zeros((len(every), 4), np.float32)
    out[some] = level.at(every[some]).view(np.float32).reshape(-1, 4)
    return out.reshape(*level.shape, 4)


def opened(level):
    """(x * y * z, 4) area and area times normal of a level's voxels, in square units of the longest side."""
    found = dense(level).reshape(-1, 4).astype(float)
    return found / (1 - found[:, :1]) * level.size ** 2


def area(positions, triangles):
    a, b, c = (positions[triangles[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


@pytest.mark.parametrize("geometry", MIXED, ids=["torus", "cube of twelve triangles", "two triangles"])
def test_every_level_holds_all_of_the_surface(geometry):
    voxels = cones.pyramid([geometry])
    whole = area(*geometry) / voxels.side ** 2
    for level in voxels.levels:
        assert opened(level)[:, 0].sum() == pytest.approx(whole, rel=1e-4)


@pytest.mark.parametrize("geometry", MIXED[:2], ids=["torus", "cube"])
def test_a_closed_surface_faces_all_ways_alike(geometry):
    for level in cones.pyramid([geometry]).levels:
        np.testing.assert_allclose(opened(level)[:, 1:].sum(0), 0, atol=1e-4)


def test_a_wall_is_as_full_as_it_is_wide():
    """A plane across all voxels of a layer: each holds one face's area, and faces up."""
    level = cones.pyramid([shapes.grid(2)]).levels[1]
    found = opened(level).reshape(*level.shape, 4) / level.size ** 2
    inner = found[4:-4, 4:-4].sum(2)
    np.testing.assert_allclose(inner[..., 0].mean(), 1, rtol=0.01)
    np.testing.assert_allclose(inner[..., 0], 1, atol=0.6)  # samples, 1.5 a voxel of the finest level
    np.testing.assert_allclose(inner[..., 3], inner[..., 0], rtol=1e-5)


def pooled_slowly(geometry, finest, levels):
    """Of each level, {voxel, counted from the low corner: (4,) area and area times normal}, sample by sample."""
    positions, triangles = geometry
    low, high = positions[triangles].min((0, 1)), positions[triangles].max((0, 1))
    side = (high - low).max()
    corners = (positions - low) / side * finest + 0.37  # voxels are counted from a little below
    found = {}
    for a, b, c in corners[triangles]:
        normal = 0.5 * np.cross(b - a, c - a)
        extent = np.linalg.norm(normal)
        edge = max(np.linalg.norm(b - a), np.linalg.norm(c - a), np.linalg.norm(c - b))
        count = int(np.ceil(max(1.5 * extent, edge)))
        for number in range(count):
            root, along = np.sqrt((number + 0.5) / count), (0.5 + number * (np.sqrt(5) - 1) / 2) % 1
            place = (a + b + c) / 3 if count == 1 else a + root * ((1 - along) * (b - a) + along * (c - a))
            key = tuple(np.floor(place).astype(int))
            found[key] = found.get(key, 0) + np.array([extent, *normal]) / count
    out = [found]
    for _ in range(levels - 1):
        coarser = {}
        for (x, y, z), value in out[-1].items():
            key = (x >> 1, y >> 1, z >> 1)
            coarser[key] = coarser.get(key, 0) + value
        out.append(coarser)
    return out


@pytest.mark.parametrize("geometry", [shapes.sphere(3), shapes.cube(subdivisions=0)],
                         ids=["sphere", "twelve triangles"])
def test_voxels_hold_what_the_slow_twin_puts_in_them(geometry, monkeypatch):
    for module in (pooling, cones):
        monkeypatch.setattr(module, "FINEST", 24)  # as the twin is slow
    voxels = cones.pyramid([geometry])
    for number, slow in enumerate(pooled_slowly(geometry, 24, len(voxels.levels))):
        level = voxels.levels[number]
        found = dense(level)
        expected = np.zeros_like(found)
        at = np.array(list(slow)) - level.low.astype(int)
        summed = np.array(list(slow.values())) / 4 ** number  # in faces of this level's voxels
        expected[tuple(at.T)] = summed / (1 + summed[:, :1])
        differ = np.abs(found - expected).max(-1) > 1e-5
        assert differ.sum() <= 3e-3 * len(slow)  # where float32 rounds a sample across a border


def test_only_voxels_with_something_in_them_are_kept_and_each_is_found():
    for level in cones.pyramid([shapes.torus()]).levels:
        kept = np.flatnonzero(np.unpackbits(level.words.view(np.uint8), bitorder="little")).astype(np.int32)
        assert len(level.voxels) == len(kept)
        assert (level.voxels.view(np.float32).reshape(-1, 4)[:, 0] > 0).all()
        assert level.filled(kept).all()
        assert not level.filled(np.setdiff1d(np.arange(np.prod(level.shape), dtype=np.int32), kept)).any()
        np.testing.assert_array_equal(level.at(kept), level.voxels)


def read_slowly(geometry, point, normal, frame):
    """`cones.read` of one point from samples, voxel by voxel: (STEPS, CHANNELS, 25)."""
    voxels = cones.pyramid(geometry)
    out = np.zeros((cones.STEPS, cones.CHANNELS, conformal.DIRECTION_COUNT))
    for step, distance in enumerate(1.7 / FINEST * np.sqrt(2) ** np.arange(cones.STEPS)):
        level = voxels.levels[step // 2]
        grid = dense(level)
        for number, direction in enumerate(conformal.hemisphere_directions() @ frame.T):
            at = (point - voxels.low) / voxels.side + distance * direction
            cell = np.floor(at / level.size - level.low).astype(int)
            if np.all(cell >= 0) and np.all(cell < level.shape):
                found = grid[tuple(cell)]
                out[step, :, number] = found[0], found[1:] @ direction, found[1:] @ normal
    return out.reshape(-1, conformal.DIRECTION_COUNT)


def test_cones_read_what_the_slow_twin_reads():
    geometry = [shapes.torus()]
    mesh = shapes.at_points(geometry[0], geometry[0][0][::40], Rotation.random(13, random_state=1).as_matrix()[:, :, 0])
    frames = gnn.frames_of(mesh.normals, over=False)
    seen = cones.read(cones.pyramid(geometry), mesh.points, mesh.normals, frames).dense()
    for i in range(len(mesh.points)):
        slow = read_slowly(geometry, mesh.points[i], mesh.normals[i], frames[i])
        differ = np.abs(seen[:, :, i] - slow) > 1e-5
        assert differ.mean() < 2e-3  # where float32 rounds a place across a border


def test_what_is_seen_does_not_depend_on_size_place_or_order_of_the_triangles():
    positions, triangles = shapes.torus()
    mesh = shapes.at_points((positions, triangles), positions[:50], positions[:50] / np.linalg.norm(positions[:50]))
    frames = gnn.frames_of(mesh.normals, over=False)
    first = cones.read(cones.pyramid([(positions, triangles)]), mesh.points, mesh.normals, frames).dense()
    mixed = np.random.default_rng(0).permutation(triangles)
    for scale, move in ((1e-3, 0.0), (1e3, 0.0), (1.0, 1e3)):
        moved = positions * scale + move
        again = cones.read(cones.pyramid([(moved, mixed)]), moved[:50], mesh.normals, frames).dense()
        assert (np.abs(again - first) > 1e-4).mean() < 1e-3


def test_a_wide_floor_costs_no_more_than_a_near_one():
    """Only the part that is near is cut finely: samples grow with the logarithm of its width."""
    ball = shapes.sphere(3)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    filled = []
    for width in (10.0, 10_000.0):
        floor = (corners * width + [0, 0, -1], np.array([[0, 1, 2], [0, 2, 3]]))
        voxels = cones.pyramid([ball, floor])
        filled.append(sum(np.count_nonzero(level.voxels) for level in voxels.levels))
        # under the ball the floor is as fine as the ball is
        below = cones.read(voxels, np.array([[0, 0, -0.98]]), np.array([[0, 0, -1.0]]),
                           gnn.frames_of(np.array([[0, 0, -1.0]]), over=False)).dense()
        assert below[0].max() > 0.2
    assert filled[1] < 1.5 * filled[0]


def test_what_is_farther_than_the_last_step_is_still_seen():
    ball = shapes.sphere(3)
    for radius in (8.0, 300.0):
        shell = shapes.sphere(2)
        voxels = cones.pyramid([ball, (shell[0] * radius, shell[1])])
        normal = np.array([[0.0, 0.0, 1.0]])
        seen = cones.read(voxels, normal, normal, gnn.frames_of(normal, over=False)).dense()
        assert (seen[-cones.CHANNELS] > 0).all()  # in every direction, be it a corner of a voxel
    alone = cones.read(cones.pyramid([ball]), normal, normal, gnn.frames_of(normal, over=False)).dense()
    assert alone[-cones.CHANNELS].max() == 0


@pytest.mark.parametrize("geometry", [
    (np.zeros((3, 3)), np.array([[0, 1, 2]])),
    (np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]), np.array([[0, 1, 2]])),
    (np.array([[0, 0, 0], [1, 0, 0], [0, 1e-9, 0.0]]), np.array([[0, 1, 2]])),
    (np.array([[0, 0, 0], [1e12, 0, 0], [0, 1e12, 0.0]]), np.array([[0, 1, 2]]))],
    ids=["a point", "a line", "a sliver", "enormous"])
def test_degenerate_surfaces_give_finite_voxels(geometry):
    voxels = cones.pyramid([geometry])
    normal = np.array([[0.0, 0.0, 1.0]])
    seen = cones.read(voxels, geometry[0][:1], normal, gnn.frames_of(normal, over=False)).dense()
    assert np.isfinite(seen).all() and np.abs(seen).max() <= 1


def test_pyramid_levels_are_where_something_is():
    ball = shapes.sphere(2)
    assert len(Pyramid.of([ball], [0.1, 0.2]).levels) == 2
    assert len(Pyramid.of([ball, (ball[0] + 2.1, ball[1])], [0.1, 0.2]).levels) == 6  # to 3.2
