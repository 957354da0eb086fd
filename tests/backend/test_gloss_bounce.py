# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy interreflection: against its slow twin ray by ray, and against diffuse bounces where nothing is glossy."""
import numpy as np
import pytest

from neural_gash_addon.backend import gloss, lobes, methods, sampling
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.bounce import Bounces
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.gloss_bounce import Finish, GlossyBounces
from neural_gash_addon.backend.raycast import Occluders

from .test_gloss_mitsuba import sky

ORDER = 4
# a floor, a wall beside it and a low roof over both: (V, 3) and (F, 3)
CORNERS = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [0, 0, 1.2], [0, 2, 1.2], [1.2, 0, 1.2],
                    [1.2, 2, 1.2]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 5], [0, 5, 4], [4, 5, 7], [4, 7, 6]], np.int32)
ALBEDO = np.repeat([[0.6, 0.5, 0.4], [0.7, 0.1, 0.1], [0.2, 0.3, 0.8]], 2, axis=0)
SPECULAR = np.repeat([[0.3, 0.3, 0.3], [0.9, 0.6, 0.2], [0.1, 0.1, 0.1]], 2, axis=0)
ROUGHNESS = np.repeat([0.5, 0.3, 0.8], 2)
LIGHT = sky()[:ORDER ** 2]


def points_on_floor(count):
    places = np.random.default_rng(1).uniform(0.2, 1.8, (count, 3)) * [1, 1, 0]
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    return TriangleMesh(CORNERS, FACES, places, up, up, np.arange(count, dtype=np.int32), "POINT", 1e-7)


def solved(finish, bounces):
    scene = Occluders([(CORNERS, FACES)])
    found = GlossyBounces([(CORNERS, FACES)], finish, scene, LIGHT)
    methods.run(found.solve(bounces))
    return found


def test_nothing_glossy_is_the_diffuse_bounce():
    mesh, scene = points_on_floor(200), Occluders([(CORNERS, FACES)])
    dull = Finish(ALBEDO, np.zeros((6, 3)), np.ones(6))
    for bounces in (1, 3):
        found = methods.run(solved(dull, bounces).gather(mesh, 512))
        radiance = found[:, 0] / (np.pi * sh.normalisation(0, 0))
        transfer = Bounces([(CORNERS, FACES)], ALBEDO, scene, ORDER)
        methods.run(transfer.solve(bounces, 0.0))
        truth = np.einsum("nkc,kc->nc", methods.run(transfer.gather(mesh, 512)), LIGHT)
        error = np.sqrt(np.square(radiance - truth).sum() / np.square(truth).sum())
        assert error < 0.04 and truth.max() > 0.05, error   # rays of their own: noise of 512


@pytest.mark.parametrize(("roughness", "lobe"), [(None, lobes.GGX), (0.0, lobes.GGX), (None, lobes.PHONG)])
def test_equals_its_slow_twin(roughness, lobe):
    finish = Finish(ALBEDO, SPECULAR, ROUGHNESS if roughness is None else np.full(6, roughness), lobe)
    attenuation = {lobes.GGX: lobes.ggx_attenuation,
                   lobes.PHONG: lambda r, order: lobes.phong_attenuation((r ** -4 - 1) / 2, order)}[lobe]
    mesh, scene = points_on_floor(6), Occluders([(CORNERS, FACES)])
    found = methods.run(solved(finish, 1).gather(mesh, 4096))
    local = sampling.hemisphere_sets(1, 1024, 7)[0]
    truth = np.zeros_like(found)
    for n in range(len(mesh.points)):
        w = (sampling.frames(mesh.normals[n:n + 1], np.zeros(1))[0] @ local.T).T
        hits = scene.hits(scene.origins(mesh.points[n:n + 1], mesh.clearance[n:n + 1]).repeat(len(w), 0),
                          w.astype(np.float32))
        corners = CORNERS[FACES[hits.faces]]
        q = corners[:, 0] + hits.u[:, None] * (corners[:, 1] - corners[:, 0]) \
            + hits.v[:, None] * (corners[:, 2] - corners[:, 0])
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal *= np.where(hits.front, 1, -1)[:, None] / np.linalg.norm(normal, axis=1, keepdims=True)
        there = TriangleMesh(CORNERS, FACES, q, normal, normal, np.arange(len(q), dtype=np.int32), "POINT", 1e-7)
        transfer = methods.run(methods.bake(there, "embree", ORDER, rays=256)).coefficients
        arriving = gloss.transferred(transfer, LIGHT)
        glossy = gloss.reflected_radiance(arriving, -w[hits.rays], normal,
                                          attenuation(finish.roughness[hits.faces], ORDER))
        radiance = finish.specular[hits.faces] * glossy + finish.albedo[hits.faces] * (transfer @ LIGHT)
        truth[n] = np.pi * np.einsum("rk,rc->kc", sh.evaluate(w[hits.rays], ORDER), radiance) / len(w)
    error = np.sqrt(np.square(found - truth).sum() / np.square(truth).sum())
    assert error < 0.03, error   # patches hold light constant


def test_energy_of_a_bounce_is_what_is_reflected_and_black_reflects_none():
    mesh = points_on_floor(50)
    assert not methods.run(solved(Finish(np.zeros((6, 3)), np.zeros((6, 3)), ROUGHNESS), 2).gather(mesh, 64)).any()
    one, two, three = (methods.run(solved(Finish(ALBEDO, 0 * SPECULAR, ROUGHNESS), b).gather(mesh, 256))[:, 0].mean()
                       for b in (1, 2, 3))
    assert 0 < three - two < two - one < one
