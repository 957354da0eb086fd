# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np
import pytest
import torch

from neural_gash_addon.backend import embedding_bake
from neural_gash_addon.backend.enclosed import SHARE, enclosed
from neural_gash_addon.backend.irradiance import irradiance
from neural_gash_addon.backend.networks.embedding import Embedding, Settings
from neural_gash_addon.backend.progress import run
from neural_gash_addon.backend.raycast import Occluders
from training.floor_plans import shell
from training.rooms import Part, assembled
from training.solids import box, place

UP = np.tile([0, 0, 1.0], (400, 1))


def below_a_plate(height, reach, normals=UP):
    """Of 400 points below a wide plate."""
    corners = 100 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, 0, height]
    points = np.random.default_rng(1).uniform(-1, 1, (400, 3)) * [1, 1, 0]
    occluders = Occluders([(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))])
    return enclosed(points, normals, normals, np.full(400, reach), occluders, 0)


@pytest.mark.parametrize("reach", [0.1, 10.0])
def test_a_plate_encloses_what_lies_so_near_below_it_that_enough_rays_end_in_reach(reach):
    # a ray of angle a is height / cos(a) long; by cosine, 1 - c² of all have a cosine of c or more
    edge = reach * (1 - SHARE) ** 0.5
    assert below_a_plate(0.8 * edge, reach).all()
    assert not below_a_plate(1.2 * edge, reach).any()


def test_nothing_encloses_what_faces_away_or_has_no_normal():
    assert not below_a_plate(0.01, 1.0, -UP).any()
    assert not below_a_plate(0.01, 1.0, 0 * UP).any()
    assert below_a_plate(0.01, 1.0).all()


def test_reflected_light_in_a_gap_is_traced_where_the_network_would_give_that_of_the_room(monkeypatch):
    torch.manual_seed(0)
    settings = Settings(first=16, widths=(32,), hidden=16)
    monkeypatch.setattr(embedding_bake, "network", lambda: Embedding(settings).eval())
    room = [Part(mesh, np.full(3, 0.6)) for mesh in shell([np.array([[0, 0, 0], [4, 3, 2.5]], float)]).values()]
    lamp = Part(place(box((0.5, 0.5, 0.02)), (2, 1.5, 2.4)), np.full(3, 0.6), np.array([20.0, 18, 15]))
    plate = Part(place(box((1, 1, 0.02)), (1, 1, 0.03)), np.full(3, 0.6))
    scene = assembled([*room, lamp, plate])
    points = np.random.default_rng(0).uniform(0.9, 1.1, (40, 3)) * [1, 1, 0] + [0, 0, 1e-9]
    points[20:] += [1.8, 0.8, 0]
    found = run(embedding_bake.irradiance(scene, points, UP[:40], threads=1))
    truth = run(irradiance(scene, points, UP[:40], 4096, threads=1)).values
    gap, beside = slice(0, 20), slice(20, 40)
    assert truth[gap].mean() < 0.05 * truth[beside].mean()
    np.testing.assert_allclose(found.values[gap].mean(0), truth[gap].mean(0), rtol=0.15)
    np.testing.assert_allclose(found.values[beside].mean(0), truth[beside].mean(0), rtol=0.2)
    monkeypatch.setattr(embedding_bake, "enclosed", lambda points, *_: np.zeros(len(points), bool))
    network = run(embedding_bake.irradiance(scene, points, UP[:40], threads=1)).values
    assert network[gap].mean() > 2 * truth[gap].mean()
