# SPDX-License-Identifier: GPL-3.0-or-later
"""Networks beside Embree with few rays, on meshes that nothing was tuned on; per mesh, per category and over all.

`.venv/bin/python benchmarks/networks.py` reads ../shared/meshes/validation, or --folder.
"""
from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from meshes import FOLDER, read
from table import Table, processor_seconds, seconds

from neural_gash_addon.backend import conformal, methods, metrics, sight, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.backend.workers import default_threads
from training import labels
from training.paper import accuracy

ORDER, REFERENCE_RAYS, REPEATS = 3, 2048, 3
RAYS = (4, 8, 16, 32)  # of Embree, beside
ENOUGH = 1.0           # seconds of a bake that is not repeated
MOST_SRR, MOST_OVER, MOST_COST = 0.35, 1.05, 15.0  # asked for: over all, on the worst mesh, µs a vertex
LEAST_ACCURACY = 0.8   # and of the paper's visibilities, on organic meshes

NETWORKS = [name for name, method in methods.METHODS.items() if name != "analytic" and not method.traces]
COLUMNS: list[tuple[str, int | None]] = [*((name, None) for name in NETWORKS), *(("embree", rays) for rays in RAYS)]


def label(method: str, rays: int | None) -> str:
    """A column's heading."""
    return method if rays is None else f"{method} {rays}"


def visibility_accuracy(mesh: TriangleMesh) -> float:
    """Of stage 1 of `gnn-paper`: the mean of the shares of free and of blocked rays that it finds to be so."""
    import torch

    from neural_gash_addon.backend.networks import paper

    network = paper.TwoStage()
    network.load_state_dict({name: torch.from_numpy(array.copy()) for name, array
                             in weights.load(weights.FOLDER / "gnn-paper.safetensors").items()})
    parts = sight.places(mesh.points, mesh.normals).sights()
    with torch.no_grad():
        logits = torch.cat([network.eval().visibility.ask(sight.Sight(*map(torch.from_numpy, part))) for part in parts])
    scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    truth = labels.visible(mesh, scene, conformal.hemisphere_directions(), labels.motor_frames)
    return accuracy(logits > 0, torch.from_numpy(truth))


