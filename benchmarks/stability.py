# SPDX-License-Identifier: GPL-3.0-or-later
"""Where methods fail: a table of trials and methods, `python benchmarks/stability.py [--quick]`.

A cell has the typical error (RMS over points, median over the disturbed cases), the worst of any point, and the largest
ratio of a case's RMS to that of the same mesh undisturbed. Methods that are in the file of numbers already are not
tried again (but that of --again is); remove it to start afresh. --only noise and --only rooms are of those parts alone.
"""
from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import trials_scene
import trials_surface
from chart_measure import about
from page import fill
from tqdm import tqdm
from trial import FULL, ORDER, REFERENCE_SEED, SMALL, Pairs, Scale, Variant, undisturbed

from neural_gash_addon.backend import compare, methods, metrics, sparse_bake
from neural_gash_addon.backend.compare import Setting
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.exchange import atomic
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.record import BakeRecord

RAYS = 64
TOLERANCE = 0.05  # of methods that plan
# What `sparse` is told instead, as it would itself trace every point of hosts as coarse as these for the 3 to 6 % that
# RAYS give: a relative error, and how many points there are for each of its first samples.
SPARSE_TOLERANCE, SPARSE_STRIDE = 0.2, 8
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
    commit: str = ""     # of which it is; + where files had changed since

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
    return [replace(setting, rays=None, tolerance=SPARSE_TOLERANCE) if setting.method == "sparse" else setting
            for setting in compare.settings_of(ORDER, (RAYS,), tolerances=(TOLERANCE,))]


def _errors(variant: Variant, setting: Setting) -> np.ndarray:
    """(n,) of the points."""
    return np.asarray(variant.errors([_baked(mesh, setting) for mesh in variant.meshes]))


@lru_cache(maxsize=64)
def _baked(mesh: TriangleMesh, setting: Setting) -> np.ndarray:
    """Coefficients (N, K); trial after trial asks for those of the undisturbed meshes."""
    return bake(mesh, setting, 0)[0]


