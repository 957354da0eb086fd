# SPDX-License-Identifier: GPL-3.0-or-later
"""`make chart QUICK=1`, all of it: measured, written, drawn, and not measured again."""
import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("bpy")
pytest.importorskip("torch")
ROOT = Path(__file__).resolve().parents[2]


def run(folder, *more):
    return subprocess.run([sys.executable, ROOT / "benchmarks" / "chart.py", "--quick", "--out", folder, *more],
                          capture_output=True, text=True, check=True).stdout


def test_quick_form(tmp_path):
    sys.path.insert(0, str(ROOT))
    from neural_gash_addon.backend.methods import METHODS
    page = tmp_path / "page.md"
    marks = "".join(f"<!-- {name} -->\nold\n<!-- end -->\n" for name in ("origin", "summary", "memory"))
    page.write_text("# Title\n" + marks + "Last words.\n")
    printed = run(tmp_path, "--page", page)
    results = json.loads((tmp_path / "results.json").read_text())
    blocks = {block["key"]: block for block in results["blocks"]}
    assert {key.split()[0] for key in blocks} == {"base", "peers", "threads", "orders", "texture", "scale"}
    for block in blocks.values():
        assert block["commit"] and "embreex" in block["machine"] and block["seeds"]["reference"]
        rows = [dict(zip(results["columns"], row, strict=True)) for row in block["rows"]]
        assert set(METHODS) <= {row["method"] for row in rows}
        for row in rows:
            if row["method"] == "analytic":
                assert row["srr"] == pytest.approx(1)
            if row["method"] == "embree" and row["rays"] == 64:
                assert row["srr"] < 0.1 and 0.5 < row["claimed"] / row["rel_l2"] < 2 and row["ratio"] == 1
                assert 0 < row["relit_mean"] <= row["relit_worst"] < 1
            if row["method"] == "auto":  # what it plans by
                assert row["rays"] is None and row["rel_l2"] < 1.5 * row["tolerance"] < 0.5
            if row["method"] == "reference":
                assert row["srr"] < 1e-3
            if row["seconds"] is None and row["method"] != "reference":
                assert row["note"].strip()  # why it is not there
        if Path("/proc/self/clear_refs").exists():  # every setting's, of peers too
            assert all(0 <= row["memory_mb"] < 4000 for row in rows if row["seconds"] is not None)
    for name in ("all", "categories", "scales", "settings", "openness"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
    text = page.read_text()
    assert "old" not in text and "| hybrid | 64 |" in text and "| hybrid | 64 |" in printed
    assert text.startswith("# Title") and text.endswith("Last words.\n")
    before = (tmp_path / "results.json").read_bytes()
    assert run(tmp_path).strip()
    assert (tmp_path / "results.json").read_bytes() == before  # nothing was missing
    rows = [row for block in results["blocks"] for row in block["rows"]]
    assert run(tmp_path, "--again", "analytic").strip()  # as it is of a method that is new in the table
    again = json.loads((tmp_path / "results.json").read_text())["blocks"]
    method = results["columns"].index("method")
    found = [row for block in again for row in block["rows"]]
    assert sorted(row[:6] for row in found if row[method] == "analytic") \
        == sorted(row[:6] for row in rows if row[method] == "analytic")
    assert [row for row in found if row[method] != "analytic"] == [row for row in rows if row[method] != "analytic"]
    assert len(again) == 2 * len(results["blocks"])


def test_what_is_measured_later_has_the_time_that_its_ratio_says(tmp_path):
    """And rows from before a column was there are read."""
    sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
    import chart_measure

    def row(method, seconds, ratio, rays=None, tolerance=None):
        known = {"method": method, "order": 3, "threads": 2, "rays": rays, "seconds": seconds, "ratio": ratio,
                 "tolerance": tolerance}
        return [known.get(column) for column in chart_measure.COLUMNS]

    def block(*rows):
        return {"key": "base knot", "mesh": "knot", "category": "none", "sweep": "base", "rows": list(rows)}

    path = tmp_path / "results.json"
    chart_measure.save(path, [block(row("embree", 0.2, 1.0, 64), row("hybrid", 0.3, 1.5, 64)),
                              block(row("auto", 5.0, 2.5, tolerance=0.1))])
    rows = {row["method"]: row for row in chart_measure.rows_of(chart_measure.load(path))}
    assert rows["hybrid"]["seconds"] == 0.3 and rows["auto"]["seconds"] == pytest.approx(0.5)
    text = json.loads(path.read_text())
    for each in text["blocks"]:
        each["rows"] = [values[:-1] for values in each["rows"]]
    text["columns"].remove("tolerance")
    path.write_text(json.dumps(text))
    assert all(row["tolerance"] is None for row in chart_measure.rows_of(chart_measure.load(path)))


def test_memory_is_what_a_bake_takes_at_most():
    sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
    import chart_measure
    import memory
    import numpy as np

    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("needs Linux's /proc")

    def bake(megabytes, seed):
        held = np.ones(megabytes * 125_000)
        yield 0.5
        del held
        return np.ones(25_000_000 // 8), None

    watched = chart_measure._Watched(bake)
    for _ in range(2):
        for megabytes in (400, 50, 200):
            for _ in watched(megabytes, 0):
                pass
    assert watched.peaks == pytest.approx({400: 400, 50: 50, 200: 200}, abs=8)
    assert memory.Watch().peak() < 8


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"columns": 1, "blocks": 2}',
                                  '{"columns": [], "blocks": [{"rows": [[1]]}]}',
                                  '{"columns": [], "blocks": [{"rows": []}]}'])
def test_results_that_are_damaged_are_kept_and_told(tmp_path, text):
    path = tmp_path / "results.json"
    path.write_text(text)
    got = subprocess.run([sys.executable, ROOT / "benchmarks" / "chart.py", "--quick", "--draw", "--out", tmp_path],
                         capture_output=True, text=True, check=False)
    assert got.returncode == 1 and len(got.stderr.strip().splitlines()) == 1 and str(path) in got.stderr
    assert path.read_text() == text
