# SPDX-License-Identifier: GPL-3.0-or-later
"""The planner's regret as `make planner` prints it, of one small mesh."""
import sys
from pathlib import Path

import pytest
import trimesh

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import planner

from neural_gash_addon.backend.methods import METHODS


def test_every_method_is_tried_and_none_that_meets_the_tolerance_is_cheaper_than_the_cheapest(tmp_path, monkeypatch,
                                                                                             capsys):
    trimesh.creation.torus(1, 0.45, 24, 12).export(tmp_path / "ring.ply")
    tried = []
    real = planner.timed
    monkeypatch.setattr(planner, "timed", lambda *of, **wish: tried.append((of[3], real(*of, **wish))) or tried[-1][1])
    monkeypatch.setattr(planner, "RAYS", (4, 16, 64))
    monkeypatch.setattr(sys, "argv", ["planner", "--folder", str(tmp_path), "--repeats", "1", "--tolerances", "0.1"])
    planner.main()
    row, = (line for line in capsys.readouterr().out.splitlines() if line.startswith("| ring"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert {name for name, _ in tried} >= {entry.name for entry in METHODS.values()
                                           if not entry.plans and entry.name != "sparse"}
    met = [spent for _, (spent, wrong, _) in tried if wrong <= 0.1]
    error, least, regret = float(cells[5].strip("%")) / 100, float(cells[8]), float(cells[9])
    assert error <= 0.15 and least <= min(met) + 1e-3
    assert regret >= 1 or error > 0.1
    assert float(cells[4]) == pytest.approx(regret * least, rel=0.2, abs=2e-3)
