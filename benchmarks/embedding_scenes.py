# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the light-transport embedding is right and where it is not, each beside the mean of the nearest scene points.

`python benchmarks/embedding_scenes.py`: errors against scene points, paths and k on the labelled rooms of the split
evaluation (its paper's Table 4); edits that it follows without training anew; the failures that its paper names. Errors
are root mean squares over the root mean square of the truth, without what the truth's own noise adds.
"""
from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from neural_gash_addon.backend import embedding_bake, irradiance, methods
from neural_gash_addon.backend.embedding_bake import STRAIGHT
from neural_gash_addon.backend.lit_points import POINTS, REFLECTED, LitPoints, lit_points
from neural_gash_addon.backend.lit_scene import LitScene
from neural_gash_addon.backend.nearest import nearest_to
from training import embedding as judging
from training import room_labels, rooms
from training.floor_plans import shell
from training.rooms import Part
from training.solids import Mesh, ball, box, cylinder, merge, place

COUNTS, PATHS, NEIGHBOURS = (1024, 2048, 4096, 8192), (16, 64, 256), (4, 8, 16, 32)
TRUTH = 4096  # paths
NEAR = 64     # scene points of the mean
GREY, WHITE = (0.55, 0.55, 0.55), (0.75, 0.75, 0.75)


def lit(scene: LitScene, count: int = POINTS, paths: int = REFLECTED) -> LitPoints:
    """Of one thread."""
    return methods.run(lit_points(scene, scene.occluders(), count, paths, threads=1))


def both(model, points: LitPoints, queries: NDArray, direct: NDArray) -> tuple[NDArray, NDArray]:
    """Reflected light at queries (N, 9) by the network, and as the mean of scene points."""
    room = embedding_bake.Room(model, points)
    return (methods.run(room.reflected(queries[:, :3], queries[:, 3:6], direct)),
            judging.near_mean(queries, np.concatenate([points.places, points.normals], 1), points.indirect, NEAR))


def error(found: NDArray, truth: NDArray, noise: NDArray) -> float:
    """See the head of the file."""
    beyond = float((np.square(found - truth) - np.square(noise)).sum())
    return max(beyond, 0.0) ** 0.5 / float(np.square(truth).sum()) ** 0.5


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
            print(f"| {value:,} | {np.median(found, 0)[0]:.3f} | {np.median(found, 0)[1]:.3f} |", flush=True)

    table("scene points", COUNTS, lambda count, scene, _: lit(scene, count))
    table("paths of a scene point", PATHS, lambda paths, scene, _: lit(scene, POINTS, paths))
    print("\n| k | network |\n|---|---|")
    for k in NEIGHBOURS:
        found = []
        for _, sample in kept:
            near = nearest_to(sample.queries[:, :3], sample.points[:len(sample.layout.around), :3], k)
            light = judging.network(model, replace(sample, near=near))
            found.append(error(light, sample.truth[rows], sample.noise[rows]))
        print(f"| {k} | {np.median(found):.3f} |", flush=True)


# --- rooms to edit ---

def block(size: Sequence[float], at: Sequence[float], colour: Sequence[float] = GREY) -> Part:
    """A box that stands at a place."""
    return Part(place(box(size), (at[0], at[1], at[2] + size[2] / 2)), np.array(colour))


def lamp(at: Sequence[float], radius: float = 0.12) -> Part:
    """A ball that shines, 40 W in each channel."""
    return Part(place(ball(radius, 2), at), np.full(3, 0.6), np.full(3, 40 / (4 * np.pi ** 2 * radius ** 2)))


def walls(boxes: Sequence[Sequence[Sequence[float]]], floor: Sequence[float] = GREY, paint: Sequence[float] = WHITE,
          side: Sequence[float] = (0.7, 0.1, 0.08)) -> list[Part]:
    """Rooms (low, high) that open into each other; the walls that look along x have a colour of their own."""
    return [Part(mesh, np.array(floor if axis == 2 and up else side if axis == 0 and up else paint))
            for (_, axis, up), mesh in shell([np.array(each, float) for each in boxes]).items()]


ROOM = [((0, 0, 0), (5, 4, 2.6))]
TWO = [*ROOM, ((5.15, 0.5, 0), (9, 3.5, 2.6)), ((5, 1.5, 0), (5.15, 2.4, 2.0))]


def furnished(lamp_at: Sequence[float] = (1.2, 1.0, 2.0), block_at: Sequence[float] = (3.2, 2.6, 0),
              floor: Sequence[float] = GREY) -> LitScene:
    """What is edited."""
    return rooms.assembled([*walls(ROOM, floor), lamp(lamp_at), block((1, 0.8, 1.2), block_at, (0.2, 0.3, 0.6)),
                            block((1.4, 0.7, 0.05), (1.5, 3.2, 0.7)), block((0.1, 0.1, 0.7), (1.5, 3.2, 0))])


def shaded() -> Mesh:
    """A tube about a bulb."""
    outer, inner = cylinder(0.2, 0.3, 24), cylinder(0.18, 0.3, 24)
    sides = [(mesh[0], mesh[1][np.ptp(mesh[0][mesh[1]][..., 2], axis=1) > 0.1]) for mesh in (outer, inner)]
    return merge([sides[0], (sides[1][0], sides[1][1][:, ::-1])])


def asked(scene: LitScene, where: Callable[[NDArray], NDArray] | None = None) -> NDArray:
    """(n, 9) queries that can be seen, or those of many for which `where` holds."""
    found = room_labels.visible_points(scene, 512 if where is None else 20_000, 0, scene.occluders())
    return found if where is None else found[where(found)][:512]


class Answers:
    """All light at queries of a scene: the truth, the network's (as a bake has it, and alone), the mean of scene points."""

    def __init__(self, model, scene: LitScene, queries: NDArray) -> None:
        places, normals, occluders = queries[:, :3], queries[:, 3:6], scene.occluders()

        def traced(rays: int, seed: int, **how) -> irradiance.Irradiance:
            return methods.run(irradiance.irradiance(scene, places, normals, rays, seed=seed, threads=1,
                                                     occluders=occluders, **how))

        self.truth, direct = traced(TRUTH, 1), traced(STRAIGHT, 2, depth=1).values
        points = lit(scene)
        self.alone, self.mean = (direct + light for light in both(model, points, queries, direct))
        self.network = methods.run(embedding_bake.irradiance(scene, places, normals, seed=2, threads=1,
                                                             occluders=occluders,
                                                             room=embedding_bake.Room(model, points))).values
        self.paths = traced(128, 3).values

    def errors(self, *lights: NDArray) -> str:
        """Columns of a table."""
        return " | ".join(f"{error(light, self.truth.values, self.truth.error):.3f}" for light in lights)


def edits(model) -> None:
    """Error before and after each, and that of what was right before."""
    print("\n| edit | before | after | of the answer before |\n|---|---|---|---|")
    base = furnished()
    for name, scene in {"lamp moved by 3 m": furnished(lamp_at=(3.8, 3.0, 1.6)),
                        "block moved by 2.6 m": furnished(block_at=(1.0, 1.2, 0)),
                        "floor from grey to green": furnished(floor=(0.1, 0.7, 0.15))}.items():
        queries = asked(scene)
        old, new = Answers(model, base, queries), Answers(model, scene, queries)
        print(f"| {name} | {old.errors(old.network)} | {new.errors(new.network, old.network)} |", flush=True)


def failures(model) -> None:
    """Rows of what the paper says to fail."""
    print(f"\n| where | mean light | network | no gaps traced | mean of {NEAR} nearest | 128 paths |\n"
          "|---|---|---|---|---|---|")
    two = rooms.assembled([*walls(TWO), lamp((1.2, 1.0, 2.0)), block((1, 0.8, 1.2), (7.5, 2.6, 0))])
    low = rooms.assembled([*walls(ROOM), lamp((1.2, 1.0, 2.0)), block((1.6, 1.2, 0.5), (3.2, 2.2, 0.03))])
    bulb = rooms.assembled([*walls(ROOM), lamp((2.5, 2, 1.4), 0.05), Part(place(shaded(), (2.5, 2, 1.4)),
                                                                         np.array(WHITE))])
    glow = Part(place(ball(0.13, 3), (2, 2, 0.13)), np.array(GREY), np.full(3, 6.0))
    beneath = rooms.assembled([*walls(ROOM), lamp((1.2, 1.0, 2.0)), glow])
    red = rooms.assembled([*walls(ROOM, (0.9, 0.03, 0.03), (0.9, 0.03, 0.03), (0.03, 0.03, 0.9)), lamp((1.2, 1, 2))])

    def under(found: NDArray) -> NDArray:
        return (np.abs(found[:, 0] - 3.2) < 0.7) & (np.abs(found[:, 1] - 2.2) < 0.5) & (found[:, 2] < 0.031)

    for name, scene, where in (
            ("a furnished room", furnished(), None),
            ("the room beside the one with the lamp", two, lambda found: found[:, 0] > 5.15),
            ("in a gap of 3 cm below a block", low, under),
            ("beneath a ball that glows, and beside it", beneath,
             lambda found: (np.hypot(found[:, 0] - 2, found[:, 1] - 2) < 0.3) & (found[:, 2] < 0.01)),
            ("in a lampshade", bulb, lambda found: np.hypot(found[:, 0] - 2.5, found[:, 1] - 2) < 0.19),
            ("a red room with a blue wall", red, None)):
        found = Answers(model, scene, asked(scene, where))
        print(f"| {name} | {found.truth.values.mean():.3g} | "
              f"{found.errors(found.network, found.alone, found.mean, found.paths)} |", flush=True)


def main() -> None:
    """All tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=8, help="labelled ones of the split evaluation")
    parser.add_argument("--only", choices=["sizes", "edits", "failures"])
    arguments = parser.parse_args()
    import torch

    torch.set_num_threads(1)
    model = embedding_bake.network().cpu()
    if arguments.only in (None, "sizes"):
        sizes(model, room_labels.evaluation(arguments.rooms, None, room_labels.VALIDATION_RAYS))
    if arguments.only in (None, "edits"):
        edits(model)
    if arguments.only in (None, "failures"):
        failures(model)


if __name__ == "__main__":
    main()
