# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance by the light-transport embedding, as a bake has it."""
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from neural_gash_addon.backend import embedding_bake, weights  # noqa: E402
from neural_gash_addon.backend import irradiance as tracing  # noqa: E402
from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.backend.lit_points import lit_points  # noqa: E402
from neural_gash_addon.backend.lit_scene import LitScene  # noqa: E402
from neural_gash_addon.backend.methods import run  # noqa: E402
from neural_gash_addon.backend.networks import embedding as networks  # noqa: E402

from .test_embedding import QUERIES, TINY, box_room, network, reflected, room  # noqa: E402, F401


@pytest.fixture
def shipped(monkeypatch):
    """A small network without training as the one that ships, and few scene points."""
    torch.manual_seed(0)
    monkeypatch.setattr(embedding_bake, "network", lambda: networks.Embedding(TINY).eval())


def test_a_bake_is_like_tracing_and_knows_how_far_off_it_is(shipped):
    scene = box_room()
    rng = np.random.default_rng(0)
    points = rng.random((300, 3)) * [4, 3, 0] + [0, 0, 1e-9]
    normals = np.tile([0, 0, 1.0], (300, 1))
    found = run(embedding_bake.irradiance(scene, points, normals, threads=1))
    truth = run(tracing.irradiance(scene, points, normals, 4096, threads=1))
    assert found.values.shape == found.error.shape == (300, 3) and not found.notice
    assert found.values.dtype == found.error.dtype == np.float32
    off = np.square(found.values - truth.values).mean() ** 0.5
    assert off < 0.2 * truth.values.mean()
    assert 0.4 < off / np.square(found.error).mean() ** 0.5 < 1.5
    again = run(embedding_bake.irradiance(scene, points, normals, threads=1, occluders=scene.occluders()))
    np.testing.assert_array_equal(again.values, found.values)


def test_a_room_modelled_inside_out_is_lit_within(shipped):
    inside, outside = (run(embedding_bake.irradiance(box_room(way), *QUERIES, threads=1)).values
                       for way in (False, True))
    np.testing.assert_allclose(outside, inside, rtol=0.3)  # both are noisy; in the dark it would be zero
    points = run(lit_points(box_room(True), box_room(True).occluders(), 512, threads=1))
    assert (points.direct + points.indirect).any(1).mean() > 0.95
    assert ((points.places - [2, 1.5, 1.25]) * points.normals).sum(1).max() < 1e-5  # all turned inwards


def test_a_scene_in_which_nothing_shines_is_dark_and_says_so():
    scene = box_room()
    found = run(embedding_bake.irradiance(LitScene(scene.positions, scene.triangles, scene.albedo,
                                                   np.zeros((14, 3))), *QUERIES))
    assert not found.values.any() and not found.error.any() and found.notice == tracing.DARK


def triangle(emission=1.0):
    return LitScene(np.eye(3), np.array([[0, 1, 2]], np.int32), np.full((1, 3), 0.5), np.full((1, 3), emission))


@pytest.mark.parametrize("scene", [
    triangle(), LitScene(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32), np.ones((1, 3)), np.ones((1, 3))),
    LitScene(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2], [1, 0, 2], [0, 1, 2.0]]),
             np.array([[0, 1, 2], [3, 5, 4]], np.int32), np.ones((2, 3)), np.array([[0, 0, 0], [1, 2, 0.0]]))],
    ids=["a triangle", "of no area", "two triangles"])
def test_strange_scenes_have_numbers(shipped, scene):
    points = np.array([[0.2, 0.2, 0], [0.2, 0.2, 1], [-5, 0, 0], [0.3, 0.3, 0.3]])
    normals = np.array([[0, 0, 1.0], [0, 0, -1], [1, 0, 0], [0, 0, 0]])
    found = run(embedding_bake.irradiance(scene, points, normals, threads=1))
    assert np.isfinite(found.values).all() and np.isfinite(found.error).all() and (found.values >= 0).all()
    assert not found.values[3].any()
    assert run(embedding_bake.irradiance(scene, points[:0], normals[:0], threads=1)).values.shape == (0, 3)


def test_points_within_solids_and_outside_have_numbers(shipped):
    found = run(embedding_bake.irradiance(box_room(), QUERIES[0] + [0, 0, -0.5], QUERIES[1], threads=1))
    assert np.isfinite(found.values).all() and np.isfinite(found.error).all()


def test_bad_input_is_refused_in_a_sentence(shipped):
    scene = box_room()
    with pytest.raises(UserError, match="finite|number"):
        run(embedding_bake.irradiance(scene, QUERIES[0] * np.nan, QUERIES[1]))
    with pytest.raises(UserError, match=r"24\.0 m long.*up to 15 m"):
        run(embedding_bake.irradiance(LitScene(scene.positions * 6, scene.triangles, scene.albedo, scene.emission),
                                      *QUERIES))


def test_weights_that_were_saved_are_those_that_are_asked(room,  # noqa: F811  a fixture
                                                           tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    with pytest.raises(UserError, match=r"embedding\.safetensors' are missing"):
        run(embedding_bake.irradiance(box_room(), *QUERIES))
    made = network(networks.SMALL)
    weights.save(tmp_path / weights.EMBEDDING, {name: value.numpy() for name, value in made.state_dict().items()})
    np.testing.assert_array_equal(reflected(embedding_bake.network(), *room), reflected(made, *room))


def test_without_torch_one_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(UserError, match="needs PyTorch.*pip install torch"):
        run(embedding_bake.irradiance(box_room(), *QUERIES))
