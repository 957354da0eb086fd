# SPDX-License-Identifier: GPL-3.0-or-later
"""The hybrid beside plain Embree at equal total time, on meshes that nothing was tuned on; per mesh and category.

`.venv/bin/python benchmarks/hybrid.py` reads ../shared/meshes/validation, or --folder.
"""
from __future__ import annotations

import argparse
import csv
import statistics
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from meshes import FOLDER, read
from table import Table, processor_seconds, seconds

from neural_gash_addon.backend import methods, metrics
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.workers import default_threads

BUDGETS = (4, 8, 16, 32)              # rays of one of them that set the time
LADDER = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)  # rays that are tried
SETTING = "hybrid", "embree"
ORDER, REFERENCE_RAYS, TARGET = 3, 2048, 0.5
REPEATS, MOST_REPEATS, ENOUGH = 5, 30, 0.6  # more than the first, up to the second, until they took so many seconds


def curve(mesh: TriangleMesh, reference: np.ndarray, ladder: tuple[int, ...],
          timed: Callable[[Callable[[], object]], float] = seconds) -> dict[str, list[tuple[float, float]]]:
    """(seconds, SRR) of both methods at each number of rays, measured in turns.

    Seconds are the least of REPEATS or more at each, and no more than with more rays: the rest is the machine's. (Not
    of a line in the number of rays, as few are traced on one thread.) SRR is the median over seeds.
    """
    unshadowed = sh.cosine_lobe(mesh.normals, ORDER)
    found: dict[str, list[tuple[float, float]]] = {"embree": [], "hybrid": []}
    for rays in ladder:
        runs: dict[str, list[tuple[float, float]]] = {name: [] for name in found}
        for seed in range(MOST_REPEATS):
            if seed >= REPEATS and sum(t for measured in runs.values() for t, _ in measured) > ENOUGH:
                break
            for number, (name, measured) in enumerate(runs.items()):
                kept: list[np.ndarray] = []
                baking = methods.bake(mesh, name, ORDER, rays=rays,
                                      seed=2 * seed + number)  # begins when run; directions of a seed may be kept
                spent = timed(lambda baking=baking, kept=kept: kept.append(methods.run(baking).coefficients))
                measured.append((spent, metrics.srr(kept[0], reference, unshadowed)))
        for name, measured in runs.items():
            found[name].append((min(t for t, _ in measured), statistics.median(s for _, s in measured)))
    for name, points in found.items():
        least = np.minimum.accumulate([t for t, _ in points[::-1]])[::-1]
        found[name] = [(float(t), s) for t, (_, s) in zip(least, points, strict=True)]
    return found


def at_time(points: list[tuple[float, float]], spent: float) -> float:
    """SRR that a method reaches in a time, on lines through its logarithms; NaN where that is less or more than any."""
    if not points[0][0] <= spent <= points[-1][0]:
        return float("nan")
    times, errors = (np.log(np.maximum(column, 1e-12)) for column in np.array(points).T)
    return float(np.exp(np.interp(np.log(spent), times, errors)))


def shown(ratio: float) -> str:
    """A cell."""
    return f"{ratio:.2f}" if np.isfinite(ratio) else "–"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER / "validation")
    parser.add_argument("--only", help="files whose name has this in it")
    parser.add_argument("--processor", action="store_true",
                        help="processor time, as it would pass on both threads of a machine that nobody else uses")
    arguments = parser.parse_args()
    timed = partial(processor_seconds, threads=default_threads()) if arguments.processor else seconds
    categories = {}
    if (FOLDER / "MANIFEST.csv").is_file():
        with (FOLDER / "MANIFEST.csv").open(newline="") as file:
            categories = {Path(row["file"]).stem: row["category"] for row in csv.DictReader(file)}
    print(f"Order {ORDER}, {default_threads()} threads; SRR against {REFERENCE_RAYS} rays with a seed of their own. "
          "Each cell: the hybrid's SRR over Embree's in the same time, that of so many rays of the hybrid, or of "
          "Embree; –: one ray of the hybrid takes longer. Last but one: at equal rays, 8.\n")
    print("| mesh | category | vertices | " + " | ".join(f"{b} of {name}" for name in SETTING for b in BUDGETS)
          + " | equal rays, 8 | hybrid µs/vertex at 4 |")
    print("|---" * (5 + len(SETTING) * len(BUDGETS)) + "|", flush=True)
    ratios: dict[tuple[str, int], list[tuple[str, float]]] = {(name, b): [] for name in SETTING for b in BUDGETS}
    two = dict.fromkeys(BUDGETS, 0)
    equal: list[float] = []
    for path in sorted(arguments.folder.glob("*.ply")):
        if arguments.only and arguments.only not in path.stem:
            continue
        mesh = read(path)
        reference = methods.run(methods.bake(mesh, "embree", ORDER, rays=REFERENCE_RAYS, seed=77)).coefficients
        found = curve(mesh, reference, LADDER, timed)
        category = categories.get(path.stem, "")
        for name, budget in ratios:
            spent = found[name][LADDER.index(budget)][0]
            ratios[name, budget].append((category, at_time(found["hybrid"], spent) / at_time(found["embree"], spent)))
            if name == "embree":
                two[budget] += found["hybrid"][LADDER.index(2)][0] <= spent
        at = LADDER.index(8)
        equal.append(found["hybrid"][at][1] / found["embree"][at][1])
        cost = 1e6 * found["hybrid"][LADDER.index(4)][0] / len(mesh.points)
        print(f"| {path.stem} | {category} | {len(mesh.points):,} | "
              + " | ".join(shown(each[-1][1]) for each in ratios.values()) + f" | {equal[-1]:.2f} | {cost:.1f} |",
              flush=True)
    for category in sorted({c for c, _ in next(iter(ratios.values()))}):
        medians = [float(np.nanmedian([r for c, r in each if c == category])) for each in ratios.values()]
        print(f"| median | {category} | | " + " | ".join(map(shown, medians)) + " | | |")
    table = Table()
    table.heading("Hybrid at equal time", "SRR of the hybrid over Embree's in the same time, median and worst mesh.")
    table.add("equal rays (8), median", "", "", statistics.median(equal))
    table.add("equal rays (8), worst mesh", "", "", max(equal))
    for (name, budget), found_here in ratios.items():
        values, of = [r for _, r in found_here if np.isfinite(r)], f"in the time of {budget} rays of {name}"
        if name == "embree":
            for rays, meshes in ((1, len(values)), (2, two[budget])):
                table.add(f"{of}, meshes where {rays} of the hybrid take no longer", f"{meshes}", f"{len(found_here)}")
        if values:
            table.add(f"{of}, median", "", "", statistics.median(values), TARGET, most=True)
            table.add(f"{of}, worst mesh", "", "", max(values), 1.0, most=True)


if __name__ == "__main__":
    main()
