# SPDX-License-Identifier: GPL-3.0-or-later
"""What `auto` says of domain and target: shadows inside faces that corners miss, and the texture that has them."""
import re

import numpy as np
import pytest

from neural_gash_addon.backend import advice, methods
from neural_gash_addon.backend.geometry import TriangleMesh
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
    assert re.fullmatch(r"Band 2 is 3[3-6] % of the whole: order 3 is kept\.", order)
    target = sentences(bake(fine, tolerance=0.1, occluders=[TABLE]).record)[3]
    assert target.startswith("Shadows inside faces follow their corners") and target.endswith("vertices are enough.")


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


def test_noise_alone_wants_no_texture_and_an_edge_does():
    """A dense ball with bumps, whose shadows have no edge, asked twenty times at tolerances near its noise."""
    positions, triangles = sphere(5)
    ball = TriangleMesh.from_triangles(positions * (1 + 0.03 * np.cos(9 * positions).sum(1, keepdims=True)), triangles)
    for mesh, others, missed in ((ball, [], False), (TriangleMesh.from_triangles(*grid(12)), [TABLE], True)):
        scene = Occluders([(mesh.positions, mesh.triangles), *others])
        baked = methods.run(methods.bake(mesh, "embree", 3, rays=1024, seed=7, scene=scene)).coefficients
        for tolerance in (0.01, 0.005):
            found = [methods.run(advice.inside_faces(mesh, scene, baked, 3, tolerance, seed, 1)) for seed in range(20)]
            assert [look.missed for look in found] == [missed] * 20 and min(found).error > 0
