# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that bounces, by the embedding and by rays from each point: error of the bounced part against time.

`.venv/bin/python benchmarks/embedding_bounces.py [--meshes 10]` reads ../shared/meshes/validation, or --folder; each
mesh in colours, often on a floor and among walls (`training.bounce_labels.dressed`). Both have the same solution on
patches, whose time is not counted. One thread, processor seconds. The truth is two solutions of their own, with 1,024
rays at 1,000 vertices, whose noise is taken out.
"""
from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from neural_gash_addon.backend import sky_bake
from neural_gash_addon.backend.bounce import Bounces
from neural_gash_addon.backend.progress import run
from neural_gash_addon.backend.raycast import Occluders
from training import bounce_labels, labels
from training.data import read

ORDER, JUDGED, TRUTH_RAYS = 3, 1000, 1024
RAYS = (1, 4, 16, 64)
FOLDER = Path(__file__).resolve().parents[2] / "shared" / "meshes" / "validation"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--meshes", type=int, default=10)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model, decoder = sky_bake.network(), sky_bake.reflecting()
    sky_bake.reflecting = lambda: decoder  # read once
    columns = [f"{rays} rays" for rays in RAYS] + ["embedding"]
    print(f"{'mesh':24}{'points':>8}{'solution, s':>12}{'mean':>7}" + "".join(f"{c:>16}" for c in columns)
          + "   relative L2 and µs a point; the embedding also: s of scene points, with their encoding")
    found = []
    for path in sorted(arguments.folder.glob("*.ply"))[:arguments.meshes]:
        positions, triangles = read(path)
        scene = bounce_labels.dressed(labels.shaded(labels.normalised(positions), triangles, None), path.stem)
        occluders = Occluders(scene.parts, scene.mesh.resolution)

        def solved(seed: int, scene: bounce_labels.Scene = scene, occluders: Occluders = occluders) -> Bounces:
            made = Bounces(scene.parts, scene.albedo, occluders, ORDER, seed, 1)
            run(made.solve(scene.bounces))
            return made

        few = bounce_labels.some(scene.mesh, JUDGED, 1)
        one, two = (run(solved(seed).gather(few, TRUTH_RAYS)).astype(float) for seed in (100, 101))
        energy = float((one * two).sum())
        began = time.process_time()
        solution = solved(0)
        cells = [time.process_time() - began]
        line = f"{path.stem:24}{len(scene.mesh.points):8,}{cells[0]:12.2f}{(4 * np.pi) ** 0.5 * one[:, 0].mean():7.3f}"
        many = bounce_labels.some(scene.mesh, 16_384, 2)
        row = []
        for rays in RAYS:
            given = run(solution.gather(few, rays, 5)).astype(float)
            began = time.process_time()
            run(solution.gather(many, rays, 6))
            row.append((_relative(given, one, two, energy), 1e6 * (time.process_time() - began) / len(many.points)))
        points = run(sky_bake.scene_points(scene.mesh, occluders, threads=1))
        sky = sky_bake.Sky(model, occluders, points)
        began = time.process_time()
        run(sky.seen(solution))
        fixed = time.process_time() - began
        given = sky._brought(sky._asked(few.points, few.normals), solution).astype(float)
        spent = 0.0
        for start in range(0, len(many.points), sky_bake.QUERIES_AT_ONCE):
            asked = sky._asked(many.points[start:start + sky_bake.QUERIES_AT_ONCE],
                               many.normals[start:start + sky_bake.QUERIES_AT_ONCE])
            began = time.process_time()  # who is near is known from what is blocked
            sky._brought(asked, solution)
            spent += time.process_time() - began
        row.append((_relative(given, one, two, energy), 1e6 * spent / len(many.points)))
        found.append([each for pair in row for each in pair] + [fixed])
        print(line + "".join(f"{error:9.3f}{cost:7.1f}" for error, cost in row) + f"{fixed:8.2f}", flush=True)
    middle = np.median(found, 0)
    print(f"{'median':51}" + "".join(f"{middle[2 * i]:9.3f}{middle[2 * i + 1]:7.1f}" for i in range(len(columns)))
          + f"{middle[-1]:8.2f}")


def _relative(given: np.ndarray, one: np.ndarray, two: np.ndarray, energy: float) -> float:
    return (max(float(((given - one) * (given - two)).sum()), 0.0) / energy) ** 0.5


if __name__ == "__main__":
    main()
