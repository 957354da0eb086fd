# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene as points: blue noise over its surfaces, in farthest point order (Eldar et al. 1997).

Each point is the farthest of many candidates from all before it, so that the first points of a sample are a good
sample too. Distance counts how far normals turn, else the two sides of a thin plate would share their points; and it
counts more on emitters, which are small and matter much.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from . import sampling
from .estimator import morton_order
from .lit_scene import LitScene

EMITTERS = 3.0    # times as close as elsewhere are points on what emits
CANDIDATES = 8    # for each point
TURN = 0.25       # of the mean spacing: as far apart count normals at one radian; two sides of a plate half a spacing
_BUCKET = 256     # candidates updated together


def scene_points(scene: LitScene, count: int, seed: int = 0) -> NDArray[np.float32]:
    """Points on all triangles of a scene, lamps within it among them, each of a front.

    Returns:
        (count, 12): position (metres), unit normal, albedo, emission (radiance). None where there is no area.
    """
    rng = np.random.default_rng([seed, 8])
    shining = np.zeros(len(scene.areas), bool)
    shining[scene.emitters] = True
    weights = np.where(shining, EMITTERS, 1.0)
    surfaces, lamps = np.split(scene.corners, [len(weights) - scene.bodiless])
    weights[len(surfaces):] *= within(lamps, surfaces)
    cumulative = np.cumsum(scene.areas * weights ** 2)
    if not cumulative[-1] > 0:
        return np.zeros((0, 12), np.float32)
    bits = sampling.owen_scramble(sampling.sobol2(CANDIDATES * count), rng.integers(0, 2**32, 2, dtype=np.uint32))
    faces, u, v = sampling.on_triangles(cumulative, (bits.T + rng.random((2, len(bits)))) / 2.0 ** 32)
    corners = scene.corners[faces]
    points = corners[:, 0] + u[:, None] * (corners[:, 1] - corners[:, 0]) + v[:, None] * (corners[:, 2] - corners[:, 0])
    spacing = float(np.sqrt(cumulative[-1] / count))
    places = np.concatenate([points, TURN * spacing * scene.normals[faces]], 1)
    kept = farthest(places, count, weights[faces] ** 2)
    return np.concatenate([points[kept], scene.normals[faces[kept]], scene.albedo_at(faces[kept], u[kept], v[kept]),
                           scene.emission[faces[kept]]], 1).astype(np.float32)


def within(lamps: NDArray, surfaces: NDArray) -> NDArray[np.bool_]:
    """(L,) whether lamps (L, 3, 3) are within the bounds of surfaces (F, 3, 3): those beyond light a room, and are no
    part of it.
    """
    low, high = surfaces.reshape(-1, 3).min(0), surfaces.reshape(-1, 3).max(0)
    return ((lamps >= low) & (lamps <= high)).all((1, 2))


def farthest(places: NDArray, count: int, weights: NDArray | None = None) -> NDArray[np.int64]:
    """Of places (n, d), `count` in farthest point order, from the one that is nearest the middle: (count,).

    weights: (n,) of squared distance. Exact; buckets whose box is too far from a new point to matter are passed over.
    """
    weights = np.ones(len(places)) if weights is None else weights
    order = morton_order(places[:, :3])
    size = -(-len(order) // max(1, -(-len(order) // _BUCKET)))
    buckets = -(-len(order) // size)
    order = np.concatenate([order, np.repeat(order[-1:], buckets * size - len(order))]).reshape(buckets, size)
    inside = places[order].transpose(2, 0, 1).astype(np.float32).copy()                  # (d, buckets, size)
    low, high = inside.min(2), inside.max(2)                                            # (d, buckets)
    heavy = weights[order].astype(np.float32)                                           # (buckets, size)
    heaviest = heavy.max(1)
    square = np.full((buckets, size), np.inf, np.float32)
    most = np.full(buckets, np.inf, np.float32)  # of each bucket
    middle = places.mean(0)
    now = int(np.square(places - middle).sum(1).argmin())
    out = np.empty(min(count, len(places)), np.int64)
    for number in range(len(out)):
        out[number] = now
        new = places[now].astype(np.float32)
        gap = np.maximum(np.maximum(low - new[:, None], new[:, None] - high), 0)
        near = np.flatnonzero((gap * gap).sum(0) * heaviest < most)
        if 2 * len(near) > buckets:
            near = np.arange(buckets)
        away = inside[:, near] - new[:, None, None]
        fresh = np.minimum(square[near], (away * away).sum(0) * heavy[near])
        square[near], most[near] = fresh, fresh.max(1)
        bucket = int(most.argmax())
        now = int(order[bucket, square[bucket].argmax()])
    return out
