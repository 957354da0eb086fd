# SPDX-License-Identifier: GPL-3.0-or-later
"""Nearest neighbours against SciPy's k-d tree, and the graph made of them."""
import numpy as np
import pytest
from scipy.spatial import cKDTree

from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.graph import graph
from neural_gash_addon.backend.nearest import nearest, nearest_to
from neural_gash_addon.backend.neighbours import Neighbours, neighbours

from . import shapes

RNG = np.random.default_rng(0)
CLOUDS = {
    "cube": RNG.random((3000, 3)), "sphere": shapes.sphere(4)[0], "plane": RNG.random((2000, 3)) * [1, 1, 0],
    "line": RNG.random((2000, 3)) * [1, 0, 0], "nine": RNG.random((9, 3)), "two": RNG.random((2, 3)),
    "far": RNG.random((500, 3)) + 1e6, "large": RNG.random((500, 3)) * 1e15, "small": RNG.random((500, 3)) * 1e-12,
    "clusters": np.concatenate([RNG.random((1000, 3)) * scale + place for scale, place in
                                ((1, 0), (1e-3, 3), (1e-6, 7))]),
    "lonely": np.concatenate([RNG.random((500, 3)) * 1e-3, [[1, 1, 1.0]]]),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_nearest_are_those_of_a_k_d_tree(name):
    places = np.unique(CLOUDS[name], axis=0)
    k = min(8, len(places) - 1)
    found = nearest(places, 8)
    assert found.shape == (len(places), k)
    distance = np.linalg.norm(places[found] - places[:, None], axis=2)
    expected = cKDTree(places).query(places, k + 1)[0][:, 1:]
    np.testing.assert_allclose(distance, expected.reshape(distance.shape), rtol=1e-9)
    assert (np.diff(distance, axis=1) >= 0).all()


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("other", ["sphere", "nine", "clusters", "far"])
def test_nearest_to_places_are_those_of_a_k_d_tree(name, other):
    places, points = CLOUDS[name], CLOUDS[other]
    k = min(16, len(points))
    found = nearest_to(places, points, 16)
    assert found.shape == (len(places), k)
    distance = np.linalg.norm(points[found] - places[:, None], axis=2)
    np.testing.assert_allclose(distance, cKDTree(points).query(places, k)[0], rtol=1e-9)
    assert (np.diff(distance, axis=1) >= -1e-12 * distance.max()).all()


def test_of_points_equally_near_the_lower_index_is_first():
    np.testing.assert_array_equal(nearest_to(np.ones((3, 3)), np.zeros((500, 3)), 5), [np.arange(5)] * 3)
    grid = np.stack(np.meshgrid(*[np.arange(9.0)] * 3), -1).reshape(-1, 3)
    square = np.square(grid[:, None] - grid[None]).sum(2)
    np.testing.assert_array_equal(nearest_to(grid, grid, 20), np.argsort(square, axis=1, kind="stable")[:, :20])


def test_no_places_have_no_nearest():
    assert nearest_to(np.zeros((0, 3)), np.zeros((4, 3)), 8).shape == (0, 4)


def edges(found):
    return set(zip(found.source.tolist(), np.repeat(np.arange(len(found.start) - 1), np.diff(found.start)).tolist(),
                   strict=True))


def test_graph_has_the_edges_of_the_mesh_and_the_nearest_and_no_others():
    mesh = TriangleMesh.from_triangles(*shapes.torus())
    found = edges(graph(mesh.points, neighbours(mesh), 4))
    on_mesh = {(a, b) for t in mesh.triangles.tolist() for a in t for b in t if a != b}
    near = {(int(j), i) for i, row in enumerate(nearest(mesh.points, 4)) for j in row}
    assert found == on_mesh | near


@pytest.mark.parametrize(("points", "count"), [
    (np.zeros((1, 3)), 0), (np.zeros((5, 3)), 4), (np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0.0]]), 4)],
    ids=["one", "one place", "two places"])
def test_points_in_one_place_are_joined_with_the_first(points, count):
    none = Neighbours(np.zeros(len(points) + 1, np.int64), np.zeros(0, np.int32))
    found = graph(points, none)
    assert len(found.source) == count and len(found.start) == len(points) + 1
