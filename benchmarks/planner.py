# SPDX-License-Identifier: GPL-3.0-or-later
"""The planner's regret: time of its plan over that of the cheapest plan that meets the tolerance; `make planner`.

Every method of the table is run on every mesh of ../shared/meshes/validation (or --folder), on one thread, and timed by
the processor, which other work on the machine disturbs least: those that trace with each of RAYS, and to the tolerance;
the others as they are. The cheapest may also be what was planned. That meets the tolerance whose error (at most 2,000
of the points) is no more. The error is the product of the differences
from two references of 2,048 rays with seeds of their own: so their noise, which a single one would add to what is
measured, cancels. The planner's own time has everything in it: its pilot, its looks for what blocks and inside faces. A
pilot may cost 50 ms or a tenth of the plan: the second regret leaves out so much of these. As in Blender, the machine
is calibrated first, and what bakes take is learned from; at the end that is printed, and what they took of it.

With --bands: the planner beside itself when it is held to bake all bands of --order, instead of the candidates; errors
are those over all these bands.
"""
from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from meshes import FOLDER, read
from numpy.typing import NDArray

from neural_gash_addon.backend import auto_bake, costs, methods, sparse_bake
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.pilot import DENSE
from neural_gash_addon.backend.plan import Plan
from neural_gash_addon.backend.transfer import Transfer

