# SPDX-License-Identifier: GPL-3.0-or-later
"""Every trial of `make stability`, in small: what must hold of the methods that are exact; failures are found."""
import json
import math
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trimesh")
pytest.importorskip("torch")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
sys.path.insert(0, str(ROOT / "benchmarks"))

import stability  # noqa: E402
import trials_rooms  # noqa: E402
import trials_scene  # noqa: E402
from trial import FULL, SMALL, box, hosts, smooth, undisturbed  # noqa: E402

from neural_gash_addon.backend import compare, methods, sparse_bake  # noqa: E402
from neural_gash_addon.backend.compare import Setting  # noqa: E402

TRIALS = [(group, trial) for group, found in stability.GROUPS.items() for trial in found]
# the truth of these is not traced: a convex plate has no shadows, a closed ball is dark inside, no light is no light
EXACT = {"thin_plates": ("analytic", "embree", "hybrid"), "nested_shells": ("embree", "hybrid"), "dark": None}


@pytest.mark.parametrize("group, trial", TRIALS, ids=[trial.__name__ for _, trial in TRIALS])
def test_trial(group, trial):
    chosen = stability.settings()
    cells = {cell.method: cell for cell in stability.tried(group, trial, SMALL, chosen)}
    assert set(cells) == set(methods.METHODS) and trial.__doc__ and len(trial.__doc__) > 35
    for cell in cells.values():
        assert not cell.refused and math.isfinite(cell.typical) and 0 <= cell.typical <= cell.worst + 1e-12
    assert not cells["embree"].red and not cells["hybrid"].red
    assert cells["embree"].worst < 0.25
    if group == "transformation":  # truths turn, mirror and move with the mesh: what has no rays is to be the same
        assert cells["analytic"].ratio == pytest.approx(1, abs=0.01)
    exact = EXACT.get(trial.__name__, ())
    for name in cells if exact is None else exact:
        assert cells[name].worst < 1e-6
    table = stability.table(list(cells.values()))
    assert table.count("\n") == 3 and trial.__name__.replace("_", " ") in table


def test_a_method_that_knows_up_from_down_is_found(monkeypatch):
    embree = methods.METHODS["embree"]

    def bake(mesh, order, **told):
        found = yield from embree.bake(mesh, order, **told)
        lean = 1 + 0.5 * mesh.positions[:, 2:] / np.abs(mesh.positions).max()
        return replace(found, coefficients=found.coefficients * lean.astype(np.float32))

    monkeypatch.setitem(methods.METHODS, "leaning", replace(embree, name="leaning", bake=bake))
    assert Setting("leaning", 3, stability.RAYS) in stability.settings()  # read off the table
    known = {trial.__name__: trial for _, trial in TRIALS}
    chosen = [Setting("leaning", 3, 512)]
    assert stability.tried("", known["rotate"], SMALL, chosen)[0].ratio > 1.1
    cell, = stability.tried("", known["translate_object"], SMALL, chosen)
    assert cell.red and "1e4 away" in cell.worst_case
    assert "🔴" in stability.table([cell]) and "leaning" in stability.red_list([cell])
    shuffled, = stability.tried("", known["shuffle_triangles"], SMALL, chosen)
    assert not shuffled.red and "🔴" not in stability.table([shuffled]) and stability.red_list([shuffled]) == "None."


def test_claims_are_near_the_truth():
    found = stability.noise(SMALL, [Setting("embree", 3, stability.RAYS), Setting("analytic", 3)])
    traced, none = found
    assert 0.7 < traced["lowest"] <= traced["highest"] < 1.5
    assert traced["least"] < traced["most"] < 1.5 * traced["least"]
    assert none["claim"] is None and none["least"] == none["most"]
    assert traced["seeds"] == SMALL.seeds and none["seeds"] == 2
    assert "claim over truth" in stability.noise_table(found)


def test_the_embedding_traces_its_scene_points_and_gets_all_seeds():
    row, = stability.noise(SMALL, [Setting("embedding", 3)])
    assert row["seeds"] == SMALL.seeds and row["least"] < row["most"]
    assert row["claim"] and row["lowest"] <= row["highest"]


def test_sparse_leaves_points_out_of_the_hosts():
    setting, = (setting for setting in stability.settings() if setting.method == "sparse")
    for name, geometry in hosts(FULL):  # those of SMALL are so coarse that every point is worth it
        mesh = smooth(geometry)
        coefficients, record = stability.bake(mesh, setting, 0)
        # a sample takes that many rays or more, so these are not enough for all points
        assert 0 < record.rays < sparse_bake._LEAST_RAYS * len(mesh.points), name
        assert np.linalg.norm(coefficients, axis=1).min() > 0 and record.error_estimate <= stability.SPARSE_TOLERANCE
    assert sparse_bake.FEWEST == 4096


def test_cases_say_what_is_allowed():
    energy = [variant.label for _, disturbed in trials_scene.energy(SMALL) for variant in disturbed]
    rings = [float(label.split("as low as ")[1].rstrip("%")) for label in energy if "sun" in label]
    assert len(rings) == len(hosts(SMALL)) and all(-20 < share < -1 for share in rings)
    assert all("true change" in variant.label for _, disturbed in trials_scene.flicker(SMALL) for variant in disturbed)