def bake(mesh: TriangleMesh, setting: Setting, seed: int) -> tuple[np.ndarray, BakeRecord | None]:
    """Coefficients (N, K) of a method, and its record.

    Fewer than 16,384 points are all traced by `sparse`, and hosts have a tenth of that. That it is tried at all, its
    first samples, of which the threshold is a multiple, are as much fewer.
    """
    baking = compare.vertex_bake(mesh)(setting, seed)
    if setting.method != "sparse":
        return methods.run(baking)
    fewest = min(sparse_bake.FEWEST, max(1, len(mesh.points) // SPARSE_STRIDE))
    with patch.object(sparse_bake, "FEWEST", fewest):
        return methods.run(baking)


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


def cells_of_rooms(rooms: dict[str, Any]) -> list[Cell]:
    """Lamps, of the methods that compute what they add: the network, as a bake has it, and paths."""
    import trials_rooms  # needs torch, as whoever has rows of it did

    calm = next((row for row in rooms.get("rows", []) if row["where"] == trials_rooms.CALM), None)
    if calm is None:
        return []
    columns = {"embree": len(trials_rooms.COLUMNS) - 1, "embedding": 0}
    return [Cell("light from within", row["where"], method, row["errors"][n], row["worst"][n], row["where"],
                 row["errors"][n], calm["errors"][n], commit=rooms["commit"])
            for row in rooms["rows"] if row is not calm for method, n in columns.items()]


def noise(scale: Scale, chosen: Sequence[Setting]) -> list[dict[str, object]]:
    """Seeds: how far the true error spreads, and how near it is what the report claims.

    A claim that is too small is a promise broken, one that is too large is time wasted. Where a second seed changes
    nothing, no dice are thrown, and two are enough.
    """
    found: list[dict[str, object]] = []
    for setting in chosen:
        for host in undisturbed(scale):
            true, claims = [], []
            for seed in range(scale.seeds):
                coefficients, record = bake(host.mesh, setting, seed)
                true.append(metrics.rel_l2(coefficients[host.rows], host.truth))
                if record is not None and record.error_estimate is not None:
                    claims.append(record.error_estimate)
                if seed == 1 and true[0] == true[1]:
                    break
            ratios = [claim / error for claim, error in zip(claims, true, strict=False)]
            found.append({"method": setting.method, "mesh": host.name, "seeds": len(true),
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
        own = [by.get((trial, name)) for name in names]
        of = next(cell.group for cell in own if cell)
        if of != group:
            group = of
            lines.append(f"| **{group}** |" + " |" * len(names))
        lines.append(f"| {trial.replace('_', ' ')} | " + " | ".join("" if cell is None else _cell(cell) for cell in own)
                     + " |")
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
    """A part of the results with rows added, each with its commit, in the order of the table of methods."""
    now = about()
    commit = now.pop("commit")
    whole = [*(part or {}).get(name, []), *({**row, "commit": commit} for row in rows)]
    whole.sort(key=lambda row: list(methods.METHODS).index(row["method"]))
    return {**now, name: whole}


def _forget(results: dict[str, Any], method: str | None, asked: Callable[[str], bool]) -> None:
    """Drop what is known of a method in the parts that are asked for, so that it is tried anew."""
    for name, part in {**results["trials"], "noise": results["noise"]}.items():
        for rows in ({"cells", "rows"} & part.keys()) if asked(name) else ():
            part[rows] = [row for row in part[rows] if row["method"] != method]
    if method == "embedding" and asked("rooms"):
        results.pop("rooms", None)  # they try its network for light from within


def _commits(rows: Sequence[dict]) -> str:
    """Of which commits the rows of the methods are."""
    by: dict[str, set[str]] = {}
    for row in rows:
        by.setdefault(row["method"], set()).update(row["commit"].split(", "))
    alike: dict[str, list[str]] = {}
    for method, commits in by.items():
        alike.setdefault(", ".join(sorted(commits)), []).append(f"`{method}`")
    return "; ".join(f"{', '.join(names)} {commits}" for commits, names in alike.items())


def origin(results: dict[str, Any]) -> str:
    """Where the numbers were measured, and of which commits those of each method are."""
    rooms = results.get("rooms", {})
    parts = (*results["trials"].values(), results["noise"], rooms)
    machines = "; ".join(sorted({part["machine"] for part in parts if "machine" in part}))
    cells = [cell for part in results["trials"].values() for cell in part["cells"]]
    return (f"Machine: {machines}. Seed 0; {REFERENCE_SEED} of the references.\n\n"
            f"Commits (+: with changes) of the trials: {_commits(cells)}. Of the noise: "
            f"{_commits(results['noise'].get('rows', []))}. Of the rooms: {rooms.get('commit', '')}.")


def main() -> int:
    """Run all trials and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small procedural meshes")
    parser.add_argument("--only", help="trials whose name has this in it; or noise, rooms")
    parser.add_argument("--again", choices=methods.METHODS, help="try this method anew, as it is another now")
    parser.add_argument("--out", type=Path, help="a file for the numbers, as JSON")
    parser.add_argument("--page", type=Path, help="page whose tables are replaced by this run's")
    arguments = parser.parse_args()
    scale = SMALL if arguments.quick else FULL
    chosen = settings()

    def asked(name: str) -> bool:
        return not arguments.only or arguments.only in name

    every = [(group, trial) for group, found in GROUPS.items() for trial in found]
    trials = [(group, trial) for group, trial in every if asked(trial.__name__)]
    results: dict[str, Any] = {"trials": {}, "noise": {}}
    if arguments.out and arguments.out.is_file():
        results = json.loads(arguments.out.read_text(encoding="utf-8"))
        _forget(results, arguments.again, asked)
    with tqdm(trials, unit="trial") as bar:
        for group, trial in bar:
            bar.set_description(trial.__name__)
            if missing := _missing(results["trials"].get(trial.__name__, {}).get("cells", []), chosen):
                found = [asdict(cell) for cell in tried(group, trial, scale, missing)]
                results["trials"][trial.__name__] = _with(results["trials"].get(trial.__name__), "cells", found)
                _save(arguments.out, results)
    if asked("noise") and (missing := _missing(results["noise"].get("rows", []), chosen)):
        results["noise"] = _with(results["noise"], "rows", noise(scale, missing))
        _save(arguments.out, results)
    rooms = ""
    if find_spec("torch"):
        import trials_rooms  # needs it

        if asked("rooms") and not results.get("rooms"):
            found = trials_rooms.tried(8 if arguments.quick else 1)
            results["rooms"] = {**about(), "rows": found}
            _save(arguments.out, results)
        rooms = trials_rooms.table(results.get("rooms", {}).get("rows", []))
    cells = [Cell(**cell) for _, trial in every for cell in results["trials"].get(trial.__name__, {}).get("cells", [])]
    cells += cells_of_rooms(results.get("rooms", {})) if rooms else []
    texts = {"origin": origin(results), "table": table(cells),
             "noise": noise_table(results["noise"].get("rows", [])), "red": red_list(cells),
             "rooms": rooms}
    if arguments.page:
        fill(arguments.page, texts)
    print("\n\n".join(texts.values()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
