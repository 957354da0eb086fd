# SPDX-License-Identifier: GPL-3.0-or-later
"""How sure a bake is of each point."""
from __future__ import annotations

import numpy as np
import pytest

from neural_gash_addon.backend import methods
from neural_gash_addon.backend.doubt import doubt
from neural_gash_addon.backend.geometry import TriangleMesh

from .shapes import sphere, torus

MESH = TriangleMesh.from_triangles(*torus(sections=64))


def baked(method, **quality):
    return methods.run(methods.bake(MESH, method, 3, **quality)).coefficients


def test_of_rays_it_is_the_error():
    found = baked("embree", rays=16)
    truth = baked("embree", rays=4096, seed=9)
    error = np.square(found - truth).sum(1)
    claimed = methods.run(doubt(MESH, found, "embree", rays=16)) ** 2
    assert claimed.mean() == pytest.approx(error.mean(), rel=0.2)
    inner = np.linalg.norm(MESH.points[:, :2], axis=1) < 1.0  # which sees the other side
    assert claimed[inner].mean() > 3 * claimed[~inner].mean()
    assert error[inner].mean() > 3 * error[~inner].mean()


def test_more_rays_are_surer():
    few, many = (methods.run(doubt(MESH, baked("embree", rays=rays), "embree", rays=rays)) for rays in (16, 256))
    assert np.sqrt(np.square(many).mean()) < 0.3 * np.sqrt(np.square(few).mean())


def test_what_is_exact_is_sure():
    assert methods.run(doubt(MESH, baked("analytic"), "analytic")).max() < 1e-6
    ball = TriangleMesh.from_triangles(*sphere(2))
    found = methods.run(methods.bake(ball, "embree", 3, rays=16)).coefficients
    assert methods.run(doubt(ball, found, "embree", rays=16)).max() < 1e-6


def test_a_network_is_less_sure_where_there_are_shadows():
    claimed = methods.run(doubt(MESH, baked("gnn"), "gnn"))
    inner = np.linalg.norm(MESH.points[:, :2], axis=1) < 0.8
    assert 0 < np.median(claimed[~inner]) < 0.5 * np.median(claimed[inner])


def test_occluders_are_turned_too():
    ball = TriangleMesh.from_triangles(*sphere(3))
    lid = (np.array([[-9, -9, 1.2], [9, -9, 1.2], [9, 9, 1.2], [-9, 9, 1.2]]), np.array([[0, 1, 2], [0, 2, 3]]))
    found = methods.run(methods.bake(ball, "embree", 3, rays=512, occluders=[lid])).coefficients
    claimed = methods.run(doubt(ball, found, "embree", [lid], rays=512))
    assert np.sqrt(np.square(claimed).mean()) < 0.02 * np.sqrt(np.square(found).sum(1).mean())