def test_boxes_are_closed_and_face_outward():
    import trimesh
    for size in ((1, 1, 1), (2, 1, 1e-5)):
        solid = trimesh.Trimesh(*box(size, 4, (3, 2, 1)), process=False)
        assert solid.is_watertight and solid.volume == pytest.approx(np.prod(size), rel=1e-5)


def test_the_undisturbed_truth_is_the_bake_with_many_rays():
    host, = undisturbed(SMALL)
    many = methods.run(compare.vertex_bake(host.mesh)(Setting("embree", 3, 16384), 5))[0][host.rows]
    assert np.abs(many - host.truth).max() < 0.01


def test_what_is_there_is_not_run_again(tmp_path, monkeypatch, capsys):
    out, page = tmp_path / "stability.json", tmp_path / "page.md"
    page.write_text("".join(f"<!-- {name} -->\n<!-- end -->\n" for name in
                            ("origin", "table", "noise", "red", "rooms")))
    monkeypatch.setattr(sys, "argv", ["stability", "--quick", "--only", "dark", "--out", str(out), "--page", str(page)])
    assert stability.main() == 0
    known = json.loads(out.read_text())
    assert set(known["trials"]) == {"dark"} and all(cell["commit"] for cell in known["trials"]["dark"]["cells"])
    monkeypatch.setattr(stability, "tried", None)
    first = page.read_text()
    assert stability.main() == 0 and page.read_text() == first and "| dark | 0 / 0 %" in first
    assert "Commits (" in first and json.loads(out.read_text()) == known


def test_a_method_that_is_another_now_is_tried_alone(tmp_path, monkeypatch):
    out = tmp_path / "stability.json"
    monkeypatch.setattr(sys, "argv", ["stability", "--quick", "--only", "dark", "--out", str(out)])
    assert stability.main() == 0
    known, asked, tried = json.loads(out.read_text())["trials"]["dark"]["cells"], [], stability.tried
    monkeypatch.setattr(stability, "tried", lambda group, trial, scale, chosen: asked.extend(chosen)
                        or tried(group, trial, scale, chosen))
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--again", "gnn"])
    assert stability.main() == 0
    assert [setting.method for setting in asked] == ["gnn"]
    assert json.loads(out.read_text())["trials"]["dark"]["cells"] == known  # in the same order


def test_parts_are_done_again_by_themselves_and_the_rooms_with_their_network(tmp_path, monkeypatch):
    room = {"where": "here", "light": 1.0, "errors": [0.0] * len(trials_rooms.COLUMNS)}
    dark = asdict(stability.Cell("light", "dark", "embedding", 0.0, 0.0, "", 0.0, 0.0, commit="old"))
    known = {"trials": {"dark": {"cells": [dark]}}, "noise": {"rows": []}, "rooms": {"commit": "old", "rows": [room]}}
    out = tmp_path / "stability.json"
    out.write_text(json.dumps(known))
    monkeypatch.setattr(stability, "tried", None)  # no trial is run
    monkeypatch.setattr(trials_rooms, "tried", lambda scale: [room, room])

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["stability", "--quick", "--out", str(out), *words])
        assert stability.main() == 0
        return json.loads(out.read_text())

    assert run("--only", "rooms", "--again", "gnn") == known
    found = run("--only", "rooms", "--again", "embedding")
    assert len(found["rooms"]["rows"]) == 2 and found["rooms"]["commit"] != "old"
    assert found["trials"] == known["trials"]
    monkeypatch.setattr(stability, "noise", lambda scale, chosen: [
        {"method": setting.method, "mesh": "knot", "error": 0.1, "least": 0.1, "most": 0.1, "claim": None}
        for setting in chosen])
    found = run("--only", "noise", "--again", "embedding")
    assert {each["method"] for each in found["noise"]["rows"]} == set(methods.METHODS)
    assert found["trials"] == known["trials"]
    assert "`embedding` old" in stability.origin(found)


def test_rooms_are_rows_of_the_table_too():
    """Of the methods that compute what lamps add, beside the same room undisturbed."""
    columns = len(trials_rooms.COLUMNS)
    rows = [{"where": where, "light": 1.0, "errors": [network, *[0.3] * (columns - 2), paths],
             "worst": [2 * network, *[0.0] * (columns - 2), 2 * paths]}
            for where, network, paths in ((trials_rooms.CALM, 0.05, 0.1), ("in a gap", 0.2, 0.11))]
    network, paths = sorted(stability.cells_of_rooms({"commit": "now", "rows": rows}), key=lambda cell: cell.method)
    assert (network.method, paths.method) == ("embedding", "embree") and {network.commit, paths.commit} == {"now"}
    assert network.ratio == pytest.approx(4) and network.red and not paths.red
    table = stability.table([paths, network])
    assert "| **light from within** |" in table and "| in a gap | 11 / 22 %, 1.1× | 🔴 20 / 40 %, 4× |" in table
    assert stability.red_list([network, paths]).count("in a gap") == 2  # the trial and its case
    assert stability.cells_of_rooms({}) == [] == stability.cells_of_rooms({"commit": "now", "rows": rows[1:]})
