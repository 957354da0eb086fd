# SPDX-License-Identifier: GPL-3.0-or-later
"""The sparse bake on dense meshes: how its time grows with the vertices, and beside a bake of every vertex.

`.venv/bin/python benchmarks/sparse.py` (some minutes; `--sizes 100000 1000000` for fewer). A knot of any density that
shadows itself, ripples and all. Seconds are of wall clock, and of the processor (both threads), which other work on the
machine disturbs less. The error is against a reference of its own at 4,000 of the points.
"""
from __future__ import annotations

import argparse
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from meshes import knot
from numpy.typing import NDArray
from table import machine

from neural_gash_addon.backend import methods, metrics
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.workers import default_threads

SIZES = (100_000, 250_000, 500_000, 1_000_000, 2_000_000)
ORDER = 3


def timed(mesh: TriangleMesh, method: str, tolerance: float, rows: NDArray, truth: NDArray
          ) -> tuple[float, float, float, float, float]:
    """Wall and processor seconds, true and estimated error, and rays a point of a bake."""
    wall, spent = time.perf_counter(), time.process_time()
    found = methods.run(methods.bake(mesh, method, ORDER, tolerance=tolerance))
    wall, spent = time.perf_counter() - wall, time.process_time() - spent
    record = found.record
    return (wall, spent, metrics.rel_l2(found.coefficients[rows], truth), record.error_estimate or 0.0,
            (record.rays + record.probe_rays) / record.points)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--tolerance", type=float, default=0.05)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--beside", type=int, default=1_000_000, help="vertices at which every vertex is baked, too")
    arguments = parser.parse_args()
    print(machine(default_threads()) + f"\n\nOrder {ORDER}, tolerance {arguments.tolerance:.0%}; medians of "
          f"{arguments.repeats}, taken in turns.\n\n| vertices | method | wall s | processor s | error | estimated | "
          "rays a point |\n|---|---|---|---|---|---|---|", flush=True)
    sparse: list[tuple[int, float, float]] = []
    for size in arguments.sizes:
        positions, triangles = knot(size)
        mesh = TriangleMesh.from_triangles(positions, triangles)
        rows = np.random.default_rng(5).choice(len(mesh.points), min(4000, len(mesh.points)), replace=False)
        few = replace(mesh, points=mesh.points[rows], normals=mesh.normals[rows], clearance=mesh.clearance[rows])
        truth = methods.run(methods.bake(few, "embree", ORDER, rays=1024, seed=99)).coefficients
        names = ("sparse", "hybrid", "embree") if size == arguments.beside else ("sparse",)
        runs: dict[str, list[tuple[float, ...]]] = {name: [] for name in names}
        for _ in range(arguments.repeats):
            for name in names:
                runs[name].append(timed(mesh, name, arguments.tolerance, rows, truth))
        middle = {name: [statistics.median(column) for column in zip(*found, strict=True)]
                  for name, found in runs.items()}
        for name, (wall, spent, error, said, rays) in middle.items():
            print(f"| {len(mesh.points):,} | {name} | {wall:.2f} | {spent:.2f} | {error:.1%} | {said:.1%} | "
                  f"{rays:.1f} |", flush=True)
        sparse.append((len(mesh.points), *middle["sparse"][:2]))
        for name in names[1:]:
            ratios = [statistics.median(b[k] / a[k] for a, b in zip(runs["sparse"], runs[name], strict=True))
                      for k in (0, 1)]
            print(f"| | {name} over sparse | {ratios[0]:.1f}x | {ratios[1]:.1f}x | | | |", flush=True)
    if len(sparse) > 1:
        size, *columns = np.log(np.array(sparse)).T
        powers = [np.polyfit(size, column, 1)[0] for column in columns]
        print(f"\nTime grows as vertices to the power {powers[0]:.2f} (wall), {powers[1]:.2f} (processor).")


if __name__ == "__main__":
    main()
