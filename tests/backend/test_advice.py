# SPDX-License-Identifier: GPL-3.0-or-later
"""What `auto` says of domain and target: shadows inside faces that corners miss, and the texture that has them."""
import re

import numpy as np
import pytest

from neural_gash_addon.backend import advice, auto_bake, methods, resolution
from neural_gash_addon.backend.geometry import Surface, TriangleMesh
from neural_gash_addon.backend.raycast import Occluders

from .shapes import cube, grid, sphere, torus

TABLE = (cube(subdivisions=0)[0] * [0.3, 0.3, 0.05] + [0.5, 0.5, 0.08], cube(subdivisions=0)[1])  # over the floor


def bake(mesh, **arguments):
    return methods.run(methods.bake(mesh, "auto", **arguments))


def sentences(record):
    return re.split(r"(?<=\.) (?=[A-Z])", record.plan)


def test_a_shadow_inside_a_face_that_its_corners_miss_is_said():
    coarse, fine = (TriangleMesh.from_triangles(*grid(n)) for n in (2, 60))
    method, order, _, target = sentences(bake(coarse, tolerance=0.1, occluders=[TABLE]).record)
    assert target.startswith("Shadow edges inside faces are missed by their corners (")
    assert target.endswith("a texture would have them.")
    assert method.startswith("Shadows are")  # at the corners there is next to none, so nothing is traced
    assert order == "Band 2 is 34 % of the whole: order 3 is kept."
    target = sentences(bake(fine, tolerance=0.1, occluders=[TABLE]).record)[3]
    assert target.startswith("Shadows inside faces follow their corners") and target.endswith("vertices are enough.")


@pytest.mark.parametrize("tolerance", [0.1, 0.03])
def test_the_texture_that_is_advised_is_about_as_large_as_one_fitted_to_the_error(tolerance):
    positions, triangles = grid(2)
    mesh = TriangleMesh.from_triangles(positions, triangles)
    surface = Surface(positions, triangles.ravel().astype(np.int32), np.tile([0, 0, 1], (6, 1)).astype(np.float32),
                      np.repeat([0, 1], 3).astype(np.int32), np.arange(6, dtype=np.int32).reshape(2, 3), 0.0)
    fitted = methods.run(resolution.fitting_side(surface, positions[triangles.ravel(), :2], error=tolerance, order=3,
                                                 occluders=[TABLE]))
    scene, baked = Occluders([(positions, triangles), TABLE]), bake(mesh, tolerance=tolerance, occluders=[TABLE])
    for seed in range(3):
        inside = methods.run(advice.inside_faces(mesh, scene, baked.coefficients, 3, tolerance, seed, 1))
        assert advice.missed(inside, tolerance)
        side = methods.run(advice.side(mesh, scene, inside, 3, tolerance, seed, 1))
        assert fitted / 8 < side * advice._FULL ** 0.5 < 8 * fitted  # the floor fills its texture


def test_a_movable_bake_stops_before_the_vertices_where_a_texture_is_wanted(monkeypatch):
    """As the look after the bake says, of corners that are traced for it alone."""
    coarse, fine = (TriangleMesh.from_triangles(*grid(n)) for n in (2, 60))
    wish = {"tolerance": 0.1, "occluders": [TABLE]}
    said, kept = (sentences(bake(mesh, **wish).record)[3] for mesh in (coarse, fine))
    with monkeypatch.context() as patch:
        patch.setitem(methods.METHODS, "embree", None)  # nothing else is begun
        patch.setitem(methods.METHODS, "hybrid", None)
        with pytest.raises(auto_bake.Elsewhere) as wanted:
            methods.run(auto_bake.bake(coarse, 3, rays=None, seed=0, threads=1, movable=True, bakers={}, **wish))
    assert said == advice.said(wanted.value.inside, 0.1)  # unshadowed at the corners, in both
    assert 64 <= wanted.value.side <= 4096
    found = bake(fine, movable=True, **wish)
    assert sentences(found.record)[3].startswith(kept[:40]) and found.record.target == "vertices"
    assert bake(TriangleMesh.from_triangles(*sphere(2)), tolerance=0.1, movable=True).record.target == "vertices"
    assert bake(coarse, rays=16, movable=True, occluders=[TABLE]).record.target == "vertices"


