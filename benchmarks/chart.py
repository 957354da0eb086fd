# SPDX-License-Identifier: GPL-3.0-or-later
"""Error against time of every method, as data, pictures and tables: `python benchmarks/chart.py [--quick]`.

What is in the folder's results.json already is not measured again; remove it to start afresh. A method that is new in
the table is measured alone, beside the plain bake with 64 rays.
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import chart_draw
import chart_measure
import numpy as np
from page import fill
from tqdm import tqdm

from neural_gash_addon.backend import methods
from neural_gash_addon.backend.methods import METHODS
from neural_gash_addon.scene.environments import shipped_environments

ROOT = Path(__file__).resolve().parents[1]


def summary(rows: list[chart_draw.Row]) -> str:
    """Medians over the meshes of the base sweep, and the peers' of theirs: a table in Markdown."""
    titles = ("method", "rays or tolerance", "meshes", "µs a point", "× Embree 64", "SRR", "rel L2", "relit, mean",
              "relit, worst", "claims", "MB")
    lines = ["| " + " | ".join(titles) + " |", "|---" * len(titles) + "|"]
    chosen = [row for row in rows if np.isfinite(row["seconds"]) and (
        row["sweep"] == "base" or (row["sweep"] == "peers" and row["method"] not in METHODS))]
    for method, rays, tolerance in dict.fromkeys(_setting(row) for row in chosen):
        own = [row for row in chosen if _setting(row) == (method, rays, tolerance)]
        claims = [row["claimed"] for row in own if row["claimed"] is not None]
        cells = [f"{np.median([1e6 * row['seconds'] / row['points'] for row in own]):.3g}"]
        cells += [f"{np.median([row[name] for row in own]):.3g}" if np.isfinite(own[0][name]) else ""
                  for name in ("ratio", "srr", "rel_l2", "relit_mean", "relit_worst")]
        cells.append(f"{np.median(claims):.3g}" if claims else "")
        held = [row["memory_mb"] for row in own if isinstance(row["memory_mb"], float | int)]
        cells.append(f"{np.median(held):.0f}" if held else "")
        told = f"{tolerance:.0%}" if tolerance else rays or ""
        lines.append(f"| {method} | {told} | {len(own)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _setting(row: chart_draw.Row) -> chart_draw.Key:
    return row["method"], row["rays"], row["tolerance"]


def memory(rows: list[chart_draw.Row]) -> str:
    """Seconds and peak memory by size, with 64 rays or a tolerance of 5 % where there are any: a table in Markdown."""
    sizes = sorted({row["points"] for row in rows if row["sweep"] == "scale"})
    lines = ["| method | " + " | ".join(f"{size:,} vertices" for size in sizes) + " |", "|---" * (1 + len(sizes)) + "|"]
    for method in METHODS:
        cells = []
        for size in sizes:
            own = [row for row in rows if row["sweep"] == "scale" and row["method"] == method and row["points"] == size
                   and row["rays"] in (None, 64) and row["tolerance"] in (None, 0.05)]
            if not own:
                cells.append("")
            elif isinstance(own[0]["memory_mb"], float | int):
                cells.append(f"{own[0]['seconds']:.3g} s, {own[0]['memory_mb']:.0f} MB")
            else:
                cells.append(own[0]["note"])
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def origin(blocks: list[dict]) -> str:
    """Where the numbers come from, in one paragraph."""
    machines, commits = (sorted({block[name] for block in blocks}) for name in ("machine", "commit"))
    meshes = sorted({block["mesh"] for block in blocks})
    seeds = blocks[0]["seeds"]
    return (f"Machine: {'; '.join(machines)}. Commit: {', '.join(commits)}. Seeds: {seeds['reference']} of the "
            f"reference, from {seeds['first']} on for what is measured. Meshes: {', '.join(meshes)}.")


def main() -> int:
    """Measure what is missing, and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small procedural meshes, few settings: a minute or two")
    parser.add_argument("--out", type=Path, help="folder for results.json and the pictures (out/chart)")
    parser.add_argument("--page", type=Path, help="page whose tables are replaced by this run's")
    parser.add_argument("--again", choices=METHODS, help="measure this method anew, as it is another now")
    parser.add_argument("--draw", action="store_true", help="draw what is there, and measure nothing")
    arguments = parser.parse_args()
    folder = arguments.out or ROOT / "out" / "chart"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "results.json"
    cases = chart_measure.quick_cases() if arguments.quick else chart_measure.full_cases()
    try:
        blocks = chart_measure.load(path)
    except (ValueError, LookupError, TypeError) as error:
        print(f"{path} is no results of a chart ({error}): move it away, or run with another --out.", file=sys.stderr)
        return 1
    if arguments.again:
        blocks = chart_measure.without(blocks, arguments.again)
    if not arguments.draw:
        lights = list(shipped_environments().values())
        missing = chart_measure.missing(cases, blocks)
        with tqdm(total=len(missing), unit="mesh", smoothing=0, mininterval=0.5,
                  bar_format="{desc}{percentage:.0f} %|{bar}| {elapsed}, {remaining} left") as bar:
            for number, (case, names) in enumerate(missing):
                bar.set_description(case.key)
                blocks.append(methods.run(chart_measure.measure(case, lights, names),
                                          lambda share, number=number: bar.update(number + share - bar.n)))
                chart_measure.save(path, blocks)
    if not blocks:
        print(f"There are no results in {path}; run without --draw.", file=sys.stderr)
        return 1
    rows = chart_measure.rows_of(blocks)
    for picture in chart_draw.draw(rows, folder):
        print(picture)
    texts = {"origin": origin(blocks), "summary": summary(rows), "memory": memory(rows)}
    if arguments.page:
        fill(arguments.page, texts)
    print("\n" + "\n\n".join(texts.values()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
