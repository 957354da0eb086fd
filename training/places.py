# SPDX-License-Identifier: GPL-3.0-or-later
"""Places and arrangements: rooms, stairs, colonnades, stacks, plates, scatter. As `objects`, each a category."""
from __future__ import annotations

import numpy as np

from . import blender
from .objects import Rng, any_primitive, anywhere
from .solids import Mesh, about, ball, box, cylinder, grid, merge, noise, place, prism, ripples, to_size, turned


def scatter(rng: Rng, target: int) -> Mesh:
    """Disjoint or overlapping parts in a volume or on a floor, by a power law of sizes."""
    count = int(rng.integers(4, 50))
    floor = rng.random() < 0.5
    parts = []
    for _ in range(count):
        size = 0.25 * rng.uniform(0.1, 1) ** -0.8
        part = blender.suzanne(0) if rng.random() < 0.05 and target > 4000 else any_primitive(rng)
        part = anywhere(rng, place(part, scale=0.5 * size), 1.8)
        if floor:
            part = place(part, (0, 0, -part[0][:, 2].min()))
        parts.append(part)
    while sum(len(p) for p, _ in parts) > 1.2 * target and len(parts) > 3:
        parts.pop(int(np.argmax([len(p) for p, _ in parts])))
    if floor:
        parts.append(box((5, 5, 0.1), (0, 0, -0.05)))
    return merge(parts)


def plates(rng: Rng, target: int) -> Mesh:
    """Thin plates: parallel, as a louvre, crossing as a crate, or as a fan of cards."""
    count, thick = int(rng.integers(3, 14)), rng.uniform(0.005, 0.06)
    kind = rng.choice(["parallel", "louvre", "crate", "fan"])
    side = rng.uniform(0.6, 1.4)
    parts = []
    for k in range(count):
        at = 2 * (k + 0.5) / count - 1
        if kind == "parallel":
            shift = rng.uniform(-0.2, 0.2, 2)
            parts.append(place(box((2, 2 * side, thick)), (*shift, at), about("z", rng.normal() / 9)))
        elif kind == "louvre":
            parts.append(place(box((2, 2.2 / count, thick)), (0, at, 0), about("x", rng.uniform(0.3, 1.2))))
        elif kind == "crate":
            depth = rng.uniform(0.4, 0.8)
            parts.append(box((thick, 2, depth), (at, 0, 0)))
            parts.append(box((2, thick, depth), (0, at, 0)))
        else:
            parts.append(place(place(box((thick, 1.4, side)), (0, 0.8, 0)), turn=about("z", np.pi * at)))
    if rng.random() < 0.4:
        parts.append(box((2.4, 2.4, thick), (0, 0, -1.2)))
    return merge(parts)


def stack(rng: Rng, target: int) -> Mesh:
    """Boxes, discs and books one on another, a little askew."""
    parts, height = [], 0.0
    for _ in range(int(rng.integers(3, 14))):
        thick, wide = rng.uniform(0.08, 0.5), rng.uniform(0.4, 1.0)
        if rng.random() < 0.6:
            part = box((wide, wide * rng.uniform(0.5, 1.2), thick), (0, 0, thick / 2))
        else:
            part = cylinder(wide / 2, thick, int(rng.integers(8, 40)), wide / 2 * rng.uniform(0.5, 1))
        parts.append(place(part, (*rng.normal(0, 0.07, 2), height), about("z", rng.uniform(0, 6))))
        height += thick * rng.choice([1.0, 1.01, 1.1])
    parts.append(box((3, 3, 0.1), (0, 0, -0.05)))
    return merge(parts)


