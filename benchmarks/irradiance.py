# SPDX-License-Identifier: GPL-3.0-or-later
"""How fast irradiance is path traced, beside Embree alone with the same rays; one thread, processor time.

`.venv/bin/python benchmarks/irradiance.py`: rooms of several seeds and the Cornell box, a table in Markdown.
"""
from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from neural_gash_addon.backend import irradiance, methods
from neural_gash_addon.backend.lit_scene import LitScene
from neural_gash_addon.backend.raycast import Occluders
from training import room_labels, rooms

POINTS, RAYS, ROUNDS = 512, 512, 5
SEEDS = (0, 3, 5, 10)


class Recorder:
    """Occluders that keep the rays they are asked for, or not."""

    def __init__(self, scene: LitScene) -> None:
        self.inner = scene.occluders()
        self.asked: list[tuple] = []
        self.keeps = False

    def __getattr__(self, name: str) -> object:
        return getattr(self.inner, name)

    def first(self, *rays: np.ndarray) -> tuple:
        """As Occluders.first."""
        if self.keeps:
            self.asked.append((Occluders.first, rays))
        return self.inner.first(*rays)

    def blocked(self, *rays: np.ndarray) -> np.ndarray:
        """As Occluders.blocked."""
        if self.keeps:
            self.asked.append((Occluders.blocked, rays))
        return self.inner.blocked(*rays)


def measure(scene: LitScene) -> tuple[float, float, int, int]:
    """Median seconds of path tracing and of its rays alone, in turns; segments and shadow rays."""
    recorder = Recorder(scene)
    asked = room_labels.visible_points(scene, POINTS, 0, recorder.inner)
    ours, theirs = [], []
    for turn in range(ROUNDS + 1):
        recorder.keeps = turn == 0
        began = time.process_time()
        methods.run(irradiance.irradiance(scene, asked[:, :3], asked[:, 3:6], RAYS, threads=1,
                                          occluders=recorder))  # type: ignore[arg-type]
        ours.append(time.process_time() - began)
        began = time.process_time()
        for query, rays in recorder.asked:
            query(recorder.inner, *rays)
        theirs.append(time.process_time() - began)
    counts = [sum(len(rays[0]) for query, rays in recorder.asked if query is kind)
              for kind in (Occluders.first, Occluders.blocked)]
    return float(np.median(ours[1:])), float(np.median(theirs[1:])), *counts


def main() -> None:
    """Print the table."""
    print("| scene | triangles | textures | paths a second | segments a second | rays a second | of Embree alone |")
    print("|---|---|---|---|---|---|---|")
    for name, scene in [*((f"room {seed}", rooms.generate(seed)) for seed in SEEDS), ("Cornell", rooms.cornell_box())]:
        seconds, embree, segments, shadows = measure(scene)
        paths = POINTS * RAYS
        print(f"| {name} | {len(scene.triangles):,} | {len(scene.pictures)} | {paths / seconds / 1e6:.2f} M | "
              f"{segments / seconds / 1e6:.2f} M | {(segments + shadows) / seconds / 1e6:.2f} M | "
              f"{embree / seconds:.2f} |")


if __name__ == "__main__":
    main()
