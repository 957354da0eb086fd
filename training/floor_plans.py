# SPDX-License-Identifier: GPL-3.0-or-later
"""Floor plans: rooms beside each other, with openings between them, and the surface that encloses it all."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .solids import Mesh

LARGEST = 16.0  # metres, of a plan along x or y
ATTEMPTS = 40   # to find a place for a room or a piece
_APART = 0.08   # metres between rooms, at least

Rng = np.random.Generator
Rectangle = tuple[float, float, float, float]  # x and y of one corner, x and y of the opposite one


@dataclass(frozen=True, eq=False)
class Plan:
    """Free space: rooms, and the openings between."""

    rooms: list[tuple[list[Rectangle], float]]  # rectangles that make each room, two of an L, and its height
    doors: list[tuple[Rectangle, float]]        # across the thickness of the wall, and its height


def plan(rng: Rng) -> Plan:
    """One to three rooms on a floor, each beside another, with an opening through the wall."""
    high = rng.uniform(2.3, 3.2)
    rooms: list[tuple[list[Rectangle], float]] = [([(0.0, 0.0, *rng.uniform(2.5, 6, 2))], high)]
    doors: list[tuple[Rectangle, float]] = []
    for _ in range(int(rng.choice(3, p=[0.45, 0.35, 0.2]))):
        for _ in range(ATTEMPTS):
            host = rooms[int(rng.integers(len(rooms)))]
            thick, sizes = rng.uniform(0.08, 0.25), rng.uniform(1.8, 5, 2)
            new, shared = _beside(rng, host[0][0], thick, sizes)
            if shared[1] - shared[0] > 1.0 and _is_free(new, rooms):
                own = high if rng.random() < 0.6 else rng.uniform(2.3, 3.2)
                most = shared[1] - shared[0] - 0.1
                wide = min(rng.uniform(0.8, 1.1) if rng.random() < 0.7 else rng.uniform(1.1, 2.5), most)
                low = shared[0] + 0.05
                start = rng.uniform(low, max(low, shared[1] - 0.05 - wide))  # as wide as can be, but for rounding
                doors.append((_between(host[0][0], new, start, start + wide),
                              float(rng.uniform(1.95, min(own, host[1]) - 0.1))))
                rooms.append(([new], own))
                break
    for rectangles, _ in rooms:
        if rng.random() < 0.4:
            x0, y0, x1, y1 = rectangles[0]
            deep, part = rng.uniform(1, 2.5), rng.uniform(0.35, 0.75)
            side, end = int(rng.integers(4)), rng.random() < 0.5
            if side < 2:
                low, up = (y0, y0 + part * (y1 - y0)) if end else (y1 - part * (y1 - y0), y1)
                wing = (x1, low, x1 + deep, up) if side else (x0 - deep, low, x0, up)
            else:
                low, up = (x0, x0 + part * (x1 - x0)) if end else (x1 - part * (x1 - x0), x1)
                wing = (low, y1, up, y1 + deep) if side == 3 else (low, y0 - deep, up, y0)
            others = [room for room in rooms if room[0] is not rectangles]
            inside = [r for r, _ in doors if overlap(r, wing, _APART)]
            if not inside and _is_free(wing, [*others, (rectangles, high)], rectangles[0]):
                rectangles.append(wing)
    return Plan(rooms, doors)


def _beside(rng: Rng, host: Rectangle, thick: float, sizes: NDArray) -> tuple[Rectangle, tuple[float, float]]:
    """A rectangle of these sizes beside another, and the stretch of wall that they share."""
    x0, y0, x1, y1 = host
    wide, deep = sizes
    if rng.random() < 0.5:
        low = rng.uniform(y0 - deep + 1.1, y1 - 1.1)
        left = x1 + thick if rng.random() < 0.5 else x0 - thick - wide
        return (left, low, left + wide, low + deep), (max(low, y0), min(low + deep, y1))
    low = rng.uniform(x0 - wide + 1.1, x1 - 1.1)
    near = y1 + thick if rng.random() < 0.5 else y0 - thick - deep
    return (low, near, low + wide, near + deep), (max(low, x0), min(low + wide, x1))


def _between(one: Rectangle, other: Rectangle, start: float, stop: float) -> Rectangle:
    """The part of the wall between two rectangles from start to stop along it."""
    if one[2] <= other[0] or other[2] <= one[0]:
        return (min(one[2], other[2]), start, max(one[0], other[0]), stop)
    return (start, min(one[3], other[3]), stop, max(one[1], other[1]))


def overlap(one: Rectangle, other: Rectangle, margin: float) -> bool:
    """Whether there is less than a margin between two rectangles."""
    return (one[0] < other[2] + margin and other[0] < one[2] + margin
            and one[1] < other[3] + margin and other[1] < one[3] + margin)


def _is_free(new: Rectangle, rooms: Sequence[tuple[list[Rectangle], float]], joined: Rectangle | None = None) -> bool:
    """Whether a rectangle keeps a wall's thickness from all but the one it is joined to, within the largest extent."""
    every = [r for rectangles, _ in rooms for r in rectangles if r is not joined]
    whole = np.array([new, *every, *([joined] if joined else [])])
    small = (whole[:, 2:].max(0) - whole[:, :2].min(0)).max() <= LARGEST
    return bool(small) and not any(overlap(new, r, _APART) for r in every)


def shell(boxes: Sequence[NDArray]) -> dict[tuple[int, int, bool], Mesh]:
    """The surface of the union of boxes ((3,), (3,)), seen from inside, without T-junctions.

    Returns:
        Meshes by the box that a face belongs to, the axis that it faces along, and whether it faces up that axis.
    """
    lines = [np.unique([b[:, axis] for b in boxes]) for axis in range(3)]
    middles = np.stack(np.meshgrid(*[(line[1:] + line[:-1]) / 2 for line in lines], indexing="ij"), -1)
    owner = np.full(middles.shape[:3], -1)
    for number in reversed(range(len(boxes))):
        low, high = boxes[number]
        owner[np.all((middles > low) & (middles < high), axis=-1)] = number
    padded = np.pad(owner, 1, constant_values=-1)
    found: dict[tuple[int, int, bool], Mesh] = {}
    for axis in range(3):
        for up in (True, False):  # up: the solid is below
            beside = np.roll(padded, 1 if up else -1, axis)[1:-1, 1:-1, 1:-1]
            cells = np.argwhere((owner >= 0) & (beside < 0))
            if not len(cells):
                continue
            a, b = (axis + 1) % 3, (axis + 2) % 3
            corners = np.zeros((len(cells), 4, 3), int)
            corners[:, [1, 2], a] = 1
            corners[:, [2, 3], b] = 1
            corners[:, :, axis] = 0 if up else 1
            if not up:
                corners = corners[:, ::-1]
            corners += cells[:, None]
            points = np.stack([lines[k][corners[..., k]] for k in range(3)], -1)  # (cells, 4, 3)
            of = owner[tuple(cells.T)]
            for number in np.unique(of):
                quads = points[of == number]
                at = 4 * np.arange(len(quads))[:, None]
                found[int(number), axis, up] = (quads.reshape(-1, 3), np.concatenate([at + [0, 1, 2], at + [0, 2, 3]])
                                                .astype(np.int32))
    return found