def stairs(rng: Rng, target: int) -> Mesh:
    """A straight flight between walls, or a spiral about a post."""
    count, rise = int(rng.integers(5, 20)), rng.uniform(0.1, 0.25)
    parts = []
    if rng.random() < 0.5:
        tread, wide = rng.uniform(0.2, 0.4), rng.uniform(0.8, 2)
        solid = rng.random() < 0.6
        for k in range(count):
            high = (k + 1) * rise if solid else 0.06
            parts.append(box((wide, tread, high), (0, k * tread, (k + 1) * rise - high / 2)))
        length, top = count * tread, count * rise
        for x in (-1, 1):
            if rng.random() < 0.6:
                parts.append(box((0.08, length, top + 0.6), (x * (wide / 2 + 0.05), length / 2, (top + 0.6) / 2)))
    else:
        step = rng.uniform(0.25, 0.5)
        wedge = np.array([(0.1, -0.1), (1, -step / 2), (1.05, 0), (1, step / 2), (0.1, 0.1)]) - [0.5, 0]
        for k in range(count):
            parts.append(place(place(prism(wedge, 0.08), (0.55, 0, 0)), (0, 0, k * rise), about("z", k * step)))
        parts.append(place(cylinder(0.14, count * rise + 0.8, 20), (0, 0, -0.1)))
    if rng.random() < 0.5:
        parts.append(box((3, 4, 0.1), (0, 0.5, -0.05)))
    return merge(parts)


