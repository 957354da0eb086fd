# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the light-transport embedding is right and where it is not, each beside the mean of the nearest scene points.

`python benchmarks/embedding_scenes.py`: errors against scene points, paths and k on the labelled rooms of the split
evaluation (its paper's Table 4); edits that it follows without training anew; the trials of `trials_rooms`.
"""
from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import trials_rooms
from trials_rooms import NEAR, Answers, asked, both, error, furnished, lit

from neural_gash_addon.backend import embedding_bake
from neural_gash_addon.backend.lit_points import LitPoints
from neural_gash_addon.backend.lit_scene import LitScene
from neural_gash_addon.backend.nearest import nearest_to
from training import embedding as judging
from training import room_labels

COUNTS, PATHS, NEIGHBOURS = (1024, 2048, 4096, 8192, 0), (16, 64, 256), (4, 8, 16, 32)


def sizes(model, jobs: Sequence[room_labels.Job]) -> None:
    """Tables against scene points, paths, and k: median of the rooms."""
    kept = [(room_labels.scene_of(job), judging.load(room_labels.CACHE / job.file_name(), model.settings))
            for job in jobs]
    rows = judging.held_rows(kept[0][1])

    def table(name: str, values: Sequence[int], give: Callable[[int, LitScene, judging.Sample], LitPoints]) -> None:
        print(f"\n| {name} | network | mean of {NEAR} nearest |\n|---|---|---|")
        for value in values:
            found = [[error(light, sample.truth[rows], sample.noise[rows])
                      for light in both(model, give(value, scene, sample), sample.queries[rows], sample.asked[rows])]
                     for scene, sample in kept]
            medians = " | ".join(f"{median:.3f}" for median in np.median(found, 0))
            print(f"| {f'{value:,}' if value else 'by area'} | {medians} |", flush=True)

    table("scene points", COUNTS, lambda count, scene, _: lit(scene, count or None))
    table("paths of a scene point", PATHS, lambda paths, scene, _: lit(scene, paths=paths))
    print("\n| k | network |\n|---|---|")
    for k in NEIGHBOURS:
        found = []
        for _, sample in kept:
            near = nearest_to(sample.queries[:, :3], sample.points[:len(sample.layout.around), :3], k)
            light = judging.network(model, replace(sample, near=near))
            found.append(error(light, sample.truth[rows], sample.noise[rows]))
        print(f"| {k} | {np.median(found):.3f} |", flush=True)


def edits(model) -> None:
    """Error before and after each, and that of what was right before."""
    print("\n| edit | before | after | of the answer before |\n|---|---|---|---|")
    base = furnished()
    for name, scene in {"lamp moved by 3 m": furnished(lamp_at=(3.8, 3.0, 1.6)),
                        "block moved by 2.6 m": furnished(block_at=(1.0, 1.2, 0)),
                        "floor from grey to green": furnished(floor=(0.1, 0.7, 0.15))}.items():
        queries = asked(scene)
        old, new = Answers(model, base, queries), Answers(model, scene, queries)
        print(f"| {name} | {old.off(old.network):.3f} | {new.off(new.network):.3f} | {new.off(old.network):.3f} |",
              flush=True)


def main() -> None:
    """All tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=8, help="labelled ones of the split evaluation")
    parser.add_argument("--only", choices=["sizes", "edits", "trials"])
    arguments = parser.parse_args()
    import torch

    torch.set_num_threads(1)
    model = embedding_bake.network()
    if arguments.only in (None, "sizes"):
        sizes(model, room_labels.evaluation(arguments.rooms, None, room_labels.VALIDATION_RAYS))
    if arguments.only in (None, "edits"):
        edits(model)
    if arguments.only in (None, "trials"):
        print("\n" + trials_rooms.table(trials_rooms.tried()))


if __name__ == "__main__":
    main()
