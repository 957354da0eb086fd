# SPDX-License-Identifier: GPL-3.0-or-later
"""What a point sees of a pyramid of voxels, along cones about 25 directions of its hemisphere.

Each cone is read at distances that grow by a ratio, from voxels whose size grows alike (Crassin et al. 2011,
"Interactive Indirect Illumination Using Voxel Cone Tracing"). Nothing is composited here: that is what the network
learns. The directions are those of Neural-GASh's visibility samples, in the frame of the point's motor.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from . import conformal
from .raycast import Geometry
from .voxels import FINEST, Level, Pyramid

STEPS = 15    # to a distance of about the longest side
CHANNELS = 3  # of each: area, how it faces along the cone, and along the point's normal
# Two steps are read of each level, at 1.7 and at 2.4 voxels: so the voxels read along a cone join, and a thin wall is
# not lost between two steps; and they are about as wide as a cone is there.
_PER_LEVEL = 2
_FIRST = 1.7


def _distance(step: int) -> float:
    return _FIRST / FINEST * 2.0 ** (step / _PER_LEVEL)


def pyramid(geometry: Sequence[Geometry]) -> Pyramid:
    """The voxels that `read` needs of parts (positions, triangles), what is baked first."""
    return Pyramid.of(geometry, [_distance(step) for step in range(1, STEPS + 1, _PER_LEVEL)])


def read(voxels: Pyramid, points: NDArray, normals: NDArray, frames: NDArray) -> NDArray[np.float32]:
    """What the network is given of some points, (STEPS * CHANNELS, 25, n), each number within -1..1.

    Args:
        points: (n, 3). normals: (n, 3) unit. frames: (n, 3, 3) rotations that carry e_y to them.

    Where surfaces are farther than the last step, its voxel is the fullest of those from there on.
    """
    directions = conformal.hemisphere_directions().T.astype(np.float32)
    along = np.ascontiguousarray(np.einsum("nij,jd->idn", frames.astype(np.float32), directions))  # (3, 25, n)
    facing = np.ascontiguousarray(normals.T, dtype=np.float32)[:, None]
    places = ((points - voxels.low) / voxels.side).T  # (3, n)
    out = np.empty((STEPS, CHANNELS, *along.shape[1:]), np.float32)
    for step in range(STEPS):
        found = _at(voxels.levels[step // _PER_LEVEL], places, along, _distance(step))
        if step == STEPS - 1:
            for farther in range(STEPS, _PER_LEVEL * len(voxels.levels)):
                other = _at(voxels.levels[farther // _PER_LEVEL], places, along, _distance(farther))
                found = np.where(other[0] > found[0], other, found)
        out[step, 0] = found[0]
        out[step, 1] = _dot(found[1:], along)
        out[step, 2] = _dot(found[1:], facing)
    return out.reshape(STEPS * CHANNELS, *along.shape[1:])


def _dot(one: NDArray[np.float32], two: NDArray[np.float32]) -> NDArray[np.float32]:
    """Of vectors (3, ...), broadcast."""
    out = one[0] * two[0]
    out += one[1] * two[1]
    out += one[2] * two[2]
    return out


def _at(level: Level, places: NDArray, along: NDArray[np.float32], distance: float) -> NDArray[np.float32]:
    """(4, 25, n) of the voxels at a distance from places (3, n) along directions (3, 25, n)."""
    at = along * np.float32(distance / level.size)
    at += (places / level.size - level.low[:, None]).astype(np.float32)[:, None]
    cell = at.astype(np.int32)
    index = cell[0]
    for axis in (1, 2):
        index *= np.int32(level.shape[axis])
        index += cell[axis]
    found = level.at(index.ravel()).view(np.float32)
    return np.ascontiguousarray(found.reshape(-1, 4).T).reshape(4, *index.shape)
