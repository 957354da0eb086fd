# SPDX-License-Identifier: GPL-3.0-or-later
"""Points spread over a mesh, and what is told of each as others see it."""
import numpy as np
import pytest

from neural_gash_addon.backend import conformal, sight
from neural_gash_addon.backend.geometry import TriangleMesh

from . import shapes
from .test_hybrid import knot

RNG = np.random.default_rng(5)


def mesh_of(name):
    return {"knot": knot, "torus": lambda: TriangleMesh.from_triangles(*shapes.torus(sections=24)),
            "sphere": lambda: TriangleMesh.from_triangles(*shapes.sphere(5))}[name]()


@pytest.mark.parametrize("name", ["knot", "torus", "sphere"])
def test_spread_points_are_the_same_in_any_order_and_size(name):
    mesh = mesh_of(name)
    whole = sight.places(mesh.points, mesh.normals)
    mixed = RNG.permutation(len(mesh.points))
    again = sight.places(mesh.points[mixed] * 1000 + 7, mesh.normals[mixed])
    np.testing.assert_array_equal(mixed[again.spread], whole.spread)
    assert len(np.unique(whole.spread)) == len(whole.spread) == min(len(mesh.points), sight.SPREAD)


def test_points_are_spread_farthest_first():
    """By the slow way, and so that the first 128 leave no larger gap than twice what 128 points must."""
    points = sight.placed(RNG.random((600, 3)), np.ones(600, bool))
    found = sight.spread(points, np.ones((600, 3)), 600)
    assert sorted(found) == list(range(600))
    apart = np.linalg.norm(points[found][:, None] - points[found][None], axis=2)
    gaps = [apart[:n, n:].min(0).max() for n in range(1, 599)]
    reached = [apart[:n, n].min() for n in range(1, 599)]  # of the next one, from those before it
    np.testing.assert_allclose(reached, gaps, atol=2 * sight.SIDE * 3 ** 0.5 / sight._STEPS)


def test_poor_points_are_spread_too():
    assert list(sight.spread(np.zeros((5, 3)), np.zeros((5, 3)), 3)) == [0]
    points = np.array([[0, 0, 0], [0, 0, 0], [4, 0, 0], [1, 0, 0.0]])
    normals = np.array([[0, 1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 0.0]])
    found = sight.spread(points, normals, 4)
    assert 3 not in found and set(found) in ({0, 2}, {1, 2})


def test_edges_tell_what_the_receivers_motor_undoes():
    """Direction and normal of a source are those that ~M carries it to, by the algebra's own products."""
    mesh = knot()
    known = sight.places(mesh.points, mesh.normals)
    receiver, sender = RNG.integers(len(mesh.points), size=(2, 50))
    motors = conformal.motor(known.points[receiver], known.normals[receiver])
    undone = conformal.multiply(conformal.reverse(motors), conformal.motor(known.points[sender], known.normals[sender]))
    normal = conformal.frames(undone)[:, :, 1]
    away = np.einsum("nji,nj->ni", conformal.frames(motors), known.points[sender] - known.points[receiver])
    # the origin, which ~M_i M_j carries to where j is: e_o = (e5 - e4) / 2, and p is the part of e1, e2, e3
    origin = np.zeros((50, 32))
    origin[:, [conformal.BLADES.index((4,)), conformal.BLADES.index((5,))]] = [-0.5, 0.5]
    carried = conformal.sandwich(undone, origin)[:, [conformal.BLADES.index((axis,)) for axis in (1, 2, 3)]]
    np.testing.assert_allclose(carried, away, atol=1e-9)
    found = known.relative(receiver, sender[:, None])[:, 0]
    length = np.sqrt(np.square(away).sum(1, keepdims=True) + sight._NEAR ** 2)
    np.testing.assert_allclose(found[:, :3], away / length, atol=1e-6)
    np.testing.assert_allclose(found[:, 3:6], normal, atol=1e-6)
    np.testing.assert_allclose(found[:, 6:7], np.log(length), atol=1e-6)
    np.testing.assert_allclose(found[:, 7], -(found[:, :3] * found[:, 3:6]).sum(1), atol=1e-6)


@pytest.mark.parametrize("name", ["knot", "torus"])
def test_chunks_hear_what_the_whole_hears(name, monkeypatch):
    mesh = mesh_of(name)
    known = sight.places(mesh.points, mesh.normals)

    def edges():
        for part in known.sights():
            assert part.source.max() < len(known.spread)
            for vertex in part.asked:
                at = slice(part.start[vertex], part.start[vertex + 1])
                yield known.spread[part.source[at]], part.encoded[vertex], part.edge[at]

    whole = list(edges())
    monkeypatch.setattr(sight, "CHUNK", 300)
    for one, other in zip(whole, edges(), strict=True):
        for left, right in zip(one, other, strict=True):
            np.testing.assert_array_equal(left, right)
    heard, encoded, _ = whole[77]
    near, far = np.split(heard, [sight.NEAREST])
    for origin, found, most in ((77, near, sight.SPREAD), (near[0], far, sight.FIRST)):
        apart = np.linalg.norm(known.points[known.spread[:most]] - known.points[origin], axis=1)
        reached = np.linalg.norm(known.points[found] - known.points[origin], axis=1)
        assert set(found) <= set(known.spread[:most]) and len(set(found)) == len(found)
        np.testing.assert_allclose(reached, np.sort(apart)[:len(found)], atol=1e-3)
    np.testing.assert_allclose(encoded, conformal.encode(known.points[77], known.normals[77]), atol=1e-5)
