# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the decoder of light that bounces, in small: its labels, that it learns, that a bake asks the same."""
import csv

import numpy as np
import pytest
import trimesh

torch = pytest.importorskip("torch")

from test_embedding_training import TINY, one_thread  # noqa: E402, F401

from neural_gash_addon.backend import sky_bake  # noqa: E402
from neural_gash_addon.backend.exchange import write_npz  # noqa: E402
from neural_gash_addon.backend.networks.sky import SkyEmbedding  # noqa: E402
from neural_gash_addon.backend.progress import run  # noqa: E402
from neural_gash_addon.backend.raycast import Occluders  # noqa: E402
from training import bounce_labels, bounces, labels  # noqa: E402

POINTS, QUERIES = 256, 200


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Three labelled scenes, the last held out."""
    folder = tmp_path_factory.mktemp("bounces")
    with pytest.MonkeyPatch.context() as patch:
        for module, name, value in ((sky_bake, "POINTS", POINTS), (bounce_labels, "QUERIES", QUERIES),
                                    (bounce_labels, "PATCHES", 300)):
            patch.setattr(module, name, value)
        for number, mesh in enumerate((trimesh.creation.torus(1, 0.45, 24, 12), trimesh.creation.annulus(0.6, 1, 1.2),
                                       trimesh.creation.torus(1, 0.3, 24, 12))):
            found = labels.label(mesh.vertices, mesh.faces, None, name=f"mesh {number}", category="test", rays=8,
                                 seed=1)
            source = folder / f"mesh-{number}.npz"
            write_npz(source, **{key: np.asarray(getattr(found, key)) for key in (*labels.ARRAYS, *labels.TEXTS)})
            bounce_labels.work((source, 1 + (number == 2)), folder / f"scene-{number}.npz")
    return folder


@pytest.fixture
def tiny(monkeypatch):
    """A small embedding without training, frozen, as the one that ships."""
    torch.manual_seed(0)
    model = SkyEmbedding(TINY).eval().requires_grad_(False)
    monkeypatch.setattr(bounces, "trained", lambda: model)
    monkeypatch.setattr(bounces, "sample", bounces.Sample)
    return model


def test_labels_are_of_one_scene_and_of_colours(cache):
    for number in range(3):
        with np.load(cache / f"scene-{number}.npz") as found:
            assert set(found.files) == set(bounce_labels.ARRAYS)
            assert found["places"].shape == (POINTS, 3) and found["bounced"].shape == (2, POINTS, 25, 3)
            truth = found["truth"]
            assert truth.shape[0] == 1 + (number == 2) and truth.shape[2:] == (25, 3)
            assert truth[:, :, 0].mean() > 0 and np.ptp(truth[:, :, 0].mean((0, 1))) > 0
            assert np.linalg.norm(found["bounced"][0] - found["bounced"][1]) > 0  # with rays of their own
    one, two = (bounce_labels.scene_of(cache / "mesh-0.npz") for _ in range(2))
    np.testing.assert_array_equal(one.albedo, two.albedo)
    assert one.albedo.min() >= 0 and one.albedo.max() < 1 and len(one.albedo) == sum(len(t) for _, t in one.parts)


def test_the_noise_of_the_truth_does_not_count(cache, tiny):
    held = bounces.Sample(cache / "scene-2.npz")
    rng = np.random.default_rng(0)
    exact = rng.uniform(0.5, 1, (2000, 25, 3))
    held.truth = np.stack([exact + rng.normal(0, 0.3, exact.shape) for _ in range(2)])
    assert bounces.relative(exact, held) < 0.02
    assert bounces.relative(1.1 * exact, held) == pytest.approx(0.1, abs=0.01)


def test_it_learns_and_is_judged(cache, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(bounces, "EVERY", 20)
    held = bounces.Sample(cache / "scene-2.npz")
    kept = [cache / f"scene-{number}.npz" for number in range(2)]
    made = bounces.train(kept, [held], 40, 0, tmp_path / "state", tmp_path / "log.csv")
    with (tmp_path / "log.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 and set(rows[0]) == {"step", "seconds", "loss", "log", "median", "mean"}
    begun = bounces.begun().eval()

    def loss(model):
        sample = bounces.Sample(kept[0])
        with torch.no_grad():
            found = sample.answer(model, np.arange(len(sample.places)))
            return float(bounces.loss(found, torch.from_numpy(sample.truth[0])))

    assert loss(made) < loss(begun)
    lines = bounces.table(made, [held]).splitlines()
    assert len(lines) == 7 and lines[1].startswith("network")


def test_a_bake_asks_the_same(cache, tiny, monkeypatch):
    """What is trained on is what `sky_bake` makes of the same scene."""
    scene, sample = bounce_labels.scene_of(cache / "mesh-0.npz"), bounces.Sample(cache / "scene-0.npz")
    occluders = Occluders(scene.parts, scene.mesh.resolution)
    points = run(sky_bake.scene_points(scene.mesh, occluders, POINTS, threads=1))
    decoder = bounces.begun().eval()
    monkeypatch.setattr(sky_bake, "reflecting", lambda: decoder)
    monkeypatch.setattr(bounce_labels, "PATCHES", 300)
    sky, solution = sky_bake.Sky(tiny, occluders, points), bounce_labels.solved(scene, occluders, 0)
    run(sky.seen(solution))
    asked = bounce_labels.some(scene.mesh, QUERIES, 1)
    both, direct = (sky.transfer(asked.points, asked.normals, 5, each) for each in (solution, None))
    np.testing.assert_allclose(both - direct[:, :, None], bounces.network(decoder, sample), atol=1e-5)