def test_corners_that_are_traced_miss_what_those_of_a_bake_miss():
    """Of a bake of many rays, whose noise is next to none."""
    mesh = TriangleMesh.from_triangles(*torus(sections=8))
    scene, baked = Occluders([(mesh.positions, mesh.triangles)]), bake(mesh, tolerance=0.005)
    for seed in range(3):
        known, traced = (methods.run(advice.inside_faces(mesh, scene, values, 3, 0.02, seed, 1))
                         for values in (baked.coefficients, None))
        assert traced.error == pytest.approx(known.error, abs=0.02) and known.error > 0.04


def test_a_texture_that_is_known_about_is_fitted_alike_and_grows_with_the_tolerance():
    positions, triangles = grid(2)
    surface = Surface(positions, triangles.ravel().astype(np.int32), np.tile([0, 0, 1], (6, 1)).astype(np.float32),
                      np.repeat([0, 1], 3).astype(np.int32), np.arange(6, dtype=np.int32).reshape(2, 3), 0.0)
    uv = positions[triangles.ravel(), :2]
    low = TABLE[0] * [1, 1, 0.4] - [0, 0, 0.01], TABLE[1]  # 2 mm over the floor: a sharp edge

    def side(error, **known):
        return methods.run(resolution.fitting_side(surface, uv, error=error, order=3, occluders=[low], **known))

    sides = [side(error, near=32) for error in (0.04, 0.015, 0.005)]
    assert sides == sorted(set(sides))
    assert side(0.015) / 1.6 < sides[1] < 1.6 * side(0.015)
    assert side(0.0005, near=4096, most=128) == 128
    assert side(0.1, near=256) == 128  # half of it is tried first, and is enough


def test_lookups_around_a_point_are_bilinear():
    """On a flat floor, what is linear comes back exactly; beyond its border there is nothing to read."""
    positions, triangles = grid(7)
    mesh = TriangleMesh.from_triangles(positions, triangles)
    rng = np.random.default_rng(2)
    faces = rng.integers(0, len(triangles), 200)
    weights = rng.dirichlet([1, 1, 1], 200)
    met, at, shares = advice.around(mesh, Occluders([(positions, triangles)]), faces, weights, 0.02, rng)
    places = np.einsum("nc,ncx->nx", weights, positions[triangles[faces]])
    read = np.einsum("rc,rcx->rx", at, positions[triangles[met]]).reshape(200, 4, 3)
    inside = (np.abs(places[:, :2] - 0.5) < 0.47).all(1)
    assert inside.sum() > 100
    np.testing.assert_allclose(np.einsum("nc,ncx->nx", shares, read)[inside], places[inside], atol=1e-5)
    np.testing.assert_allclose(shares.sum(1), 1, atol=1e-6)
    far = np.abs(read - places[:, None]).max(2)
    assert (far[inside] <= 0.02 * 2 ** 0.5 + 1e-5).all() and far[inside].max() > 0.015


@pytest.mark.parametrize(("smooth", "words"), [(True, "each vertex has one value"), (False, "each side of an edge")])
def test_the_domain_is_explained(smooth, words):
    for shape, tolerance in ((torus(), 0.1), (sphere(2), 0.1)):
        found = bake(TriangleMesh.from_triangles(*shape, smooth=smooth), tolerance=tolerance)
        assert words in sentences(found.record)[2]


def test_one_sentence_for_each_choice_and_none_where_a_method_was_chosen():
    mesh = TriangleMesh.from_triangles(*torus())
    assert len(sentences(bake(mesh, tolerance=0.05).record)) == 4
    assert len(sentences(bake(mesh, rays=16).record)) == 2
    assert methods.run(methods.bake(mesh, "embree", tolerance=0.05)).record.plan == ""


def test_split_normals_without_corners_and_darkness_give_no_sentence():
    from dataclasses import replace
    mesh = replace(TriangleMesh.from_triangles(*torus(), smooth=False), corners=None)
    assert len(sentences(bake(mesh, tolerance=0.1).record)) == 3
    dark = TriangleMesh.from_triangles(sphere(3)[0], sphere(3)[1][:, ::-1])
    assert len(sentences(bake(dark, tolerance=0.1).record)) == 2
