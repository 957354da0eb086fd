# SPDX-License-Identifier: GPL-3.0-or-later
"""Who is near whom in a room: what the light-transport embedding (`networks.embedding`) reads beside the points.

Xu et al. 2026, "A Generalizable Light Transport 3D Embedding for Global Illumination". A room is M scene points in
farthest-point order, so its codes (section 3.3: M / 4) are the first of them, and those between, halfway there, too:
farthest point sampling takes at each step the point farthest from those it has; those that it takes of all M first are
those that it would take at all.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import serialise
from .nearest import nearest_to

EXTENT = 20.0   # metres, the paper's fixed scale (A.3): more than any room has
LARGEST = 15.0  # metres: the longest side of a room that was trained with
_BESIDE = 6     # neighbours whose distance tells a point's area
_FACING = 0.5   # cosine of normals from which on a scene point has a query's albedo
_AREA = 0.95    # of their mean squared distance; measured on 16 rooms of training.rooms: 0.93 of all, 1.0 of lamps

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Layout:
    """Neighbours of M scene points, of which the first m are codes.

    All but the orders hold for the room turned, mirrored or moved, too.
    """

    gathered: Indices           # (m, k) the points nearest to each code, itself first
    halvings: tuple[Indices, ...]  # of each step from M points to m codes: (to, k) those before it nearest to each
    around: Indices             # (m, k) the codes nearest to each
    orders: Indices             # (serialise.CURVES, m) of the codes along each curve
    areas: NDArray[np.float32]  # (M,)


def layout(positions: NDArray, steps: Sequence[int], gathered: int, around: int) -> Layout:
    """What an encoder reads.

    Args:
        positions: (M, 3) of scene points in farthest-point order, M >= 1; points may coincide. Metres.
        steps: of each, how many of the points before it are one after it; a code for as many points as their product.
        gathered: points of each code, and of each point after a step. around: codes about each code. Fewer, where
            there are no more.
    """
    counts = [len(positions)]
    for step in steps:
        counts.append(-(-counts[-1] // step))
    codes = positions[:counts[-1]]
    places = (np.asarray(codes, np.float64) - np.min(positions, axis=0)) / EXTENT
    halvings = tuple(nearest_to(positions[:after], positions[:before], gathered)
                     for before, after in zip(counts, counts[1:], strict=False))
    near = halvings[0] if len(steps) == 1 else nearest_to(codes, positions, gathered)
    return Layout(near, halvings, nearest_to(codes, codes, around), serialise.orders(places), areas(positions))


def colours(places: NDArray, normals: NDArray, codes: NDArray, gathered: NDArray, points: NDArray
            ) -> NDArray[np.float32]:
    """(N, 3) albedo at queries: that of the scene point, of those about its code, that is nearest and faces as it does.

    What that costs does not grow with the scene.

    Args:
        places, normals: (N, 3) of queries. codes: (N,) the code nearest to each. gathered: of the layout.
        points: (M, 9) of scene points: position, normal, albedo.
    """
    near = gathered[codes]                                                          # (N, k)
    about = points.astype(np.float32).T[:6].take(near, 1)                           # (6, N, k)
    far = sum(np.square(about[axis] - places[:, axis, None]) for axis in range(3))
    along = sum(about[3 + axis] * normals[:, axis, None] for axis in range(3))
    best = np.argmin(far + np.where(along > _FACING, 0, far.max(initial=0.0)), 1)   # of none that faces so, the nearest
    return points[near[np.arange(len(near)), best], 6:9].astype(np.float32)


def areas(positions: NDArray) -> NDArray[np.float32]:
    """(M,) square metres that each scene point (M, 3) stands for, about, by how far the points beside it are.

    Samples are denser on emitters, so means over points would count those too often.
    """
    near = nearest_to(positions, positions, 1 + _BESIDE)[:, 1:]
    square = np.square(positions[near] - positions[:, None]).sum(2).sum(1) / max(near.shape[1], 1)
    return (_AREA * square).astype(np.float32)
