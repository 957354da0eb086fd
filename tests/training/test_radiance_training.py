# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the radiance decoder, in small: it learns, is judged, and what is learned is what the bake asks."""
import csv

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from test_embedding_training import TINY, box, one_thread  # noqa: E402, F401

from neural_gash_addon.backend import embedding_bake, methods  # noqa: E402
from neural_gash_addon.backend import spherical_harmonics as sh  # noqa: E402
from neural_gash_addon.backend.exchange import write_npz  # noqa: E402
from neural_gash_addon.backend.lit_points import LitPoints  # noqa: E402
from neural_gash_addon.backend.networks.embedding import Embedding  # noqa: E402
from neural_gash_addon.backend.networks.radiance import ORDER, Radiance  # noqa: E402
from training import radiance, room_labels, rooms  # noqa: E402


def leaning(points, light, tilt):
    """(n, K, 3) by direction: the light (n, 3) over each normal as even, and some of it from above."""
    even = sh.cosine_lobe(points[:, 3:6], ORDER)
    above = tilt * sh.evaluate(np.array([[0, 0, 1.0]]), ORDER)[0] * np.r_[0, np.ones(ORDER ** 2 - 1)]
    return ((even + above)[:, :, None] * light[:, None]).astype(np.float32)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Rooms in which the queries' light leans twice as much as that of the scene points."""
    folder = tmp_path_factory.mktemp("rooms")
    for seed in range(3):
        made = box(seed)
        write_npz(folder / f"{'train' if seed < 2 else 'validation'}-{seed}.npz", **made, point_shape=np.stack(
            [leaning(made["scene_points"], look, 0.2) for look in made["point_indirect"]]).astype(np.float16),
            shape=leaning(made["queries"], made["indirect"], 0.4), shape_noise=np.zeros((600, ORDER, 3), np.float32),
            split=np.array("of a test"))
    return folder


@pytest.fixture
def tiny(monkeypatch):
    """A small embedding without training, frozen, as the one that ships."""
    torch.manual_seed(0)
    model = Embedding(TINY).eval().requires_grad_(False)
    monkeypatch.setattr(radiance, "trained", lambda: model)
    monkeypatch.setattr(radiance, "room", radiance.Room)
    return model


def held_out(cache):
    return radiance.Room(radiance.rooms(cache, "validation")[0])


def test_it_learns(cache, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(radiance, "EVERY", 20)
    held = held_out(cache)
    made = radiance.train(radiance.rooms(cache, "train"), [held], 40, 0, tmp_path / "state", tmp_path / "log.csv")
    with (tmp_path / "log.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 and float(rows[1]["loss"]) < float(rows[0]["loss"])
    before = radiance.by_band(radiance.network(Radiance(TINY).eval(), held), held)
    assert (radiance.by_band(radiance.network(made, held), held)[3:] < before[3:]).all()


def test_training_asks_as_the_bake_does(cache, tiny):
    torch.manual_seed(1)
    model = Radiance(TINY).eval()
    torch.nn.init.normal_(model.weigh.weight, std=0.5)
    held = held_out(cache)
    sample, rows = held.sample, radiance.held_rows(held.sample)
    points = LitPoints(*(sample.points[:, at:at + 3] for at in (0, 3, 6, 9)), sample.direct, sample.looks[0],
                       held.shapes[0].astype(np.float32))
    queries = sample.queries[rows]
    _, baked = methods.run(embedding_bake.Room(tiny, points, model).reflected_from(
        queries[:, :3], queries[:, 3:6], sample.asked[rows], ORDER))
    np.testing.assert_allclose(radiance.network(model, held), baked, rtol=1e-3, atol=1e-4)


def test_errors_are_over_those_of_darkness_and_without_noise(cache, tiny):
    held = held_out(cache)
    truth = held.truth[radiance.held_rows(held.sample)]
    np.testing.assert_allclose(radiance.by_band(truth, held), 0, atol=1e-12)
    np.testing.assert_allclose(radiance.by_band(1.5 * truth, held), 0.25, rtol=1e-4)
    assert radiance.in_lobe(1.5 * truth, held, 0.4) == pytest.approx(0.25, rel=1e-4)
    found = truth.copy()
    found[:, sh.band_slice(2)] = 0
    np.testing.assert_allclose(radiance.by_band(found, held), [0, 0, 1, 0, 0], atol=1e-6)
    assert radiance.in_lobe(found, held, 0.95) < radiance.in_lobe(found, held, 0.2)
    energy = np.square(truth[:, sh.band_slice(4)]).sum()
    held.noise = held.noise.copy()
    held.noise[:, 4] = np.sqrt(0.2 * energy / truth[:, 0].size)
    assert radiance.by_band(1.5 * truth, held)[4] == pytest.approx((0.25 - 0.2) / 0.8, rel=1e-3)
    assert radiance.by_band(None, held)[4] == pytest.approx(0.2 * 2048 / 64 / 0.8, rel=1e-3)


def test_the_table_has_a_row_of_each(cache, tiny):
    assert len(radiance.table(Radiance(TINY).eval(), [held_out(cache)]).splitlines()) == 7


def test_the_weights_that_ship_are_better_than_what_needs_no_training(tmp_path):
    """In the mean of four rooms of seeds that no split has."""
    model = embedding_bake.radiance_network(radiance.trained()).to(next(radiance.trained().parameters()).device)
    untrained, errors = Radiance(model.settings).eval(), []
    for seed in range(3_000_000, 3_000_004):
        made = room_labels.label(rooms.generate(seed), seed=seed, split="evaluation", rays=1024, queries=1024)
        write_npz(tmp_path / f"{seed}.npz", **made)
        held = radiance.Room(tmp_path / f"{seed}.npz")
        errors.append([radiance.by_band(found, held) for found in (
            radiance.network(model, held), radiance.lobe(held), radiance.near_mean(held, 16),
            radiance.network(untrained, held))])
    found, *others = np.mean(errors, 0)
    assert all((found[1:] < other[1:]).all() for other in others)
