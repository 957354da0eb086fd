# SPDX-License-Identifier: GPL-3.0-or-later
"""What a point is: vertices under smooth shading, distinct (vertex, normal) pairs under split."""
import numpy as np

from neural_gash_addon.backend.geometry import CORNER, INSET, POINT, TriangleMesh

from . import shapes


def test_smooth_points_are_the_vertices_in_their_order():
    positions, triangles = shapes.sphere(2)
    mesh = TriangleMesh.from_triangles(positions, triangles)
    assert mesh.domain == POINT
    np.testing.assert_array_equal(mesh.points, positions)
    np.testing.assert_array_equal(mesh.elements, np.arange(len(positions)))
    np.testing.assert_allclose(mesh.normals, positions, atol=0.02)


def test_flat_cube_has_24_points_for_36_corners():
    mesh = TriangleMesh.from_triangles(*shapes.cube(subdivisions=0), smooth=False)
    assert (mesh.domain, len(mesh.points), len(mesh.elements)) == (CORNER, 24, 36)
    face = np.repeat(np.arange(12), 3)
    corners = mesh.positions[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(mesh.normals[mesh.elements], normals[face], atol=1e-12)
    np.testing.assert_array_equal(mesh.points[mesh.elements], mesh.positions[mesh.triangles.ravel()])


def test_a_flat_shaded_plane_needs_no_more_points_than_vertices():
    mesh = TriangleMesh.from_triangles(*shapes.grid(6), smooth=False)
    assert mesh.domain == POINT and len(mesh.points) == 36


def test_one_sharp_edge_splits_only_its_vertices():
    positions, triangles = shapes.grid(5)
    positions[:, 2] = np.maximum(positions[:, 0] - 0.5, 0)  # folded along x = 0.5
    tilt = np.array([-1, 0, 1]) / np.sqrt(2)
    centre = positions[triangles].mean(1)[:, 0]
    normals = np.where((centre > 0.5)[:, None], tilt, [0, 0, 1.0]).repeat(3, 0)
    mesh = TriangleMesh.from_corners(positions, triangles, triangles.ravel(), normals,
                                     np.repeat(np.arange(len(triangles)), 3))
    assert mesh.domain == CORNER and len(mesh.points) == 25 + 5
    on_fold = np.isclose(mesh.points[:, 0], 0.5)
    flat = mesh.normals[:, 2] > 0.99
    insets = (mesh.clearance - mesh.normals) / INSET
    assert (insets[on_fold & flat] @ [1, 0, 0] < -0.5).all()   # each into its own side
    assert (insets[on_fold & ~flat] @ [1, 0, 1] > 0.5).all()
    np.testing.assert_allclose((insets * mesh.normals).sum(1), 0, atol=1e-12)


def test_noise_in_normals_does_not_split():
    positions, triangles = shapes.sphere(2)
    noise = np.random.default_rng(0).normal(size=(triangles.size, 3)) * 1e-6
    mesh = TriangleMesh.from_corners(positions, triangles, triangles.ravel(), positions[triangles.ravel()] + noise,
                                     np.repeat(np.arange(len(triangles)), 3))
    assert mesh.domain == POINT


def test_loose_vertices_have_no_normal():
    positions, triangles = shapes.grid(3)
    mesh = TriangleMesh.from_triangles(np.concatenate([positions, [[5.0, 5, 5]]]), triangles)
    assert len(mesh.points) == 10 and not mesh.normals[-1].any()
