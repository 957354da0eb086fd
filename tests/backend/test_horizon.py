# SPDX-License-Identifier: GPL-3.0-or-later
"""What rises above no horizon: every vertex against every plane, as a plain loop has it."""
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from neural_gash_addon.backend import horizon
from neural_gash_addon.backend.geometry import TEXEL, TriangleMesh
from neural_gash_addon.backend.horizon import convex, nothing_blocks

from .shapes import cube, grid, sphere, torus


def slowly(mesh, occluders=()):
    """`nothing_blocks`, every vertex against every plane."""
    parts = [(mesh.positions, mesh.triangles), *occluders]
    vertices = np.concatenate([p[np.unique(t)] for p, t in parts])
    size = np.ptp(vertices, axis=0).max()
    return not any(((vertices - p) @ n > 1e-6 * size).any() for p, n in zip(mesh.points, mesh.normals, strict=True))


def turned(positions, seed=1):
    """In some frame, as float32 has it."""
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return (positions @ (turn * np.sign(np.linalg.det(turn))).T * 3 + [1, 2, -1]).astype(np.float32).astype(float)


def hull(points):
    """Triangles, outwards, of a convex hull."""
    found = ConvexHull(points)
    triangles = found.simplices.copy()
    corners = points[triangles]
    facing = np.einsum("fx,fx->f", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
                       found.equations[:, :3])
    triangles[facing < 0] = triangles[facing < 0][:, ::-1]
    return points, triangles.astype(np.int32)


def two(geometry, offset):
    positions, triangles = geometry
    return np.concatenate([positions, positions + offset]), np.concatenate([triangles, triangles + len(positions)])


def star(points=5, depth=0.45):
    """A pyramid over a star: below the plane of its top, and yet creased."""
    angles, reach = np.arange(2 * points) * np.pi / points, np.tile([1.0, depth], points)
    ring = np.stack([reach * np.cos(angles), reach * np.sin(angles), 0 * angles], 1)
    near = np.arange(2 * points)
    after = np.roll(near, -1)
    top, bottom = np.full_like(near, 2 * points), np.full_like(near, 2 * points + 1)
    triangles = np.concatenate([np.stack([near, after, top], 1), np.stack([after, near, bottom], 1)])
    return np.concatenate([ring, [[0, 0, 1], [0, 0, 0]]]), triangles.astype(np.int32)


def dented():
    positions, triangles = sphere(4)
    positions[1234] *= 0.98  # one vertex of 2562, which the handful looked at first may well miss
    return positions, triangles


def holed():
    positions, triangles = sphere(3)
    return positions, triangles[5:]


SHAPES = {
    "sphere": (sphere(4), True, True), "cube": (cube(subdivisions=3), False, True), "torus": (torus(), True, False),
    "grid": (grid(), True, True), "dented": (dented(), True, False), "shaded": (sphere(4), False, True),
    "cube shaded smooth": (cube(subdivisions=3), True, True), "holed": (holed(), True, True),
    "turned cube": ((turned(cube(subdivisions=3)[0]), cube(subdivisions=3)[1]), False, True),
    "ellipsoid": ((turned(sphere(4)[0] * [1, 2, 0.1]), sphere(4)[1]), True, True),
    "inside out": ((sphere(3)[0], sphere(3)[1][:, ::-1]), True, False), "star": (star(), False, False),
    "two spheres": (two(sphere(2), [3, 0, 0]), True, False), "twice the same": (two(sphere(2), [0, 0, 0]), True, True)}


@pytest.mark.parametrize("name", SHAPES)
def test_what_blocks_is_found_as_a_plain_loop_finds_it(name):
    (positions, triangles), smooth, free = SHAPES[name]
    mesh = TriangleMesh.from_triangles(positions, triangles, smooth=smooth)
    assert slowly(mesh) == free
    assert nothing_blocks(mesh, []) == free


@pytest.mark.parametrize("name, expected", [
    ("sphere", True), ("cube", True), ("ellipsoid", True), ("turned cube", True), ("torus", False), ("grid", False),
    ("dented", False), ("holed", False), ("inside out", False), ("star", False), ("two spheres", False),
    ("twice the same", False)])
def test_a_closed_convex_body_is_known_by_its_edges(name, expected):
    assert convex(*SHAPES[name][0], 1e-6) == expected


def test_no_convex_mesh_is_too_large(monkeypatch):
    """Above all limits of what is looked at point by point."""
    monkeypatch.setattr(horizon, "_MOST_PAIRS", 10)
    monkeypatch.setattr(horizon, "_AT_ONCE", 1000)
    for smooth in (True, False):
        assert nothing_blocks(TriangleMesh.from_triangles(*sphere(5), smooth=smooth), [])
    assert not nothing_blocks(TriangleMesh.from_triangles(*holed()), [])


def test_a_tile_of_texels_may_be_looked_at_for_longer(monkeypatch):
    """Of a faceted ball: each texel lies in its face's plane, and no mesh is known by its edges from texels."""
    faceted = TriangleMesh.from_triangles(*sphere(3), smooth=False)
    tile = replace(faceted, domain=TEXEL)
    monkeypatch.setattr(horizon, "_MOST_PAIRS", 10)
    assert nothing_blocks(tile, [])
    monkeypatch.setattr(horizon, "_MOST_OF_TEXELS", 10)
    assert not nothing_blocks(tile, [])


def test_normals_that_lean_too_far_are_found_on_a_convex_mesh():
    """One of 2562, which the handful does not look at."""
    mesh = TriangleMesh.from_triangles(*sphere(4))
    normals = mesh.normals.copy()
    normals[1235] = [normals[1235, 1], -normals[1235, 0], normals[1235, 2]]
    assert nothing_blocks(mesh, []) and not nothing_blocks(replace(mesh, normals=normals), [])
    unlit = mesh.normals.copy()
    unlit[1235] = 0
    assert nothing_blocks(replace(mesh, normals=unlit), [])
    assert nothing_blocks(replace(mesh, normals=0 * unlit), [])


def test_other_objects_block_only_above_the_horizon():
    mesh = TriangleMesh.from_triangles(*grid())
    ball = sphere(2)
    below, above = (ball[0] - [0, 0, 2], ball[1]), (ball[0] + [0, 0, 2], ball[1])
    assert nothing_blocks(mesh, [below])
    assert not nothing_blocks(mesh, [below, above])
    assert not nothing_blocks(TriangleMesh.from_triangles(*sphere(3)), [above])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10 ** 6), st.integers(8, 60), st.floats(0, 0.3), st.booleans())
def test_hulls_with_and_without_dents_are_as_the_loop_has_them(seed, count, dent, smooth):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    positions, triangles = hull((points / np.linalg.norm(points, axis=1)[:, None]) * rng.uniform(0.3, 2, 3))
    positions = turned(positions, seed)
    positions[0] -= dent * (positions[0] - positions.mean(0))
    mesh = TriangleMesh.from_triangles(positions, triangles, smooth=smooth)
    assert nothing_blocks(mesh, []) == slowly(mesh)
