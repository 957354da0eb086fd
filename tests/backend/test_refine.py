# SPDX-License-Identifier: GPL-3.0-or-later
"""Ambient-occlusion refinement against its slow twin, and where it must do nothing."""
import numpy as np
import pytest

from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.graph import graph
from neural_gash_addon.backend.neighbours import neighbours
from neural_gash_addon.backend.refine import occlusion, refined

from . import shapes


def case(geometry):
    mesh = TriangleMesh.from_triangles(*geometry)
    return mesh, graph(mesh.points, neighbours(mesh))


def test_it_is_the_mean_square_of_the_sines():
    mesh, edges = case(shapes.torus())
    found = occlusion(mesh.points, mesh.normals, edges)
    for i in range(0, len(mesh.points), 37):
        heights = [max(0.0, float((mesh.points[j] - mesh.points[i]) @ mesh.normals[i]
                                  / np.linalg.norm(mesh.points[j] - mesh.points[i])))
                   for j in edges.source[edges.start[i]:edges.start[i + 1]]]
        assert found[i] == pytest.approx(np.mean(np.square(heights)), abs=1e-6)


def test_convex_shapes_stay_and_hollows_darken():
    for geometry, darker in ((shapes.sphere(3), False), (shapes.cube(inside=True, subdivisions=2), True)):
        mesh, edges = case(geometry)
        before = np.ones((len(mesh.points), 9))
        after = refined(before, mesh.points, mesh.normals, edges)
        assert (after < 1).any() == darker and (after >= 0).all()
        assert darker or np.array_equal(after, before)


def test_vertices_without_neighbours_or_normals_stay():
    mesh, edges = case((np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0.0]]), np.array([[0, 1, 2]])))
    assert np.isfinite(refined(np.ones((4, 9)), mesh.points, mesh.normals * 0, edges)).all()
