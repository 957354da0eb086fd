# SPDX-License-Identifier: GPL-3.0-or-later
"""Grown things: blobs, organs, figures, trees, corals, folds, knots, cloth. As `objects`, each a category."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .fields import Field, capsule, common, ellipsoid, slab, surface, union, without
from .objects import Rng, any_primitive
from .solids import Mesh, about, ball, box, grid, merge, noise, place, ripples, swept, to_size, torus


def _directions(rng: Rng, count: int) -> NDArray[np.float64]:
    """Unit vectors (count, 3) all about."""
    v = rng.normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def blobs(rng: Rng, target: int) -> Mesh:
    """Balls and rods that melt into each other, as metaballs do."""
    parts: list[Field] = []
    for _ in range(int(rng.integers(3, 14))):
        at = rng.uniform(-1, 1, 3)
        if rng.random() < 0.7:
            parts.append(ellipsoid(at, rng.uniform(0.2, 0.6, 3)))
        else:
            parts.append(capsule(at, at + rng.uniform(-1, 1, 3), rng.uniform(0.1, 0.3)))
    return surface(union(parts, rng.uniform(0.03, 0.15)), np.full(3, -2.2), np.full(3, 2.2), target)


def hollow(rng: Rng, target: int) -> Mesh:
    """A lump with cavities and tunnels cut into it: bones, caves, chambers of a heart."""
    lobes = _directions(rng, int(rng.integers(1, 4)))
    whole = union([ellipsoid(0.5 * d, rng.uniform(0.6, 1.0, 3)) for d in lobes], 0.1)
    rounding = rng.uniform(0.015, 0.05)
    for d in _directions(rng, int(rng.integers(3, 10))):
        depth = rng.uniform(-0.3, 0.9)
        hole = (ellipsoid(1.1 * d, rng.uniform(0.3, 0.6)) if rng.random() < 0.4
                else capsule(1.8 * d, depth * d, rng.uniform(0.1, 0.35), rng.uniform(0.1, 0.4)))
        whole = without(whole, hole, rounding)
    return surface(whole, np.full(3, -1.7), np.full(3, 1.7), target)


def porous(rng: Rng, target: int) -> Mesh:
    """A ball or block of a triply periodic surface with walls, or of sponge."""
    cell = rng.uniform(1.1, 1.8)
    wall = rng.uniform(0.5, 0.8)  # thinner ones would come out in holes
    field = ripples(rng, 0.9, 12)
    kind = rng.choice(["gyroid", "primitive", "sponge"])

    def lattice(p: NDArray) -> NDArray:
        q = 2 * np.pi * p / cell
        if kind == "sponge":
            return 0.06 * (noise(p, field) + 0.2)
        if kind == "gyroid":
            value = (np.sin(q) * np.cos(np.roll(q, -1, 1))).sum(1)
        else:
            value = np.cos(q).sum(1)
        return 0.1 * cell * (np.abs(value) - wall)

    hull = ellipsoid((0, 0, 0), rng.uniform(0.8, 1.1, 3))
    if rng.random() < 0.4:
        hull = slab((0, 0, 0), (0.9, 0.9, 0.7), 0.05)
    return surface(common(lattice, hull, 0.02), np.full(3, -1.2), np.full(3, 1.2), max(target, 5000))


def figure(rng: Rng, target: int) -> Mesh:
    """A body with limbs in some pose: two or four legs, arms, a head, some a tail or horns."""
    def limb(start: NDArray, way: NDArray, length: float, radius: float) -> list[Field]:
        bend = way + 0.6 * rng.normal(size=3)
        knee = start + way / np.linalg.norm(way) * length / 2
        end = knee + bend / np.linalg.norm(bend) * length / 2
        return [capsule(start, knee, radius, 0.8 * radius), capsule(knee, end, 0.8 * radius, 0.55 * radius),
                ellipsoid(end, radius * rng.uniform(0.8, 1.3, 3))]

    four = rng.random() < 0.4
    body = rng.uniform(0.25, 0.42) * (0.75 if four else 1)
    length = rng.uniform(0.5, 1.0)
    axis = np.array([0, 1, 0.1]) if four else np.array([0, 0.1, 1])
    low, high = -length / 2 * axis, length / 2 * axis
    parts = [capsule(low, high, body, body * rng.uniform(0.8, 1.3)),
             ellipsoid(high + (body + 0.25) * np.array([0, 0.4 if four else 0, 1]), rng.uniform(0.2, 0.35, 3))]
    for side in (-1, 1):
        out = np.array([side, 0, 0])
        leg = rng.uniform(0.9, 1.5), rng.uniform(0.1, 0.17)
        if four:
            parts += limb(low + 0.7 * body * out, np.array([0.2 * side, 0, -1]), *leg)
            parts += limb(high + 0.7 * body * out, np.array([0.2 * side, 0, -1]), *leg)
        else:
            parts += limb(low + 0.5 * body * out, np.array([0.3 * side, 0, -1]), *leg)
            parts += limb(high + 0.9 * body * out, np.array([side, rng.normal() / 3, rng.uniform(-1.5, 0.5)]),
                          leg[0], 0.8 * leg[1])
        if rng.random() < 0.3:
            top = high + (body + 0.4) * np.array([0, 0.4 if four else 0, 1])
            parts.append(capsule(top, top + [0.25 * side, 0, 0.35], 0.07, 0.02))
    if rng.random() < 0.4:
        parts += limb(low, np.array([0, -1, 0.2]), rng.uniform(0.5, 1), 0.07)
    return surface(union(parts, rng.uniform(0.02, 0.05)), np.full(3, -2.4), np.full(3, 2.4), target)


def _branches(rng: Rng, start: NDArray, way: NDArray, length: float, radius: float, levels: int
              ) -> list[tuple[NDArray, NDArray]]:
    """Spines (S, 3) and radii (S,) of a branch and all that grow from it."""
    steps = 10
    spine, heading = [start], way
    for _ in range(steps):
        heading = heading + 0.12 * rng.normal(size=3) + [0, 0, 0.02]
        heading = heading / np.linalg.norm(heading)
        spine.append(spine[-1] + heading * length / steps)
    points, radii = np.array(spine), radius * np.linspace(1, 0.55, steps + 1)
    found = [(points, radii)]
    if levels:
        for k in range(int(rng.integers(2, 4))):
            at = steps if k == 0 else int(rng.integers(steps // 2, steps))
            turn = Rotation.from_rotvec(rng.uniform(0.3, 1.0) * np.cross(heading, _directions(rng, 1)[0]))
            found += _branches(rng, points[at], turn.apply(heading), length * rng.uniform(0.55, 0.85), radii[at] * 0.85,
                               levels - 1)
    return found


def tree(rng: Rng, target: int) -> Mesh:
    """Branching tubes that run into each other, some with leaves or on a ground."""
    found = _branches(rng, np.zeros(3), np.array([0, 0, 1.0]), rng.uniform(0.8, 1.4), rng.uniform(0.06, 0.16),
                      2 if target < 3500 else 3)
    sections = int(np.clip(target / (13 * len(found)), 5, 14))
    parts = [swept(spine, radii, sections) for spine, radii in found]
    if rng.random() < 0.4:
        leaf = ball(1.0, 1)
        for spine, _ in found[-int(rng.integers(3, 40)):]:
            parts.append(place(leaf, spine[-1], about("x", rng.uniform(0, 3)) * about("z", rng.uniform(0, 6)),
                               rng.uniform(0.05, 0.14) * np.array([1, 1.8, 0.2])))
    if rng.random() < 0.4:
        parts.append(box((2.5, 2.5, 0.1), (0, 0, -0.03)))
    return merge(parts)


def vessels(rng: Rng, target: int) -> Mesh:
    """Branching tubes as one skin with fillets: blood vessels, corals, antlers."""
    found = _branches(rng, np.zeros(3), np.array([0, 0, 1.0]), 1.0, rng.uniform(0.12, 0.2), 3)
    found = [(spine, np.maximum(radii, 0.05)) for spine, radii in found]  # thinner ones would fall apart
    parts = [capsule(spine[a], spine[b], radii[a], radii[b]) for spine, radii in found
             for a, b in ((0, 3), (3, 6), (6, 10))]
    ends = np.concatenate([spine for spine, _ in found])
    return surface(union(parts, 0.012), ends.min(0) - 0.3, ends.max(0) + 0.3, max(target, 2500))


def displaced(rng: Rng, target: int) -> Mesh:
    """A primitive under noise: lumps, craters, ridges or spikes."""
    p, t = to_size(ball(1, 4) if rng.random() < 0.5 else any_primitive(rng, 1.3), target)
    centre = p.mean(0)
    away = (p - centre) / np.maximum(np.linalg.norm(p - centre, axis=1, keepdims=True), 1e-9)
    field = ripples(rng, rng.uniform(0.3, 1.4))
    kind, depth = rng.choice(["lumps", "ridges", "craters", "spikes"]), rng.uniform(0.03, 0.14)
    value = noise(p, field)
    if kind == "ridges":
        value = 1 - 2 * np.abs(value)
    elif kind == "craters":
        for c in p[rng.integers(len(p), size=int(rng.integers(5, 25)))]:
            d = np.linalg.norm(p - c, axis=1) / rng.uniform(0.15, 0.4)
            value = value * 0.9 + np.where(d < 1.3, np.minimum(3 * d**2 - 2.5, 2 * (1.3 - d)), 0)
    elif kind == "spikes":
        value = np.maximum(value, 0) ** 3
    return p + away * np.clip(depth * value, -0.35, 0.8)[:, None], t


def folds(rng: Rng, target: int) -> Mesh:
    """Gyri and furrows over two lobes or one, as of a brain: warped stripes pushed in along their lines."""
    p, t = to_size(ball(1, 4), target)
    warp = ripples(rng, 1.6)
    q = p + 0.25 * np.stack([noise(p, warp), noise(p + 5, warp), noise(p - 5, warp)], 1)
    stripes = noise(q, ripples(rng, rng.uniform(0.35, 0.8), 10))
    depth = rng.uniform(0.08, 0.22)
    furrow = np.exp(-np.square(stripes / rng.uniform(0.2, 0.4)))
    radius = 1 - depth * furrow
    if rng.random() < 0.5:
        radius = radius - 0.25 * np.exp(-np.square(p[:, 0] / 0.07))  # the cleft between the halves
    return p * radius[:, None] * [1, rng.uniform(1, 1.4), rng.uniform(0.7, 1)], t


def knot(rng: Rng, target: int) -> Mesh:
    """A torus knot, round, flat or rippled; or linked rings."""
    if rng.random() < 0.25:
        ring = torus(1, rng.uniform(0.1, 0.3), 60, 16)
        return merge([place(ring, (1.1 * k, 0, 0), about("x", np.pi / 2 * (k % 2) + 0.3 * rng.normal()))
                      for k in range(int(rng.integers(2, 6)))])
    p, q = [(2, 3), (3, 2), (2, 5), (3, 4), (3, 5), (2, 7)][int(rng.integers(6))]
    around = int(np.clip(np.sqrt(target / 14), 8, 36))
    s = np.linspace(0, 2 * np.pi, max(60, target // around), endpoint=False)
    big = 2 + rng.uniform(0.6, 1.1) * np.cos(q * s)
    spine = np.stack([big * np.cos(p * s), big * np.sin(p * s), rng.uniform(0.6, 1.2) * np.sin(q * s)], 1)
    ripple = 1 + rng.uniform(0, 0.25) * (rng.random() < 0.5) * np.sin(int(rng.integers(20, 60)) * s)
    radii = rng.uniform(0.2, 0.45) * ripple[:, None] * [1, rng.uniform(0.4, 1)]
    return swept(spine, radii, around, closed=True, power=rng.choice([2.0, 2.0, 6.0]))


def cloth(rng: Rng, target: int) -> Mesh:
    """One open sheet in folds: a curtain, a roll, or a cloth over something."""
    side = int(np.sqrt(target))
    u, v = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side), indexing="ij")
    flat = np.stack([u, v, 0 * u], -1).reshape(-1, 3)
    soft = 0.05 * noise(flat, ripples(rng, 0.9)).reshape(side, side)
    kind = rng.choice(["curtain", "roll", "drape"])
    if kind == "curtain":
        fold = rng.uniform(0.05, 0.25) * np.sin(rng.uniform(8, 22) * u + 2 * soft)
        return grid(np.stack([u, fold * (1.2 - 0.5 * v) + soft, v], -1))
    if kind == "roll":
        angle = 1.5 + rng.uniform(3, 8) * (u + 1)
        radius = 0.25 + 0.05 * rng.uniform(0.6, 2) * angle
        return grid(np.stack([radius * np.cos(angle), radius * np.sin(angle), v * 0.9 + soft], -1))
    r = np.sqrt(u**2 + v**2)
    below = ball(0.35, 3)
    # over a ball: on it near the middle, then down in folds
    drop = -np.maximum(r - 0.5, 0) * rng.uniform(0.8, 1.6) * (1 + 0.3 * np.sin(rng.integers(4, 9) * np.arctan2(v, u)))
    height = np.where(r < 0.5, np.sqrt(np.maximum(0.5**2 - r**2, 0)), 0) + drop + 0.4 * soft
    return merge([grid(np.stack([0.8 * u, 0.8 * v, height + 0.08], -1)), place(below, (0, 0, -0.03))])
