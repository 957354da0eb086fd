# SPDX-License-Identifier: GPL-3.0-or-later
"""Unwraps have no faces over each other: what is found against a slow twin, and what a bake says of the UVs."""
import numpy as np
import pytest

from neural_gash_addon.backend import methods
from neural_gash_addon.backend.atlas import Part, place
from neural_gash_addon.backend.folds import overlapping, taken_out
from neural_gash_addon.backend.geometry import Surface, TriangleMesh
from neural_gash_addon.backend.raster import Layout
from neural_gash_addon.backend.unwrap import unwrap

from . import shapes

SIDES = (64, 128, 256, 512, 1024)


def crumpled(seed):
    """A sphere crumpled so that xatlas makes charts of it that lie over themselves beside slits."""
    positions, triangles = shapes.sphere(3)
    places = positions + 0.06 * np.random.default_rng(seed).normal(size=positions.shape)
    mesh = TriangleMesh.from_triangles(places, triangles.astype(np.int32))
    return Surface(mesh.positions, mesh.triangles.ravel(), mesh.normals[mesh.triangles.ravel()].astype(np.float32),
                   np.arange(len(triangles), dtype=np.int32).repeat(3),
                   np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3), 0.0)


def polygon(points):
    """A mesh of one face, in triangles that all begin at its first corner."""
    count = len(points)
    fan = np.array([[0, n, n + 1] for n in range(1, count - 1)], np.int32)
    return Surface(np.asarray(points, float), np.arange(count, dtype=np.int32),
                   np.tile(np.float32([0, 0, 1]), (count, 1)), np.zeros(count, np.int32), fan, 0.0)


def area(corners):
    x, y = np.asarray(corners).reshape(-1, 2).T
    return 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))


def common_area(one, other):
    """Area of what two triangles share: one cut along each edge of the other."""
    if abs(area(other)) < 1e-12:
        return 0.0
    left, other = [*one], other if area(other) > 0 else other[::-1]
    for a, b in zip(other, np.roll(other, -1, 0), strict=True):
        inside = [(b - a)[0] * (p - a)[1] - (b - a)[1] * (p - a)[0] for p in left]
        kept = []
        for p, q, s, t in zip(left, left[1:] + left[:1], inside, inside[1:] + inside[:1], strict=True):
            kept += [p] if s >= 0 else []
            kept += [p + (q - p) * s / (s - t)] if s * t < 0 else []
        left = kept
    return abs(area(left)) if left else 0.0


def assert_served(surface, uv):
    """A bake takes the UVs, also as Blender keeps them, whatever the size of its texture."""
    for kept in (uv, uv.astype(np.float32)):
        for side in SIDES:
            methods.run(place([Part(surface, kept)], side=side))


@pytest.mark.parametrize("seed", range(3))
def test_overlaps_equal_the_slow_twin(seed):
    rng = np.random.default_rng(seed)
    local = rng.uniform(0, 1, (90, 1, 2)) + rng.uniform(-0.2, 0.2, (90, 3, 2))
    local[7] = local[7, :1]                       # a point
    local[8, 2] = (local[8, 0] + local[8, 1]) / 2  # a line
    local[9] = local[10]
    charts = rng.integers(0, 3, 90)
    charts[9] = charts[10]
    slow = {(a, b) for a in range(90) for b in range(a + 1, 90)
            if charts[a] == charts[b] and common_area(local[a], local[b]) > 1e-9}
    found = [tuple(pair) for pair in overlapping(local, charts)]
    assert (9, 10) in slow and len(slow) > 50
    assert set(found) == slow and len(found) == len(slow)
    assert not len(overlapping(local[:0], charts[:0]))


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_faces_that_only_touch_do_not_overlap(turn):
    positions, triangles = shapes.grid(12)
    c, s = np.cos(turn), np.sin(turn)
    local = positions[triangles][..., :2] @ np.array([[c, -s], [s, c]])
    one = np.zeros(len(local), np.int64)
    assert not len(overlapping(local, one))
    assert not len(overlapping(local.astype(np.float32).astype(np.float64), one))
    moved = local.copy()
    moved[50] += [0.002, 0.001]
    assert (overlapping(moved, one) == 50).any(1).all() and len(overlapping(moved, one)) > 2


def test_few_faces_are_taken_out():
    star, ring = [(0, n) for n in range(1, 9)], [(n, (n + 1) % 4 + 20) for n in range(20, 24)]
    pairs = np.array([*star, *ring, (30, 30), (30, 31)])
    out = taken_out(pairs)
    assert np.isin(pairs, out).any(1).all()
    assert {0, 30} <= set(out.tolist()) and len(out) == len(set(out.tolist())) <= 5
    assert not len(taken_out(pairs[:0]))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("side", [128, 256, 512])
def test_charts_that_xatlas_lays_over_themselves_are_parted(seed, side):
    mesh = crumpled(seed)
    found = methods.run(unwrap(mesh, side=side))
    assert 1 <= found.alone.sum() < 10
    assert_served(mesh, found.uv)


@pytest.mark.parametrize("points", [
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.9, 0.1, 0.2]],                             # one half turned over the other
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 0, 1e-12]],                               # and on it
    [[0, 0, 0], *([np.cos(a), np.sin(a), a / 9] for a in np.linspace(0, 10, 14))],  # a winding stair
], ids=["turned", "closed", "stair"])
def test_a_polygon_does_not_lie_over_itself(points):
    mesh = polygon(points)
    found = methods.run(unwrap(mesh, side=128))
    assert_served(mesh, found.uv)
    assert len(np.unique(Layout(found.uv[mesh.corners], mesh.triangles, 128).coverage().faces)) == len(mesh.corners)
    corners = mesh.positions[mesh.triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    room = sum(abs(area(face)) for face in found.uv[mesh.corners]) * (found.side / found.texels_per_metre) ** 2
    assert room == pytest.approx(areas.sum(), rel=0.01)