def measure(mesh: TriangleMesh, unshadowed: np.ndarray, reference: np.ndarray,
            timed: Callable[[Callable[[], object]], float] = seconds
            ) -> tuple[dict[str, float], dict[str, float], dict[str, np.ndarray]]:
    """SRR, µs a vertex (least of REPEATS, in turns), and errors (N, K) of the networks."""
    errors, spent, residuals = {}, {label(*column): [] for column in COLUMNS}, {}
    for repeat in range(REPEATS):
        for method, rays in COLUMNS:
            if max(spent[label(method, rays)], default=0.0) > ENOUGH:
                continue
            kept: list[np.ndarray] = []
            baking = methods.bake(mesh, method, ORDER, rays=rays, seed=repeat)
            spent[label(method, rays)].append(
                timed(lambda baking=baking, kept=kept: kept.append(methods.run(baking).coefficients)))
            errors[label(method, rays)] = metrics.srr(kept[0], reference, unshadowed)
            if rays is None:
                residuals[method] = kept[0] - reference
    return errors, {name: 1e6 * min(times) / len(mesh.points) for name, times in spent.items()}, residuals


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER / "validation")
    parser.add_argument("--only", help="files whose name has this in it")
    parser.add_argument("--processor", action="store_true",
                        help="processor time, as it would pass on both threads of a machine that nobody else uses")
    parser.add_argument("--network", choices=tuple(NETWORKS), nargs="+", help="of them these alone")
    arguments = parser.parse_args()
    timed = partial(processor_seconds, threads=default_threads()) if arguments.processor else seconds
    if arguments.network:
        NETWORKS[:] = arguments.network
        COLUMNS[:] = [column for column in COLUMNS if column[0] in ("embree", *NETWORKS)]
    categories = {}
    if (FOLDER / "MANIFEST.csv").is_file():
        with (FOLDER / "MANIFEST.csv").open(newline="") as file:
            categories = {Path(row["file"]).stem: row["category"] for row in csv.DictReader(file)}
    names = [label(*column) for column in COLUMNS]
    print(f"Order {ORDER}, {default_threads()} threads; SRR against {REFERENCE_RAYS} rays with a seed of their own "
          "(1: no better than without shadows), and µs a vertex, all included.\n")
    print("| mesh | category | vertices | " + " | ".join(f"{n} SRR" for n in names) + " | "
          + " | ".join(f"{n} µs" for n in names) + " |")
    print("|---" * (3 + 2 * len(names)) + "|", flush=True)
    found: list[tuple[str, dict[str, float], dict[str, float], dict[str, np.ndarray]]] = []
    seen: dict[str, list[float]] = {}
    for path in sorted(arguments.folder.glob("*.ply")):
        if arguments.only and arguments.only not in path.stem:
            continue
        mesh = read(path)
        unshadowed = sh.cosine_lobe(mesh.normals, ORDER)
        reference = methods.run(methods.bake(mesh, "embree", ORDER, rays=REFERENCE_RAYS, seed=77)).coefficients
        errors, costs, residuals = measure(mesh, unshadowed, reference, timed)
        category = categories.get(path.stem, "")
        found.append((category, errors, costs, residuals))
        if "gnn-paper" in NETWORKS:
            seen.setdefault(category, []).append(visibility_accuracy(mesh))
        print(f"| {path.stem} | {category} | {len(mesh.points):,} | " + " | ".join(f"{errors[n]:.4f}" for n in names)
              + " | " + " | ".join(f"{costs[n]:.1f}" for n in names) + " |", flush=True)
    for category in [*sorted({c for c, *_ in found}), ""]:
        rows = [row for row in found if not category or row[0] == category]
        print(f"| median | {category or 'all'} | {len(rows)} meshes | "
              + " | ".join(f"{np.median([r[1][n] for r in rows]):.4f}" for n in names) + " | "
              + " | ".join(f"{np.median([r[2][n] for r in rows]):.1f}" for n in names) + " |")
    table = Table()
    for name in NETWORKS:
        table.heading(name, "Over all meshes.")
        values = [errors[name] for _, errors, _, _ in found]
        table.add("SRR, mean", "", "", float(np.mean(values)), MOST_SRR, unit="", most=True)
        table.add("SRR, median", "", "", float(np.median(values)), unit="")
        table.add("SRR, worst mesh (1 is `analytic`)", "", "", max(values), MOST_OVER, unit="", most=True)
        costs = [cost[name] for _, _, cost, _ in found]
        table.add("µs a vertex, median", "", "", float(np.median(costs)), MOST_COST, unit=" µs", most=True)
        table.add("µs a vertex, dearest mesh", "", "", max(costs), unit=" µs")
    table.heading("Visibility of gnn-paper", "Balanced accuracy, mean over the meshes of a category (figure 11).")
    for category, values in sorted(seen.items()):
        table.add(category or "all", "", "", float(np.mean(values)),
                  LEAST_ACCURACY if category == "organic" else None, unit="")
    print("\nError of each coefficient over all vertices of all meshes (the paper's figures 9 and 10):\n")
    print("| network | measure | " + " | ".join(str(k) for k in range(ORDER ** 2)) + " |")
    print("|---" * (2 + ORDER ** 2) + "|")
    for name in NETWORKS:
        every = np.concatenate([residuals[name] for *_, residuals in found])
        print(f"| {name} | MSE | " + " | ".join(f"{v:.5f}" for v in np.square(every).mean(0)) + " |")
        print(f"| {name} | standard deviation | " + " | ".join(f"{v:.4f}" for v in every.std(0)) + " |")


if __name__ == "__main__":
    main()
