# SPDX-License-Identifier: GPL-3.0-or-later
"""Where methods fail: a table of trials and methods, `python benchmarks/stability.py [--quick]`.

A cell has the typical error (RMS over points, median over the disturbed cases), the worst of any point, and the largest
ratio of a case's RMS to that of the same mesh undisturbed. Methods that are in the file of numbers already are not
tried again (but that of --again is); remove it to start afresh.
"""
from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import trials_scene
import trials_surface
from chart_measure import about
from page import fill
from tqdm import tqdm
from trial import FULL, ORDER, REFERENCE_SEED, SMALL, Pairs, Scale, Variant, undisturbed

from neural_gash_addon.backend import compare, methods, metrics
from neural_gash_addon.backend.compare import Setting
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.exchange import atomic
from neural_gash_addon.backend.geometry import TriangleMesh

RAYS = 64
RED_RATIO, RED_ERROR = 1.5, 0.01  # a red cell's worst case has so many times the error, and so much more in all
_NOTHING = 1e-6  # an error below which all is rounding
GROUPS: dict[str, tuple[Callable[[Scale], Pairs], ...]] = {**trials_surface.TRIALS, **trials_scene.TRIALS}


@dataclass(frozen=True)
class Cell:
    """A method in a trial. Errors are parts of the open sky."""

    group: str
    trial: str
    method: str
    typical: float       # RMS over points, median over the disturbed cases
    worst: float         # of any point of any of them
    worst_case: str      # whose RMS is the largest beside that of the same mesh undisturbed
    worst_typical: float  # and how large
    calm: float          # RMS of that mesh undisturbed
    refused: str = ""

    @property
    def ratio(self) -> float:
        """Of the worst case to the undisturbed."""
        return _ratio(self.worst_typical, self.calm)

    @property
    def red(self) -> bool:
        """Whether it has to be explained."""
        return self.ratio > RED_RATIO and self.worst_typical - self.calm > RED_ERROR


def settings() -> list[Setting]:
    """Every method of the table."""
    return compare.settings_of(ORDER, (RAYS,))


def _errors(variant: Variant, setting: Setting) -> np.ndarray:
    """(n,) of the points."""
    return np.asarray(variant.errors([_baked(mesh, setting) for mesh in variant.meshes]))


@lru_cache(maxsize=64)
def _baked(mesh: TriangleMesh, setting: Setting) -> np.ndarray:
    """Coefficients (N, K); trial after trial asks for those of the undisturbed meshes."""
    return methods.run(compare.vertex_bake(mesh)(setting, 0))[0]


def _ratio(error: float, calm: float) -> float:
    """Of an error to the undisturbed one; 0 where there is none at all, and 1 where there is neither."""
    if error <= _NOTHING:
        return 0.0 if calm > _NOTHING else 1.0
    return error / calm if calm > _NOTHING else float("inf")


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.square(errors).mean()))


def tried(group: str, trial: Callable[[Scale], Pairs], scale: Scale, chosen: Sequence[Setting]) -> list[Cell]:
    """A trial with all methods."""
    pairs = trial(scale)
    cells = []
    for setting in chosen:
        try:
            cases = []
            for calm, disturbed in pairs:
                rest = float(np.median([_rms(_errors(variant, setting)) for variant in calm]))
                cases += [(variant.label, _errors(variant, setting), rest) for variant in disturbed]
        except UserError as error:
            none = float("nan")
            cells.append(Cell(group, trial.__name__, setting.method, none, none, "", none, none, str(error)))
            continue
        means = [_rms(errors) for _, errors, _ in cases]
        worst = max(range(len(cases)), key=lambda case: (_ratio(means[case], cases[case][2]), means[case]))
        cells.append(Cell(group, trial.__name__, setting.method, float(np.median(means)),
                          max(float(errors.max()) for _, errors, _ in cases), cases[worst][0], means[worst],
                          cases[worst][2]))
    return cells


def noise(scale: Scale, chosen: Sequence[Setting]) -> list[dict[str, object]]:
    """Seeds: how far the true error spreads, and how near it is what the report claims.

    A claim that is too small is a promise broken, one that is too large is time wasted. What traces nothing has nothing
    to throw dice for: two seeds show that.
    """
    found: list[dict[str, object]] = []
    for setting in chosen:
        for host in undisturbed(scale):
            true, claims = [], []
            seeds = scale.seeds if methods.METHODS[setting.method].traces else 2
            for seed in range(seeds):
                coefficients, record = methods.run(compare.vertex_bake(host.mesh)(setting, seed))
                true.append(metrics.rel_l2(coefficients[host.rows], host.truth))
                if record is not None and record.error_estimate is not None:
                    claims.append(record.error_estimate)
            ratios = [claim / error for claim, error in zip(claims, true, strict=False)]
            found.append({"method": setting.method, "mesh": host.name, "seeds": seeds,
                          "error": float(np.median(true)), "least": min(true), "most": max(true),
                          "claim": float(np.median(claims)) if claims else None,
                          "lowest": min(ratios, default=None), "highest": max(ratios, default=None)})
    return found


def table(cells: Sequence[Cell]) -> str:
    """In Markdown: trials down, methods across."""
    names = list(dict.fromkeys(cell.method for cell in cells))
    lines = ["| trial | " + " | ".join(names) + " |", "|---" * (1 + len(names)) + "|"]
    by = {(cell.trial, cell.method): cell for cell in cells}
    group = ""
    for trial in dict.fromkeys(cell.trial for cell in cells):
        first = by[trial, names[0]]
        if first.group != group:
            group = first.group
            lines.append(f"| **{group}** |" + " |" * len(names))
        lines.append(f"| {trial.replace('_', ' ')} | " + " | ".join(_cell(by[trial, name]) for name in names) + " |")
    return "\n".join(lines)


