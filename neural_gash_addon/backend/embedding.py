# SPDX-License-Identifier: GPL-3.0-or-later
"""Who is near whom in a room: what the light-transport embedding (`networks.embedding`) reads beside the points.

Xu et al. 2026, "A Generalizable Light Transport 3D Embedding for Global Illumination". A room is M scene points in
farthest-point order, so its codes (section 3.3: M / 4) are the first of them: farthest point sampling takes at each
step the point farthest from those it has; those that it takes of all M first are those that it would take at all.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import serialise
from .nearest import nearest_to

EXTENT = 20.0   # metres: the largest side of a room that was trained with, and a little more
CODES = 4       # scene points to a code (section 3.3)
_BESIDE = 6     # neighbours whose distance tells a point's area
_AREA = 0.95    # of their mean squared distance; measured on 16 rooms of training.rooms: 0.93 of all, 1.0 of lamps

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Layout:
    """Neighbours of M scene points, of which the first m are codes.

    All but the orders hold for the room turned, mirrored, moved or larger, too.
    """

    gathered: Indices           # (m, k) the points nearest to each code, itself first
    around: Indices             # (m, k) the codes nearest to each
    orders: Indices             # (serialise.CURVES, m) of the codes along each curve
    areas: NDArray[np.float32]  # (M,)


def layout(positions: NDArray, gathered: int, around: int) -> Layout:
    """What an encoder reads.

    Args:
        positions: (M, 3) of scene points in farthest-point order, M >= 1; points may coincide. Metres.
        gathered: points of each code. around: codes about each code. Fewer, where there are no more.
    """
    codes = positions[:-(-len(positions) // CODES)]
    places = (np.asarray(codes, np.float64) - np.min(positions, axis=0)) / EXTENT
    return Layout(nearest_to(codes, positions, gathered), nearest_to(codes, codes, around),
                  serialise.orders(places), areas(positions))


def areas(positions: NDArray) -> NDArray[np.float32]:
    """(M,) square metres that each scene point (M, 3) stands for, about, by how far the points beside it are.

    Samples are denser on emitters, so means over points would count those too often.
    """
    near = nearest_to(positions, positions, 1 + _BESIDE)[:, 1:]
    square = np.square(positions[near] - positions[:, None]).sum(2).sum(1) / max(near.shape[1], 1)
    return (_AREA * square).astype(np.float32)
