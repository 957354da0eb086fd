# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the light-transport embedding, in small: it learns, goes on where it was stopped, and is judged."""
import csv
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from neural_gash_addon.backend import embedding_bake, methods  # noqa: E402
from neural_gash_addon.backend.exchange import write_npz  # noqa: E402
from neural_gash_addon.backend.lit_points import LitPoints  # noqa: E402
from neural_gash_addon.backend.networks.embedding import FULL, Embedding, Settings  # noqa: E402
from training import embedding, loop, room_labels, rooms  # noqa: E402

TINY = Settings(first=16, widths=(32, 32), hidden=16, gathered=6, around=4, patch=64, neighbours=5)
RECIPE = embedding.Recipe(TINY, tuple(embedding.Phase(loss, 16, 3e-3, 2, 100, 8) for loss in ("logarithms", "values")))


@pytest.fixture(autouse=True)
def one_thread():
    """As it runs: on a busy machine a second thread of torch waits for a core, and everything for it."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def box(seed):
    """A box of which light falls off with height, and half as much again where scene points do not tell."""
    rng = np.random.default_rng(seed)
    size, count = rng.uniform(2, 5, 3), 1000
    axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
    positions = rng.random((count, 3)) * size
    positions[np.arange(count), axis] = side * size[axis]
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = 1 - 2 * side
    points = np.concatenate([positions, normals, np.full((count, 3), 0.4)], 1).astype(np.float32)
    light = ((1 + positions[:, 2:]) * rng.uniform(0.5, 3, 3)).astype(np.float32)
    looks = light[:400] * rng.gamma(16, 1 / 16, (2, 400, 1)).astype(np.float32)
    shining = np.where(rng.random((400, 1)) < 0.1, light[:400], 0).astype(np.float32)
    return {"scene_points": np.concatenate([points[:400], shining], 1),
            "point_direct": light[:400], "point_indirect": looks,
            "queries": points[400:], "direct": light[400:], "direct_noise": 0.01 * light[400:],
            "indirect": 1.5 * light[400:], "indirect_noise": np.zeros((600, 3), np.float32), "seed": np.array(seed)}


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms")
    for seed in range(4):
        split = "train" if seed < 3 else "validation"
        write_npz(folder / f"{split}-{seed}.npz", **box(seed), split=np.array(split))
    return folder


def held_out(cache):
    path, = embedding.rooms(cache, "validation")
    return embedding.load(path, TINY)


def test_rooms_are_of_their_split(cache):
    assert [len(embedding.rooms(cache, split)) for split in ("train", "validation")] == [3, 1]


def test_a_share_of_the_scene_points_are_the_first_of_them(cache):
    path, = embedding.rooms(cache, "validation")
    whole, part = (embedding.load(path, TINY, share) for share in (1.0, 0.5))
    assert len(whole.points) == 400 and len(part.points) == len(part.direct) == part.looks.shape[1] == 200
    np.testing.assert_array_equal(part.points, whole.points[:200])
    np.testing.assert_array_equal(part.looks, whole.looks[:, :200])
    assert len(part.layout.around) == 50 and part.near.max() < 50 and part.layout.gathered.max() < 200
    assert part.layout.areas.sum() == pytest.approx(whole.layout.areas.sum(), rel=0.2)
    np.testing.assert_array_equal(part.truth, whole.truth)


def test_equation_12_is_that_of_the_paper_and_what_it_is_relative_to_is_fixed():
    found, truth = torch.tensor([[0.0, 1, 3]], requires_grad=True), torch.tensor([[1.0, 1, 1]])
    e = embedding.EPSILON
    loss = embedding.of_logarithms(found, truth, truth)
    squares = (np.log(2) / e) ** 2, 0, (np.log(2) / (np.log(4) + e)) ** 2
    assert float(loss.detach()) == pytest.approx(np.mean(squares), rel=1e-5)
    loss.backward()
    by_hand = [-2 * np.log(2) / e ** 2 / 3, 0, 2 * np.log(2) / (np.log(4) + e) ** 2 / 4 / 3]
    np.testing.assert_allclose(found.grad[0], by_hand, rtol=1e-5, atol=1e-7)
    dark = torch.zeros(1, 3, requires_grad=True)
    embedding.of_logarithms(dark, torch.zeros(1, 3), truth).backward()
    assert not dark.grad.any()


@pytest.mark.parametrize("configuration", ["full", "small"])
def test_each_configuration_takes_a_step_of_each_phase_from_the_command_line(cache, tmp_path, monkeypatch, capsys,
                                                                             configuration):
    """The full one as large as it is, in tiny rooms and at few queries; where there is CUDA, there."""
    recipe = embedding.RECIPES[configuration]
    assert recipe.phases[0].loss == "logarithms"
    assert all(phase.rooms * phase.queries == 8192 for phase in recipe.phases)
    few = tuple(replace(phase, rooms=1, queries=40) for phase in recipe.phases)
    monkeypatch.setitem(embedding.RECIPES, configuration, replace(recipe, phases=few))
    monkeypatch.setattr(embedding, "HELD_OUT", 40)
    command = ["embedding", "--configuration", configuration, "--cache", str(cache), "--out", str(tmp_path), "--logs",
               str(tmp_path), "--steps"]
    monkeypatch.setattr("sys.argv", [*command, *["1"] * len(few)])
    embedding.main()
    assert "3 rooms, 1 held out" in capsys.readouterr().out
    name = {"full": "embedding-full", "small": "embedding"}[configuration]
    assert {log.stem for log in tmp_path.glob("*.csv")} == {f"{name}-{phase.loss}" for phase in recipe.phases}
    assert all(len(losses_of(log)) == 1 and np.isfinite(losses_of(log)).all() for log in tmp_path.glob("*.csv"))
    with monkeypatch.context() as patch:
        patch.setattr(embedding_bake.weights, "FOLDER", tmp_path)
        model = embedding_bake.network()
    assert model.settings == recipe.settings and len(model.encoder.transform.blocks) == len(recipe.settings.widths)
    monkeypatch.setattr("sys.argv", [*command, "1", "1", "1"])
    with pytest.raises(SystemExit):
        embedding.main()
    assert f"--steps needs {len(few)} numbers" in capsys.readouterr().err


def test_the_full_configuration_is_that_of_table_3():
    assert FULL.first == FULL.hidden == 128 and FULL.gathered == FULL.neighbours == 32 and FULL.patch == 1024
    depths, channels = (2, 2, 2, 6, 2), (128, 128, 128, 256, 256)
    assert FULL.widths == tuple(width for depth, width in zip(depths, channels, strict=True) for _ in range(depth))
    assert FULL.halvings == (2, 2) and FULL.layers == 6 and FULL.dropout == 0.1
    model = Embedding(FULL)
    assert model.decoder.further[0].mix[0].out_features == 512 and len(model.decoder.further) == 6
    assert [block.attention.heads for block in model.encoder.transform.blocks] == [width // 32 for width in FULL.widths]
    phase, = embedding.RECIPES["full"].phases
    assert (phase.loss, phase.rate, phase.steps) == ("logarithms", 2e-4, 2_000_000)


def losses_of(log):
    with log.open(newline="") as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


class Stopped(Exception):
    pass


@pytest.mark.parametrize("saves", [1, 3])
def test_it_learns_and_goes_on_from_its_checkpoint(cache, tmp_path, monkeypatch, saves):
    """Stopped in either phase."""
    kept, held = embedding.rooms(cache, "train"), [held_out(cache)]
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    whole = embedding.train(RECIPE, kept, held, 3, tmp_path / "one", tmp_path / "one")
    losses = [losses_of(tmp_path / "one" / f"embedding-{phase.loss}.csv") for phase in RECIPE.phases]
    assert [len(each) for each in losses] == [2, 2] and losses[0][1] < losses[0][0]
    saved = []

    def save_and_stop(self, path, save=loop.Training.save):
        save(self, path)
        saved.append(path)
        if len(saved) == saves:
            raise Stopped

    with monkeypatch.context() as patch:
        patch.setattr(loop.Training, "save", save_and_stop)
        with pytest.raises(Stopped):
            embedding.train(RECIPE, kept, held, 3, tmp_path / "two", tmp_path / "two")
    again = embedding.train(RECIPE, kept, held, 3, tmp_path / "two", tmp_path / "two")
    for one, two in zip(whole.parameters(), again.parameters(), strict=True):
        np.testing.assert_allclose(two.detach(), one.detach(), atol=1e-6)


def test_a_later_phase_begins_with_what_the_one_before_learned(cache, tmp_path):
    """And anew, where that was trained anew."""
    kept, held = embedding.rooms(cache, "train"), [held_out(cache)]
    still = [replace(RECIPE.phases[1], steps=1, every=1, rate=1e-7)]
    learned = embedding.train(replace(RECIPE, phases=RECIPE.phases[:1]), kept, held, 3, tmp_path, tmp_path)
    after = embedding.train(replace(RECIPE, phases=(RECIPE.phases[0], *still)), kept, held, 3, tmp_path, tmp_path)
    for one, two in zip(learned.parameters(), after.parameters(), strict=True):
        np.testing.assert_allclose(two.detach(), one.detach(), atol=1e-5)
    (tmp_path / "embedding-logarithms.checkpoint").unlink()
    short = replace(RECIPE.phases[0], steps=2, every=2)
    anew = embedding.train(replace(RECIPE, phases=(short, *still)), kept, held, 3, tmp_path, tmp_path)
    alone = embedding.train(replace(RECIPE, phases=(short,)), kept, held, 3, tmp_path, tmp_path)
    for one, two in zip(alone.parameters(), anew.parameters(), strict=True):
        np.testing.assert_allclose(two.detach(), one.detach(), atol=1e-5)


def test_training_asks_as_the_bake_does(cache):
    """The same room through both: what is learned is what is used."""
    torch.manual_seed(0)
    model = Embedding(TINY).eval()
    torch.nn.init.normal_(model.encoder.factor.weight, std=0.5)
    sample = held_out(cache)
    rows = embedding.held_rows(sample)
    points = LitPoints(*(sample.points[:, at:at + 3] for at in (0, 3, 6, 9)), sample.direct, sample.looks[0])
    queries = sample.queries[rows]
    baked = methods.run(embedding_bake.Room(model, points).reflected(queries[:, :3], queries[:, 3:6],
                                                                     sample.asked[rows]))
    np.testing.assert_allclose(embedding.network(model, sample), baked, rtol=1e-3)


def test_errors_are_over_those_of_darkness_and_without_noise(cache):
    sample = held_out(cache)
    rows = embedding.held_rows(sample)
    truth = sample.truth[rows]
    assert embedding.judged(truth, sample) == {"relative": 0, "squares": 0, "logs": 0}
    found = embedding.judged(1.5 * truth, sample)
    assert found["squares"] == pytest.approx(0.25, rel=1e-5)
    one, other = np.log1p(1.5 * truth / sample.level), np.log1p(truth / sample.level)
    assert found["logs"] == pytest.approx(np.square(one - other).sum() / np.square(other).sum(), rel=1e-4)
    loss = embedding.of_values(*(torch.from_numpy(each / sample.level) for each in (
        1.5 * truth, truth, sample.guide[rows])))
    assert found["relative"] == pytest.approx(float(loss), rel=1e-4)
    noise = np.full_like(sample.noise, 0.1)
    signs = np.random.default_rng(0).choice([-1, 1], noise.shape)
    noisy = replace(sample, noise=noise, truth=sample.truth + noise * signs)
    assert embedding.judged(sample.truth[rows], noisy)["squares"] == pytest.approx(0, abs=1e-5)


def test_baselines_are_right_where_it_is_known():
    """In a sphere of one albedo, lit alike, one bounce is a d everywhere and all are a d / (1 - a)."""
    turns, rise = np.arange(1000) * np.pi * (3 - 5 ** 0.5), 1 - (2 * np.arange(1000) + 1) / 1000
    round_ = np.sqrt(1 - rise ** 2)
    places = 2 * np.stack([round_ * np.cos(turns), round_ * np.sin(turns), rise], 1)
    points = np.concatenate([places, -places / 2, np.full((1000, 3), 0.5), np.zeros((1000, 3))], 1).astype(np.float32)
    sample = embedding.Sample(points, np.full((1000, 3), 3.0), np.full((2, 1000, 3), 7.0), points[::50], None,
                              np.ones((20, 3)), np.zeros((20, 3)), embedding.embedding.layout(places, (2, 2), 6, 4),
                              None, None, None)
    for name, give in embedding.BASELINES.items():
        expected = np.full((20, 3), 7.0 if "nearest" in name else 3.0)
        np.testing.assert_allclose(give(sample, np.arange(20)), expected, rtol=0.2, err_msg=name)


def test_the_table_has_a_row_of_the_network_and_of_each_baseline(cache):
    lines = embedding.table(Embedding(TINY).eval(), [held_out(cache)]).splitlines()
    assert len(lines) == 2 + len(embedding.BASELINES)


def test_the_weights_that_ship_are_better_than_what_needs_no_training(tmp_path):
    """In a room of a seed that no split has."""
    model = embedding_bake.network()
    room = room_labels.label(rooms.generate(3_000_003), seed=3_000_003, split="evaluation", rays=1024, queries=1024)
    write_npz(tmp_path / "room.npz", **room)
    sample = embedding.load.__wrapped__(tmp_path / "room.npz", model.settings)
    rows = embedding.held_rows(sample)
    found = embedding.judged(embedding.network(model, sample), sample)
    for name, give in embedding.BASELINES.items():
        other = embedding.judged(give(sample, rows), sample)
        assert found["relative"] < 0.8 * other["relative"] and found["squares"] < other["squares"], name
