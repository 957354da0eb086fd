# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps by whichever is cheaper: the network that ships, or paths."""
import sys

import numpy as np
import pytest

pytest.importorskip("torch")

from neural_gash_addon.backend import embedding_bake, lamps, methods
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.irradiance import irradiance
from neural_gash_addon.backend.lamps import Lamps
from neural_gash_addon.backend.lit_scene import LitScene
from training.floor_plans import shell
from training.rooms import Part, assembled
from training.solids import ball, box, place


@pytest.fixture(scope="module")
def room():
    walls = [Part(mesh, np.full(3, 0.6)) for mesh in shell([np.array([[0, 0, 0], [4, 3, 2.5]], float)]).values()]
    lamp = Part(place(ball(0.12, 2), (1.2, 1.0, 1.7)), np.full(3, 0.6), np.array([70.0, 65, 60]))
    table = Part(place(box((1.5, 1, 0.1)), (2.5, 1.5, 0.8)), np.array([0.2, 0.5, 0.3]))
    return assembled([*walls, lamp, table])


@pytest.fixture(scope="module")
def floor():
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(0.02, 3.98, 31), np.linspace(0.02, 2.98, 25),
                                               indexing="ij"))
    i = np.arange(31 * 25).reshape(31, 25)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return TriangleMesh.from_triangles(np.stack([x, y, 0 * x + 1e-4], 1), triangles)


@pytest.fixture
def encodings(monkeypatch):
    """Rooms cost nothing, as if there were many points; how many were encoded."""
    calls, real = [], embedding_bake.encoded
    monkeypatch.setattr(embedding_bake, "encoded", lambda *a, **k: calls.append(1) or real(*a, **k))
    monkeypatch.setattr(lamps, "_MEASURED", 0)
    monkeypatch.setattr(lamps, "_SCENE_POINT", 0)
    monkeypatch.setattr(lamps, "_TRIAL", 256)
    return calls


def baked(room, floor, **how):
    return methods.run(methods.bake(floor, "auto", 3, tolerance=0.1, threads=1, lamps=Lamps(room, "key", **how)))


def test_the_network_is_taken_where_it_keeps_to_the_tolerance(room, floor, encodings):
    found = baked(room, floor, tolerance=0.08, learned=None)
    assert encodings == [1]
    assert found.record.lamps_rays == embedding_bake.STRAIGHT * len(floor.points)
    assert found.record.lamps_error <= 0.08 and "Lamps by the network" in found.record.plan
    truth = methods.run(irradiance(room, floor.points, floor.normals, 2048, seed=9)).values
    lit = truth.any(1)
    assert np.linalg.norm((found.irradiance - truth)[lit]) < 0.1 * np.linalg.norm(truth)


@pytest.mark.parametrize("how", [
    {"tolerance": 0.3}, {"tolerance": 0.035}, {"rays": 64}], ids=["few paths do", "never so near", "a number of paths"])
def test_it_is_not_even_asked_where_it_cannot_be_worth_it(room, floor, encodings, how):
    found = baked(room, floor, learned=None, **how)
    assert not encodings and "network" not in found.record.plan.split("Lamps")[-1]
    np.testing.assert_array_equal(found.irradiance, baked(room, floor, learned=False, **how).irradiance)


def test_else_paths_are_taken(room, floor, encodings, monkeypatch):
    paths = baked(room, floor, tolerance=0.08, learned=False)
    monkeypatch.setattr(embedding_bake, "_share_off", lambda *_: 0.5)
    erring = baked(room, floor, tolerance=0.08, learned=None)
    assert encodings == [1] and erring.record.lamps_error <= 0.08
    np.testing.assert_array_equal(erring.irradiance, paths.irradiance)
    # rooms larger than it knows, and no torch
    large = LitScene(room.positions * [6, 1, 1], room.triangles, room.albedo, room.emission)
    assert baked(large, floor, tolerance=0.08, learned=None).record.lamps_rays > 128 * len(floor.points)
    monkeypatch.setitem(sys.modules, "torch", None)
    assert baked(room, floor, tolerance=0.08, learned=None).record.lamps_rays == paths.record.lamps_rays


def test_a_torch_that_is_broken_is_told_of_and_paths_take_over(room, floor, encodings, monkeypatch, caplog):
    paths = baked(room, floor, tolerance=0.08, learned=False)

    def broken():
        raise RuntimeError("Numpy is not available")

    monkeypatch.setattr(embedding_bake, "network", broken)
    found = baked(room, floor, tolerance=0.08, learned=None)
    assert found.record.lamps_rays == paths.record.lamps_rays and "PyTorch failed" in caplog.text


def test_an_error_that_is_no_number_is_not_within_the_tolerance(room, floor, encodings, monkeypatch):
    monkeypatch.setattr(embedding_bake, "_share_off", lambda *_: float("nan"))
    assert baked(room, floor, tolerance=0.08, learned=None).record.lamps_error <= 0.08
    assert "above the tolerance" in baked(room, floor, tolerance=0.08, learned=True).record.lamps_notice


def test_what_a_tile_is_baked_by_does_not_hang_on_those_before_it(room, floor, encodings):
    again = Lamps(room, "key", tolerance=0.08, learned=None)
    first, second = (methods.run(methods.bake(floor, "analytic", 3, threads=1, lamps=again, seed=seed)).irradiance
                     for seed in (1, 2))
    alone = methods.run(methods.bake(floor, "analytic", 3, threads=1, seed=2,
                                     lamps=Lamps(room, "key", tolerance=0.08, learned=None)))
    np.testing.assert_array_equal(alone.irradiance, second)
    assert not np.array_equal(first, second) and "network" in alone.record.plan


def test_lamps_that_no_float_holds_are_refused(room):
    with pytest.raises(UserError, match="infinite"):
        LitScene(room.positions, room.triangles, room.albedo, 1e30 * (1e9 * room.emission))