def columns(rng: Rng, target: int) -> Mesh:
    """Rows or a ring of columns, some fluted, on steps and under a roof or beams."""
    high, radius = rng.uniform(1.2, 3), rng.uniform(0.1, 0.25)
    sections = int(rng.integers(10, 28))
    swell = np.array([(0, 0), (1.5, 0), (1.5, 0.08), (1, 0.1), (1, 0.4), (0.85, 0.9), (1.4, 0.95), (1.4, 1), (0, 1)])
    one = turned(swell * [radius, high], sections)
    flutes = np.arctan2(one[0][:, 1], one[0][:, 0]) * (sections // 2)
    one = (one[0] * np.stack([1 - 0.06 * np.cos(flutes)] * 2 + [np.ones(len(flutes))], 1), one[1])
    if rng.random() < 0.3:
        one = box((1.8 * radius, 1.8 * radius, high), (0, 0, high / 2))
    ring = rng.random() < 0.35
    if ring:
        a = np.linspace(0, 2 * np.pi, int(rng.integers(5, 12)), endpoint=False)
        places = np.stack([1.5 * np.cos(a), 1.5 * np.sin(a)], 1)
    else:
        nx, ny = int(rng.integers(2, 6)), int(rng.integers(1, 4))
        x, y = np.meshgrid((np.arange(nx) - (nx - 1) / 2) * 0.8, (np.arange(ny) - (ny - 1) / 2) * 0.9)
        places = np.stack([x.ravel(), y.ravel()], 1)
    parts = [place(one, (x, y, 0), about("z", rng.uniform(0, 1))) for x, y in places]
    half = np.abs(places).max(0) + 0.5
    if ring:
        parts += [place(cylinder(2.1, 0.15, 40), (0, 0, -0.15)), place(cylinder(2.0, 0.5, 40, 0.2), (0, 0, high))]
    else:
        parts += [box((2 * half[0], 2 * half[1], 0.15), (0, 0, -0.075)),
                  box((2 * half[0] + 0.4, 2 * half[1] + 0.4, 0.12), (0, 0, -0.21))]
        if rng.random() < 0.7:
            parts.append(box((2 * half[0], 2 * half[1], 0.2), (0, 0, high + 0.1)))
    return merge(parts)


def furniture(rng: Rng) -> tuple[str, list[Mesh]]:
    """Which of table, chair, shelf, lamp, cupboard or sofa it is, and its parts: stands on z = 0, about 1 wide."""
    kind = str(rng.choice(["table", "chair", "shelf", "lamp", "cupboard", "sofa"]))
    if kind in ("table", "chair"):
        high, leg = (0.7, 0.06) if kind == "table" else (0.45, 0.05)
        wide, deep = (1.2, 0.7) if kind == "table" else (0.5, 0.5)
        parts = [box((wide, deep, 0.05), (0, 0, high))]
        parts += [box((leg, leg, high), (x * (wide / 2 - leg), y * (deep / 2 - leg), high / 2))
                  for x in (-1, 1) for y in (-1, 1)]
        if kind == "chair":
            parts.append(box((wide, 0.05, 0.5), (0, deep / 2, high + 0.28)))
        elif rng.random() < 0.6:
            parts.append(place(any_primitive(rng, 0.2), (rng.uniform(-0.4, 0.4), 0, high + 0.2)))
    elif kind == "shelf":
        levels = int(rng.integers(2, 6))
        parts = [box((1, 0.3, 0.03), (0, 0, 0.02 + k * 0.35)) for k in range(levels + 1)]
        parts += [box((0.03, 0.3, levels * 0.35), (x * 0.5, 0, levels * 0.175)) for x in (-1, 1)]
        parts += [box((0.06, 0.2, 0.25), (x, 0, 0.16 + 0.35 * int(rng.integers(levels))))
                  for x in rng.uniform(-0.4, 0.4, 5)]
    elif kind == "lamp":
        parts = [cylinder(0.18, 0.04, 20), cylinder(0.02, 1.4, 10),
                 place(turned([(0.25, 0), (0.14, 0.3), (0.12, 0.3), (0.23, 0)], 24, ring=True), (0, 0, 1.2))]
    elif kind == "cupboard":
        parts = [box((0.8, 0.5, 1.6), (0, 0, 0.85)), place(ball(0.03, 1), (0.05, -0.27, 0.9))]
    else:
        parts = [box((1.6, 0.8, 0.35), (0, 0, 0.2)), box((1.6, 0.2, 0.5), (0, 0.35, 0.6)),
                 *(box((0.2, 0.8, 0.3), (x * 0.8, 0, 0.5)) for x in (-1, 1))]
    return kind, parts


def room(rng: Rng, target: int) -> Mesh:
    """A room seen from inside: a box open in front, above or by a window, and furniture."""
    x, y, z = rng.uniform(1.8, 4, 2).tolist() + [rng.uniform(2, 3)]
    corners = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * [x, y, z] - [x / 2, y / 2, 0]
    # counter-clockwise, seen from inside
    walls = {"floor": (0, 4, 6, 2), "back": (2, 6, 7, 3), "left": (0, 2, 3, 1), "right": (4, 5, 7, 6),
             "ceiling": (1, 3, 7, 5), "front": (0, 1, 5, 4)}
    away = rng.choice(["front", "ceiling", "both", "window"])
    left_out = {"both": ("front", "ceiling"), "window": ("left",)}.get(str(away), (str(away),))
    shell = merge([grid(corners[list(w)][[[0, 3], [1, 2]]]) for name, w in walls.items() if name not in left_out])
    parts = [to_size(shell, target // 3)]
    if away == "window":  # the left wall in four pieces around a hole
        parts += [box((0.1, y, z / 3), (-x / 2 - 0.05, 0, z / 6)), box((0.1, y, z / 5), (-x / 2 - 0.05, 0, 0.9 * z)),
                  *(box((0.1, y / 4, z), (-x / 2 - 0.05, s * 0.375 * y, z / 2)) for s in (-1, 1))]
    for _ in range(int(rng.integers(2, 7))):
        at = (*(rng.uniform(-0.5, 0.5, 2) * np.maximum(np.array([x, y]) - 1.1, 0.2)), 0.001)
        parts.append(place(merge(furniture(rng)[1]), at, about("z", np.pi / 2 * int(rng.integers(4)))))
    return merge(parts)


def terrain(rng: Rng, target: int) -> Mesh:
    """A height field, open below: hills, canyons or a street of boxes."""
    side = int(np.sqrt(target))
    line = np.linspace(-2, 2, side)
    x, y = np.meshgrid(line, line, indexing="ij")
    p = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    high = 0.35 * rng.uniform(0.5, 2) * noise(p, ripples(rng, 2.5)) + 0.08 * noise(p, ripples(rng, 0.6))
    if rng.random() < 0.5:
        high = -np.abs(high)  # ridges
    if rng.random() < 0.3:
        high = 0.25 * np.rint(high / 0.25)  # terraces
    p[:, 2] = high
    return grid(p.reshape(side, side, 3))
