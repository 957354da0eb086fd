# SPDX-License-Identifier: GPL-3.0-or-later
"""Coverage of texels against a slow twin, and what a bilinear lookup needs of it."""
import numpy as np
import pytest

from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.raster import Layout
from neural_gash_addon.backend.texels import fill_map


def grid(count, turn=0.3):
    """A turned square of count x count cells as triangles: uv (F, 3, 2) and vertices (F, 3)."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, count + 1), np.linspace(-0.3, 0.3, count + 1))
    c, s = np.cos(turn), np.sin(turn)
    places = np.stack([0.5 + c * x.ravel() - s * y.ravel(), 0.5 + s * x.ravel() + c * y.ravel()], 1)
    cell = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    n = count + 1
    triangles = np.concatenate([np.stack([cell, cell + 1, cell + n + 1], 1),
                                np.stack([cell, cell + n + 1, cell + n], 1)])
    return places[triangles], triangles


def barycentric(triangle, point):
    matrix = np.vstack([triangle.T, np.ones(3)])
    return np.linalg.solve(matrix, [*point, 1])


def slow_inside(uv, side):
    """Texels whose centre is in some triangle: {texel: triangles}."""
    found = {}
    for face, triangle in enumerate(uv * side):
        if abs(np.linalg.det(np.vstack([triangle.T, np.ones(3)]))) < 1e-12:
            continue
        for row in range(side):
            for column in range(side):
                if (barycentric(triangle, (column + 0.5, row + 0.5)) > 1e-9).all():
                    found.setdefault(row * side + column, []).append(face)
    return found


def near_an_edge(triangle, texel, side):
    """Whether a texel's centre is within a hundredth of a texel of the lines along a triangle's edges."""
    centre = np.array([texel % side + 0.5, texel // side + 0.5])
    normals = (triangle - np.roll(triangle, 1, 0))[:, ::-1] * [-1, 1]
    return (np.abs(((centre - triangle) * normals).sum(1)) <= 0.01 * np.linalg.norm(normals, axis=1)).any()


@pytest.mark.parametrize("seed", range(4))
def test_centres_equal_the_slow_twin(seed):
    rng = np.random.default_rng(seed)
    uv, side = rng.uniform(0, 1, (6, 3, 2)), 24
    triangles = np.arange(18).reshape(6, 3)
    slow = slow_inside(uv, side)
    found = Layout(uv, triangles, side).coverage()
    inside = (found.barycentric > 1e-9).all(1) & np.isclose(found.barycentric, found.centres).all(1)
    assert set(found.texels[inside]) == set(slow)
    for texel, face in zip(found.texels[inside], found.faces[inside], strict=True):
        assert face == min(slow[texel])
    pairs = {tuple(p) for p in Layout(uv, triangles, side).overlapping()}
    slow = {texel: [face for face in faces if not near_an_edge(uv[face] * side, texel, side)]
            for texel, faces in slow.items()}
    assert {(a, b) for faces in slow.values() for a, b in zip(faces[:-1], faces[1:], strict=True)} == pairs


@pytest.mark.parametrize("side", [7, 32, 129])
def test_joined_triangles_share_no_texel_and_leave_no_hole(side):
    uv, triangles = grid(16, 0.0)   # edges may run exactly through centres
    found = Layout(uv, triangles, side).coverage()
    assert not len(Layout(uv, triangles, side).overlapping())
    centres = (np.stack([found.texels % side, found.texels // side], 1) + 0.5) / side
    inside = np.zeros(side * side, bool)
    inside[found.texels] = True
    every = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2) + 0.5) / side
    within = np.all(np.abs(every - 0.5) < 0.3, axis=1)
    assert inside[within].all()
    places = np.einsum("nc,ncx->nx", found.centres, uv[found.faces])
    reached = np.abs(found.centres - found.barycentric).max(1) < 0.9
    np.testing.assert_allclose(places[reached], centres[reached], atol=1e-9)


@pytest.mark.parametrize(("count", "side"), [(1, 16), (3, 40), (40, 20)])
def test_every_bilinear_lookup_inside_reads_covered_texels_only(count, side):
    uv, triangles = grid(count)
    found = Layout(uv, triangles, side).coverage()
    covered = np.zeros((side, side), bool)
    covered.ravel()[found.texels] = True
    rng = np.random.default_rng(0)
    weights = rng.dirichlet([0.4, 0.4, 0.4], 4000)          # many near the edges
    places = np.einsum("nc,ncx->nx", weights, uv[rng.integers(0, len(uv), 4000)]) * side - 0.5
    low = np.floor(places).astype(int)
    for dx in (0, 1):
        for dy in (0, 1):
            assert covered[low[:, 1] + dy, low[:, 0] + dx].all()
    assert (found.barycentric > -1e-9).all() and (found.barycentric < 1 + 1e-9).all()
    np.testing.assert_allclose(found.barycentric.sum(1), 1)
    np.testing.assert_allclose(found.centres.sum(1), 1)


def test_border_belongs_to_the_nearest_point_of_the_outline():
    uv, triangles = np.array([[[0.25, 0.25], [0.75, 0.25], [0.25, 0.75]]]), np.array([[0, 1, 2]])
    found = Layout(uv, triangles, 16).coverage()
    places = np.einsum("nc,cx->nx", found.barycentric, uv[0]) * 16
    centres = np.stack([found.texels % 16, found.texels // 16], 1) + 0.5
    edges = [(uv[0][a] * 16, uv[0][b] * 16) for a, b in ((0, 1), (1, 2), (2, 0))]
    for place, centre in zip(places, centres, strict=True):
        away = np.linalg.norm(place - centre)
        if away > 1e-9:
            nearest = min(np.linalg.norm(a + np.clip((centre - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1) * (b - a)
                                         - centre) for a, b in edges)
            assert away == pytest.approx(nearest)


def test_rows_at_a_time_equal_the_whole():
    uv, triangles = grid(5)
    layout = Layout(uv, triangles, 48)
    whole = layout.coverage()
    parts = [layout.coverage(start, min(start + 7, 48)) for start in range(0, 48, 7)]
    for name in ("texels", "faces", "barycentric", "centres"):
        np.testing.assert_array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name))


def test_faces_smaller_than_a_texel_are_covered():
    uv = 0.5 + 1e-4 * np.array([[[0.1, 0.1], [0.3, 0.1], [0.1, 0.3]]])
    assert len(Layout(uv, np.array([[0, 1, 2]]), 64).coverage().texels) >= 4


@pytest.mark.parametrize("bad", [np.nan, np.inf, -0.2, 1.5])
def test_coordinates_outside_are_refused(bad):
    uv, triangles = grid(2)
    uv = uv.copy()
    uv[3, 1, 0] = bad
    with pytest.raises(UserError, match="UVs"):
        Layout(uv, triangles, 32)


def test_flipped_and_flat_triangles_are_covered_or_left_out():
    uv, triangles = grid(4)
    flipped = Layout(uv[:, ::-1], triangles[:, ::-1], 32).coverage()
    np.testing.assert_array_equal(flipped.texels, Layout(uv, triangles, 32).coverage().texels)
    flat = Layout(np.full((1, 3, 2), 0.4), np.array([[0, 1, 2]]), 32).coverage()
    assert np.isfinite(flat.centres).all() and np.isfinite(flat.barycentric).all()


def test_empty_texels_show_the_nearest_covered_one():
    rng = np.random.default_rng(1)
    covered = rng.uniform(size=(40, 40)) < 0.02
    source = fill_map(covered, texels=3).reshape(40, 40)
    rows, columns = np.nonzero(covered)
    assert covered.ravel()[source].all()
    for row in range(40):
        for column in range(40):
            nearest = np.sqrt(((rows - row) ** 2 + (columns - column) ** 2).min())
            there = source[row, column]
            away = np.hypot(there // 40 - row, there % 40 - column)
            assert away <= nearest + 0.6 if nearest <= 3 else away <= 8 * nearest
    assert (fill_map(np.zeros((8, 8), bool)) == 0).all()


@pytest.mark.parametrize(("by", "pairs"), [(1e-7, 0), (0.002, 0), (0.05, 1)])
def test_islands_that_touch_do_not_overlap(by, pairs):
    """Two sides of a line through centres, moved over each other by some texels."""
    line = 20.5
    one = np.array([[5, line + by / 2], [55, line + by / 2], [30, 5]])
    other = np.array([[5, line - by / 2], [55, line - by / 2], [30, 60]])
    assert len(Layout(np.stack([one, other]) / 64, np.arange(6).reshape(2, 3), 64).overlapping()) == pairs
