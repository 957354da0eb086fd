# SPDX-License-Identifier: GPL-3.0-or-later
"""Trainings of the networks, in small: they learn, go on where they were stopped, and turn labels as meshes."""
import csv

import numpy as np
import pytest
import trimesh

torch = pytest.importorskip("torch")

from neural_gash_addon.backend import conformal  # noqa: E402
from neural_gash_addon.backend import spherical_harmonics as sh  # noqa: E402
from neural_gash_addon.backend.exchange import write_npz  # noqa: E402
from neural_gash_addon.backend.networks import paper as networks  # noqa: E402
from training import curves, gnn, labels, loop, paper  # noqa: E402


@pytest.fixture(autouse=True)
def one_thread():
    """As the trainings run: on a busy machine a second thread of torch waits for a core, and everything for it."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Two labelled meshes."""
    folder = tmp_path_factory.mktemp("cache")
    for name, mesh in (("torus", trimesh.creation.torus(1, 0.45, 24, 12)),
                       ("cup", trimesh.creation.annulus(0.6, 1.0, 1.2).subdivide())):
        found = labels.label(mesh.vertices, mesh.faces, None, name=name, category="test", rays=128, seed=1)
        write_npz(folder / f"{name}-0.npz", **{key: np.asarray(getattr(found, key))
                                               for key in (*labels.ARRAYS, *labels.TEXTS)})
    return folder


def samples(cache):
    return [labels.load(path) for path in sorted(cache.glob("*.npz"))]


def losses_of(log):
    with log.open(newline="") as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


class Stopped(Exception):
    pass


def test_gnn_learns_and_goes_on_from_its_checkpoint(cache, tmp_path, monkeypatch):
    monkeypatch.setattr(gnn, "POINTS", 200)
    monkeypatch.setattr(gnn, "EVERY", 8)
    known = samples(cache)
    whole = gnn.train(known, known, 16, 3, tmp_path / "one", tmp_path / "one.csv")
    losses = losses_of(tmp_path / "one.csv")
    assert len(losses) == 2 and losses[1] < losses[0]

    def save_and_stop(self, path, save=loop.Training.save):
        save(self, path)
        raise Stopped

    with monkeypatch.context() as patch:
        patch.setattr(loop.Training, "save", save_and_stop)
        with pytest.raises(Stopped):
            gnn.train(known, known, 16, 3, tmp_path / "two", tmp_path / "two.csv")
    again = gnn.train(known, known, 16, 3, tmp_path / "two", tmp_path / "two.csv")
    for one, two in zip(whole.parameters(), again.parameters(), strict=True):
        np.testing.assert_allclose(two.detach(), one.detach(), atol=1e-6)


def line(steps, tmp_path, look):
    """Fit y = 3x; `look` judges."""
    torch.manual_seed(0)
    x = torch.linspace(-1, 1, 20)[:, None]
    return loop.run(torch.nn.Linear(1, 1), lambda model, rng: (model(x) - 3 * x).square().mean(), look, steps=steps,
                    rate=0.1, every=10, seed=0, checkpoint=tmp_path / "line", log=tmp_path / "line.csv")


def test_the_best_of_a_training_is_kept_and_it_ends_where_nothing_more_comes(tmp_path):
    scores = iter([3.0, 1.0, *[2.0] * 100])
    seen = []

    def look(model):
        seen.append(model.weight.detach().clone())
        return {"score": next(scores)}

    model = line(1000, tmp_path, look)
    assert len(seen) == 2 + loop.PATIENCE
    torch.testing.assert_close(model.weight.detach(), seen[1])


def test_a_checkpoint_of_another_training_is_not_gone_on_from(tmp_path, caplog):
    error = {"score": 0.0}
    line(100, tmp_path, lambda model: error)
    line(60, tmp_path, lambda model: error)
    assert "another training" in caplog.text
    assert len(losses_of(tmp_path / "line.csv")) == 6


