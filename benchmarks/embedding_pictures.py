# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance of rooms that the light-transport embedding has not seen, beside path tracing; as Table 1 of its paper.

`python benchmarks/embedding_pictures.py --rooms 4 --out docs`: a table, and embedding_rooms.png. From the left: 64
paths a pixel, as many as the network's time allows, the network, the reference. One thread, processor seconds; the
network's are of a whole bake: sampling and lighting the scene points, encoding, tracing direct light and what lies in
gaps, decoding, and measuring the error.
"""
from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from neural_gash_addon.backend import embedding, embedding_bake, irradiance, methods
from neural_gash_addon.backend.embedding_bake import STRAIGHT
from neural_gash_addon.backend.lit_points import lit_points
from training import embedding as judging
from training import room_labels, room_views

REFERENCE, USUAL = 2048, 64  # paths


def ssim(one: NDArray, other: NDArray) -> float:
    """Wang et al. 2004, of pictures (H, W, C) in [0, 1]: Gaussian windows of deviation 1.5, mean over all."""
    def mean(image: NDArray) -> NDArray:
        return gaussian_filter(image, (1.5, 1.5, 0), truncate=3.5)

    a, b = mean(one), mean(other)
    variances = mean(one ** 2) - a ** 2 + mean(other ** 2) - b ** 2
    both = mean(one * other) - a * b
    return float(((2 * a * b + 1e-4) * (2 * both + 9e-4) / ((a ** 2 + b ** 2 + 1e-4) * (variances + 9e-4))).mean())


def timed(make: Callable[[], NDArray]) -> tuple[NDArray, float]:
    """What a function gives, and the processor seconds that it takes."""
    began = time.process_time()
    made = make()
    return made, time.process_time() - began


def main() -> None:
    """Print the table, write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=4, help="of the split evaluation, after the Cornell box")
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--reference", type=int, default=REFERENCE, help="paths")
    parser.add_argument("--out", type=Path, default=Path("out"))
    arguments = parser.parse_args()
    import torch
    from matplotlib.image import imsave

    torch.set_num_threads(1)
    sizes = embedding_bake.network().settings
    strips, sums = [], {}
    print("| room | light | s | MSE | SSIM | rel. MSE |\n|---|---|---|---|---|---|")
    for job in room_labels.evaluation(arguments.rooms, None, REFERENCE):
        scene, cornell = room_labels.scene_of(job), job.seed == room_labels.CORNELL
        occluders = scene.occluders()
        width, height = arguments.width, arguments.width * 3 // 4
        where = room_views.CORNELL if cornell else room_views.camera(scene, job.seed, occluders)
        seen = room_views.view(scene, *where, width, height, occluders)
        places, normals = seen.queries[:, :3], seen.queries[:, 3:6]

        def traced(rays: int, start: int, scene=scene, places=places, normals=normals, occluders=occluders, **how
                   ) -> NDArray:
            return methods.run(irradiance.irradiance(scene, places, normals, rays, seed=start, threads=1,
                                                     occluders=occluders, **how)).values

        def asked(scene=scene, places=places, normals=normals, occluders=occluders) -> NDArray:
            return methods.run(embedding_bake.irradiance(scene, places, normals, seed=4, threads=1,
                                                         occluders=occluders)).values

        def untrained(seen=seen, places=places, scene=scene, occluders=occluders, traced=traced) -> dict[str, NDArray]:
            points, direct = methods.run(lit_points(scene, occluders, threads=1)), traced(STRAIGHT, 4, depth=1)
            every = np.concatenate([points.places, points.normals, points.albedo, points.emission], 1)
            sample = judging.Sample(every, points.direct, points.indirect[None], seen.queries, None, None, None,
                                    embedding.layout(points.places, sizes.halvings, sizes.gathered, sizes.around), None,
                                    None, None)
            return {name: direct + give(sample, np.arange(len(places))) for name, give in judging.BASELINES.items()}

        truth = traced(arguments.reference, 1)
        usual, usual_seconds = timed(lambda traced=traced: traced(USUAL, 2))
        found, seconds = timed(asked)
        rays = max(8, 8 * round(USUAL * seconds / usual_seconds / 8))
        equal, equal_seconds = timed(lambda rays=rays, traced=traced: traced(rays, 3))
        exposed = 2.5 * float(np.median(truth.mean(1)))

        def shown(light: NDArray, seen=seen, exposed=exposed) -> NDArray:
            scaled = seen.image(light) / exposed
            return np.clip(1.25 * scaled / (1 + scaled), 0, 1) ** (1 / 2.2)

        strips.append(np.concatenate([shown(light) for light in (usual, equal, found, truth)], 1))
        for name, light, spent in ((f"{USUAL} paths", usual, usual_seconds), ("paths, same time", equal, equal_seconds),
                                   ("network", found, seconds),
                                   *((f"direct and {name}", light, float("nan"))
                                     for name, light in untrained().items())):
            row = (spent, float(np.square(shown(light) - shown(truth)).mean()), ssim(shown(light), shown(truth)),
                   float(np.square(light - truth).sum() / np.square(truth).sum()))
            sums.setdefault(name, []).append(row)
            label = f"{rays} {name}" if light is equal else name
            print(f"| {job.seed} | {label} | " + " | ".join(f"{value:.4g}" for value in row) + " |", flush=True)
    for name, found_rows in sums.items():
        print(f"| mean | {name} | " + " | ".join(f"{value:.4g}" for value in np.mean(found_rows, 0)) + " |")
    arguments.out.mkdir(parents=True, exist_ok=True)
    imsave(arguments.out / "embedding_rooms.png", np.concatenate(strips).clip(0, 1))


if __name__ == "__main__":
    main()