TOLERANCES = (0.2, 0.1, 0.05, 0.02, 0.01)
REFERENCE_RAYS, POINTS = 2048, 2000
RAYS = (2, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
FEW_POINTS = 4 * sparse_bake.FEWEST  # with less, a sparse bake is a ray-traced one
QUICK, QUICK_RUNS = 0.1, 5  # seconds of all runs
FREE_SECONDS, FREE_SHARE = 0.05, 0.1  # that a pilot may cost, whichever is more


def relative(found: NDArray, truth: Sequence[NDArray]) -> float:
    """Relative L2 error (n, k) against two references (n, K) whose noise is independent; bands that lack are zero."""
    one, two = truth
    found = sh.padded(found, one.shape[1])
    squared = float(((found - one) * (found - two)).sum())
    return (max(squared, 0.0) / float((one * two).sum())) ** 0.5


def timed(mesh: TriangleMesh, rows: NDArray, truth: Sequence[NDArray], method: str, repeats: int, **wish: float
          ) -> tuple[float, float, Transfer]:
    """Processor seconds (the least of some runs), true error and outcome of a bake."""
    order = sh.order_of(truth[0].shape[1])
    times: list[float] = []
    while _again(times, repeats):
        began = time.process_time()
        found = methods.run(methods.bake(mesh, method, order, threads=1, **wish))
        times.append(time.process_time() - began)
    return min(times), relative(found.coefficients[rows], truth), found


def looked(mesh: TriangleMesh, rows: NDArray, truth: Sequence[NDArray], repeats: int, tolerance: float
           ) -> tuple[float, float, float, Transfer]:
    """As `timed`, of the planner; second: what its looks take (and the scene, if the plan wants none)."""
    runs: list[tuple[float, float]] = []
    order = sh.order_of(truth[0].shape[1])
    while _again([spent for spent, _ in runs], repeats):
        looks, scenes = [0.0], [0.0]
        with patch.object(auto_bake, "planned", _clocked(auto_bake.planned, looks)), \
                patch.object(auto_bake.advice, "inside_faces", _clocked(auto_bake.advice.inside_faces, looks)), \
                patch.object(auto_bake, "Occluders", _clocked_at_once(auto_bake.Occluders, scenes)):
            began = time.process_time()
            found = methods.run(methods.bake(mesh, "auto", order, threads=1, tolerance=tolerance))
            spent = time.process_time() - began
        runs.append((spent, sum(looks) - (sum(scenes) if found.record.method != "analytic" else 0)))
    spent, pilot = min(runs)
    return spent, pilot, relative(found.coefficients[rows], truth), found


def _again(times: Sequence[float], repeats: int) -> bool:
    """Whether to run once more: as often as was asked for, and what is quick up to QUICK_RUNS times."""
    return len(times) < repeats or (sum(times) < QUICK and len(times) < QUICK_RUNS)


def _clocked(work: Callable[..., Generator], times: list[float]) -> Callable[..., Generator]:
    """The same generator, whose processor time is kept."""
    def clocked(*arguments: object, **named: object) -> Generator:
        began = time.process_time()
        found = yield from work(*arguments, **named)
        times.append(time.process_time() - began)
        return found
    return clocked


def _clocked_at_once(work: Callable, times: list[float]) -> Callable:
    """The same function, whose processor time is kept."""
    def clocked(*arguments: object) -> object:
        began = time.process_time()
        found = work(*arguments)
        times.append(time.process_time() - began)
        return found
    return clocked


def meshes(arguments: argparse.Namespace) -> Iterator[tuple[str, TriangleMesh, NDArray, list[NDArray]]]:
    """Name, mesh, points at which errors are measured (n,), and two references (n, K) of each file."""
    for path in sorted(p for p in arguments.folder.glob("*.ply") if any(o in p.stem for o in arguments.only)):
        mesh = read(path)
        rows = np.random.default_rng(5).choice(len(mesh.points), min(POINTS, len(mesh.points)), replace=False)
        few = replace(mesh, points=mesh.points[rows], normals=mesh.normals[rows], clearance=mesh.clearance[rows])
        truth = [methods.run(methods.bake(few, "embree", arguments.order, rays=REFERENCE_RAYS, seed=seed)
                             ).coefficients.astype(np.float64) for seed in (99, 98)]
        yield path.stem, mesh, rows, truth


def regret(arguments: argparse.Namespace) -> None:
    """The planner beside every candidate."""
    print(f"Order {arguments.order}, one thread, processor seconds.\n\n| mesh | vertices | tolerance | plan | s | "
          "error | pilot s | cheapest | s | regret | less the pilot |\n|---|---|---|---|---|---|---|---|---|---|---|",
          flush=True)
    regrets: dict[float, list[tuple[float, float]]] = {tolerance: [] for tolerance in arguments.tolerances}
    misses: list[float] = []
    lowered = 0
    for stem, mesh, rows, truth in meshes(arguments):
        tracing = [entry.name for entry in methods.METHODS.values() if entry.traces and not entry.plans
                   and (entry.name != "sparse" or len(mesh.points) >= FEW_POINTS)]
        wishes: list[tuple[str, dict[str, int]]] = [(name, {"rays": rays}) for name in tracing for rays in RAYS]
        wishes += [(entry.name, {}) for entry in methods.METHODS.values() if not entry.traces]
        fixed = []
        for name, wish in wishes:
            with suppress(UserError):  # it does not give this order, or there is no torch
                fixed.append((" ".join([name, *map(str, wish.values())]),
                              *timed(mesh, rows, truth, name, arguments.repeats, **wish)[:2]))
        for tolerance in arguments.tolerances:
            tried = fixed + [(name, *timed(mesh, rows, truth, name, arguments.repeats, tolerance=tolerance)[:2])
                             for name in tracing]
            spent, pilot, error, found = looked(mesh, rows, truth, arguments.repeats, tolerance)
            misses.append(error / tolerance)
            lowered += found.record.order < arguments.order
            tried.append(("planned", spent, error))
            met = [(seconds, name) for name, seconds, wrong in tried if wrong <= tolerance]
            least, name = min(met) if met else (float("nan"), "none")
            free = min(pilot, max(FREE_SECONDS, FREE_SHARE * (spent - pilot)))
            regrets[tolerance].append((spent / least, (spent - free) / least))
            print(f"| {stem} | {len(mesh.points):,} | {tolerance:.0%} | {_plan(found)} | {spent:.3f} | {error:.2%} | "
                  f"{pilot:.3f} | {name} | {least:.3f} | {spent / least:.2f} | {(spent - free) / least:.2f} |",
                  flush=True)
    print("\n| tolerance | cases | median regret | 90th percentile | less the pilot: median | 90th percentile |\n"
          "|---|---|---|---|---|---|")
    for label, values in [*((f"{t:.0%}", r) for t, r in regrets.items()), ("all", sum(regrets.values(), []))]:
        known = np.array(values).reshape(-1, 2)
        known = known[np.isfinite(known[:, 0])]
        if len(known):
            figures = np.percentile(known, (50, 90), axis=0).T.ravel()
            print(f"| {label} | {len(known)} | " + " | ".join(f"{figure:.2f}" for figure in figures) + " |")
    print(f"\n{_missed(misses)} A lower order was baked in {lowered}.")


@contextmanager
def expecting() -> Iterator[None]:
    """On a machine that is calibrated; prints at the end what bakes took of what plans expected."""
    ratios: dict[str, list[float]] = {}
    real = costs.learn

    def known() -> dict[str, float]:
        return {**costs.factors(1, DENSE), **costs.factors(1)}  # of sparse bakes, that of dense meshes

    def learn(plan: Plan, threads: int, taken: float) -> None:
        if plan.seconds:
            ratios.setdefault(plan.method, []).append(taken / plan.seconds)
        real(plan, threads, taken)

    with tempfile.TemporaryDirectory() as folder, patch.object(costs, "learn", learn), \
            patch.object(time, "perf_counter", time.process_time):
        costs.keep_in(Path(folder) / "costs.json")
        methods.run(costs.ways(methods.candidates(), 1, 1 << 20))
        before = known()
        yield
    print("\n| method | plans | taken over expected: median | 10th percentile | 90th | factor at first | in the end |\n"
          "|---|---|---|---|---|---|---|")
    for method, values in sorted(ratios.items()):
        few, half, many = np.percentile(values, (10, 50, 90))
        print(f"| {method} | {len(values)} | {half:.2f} | {few:.2f} | {many:.2f} | {before.get(method, 1):.2f} | "
              f"{known().get(method, 1):.2f} |")


def bands(arguments: argparse.Namespace) -> None:
    """The planner beside itself held at the order."""
    print(f"Order {arguments.order}, one thread, processor seconds.\n\n| mesh | vertices | tolerance | all bands | s | "
          "error | order | plan | s | error | said | time |\n|---|---|---|---|---|---|---|---|---|---|---|---|",
          flush=True)
    ratios: dict[float, list[tuple[int, float, float, float, float]]] = {t: [] for t in arguments.tolerances}
    for stem, mesh, rows, truth in meshes(arguments):
        for tolerance in arguments.tolerances:
            held, wrong, every = timed(mesh, rows, truth, "auto", arguments.repeats, tolerance=tolerance, whole=True)
            spent, error, found = timed(mesh, rows, truth, "auto", arguments.repeats, tolerance=tolerance)
            ratios[tolerance].append((found.record.order, spent, held, error / tolerance, wrong / tolerance))
            print(f"| {stem} | {len(mesh.points):,} | {tolerance:.0%} | {_plan(every)} | {held:.3f} | {wrong:.2%} | "
                  f"{found.record.order} | {_plan(found)} | {spent:.3f} | {error:.2%} | "
                  f"{found.record.error_estimate or 0:.2%} | {spent / held:.2f} |", flush=True)
    print("\n| tolerance | meshes | of a lower order | their orders | their time beside all bands: median | most | "
          "tolerance missed | at worst | with all bands |\n|---|---|---|---|---|---|---|---|---|")
    for tolerance, cases in ratios.items():
        low = [case for case in cases if case[0] < arguments.order]
        times = [spent / held for _, spent, held, _, _ in low] or [float("nan")]
        orders = ", ".join(f"{sum(case[0] == n for case in low)} of {n}" for n in range(2, arguments.order))
        print(f"| {tolerance:.0%} | {len(cases)} | {len(low)} | {orders} | {np.median(times):.2f} | {max(times):.2f} | "
              f"{sum(case[3] > 1 for case in cases)} | {max(case[3] for case in cases):.2f} | "
              f"{sum(case[4] > 1 for case in cases)} |")


def _plan(found: Transfer) -> str:
    return found.record.method + (f" {found.record.rays_per_point:.0f}" if found.record.rays else "")


def _missed(misses: Sequence[float]) -> str:
    """misses: errors over tolerances."""
    missed = sum(m > 1 for m in misses)
    return (f"Tolerance missed in {missed} of {len(misses)} cases ({missed / max(len(misses), 1):.0%}), at worst "
            f"{max(misses, default=0):.2f} times.")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER / "validation")
    parser.add_argument("--only", nargs="*", default=[""], help="files whose name has one of these in it")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--order", type=int, default=3)
    parser.add_argument("--tolerances", type=float, nargs="*", default=TOLERANCES)
    parser.add_argument("--bands", action="store_true", help="beside itself with all bands")
    arguments = parser.parse_args()
    with expecting():
        (bands if arguments.bands else regret)(arguments)


if __name__ == "__main__":
    main()