@pytest.mark.parametrize("parts", [0.0, 1.0])
def test_gnn_examples_have_the_labels_of_their_frames(cache, parts):
    """Local coefficients of fully blocked points would be the lobe about e_y; energy and share do not turn."""
    sample = samples(cache)[0]
    seen, truth = gnn.example(sample, 10_000, np.random.default_rng(0), parts)
    assert seen.shape[2] == len(truth) and torch.isfinite(seen).all()
    blocked = sh.cosine_lobe(sample.normals, labels.ORDER) - sample.coefficients
    if not parts:
        assert float(truth[:, 0].sum()) == pytest.approx(float(blocked[:, 0].sum()), rel=1e-4)
        assert float(truth.square().sum()) == pytest.approx(float(np.square(blocked).sum()), rel=1e-3)


@pytest.mark.parametrize("network", ["mlp", "gnn-paper", "end-to-end", "student"])
def test_the_papers_networks_learn(cache, tmp_path, network, monkeypatch):
    known = [paper.Source(path) for path in sorted(cache.glob("*.npz"))]
    teacher = networks.TwoStage().eval() if network == "student" else None
    monkeypatch.setattr(paper, "LOOKS", 2)
    model = paper.train(network, "motor", 0, known, known, 40, tmp_path / "log.csv", tmp_path / "checkpoint", teacher)
    for log in ["log.csv"] + ["log-visibility.csv"] * (network == "gnn-paper"):
        losses = losses_of(tmp_path / log)
        assert len(losses) == 2 and losses[-1] < losses[0]
    assert np.isfinite(paper.evaluate(model, known, "motor")["srr_median"])
    assert curves.draw(tmp_path / "log.csv", ["srr_median"]).stat().st_size > 1000


def test_balanced_accuracy_does_not_reward_the_larger_class():
    truth = torch.tensor([True] * 9 + [False])
    assert paper.accuracy(torch.ones(10, dtype=bool), truth) == 0.5
    assert paper.accuracy(truth, truth) == 1


@pytest.mark.parametrize("encoding", list(paper.ENCODINGS))
def test_encodings_have_the_width_that_they_say(cache, encoding):
    known = paper.Source(sorted(cache.glob("*.npz"))[0])
    example = known.example(encoding, np.random.default_rng(0), local=False)
    assert example.encoded.shape == (len(example.blocked), paper.ENCODINGS[encoding][0])


def test_turned_meshes_see_what_the_turned_mesh_shows(cache):
    """Visibility traced anew after a turn is that of the same mesh labelled turned."""
    known = paper.Source(sorted(cache.glob("*.npz"))[1])
    plain, turned = known.look("plain", None), known.look("plain", np.random.default_rng(4))
    np.testing.assert_array_equal(plain.sight.asked, turned.sight.asked)
    # the share that is blocked does not turn; the directions differ, so single rays do
    assert float(turned.visibility.mean()) == pytest.approx(float(plain.visibility.mean()), abs=0.02)
    assert (turned.visibility != plain.visibility).any()
    normals = turned.sight.encoded[:, 3:].double().numpy()
    up = conformal.frames(conformal.motor(np.zeros_like(normals), normals))[:, :, 1]
    np.testing.assert_allclose(up, normals, atol=1e-6)


def test_stage_1_of_a_patch_is_that_of_the_whole(cache):
    """What a vertex hears does not depend on which others are asked."""
    torch.manual_seed(0)
    known, network = paper.Source(sorted(cache.glob("*.npz"))[0]), networks.VisibilityNet().eval()
    rows = np.arange(20, 60)
    with torch.no_grad():
        whole, part = (network.ask(paper.Sight(*paper.tensors(*known.places.sight(asked))))
                       for asked in (np.arange(len(known.lit)), rows))
    np.testing.assert_allclose(part, whole[rows], atol=1e-5)


@pytest.mark.parametrize("local", [False, True])
def test_turned_patches_have_the_labels_of_their_axes(cache, local):
    """Turned back, the blocked part is the mesh's own."""
    known = paper.Source(sorted(cache.glob("*.npz"))[1])
    found = known.example("plain", np.random.default_rng(4), local)
    assert len(found.blocked) == len(known.blocked)
    normals = found.encoded[:, 3:].double().numpy()
    # the rotation of the patch, from its normals alone (Kabsch)
    left, _, right = np.linalg.svd(known.sample.normals.T.astype(float) @ normals)
    back = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    turn = back @ labels.motor_frames(normals) if local else np.broadcast_to(back, (len(normals), 3, 3))
    np.testing.assert_allclose(sh.rotate_each(found.blocked.numpy(), turn), known.blocked, atol=1e-5)