def _cell(cell: Cell) -> str:
    if cell.refused:
        return "refused"
    mark = "🔴 " if cell.red else ""
    ratio = "∞" if np.isinf(cell.ratio) else f"{cell.ratio:.2g}×"
    return f"{mark}{100 * cell.typical:.2g} / {100 * cell.worst:.2g} %, {ratio}"


def red_list(cells: Sequence[Cell]) -> str:
    """The red cells by trial: which case is the worst, and how bad."""
    lines = []
    for cell in cells:
        if cell.red:
            ratio = "from none" if np.isinf(cell.ratio) else f"{cell.ratio:.2g} times the {cell.calm:.2%} undisturbed"
            lines.append(f"- {cell.trial.replace('_', ' ')}, `{cell.method}`: {cell.worst_typical:.2%} in the case "
                         f"*{cell.worst_case}*, {ratio}.")
    return "\n".join(lines) or "None."


def noise_table(found: Sequence[dict]) -> str:
    """In Markdown."""
    lines = ["| method | mesh | rel L2, median of the seeds | least to most | claim, median | claim over truth |",
             "|---|---|---|---|---|---|"]
    for row in found:
        claim = "" if row["claim"] is None else f"{row['claim']:.2%}"
        ratios = "" if row["claim"] is None else f"{row['lowest']:.2f} to {row['highest']:.2f}"
        lines.append(f"| {row['method']} | {row['mesh']} | {row['error']:.2%} | "
                     f"{row['least']:.2%} to {row['most']:.2%} | {claim} | {ratios} |")
    return "\n".join(lines)


def _save(path: Path | None, results: dict[str, Any]) -> None:
    """What is known so far."""
    if path is not None:
        with atomic(path) as draft:
            draft.write_text(json.dumps(results, indent=0) + "\n", encoding="utf-8")


def _missing(rows: Sequence[dict], chosen: Sequence[Setting]) -> list[Setting]:
    """The settings whose methods are in none of the rows."""
    there = {row["method"] for row in rows}
    return [setting for setting in chosen if setting.method not in there]


def _with(part: dict[str, Any] | None, name: str, rows: list[dict]) -> dict[str, Any]:
    """A part of the results with rows added, in the order of the table of methods, and of which commits they are."""
    whole, now = [*(part or {}).get(name, []), *rows], about()
    commits = sorted({*(part or {}).get("commit", now["commit"]).split(", "), now["commit"]})
    whole.sort(key=lambda row: list(methods.METHODS).index(row["method"]))
    return {**now, "commit": ", ".join(commits), name: whole}


def main() -> int:
    """Run all trials and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small procedural meshes")
    parser.add_argument("--only", help="trials whose name has this in it")
    parser.add_argument("--again", choices=methods.METHODS, help="try this method anew, as it is another now")
    parser.add_argument("--out", type=Path, help="a file for the numbers, as JSON")
    parser.add_argument("--page", type=Path, help="page whose tables are replaced by this run's")
    arguments = parser.parse_args()
    scale = SMALL if arguments.quick else FULL
    chosen = settings()
    compare.warm(chosen)
    trials = [(group, trial) for group, found in GROUPS.items() for trial in found
              if not arguments.only or arguments.only in trial.__name__]
    results: dict[str, Any] = {"trials": {}, "noise": {}}
    if arguments.out and arguments.out.is_file():
        results = json.loads(arguments.out.read_text(encoding="utf-8"))
        for part, name in [*((trial, "cells") for trial in results["trials"].values()), (results["noise"], "rows")]:
            if name in part:
                part[name] = [row for row in part[name] if row["method"] != arguments.again]
    with tqdm(trials, unit="trial") as bar:
        for group, trial in bar:
            bar.set_description(trial.__name__)
            if missing := _missing(results["trials"].get(trial.__name__, {}).get("cells", []), chosen):
                found = [asdict(cell) for cell in tried(group, trial, scale, missing)]
                results["trials"][trial.__name__] = _with(results["trials"].get(trial.__name__), "cells", found)
                _save(arguments.out, results)
    if not arguments.only and (missing := _missing(results["noise"].get("rows", []), chosen)):
        results["noise"] = _with(results["noise"], "rows", noise(scale, missing))
        _save(arguments.out, results)
    rooms = ""
    if find_spec("torch"):
        import trials_rooms  # needs it

        if not arguments.only and not results.get("rooms"):
            found = trials_rooms.tried(8 if arguments.quick else 1)
            results["rooms"] = {**about(), "rows": found}
            _save(arguments.out, results)
        rooms = trials_rooms.table(results.get("rooms", {}).get("rows", []))
    every = (*results["trials"].values(), results["noise"], results.get("rooms", {}))
    parts = [part for part in every if "commit" in part]
    machines = "; ".join(sorted({part["machine"] for part in parts}))
    commits = ", ".join(sorted({commit for part in parts for commit in part["commit"].split(", ")}))
    cells = [Cell(**cell) for _, trial in trials for cell in results["trials"][trial.__name__]["cells"]]
    texts = {"origin": f"Machine: {machines}. Commit: {commits}. Seed 0; {REFERENCE_SEED} of the references.",
             "table": table(cells), "noise": noise_table(results["noise"].get("rows", [])), "red": red_list(cells),
             "rooms": rooms}
    if arguments.page:
        fill(arguments.page, texts)
    print("\n\n".join(texts.values()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
