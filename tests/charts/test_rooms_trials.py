# SPDX-License-Identifier: GPL-3.0-or-later
"""Rooms in which the embedding might fail, in small."""
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trimesh")
pytest.importorskip("torch")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
sys.path.insert(0, str(ROOT / "benchmarks"))

import trials_rooms  # noqa: E402

from neural_gash_addon.backend import embedding_bake  # noqa: E402


def test_a_gap_is_found_to_be_where_the_network_fails_and_a_bake_does_not(monkeypatch):
    monkeypatch.setattr(trials_rooms, "TRUTH", 512)
    chosen = {name: make for name, make in trials_rooms.trials(4).items() if "gap" in name}
    assert len(chosen) == 1
    monkeypatch.setattr(trials_rooms, "trials", lambda scale: chosen)
    row, = trials_rooms.tried(4)
    bake, alone, mean, paths = row["errors"]
    assert np.isfinite(row["errors"]).all() and 0 < row["light"] < 0.05
    assert bake < 0.7 * alone and alone < mean and paths < alone
    table = trials_rooms.table([row])
    assert table.count("\n") == 2 and f"{bake:.3f}" in table


def test_every_trial_has_queries_that_are_where_it_says():
    for name, make in trials_rooms.trials(16).items():
        scene, queries = make()
        assert len(scene.emitters) and 8 <= len(queries) <= trials_rooms.QUERIES // 16, name
        assert np.isfinite(queries).all()


@pytest.mark.parametrize("edit", [{"lamp_at": (3.8, 3.0, 1.6)}, {"block_at": (1.0, 1.2, 0)},
                                  {"floor": (0.1, 0.7, 0.15)}], ids=["lamp", "block", "floor"])
def test_an_edit_is_followed_by_encoding_anew(monkeypatch, edit):
    """Without training: as near the truth as before, and nearer than what was right before."""
    monkeypatch.setattr(trials_rooms, "TRUTH", 1024)
    scene = trials_rooms.furnished(**edit)
    queries = trials_rooms.asked(scene)[:128]
    old, new = (trials_rooms.Answers(embedding_bake.network(), each, queries)
                for each in (trials_rooms.furnished(), scene))
    followed, stale = new.off(new.network), new.off(old.network)
    assert followed < 0.12 and stale > 1.3 * followed and new.off(old.truth.values) > followed
