# SPDX-License-Identifier: GPL-3.0-or-later
"""Coarser meshes by topology: what stays is a maximal independent set, and values spread as weights say."""
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neural_gash_addon.backend.coarsen import BESIDE, coarsened, independent
from neural_gash_addon.backend.geometry import TriangleMesh

from .shapes import cube, sphere, torus


@given(st.integers(1, 30), st.lists(st.tuples(st.integers(0, 29), st.integers(0, 29)), max_size=80),
       st.integers(0, 1000))
def test_independent_and_maximal(count, pairs, seed):
    edges = sorted({(a % count, b % count) for one, other in pairs for a, b in ((one, other), (other, one))
                    if a % count != b % count})
    one, other = (np.array(column, dtype=np.int64) for column in (zip(*edges, strict=True) if edges else ((), ())))
    stays = independent(count, one, other, np.random.default_rng(seed))
    assert not any(stays[a] and stays[b] for a, b in edges)
    for vertex in np.flatnonzero(~stays):
        assert any(a == vertex and stays[b] for a, b in edges)


@pytest.mark.parametrize("geometry", [sphere(4), torus(), cube(subdivisions=4)], ids=["sphere", "torus", "cube"])
def test_a_coarse_mesh_is_whole(geometry):
    mesh = TriangleMesh.from_triangles(*geometry)
    found = coarsened(mesh)
    coarse = found.mesh(mesh)
    assert len(mesh.points) / 8 < len(coarse.points) < len(mesh.points) / 2
    np.testing.assert_array_equal(coarse.points, mesh.points[found.rows])
    np.testing.assert_array_equal(coarse.normals, mesh.normals[found.rows])
    assert coarse.triangles.min() >= 0 and coarse.triangles.max() < len(coarse.points)
    assert (coarse.triangles != np.roll(coarse.triangles, 1, 1)).all()
    # closed, as the fine one is: each edge has as many triangles on one side as on the other
    edges = np.concatenate([coarse.triangles[:, [0, 1]], coarse.triangles[:, [1, 2]], coarse.triangles[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    assert sum((b, a) in there for a, b in there) > 0.98 * len(there)  # doubled triangles are dropped


def test_spread_is_the_matrix_of_its_shares():
    mesh = TriangleMesh.from_triangles(*torus())
    found = coarsened(mesh)
    matrix = np.zeros((len(mesh.points), len(found.rows)))
    for point in range(len(mesh.points)):
        for column in range(BESIDE):
            matrix[point, found.beside[point, column]] += found.shares[point, column]
    values = np.random.default_rng(0).normal(size=(len(found.rows), 4)).astype(np.float32)
    np.testing.assert_allclose(found.spread(values), matrix @ values, atol=1e-5)
    np.testing.assert_allclose(matrix.sum(1), 1, atol=1e-6)
    np.testing.assert_array_equal(found.spread(values)[found.rows], values)
    beside = {frozenset(edge) for t in mesh.triangles.tolist() for edge in zip(t, t[1:] + t[:1], strict=True)}
    for point, near in zip(*np.nonzero(matrix), strict=True):
        assert point == found.rows[near] or frozenset((point, found.rows[near])) in beside


def test_the_set_does_not_depend_on_where_the_mesh_is():
    positions, triangles = torus()
    positions = positions + 0.02 * np.random.default_rng(0).normal(size=positions.shape)  # no two equally near
    one = coarsened(TriangleMesh.from_triangles(positions, triangles))
    other = coarsened(TriangleMesh.from_triangles(5 * positions + 3, triangles))
    np.testing.assert_array_equal(one.rows, other.rows)
    np.testing.assert_array_equal(one.triangles, other.triangles)


def test_split_normals_are_refused():
    with pytest.raises(ValueError, match="not vertices"):
        coarsened(TriangleMesh.from_triangles(*cube(), smooth=False))


def test_nothing_left_of_one_triangle():
    assert coarsened(TriangleMesh.from_triangles(np.eye(3), np.array([[0, 1, 2]]))) is None


def test_loose_vertices_and_one_place():
    positions, triangles = sphere(3)
    positions = np.concatenate([positions, positions[:1], [[9, 9, 9]]])
    found = coarsened(TriangleMesh.from_triangles(positions, triangles))
    assert {len(positions) - 2, len(positions) - 1} <= set(found.rows.tolist())
    assert np.isfinite(found.shares).all()
    squeezed = coarsened(TriangleMesh.from_triangles(np.zeros_like(positions), triangles))
    assert squeezed is None or np.isfinite(squeezed.shares).all()
