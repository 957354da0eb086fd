# SPDX-License-Identifier: GPL-3.0-or-later
"""Rooms lit from within, and where the light-transport embedding might fail in them (its paper's section 6).

Errors are root mean squares over the root mean square of the truth, without what the truth's own noise adds.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from neural_gash_addon.backend import embedding_bake, irradiance, methods
from neural_gash_addon.backend.embedding_bake import STRAIGHT
from neural_gash_addon.backend.lit_points import REFLECTED, LitPoints, lit_points
from neural_gash_addon.backend.lit_scene import LitScene
from training import embedding as judging
from training import room_labels, rooms
from training.floor_plans import shell
from training.rooms import Part
from training.solids import Mesh, ball, box, cylinder, merge, place

TRUTH = 4096  # paths
NEAR = 64     # scene points of the mean
QUERIES = 512
PATHS = 128   # from a query, of path tracing beside it
GREY, WHITE = (0.55, 0.55, 0.55), (0.75, 0.75, 0.75)
CALM = "a furnished room"  # undisturbed
COLUMNS = ("network, as a bake has it", "network alone", f"mean of {NEAR} nearest scene points", f"{PATHS} paths")


def lit(scene: LitScene, count: int | None = None, paths: int = REFLECTED) -> LitPoints:
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
    found = room_labels.visible_points(scene, QUERIES if where is None else 20_000, 0, scene.occluders())
    return found if where is None else found[where(found)][:QUERIES]


class Answers:
    """All light at queries of a scene: the truth, and what COLUMNS are of."""

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
        self.paths = traced(PATHS, 3).values

    def errors(self) -> list[float]:
        """Of COLUMNS."""
        return [self.off(light) for light in self._columns()]

    def worst(self) -> list[float]:
        """Of COLUMNS, of any query: how far it is off, over the root mean square of the truth."""
        truth = self.truth.values
        typical = float(np.square(truth).sum(1).mean()) ** 0.5
        return [float(np.linalg.norm(light - truth, axis=1).max()) / typical for light in self._columns()]

    def _columns(self) -> tuple[NDArray, ...]:
        return self.network, self.alone, self.mean, self.paths

    def off(self, light: NDArray) -> float:
        """Error of light (n, 3)."""
        return error(light, self.truth.values, self.truth.error)


def trials(scale: int = 1) -> dict[str, Callable[[], tuple[LitScene, NDArray]]]:
    """By name, a scene and a `scale`-th of its queries (n, 9): what the paper says to fail, and where things touch."""
    def found(scene: LitScene, where: Callable[[NDArray], NDArray] | None = None) -> tuple[LitScene, NDArray]:
        return scene, asked(scene, where)[:QUERIES // scale]

    def below(found: NDArray) -> NDArray:
        return (np.abs(found[:, 0] - 3.2) < 0.7) & (np.abs(found[:, 1] - 2.2) < 0.5) & (found[:, 2] < 0.031)

    def beside(found: NDArray) -> NDArray:
        return (np.hypot(found[:, 0] - 2, found[:, 1] - 2) < 0.3) & (found[:, 2] < 0.01)

    bulb, red = lamp((1.2, 1.0, 2.0)), (0.9, 0.03, 0.03)
    tube = Part(place(shaded(), (2.5, 2, 1.4)), np.array(WHITE))
    glowing = Part(place(ball(0.13, 3), (2, 2, 0.13)), np.array(GREY), np.full(3, 6.0))
    return {
        CALM: lambda: found(furnished()),
        "the room beside the one with the lamp": lambda: found(
            rooms.assembled([*walls(TWO), bulb, block((1, 0.8, 1.2), (7.5, 2.6, 0))]), lambda all: all[:, 0] > 5.15),
        "in a gap of 3 cm below a block": lambda: found(
            rooms.assembled([*walls(ROOM), bulb, block((1.6, 1.2, 0.5), (3.2, 2.2, 0.03))]), below),
        "on the floor beneath a glowing ball, and beside it": lambda: found(
            rooms.assembled([*walls(ROOM), bulb, glowing]), beside),
        "in a lampshade": lambda: found(rooms.assembled([*walls(ROOM), lamp((2.5, 2, 1.4), 0.05), tube]),
                                        lambda all: np.hypot(all[:, 0] - 2.5, all[:, 1] - 2) < 0.19),
        "a red room with a blue wall": lambda: found(
            rooms.assembled([*walls(ROOM, red, red, red[::-1]), bulb]))}


def tried(scale: int = 1) -> list[dict]:
    """Of each trial: 'where', 'light' (mean, W/m²), 'errors' and 'worst' (of COLUMNS).

    Raises:
        UserError: no torch.
    """
    model = embedding_bake.network()
    rows = []
    for name, scene_of in trials(scale).items():
        found = Answers(model, *scene_of())
        rows.append({"where": name, "light": float(found.truth.values.mean()), "errors": found.errors(),
                     "worst": found.worst()})
    return rows


def table(rows: Sequence[dict]) -> str:
    """In Markdown."""
    lines = ["| where | mean light, W/m² | " + " | ".join(COLUMNS) + " |", "|---" * (2 + len(COLUMNS)) + "|"]
    return "\n".join(lines + [f"| {row['where']} | {row['light']:.3g} | "
                              + " | ".join(f"{error:.3f}" for error in row["errors"]) + " |" for row in rows])
