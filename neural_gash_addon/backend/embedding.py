# SPDX-License-Identifier: GPL-3.0-or-later
"""Who is near whom in a room: what the light-transport embedding (`networks.embedding`) reads beside the points.

Xu et al. 2026, "A Generalizable Light Transport 3D Embedding for Global Illumination". A room is M scene points in
farthest-point order, so each halving of section 3.3 is the first half of what was there: farthest point sampling takes
at each step the point farthest from those it has; the one that it takes of all M is among the first M / 2, and so it is
the one that it would take of these alone.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import serialise
from .nearest import nearest_to

EXTENT = 20.0   # metres: the largest side of a room; one for all, as light falls off with true distances (A.3)
_BESIDE = 6     # neighbours whose distance tells a point's area
_AREA = 0.95    # of their mean squared distance; measured on 16 rooms of training.rooms: 0.93 of all, 1.0 of lamps
HALVINGS = 2    # of the nearest-neighbour embedding: a quarter of the scene points are codes (section 3.3)

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Layout:
    """Neighbours of M scene points and of their first halves, down to the last stage of the encoder.

    They hold for the room turned, mirrored or moved, too.
    """

    gathered: list[Indices]  # of each halving: (m, k) the points before it that are nearest to those kept
    around: list[Indices]    # of each stage: (m, k) the codes nearest to each, itself first
    above: list[Indices]     # of each stage but the last: (m,) the nearest code of the next


def layout(positions: NDArray, stages: int, k: int, around: int) -> Layout:
    """The neighbours that an encoder of `stages` stages reads.

    Args:
        positions: (M, 3) of scene points in farthest-point order, M >= 1; points may coincide.
        k: points gathered by each code kept. around: codes about each code. Fewer, where there are no more.
    """
    counts = [len(positions)]
    for _ in range(HALVINGS + stages - 1):
        counts.append(-(-counts[-1] // 2))
    steps = list(zip(counts[:-1], counts[1:], strict=True))
    codes = counts[HALVINGS:]
    return Layout([nearest_to(positions[:kept], positions[:count], k) for count, kept in steps],
                  [nearest_to(positions[:count], positions[:count], around) for count in codes],
                  [nearest_to(positions[:count], positions[:kept], 1)[:, 0] for count, kept in steps[HALVINGS:]])


def orders(places: NDArray, stages: int) -> list[Indices]:
    """(serialise.CURVES, m) the order of each stage's codes along each curve.

    places: (M, 3) of scene points, of what `normalised` gives.
    """
    count, out = len(places), []
    for _ in range(HALVINGS):
        count = -(-count // 2)
    for _ in range(stages):
        out.append(serialise.orders(places[:count]))
        count = -(-count // 2)
    return out


def areas(positions: NDArray) -> NDArray[np.float32]:
    """(M,) square metres that each scene point (M, 3) stands for, about, by how far the points beside it are.

    Samples are denser on emitters, so counting points would not tell how much of a room shines.
    """
    near = nearest_to(positions, positions, 1 + _BESIDE)[:, 1:]
    square = np.square(positions[near] - positions[:, None]).sum(2).sum(1) / max(near.shape[1], 1)
    return (_AREA * square).astype(np.float32)


def normalised(positions: NDArray, scene: NDArray) -> NDArray[np.float32]:
    """Positions (N, 3) in metres, from the lowest corner of the scene points (M, 3), in units of EXTENT (A.3)."""
    return ((np.asarray(positions, np.float64) - np.min(scene, axis=0)) / EXTENT).astype(np.float32)
