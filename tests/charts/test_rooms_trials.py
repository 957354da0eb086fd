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
