# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the light-transport embedding, in small: it learns, goes on where it was stopped, and is judged."""
import csv
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from neural_gash_addon.backend import embedding_bake, methods  # noqa: E402
from neural_gash_addon.backend.exchange import write_npz  # noqa: E402
from neural_gash_addon.backend.networks.embedding import Embedding, Settings  # noqa: E402
from training import embedding, loop  # noqa: E402

TINY = Settings(width=32, depths=(1, 1), channels=(32, 32), layers=1, dropout=0.1, gathered=6, around=4, patch=64,
                neighbours=5)
RECIPE = embedding.Recipe(TINY, steps=16, rate=3e-3, rooms=2, queries=100, every=8)


@pytest.fixture(autouse=True)
def one_thread():
    """As it runs: on a busy machine a second thread of torch waits for a core, and everything for it."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def box(seed):
    """A room whose ceiling shines, with half of the light of an empty box and some that has bounced."""
    rng = np.random.default_rng(seed)
    size, count = rng.uniform(2, 5, 3), 1000
    axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
    positions = rng.random((count, 3)) * size
    positions[np.arange(count), axis] = side * size[axis]
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = 1 - 2 * side
    emission = np.where((normals[:, 2] < 0)[:, None], rng.uniform(0.5, 3, 3), 0)
    points = np.concatenate([positions, normals, np.full((count, 3), 0.4), emission], 1).astype(np.float32)
    return {"scene_points": points[:400], "queries": points[400:, :9], "noise": np.full((600, 3), 0.01, np.float32),
            "irradiance": np.ones((600, 3), np.float32), "seed": np.array(seed)}


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms")
    for seed in range(4):
        split = "train" if seed < 3 else "validation"
        room = box(seed)
        write_npz(folder / f"{split}-{seed}.npz", **room, split=np.array(split))
        sample = embedding.load.__wrapped__(folder / f"{split}-{seed}.npz", TINY)
        room["irradiance"] = (0.5 * sample.asked + sample.level[:, None]).T.astype(np.float32)
        write_npz(folder / f"{split}-{seed}.npz", **room, split=np.array(split))
    return folder


def held_out(cache):
    path, = embedding.rooms(cache, "validation")
    return embedding.load(path, TINY)


def test_rooms_are_of_their_split(cache):
    assert [len(embedding.rooms(cache, split)) for split in ("train", "validation")] == [3, 1]


def losses_of(log):
    with log.open(newline="") as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


class Stopped(Exception):
    pass


def test_it_learns_and_goes_on_from_its_checkpoint(cache, tmp_path, monkeypatch):
    kept, held = embedding.rooms(cache, "train"), [held_out(cache)]
    for path in kept:  # what is not so before training
        embedding.load(path, TINY).irradiance[:] *= 1.5
    whole = embedding.train(RECIPE, kept, held, 3, tmp_path / "one", tmp_path / "one.csv")
    losses = losses_of(tmp_path / "one.csv")
    assert len(losses) == 2 and losses[1] < losses[0]

    def save_and_stop(self, path, save=loop.Training.save):
        save(self, path)
        raise Stopped

    with monkeypatch.context() as patch:
        patch.setattr(loop.Training, "save", save_and_stop)
        with pytest.raises(Stopped):
            embedding.train(RECIPE, kept, held, 3, tmp_path / "two", tmp_path / "two.csv")
    again = embedding.train(RECIPE, kept, held, 3, tmp_path / "two", tmp_path / "two.csv")
    for one, two in zip(whole.parameters(), again.parameters(), strict=True):
        np.testing.assert_allclose(two.detach(), one.detach(), atol=1e-6)


def test_training_asks_as_the_bake_does(cache):
    """The same room through both: what is learned is what is used."""
    torch.manual_seed(0)
    model = Embedding(TINY).eval()
    torch.nn.init.normal_(model.decoder.leave.weight, std=0.5)
    sample = held_out(cache)
    queries = sample.queries[embedding.held_rows(sample)]
    baked = methods.run(embedding_bake.Room(model, sample.points).irradiance(queries))
    np.testing.assert_allclose(embedding.network(model, sample), baked, rtol=1e-3)


def test_light_does_not_change_as_a_room_is_turned(cache):
    """What a turn must keep: the truth, and what an untrained network gives, which sees no directions."""
    torch.manual_seed(0)
    model, rng = Embedding(TINY).eval(), np.random.default_rng(0)
    sample = held_out(cache)
    rows = np.arange(50)
    found = []
    for matrix in (np.eye(3), embedding.turn(rng), embedding.turn(rng)):
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        assert matrix[2].tolist() == [0, 0, 1]
        with torch.no_grad():
            found.append(embedding.answer(model, sample, rows, [1], matrix))
    for network, truth in found:
        np.testing.assert_allclose(truth[0], np.log1p(sample.irradiance[rows, 1] / sample.level[1]), rtol=1e-5)
        np.testing.assert_allclose(network, truth, atol=1e-5)  # the rooms were made so
    assert {np.linalg.det(embedding.turn(rng)).round() for _ in range(20)} == {-1, 1}


def test_errors_are_those_of_equation_12(cache):
    sample = held_out(cache)
    truth = sample.irradiance[embedding.held_rows(sample)]
    assert embedding.judged(truth, sample) == {"log_mse": 0, "rel_mse": 0, "equation_12": 0}
    found = embedding.judged(1.5 * truth, sample)
    assert found["rel_mse"] == pytest.approx(0.25, rel=1e-5)
    one, other = np.log1p(1.5 * truth / sample.level), np.log1p(truth / sample.level)
    assert found["log_mse"] == pytest.approx(np.square(one - other).sum() / np.square(other).sum(), rel=1e-4)
    assert found["equation_12"] == pytest.approx(np.mean(((one - other) / (one + embedding.EPSILON)) ** 2), rel=1e-4)


def test_the_table_has_a_row_of_the_network_and_of_each_baseline(cache):
    sample = held_out(cache)
    flat = replace(sample, irradiance=np.ones_like(sample.irradiance))
    lines = embedding.table(Embedding(TINY).eval(), [flat]).splitlines()
    assert len(lines) == 3 + len(embedding.BASELINES)
    # the true mean of what is the same everywhere
    assert lines[2].split()[-6:] == ["0.0000", "(0.0000)"] * 3
