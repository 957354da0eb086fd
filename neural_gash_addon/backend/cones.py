# SPDX-License-Identifier: GPL-3.0-or-later
"""What a point sees of a pyramid of voxels, along cones about 25 directions of its hemisphere.

Each cone is read at distances that grow by a ratio, from voxels whose size grows alike (Crassin et al. 2011,
"Interactive Indirect Illumination Using Voxel Cone Tracing"). Nothing is composited here: that is what the network
learns. The directions are those of Neural-GASh's visibility samples, in the frame of the point's motor.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True, eq=False)
class Seen:
    """What the network is given of n points; most cones are read where nothing is, and about half see nothing."""

    points: int                      # n
    cones: NDArray[np.int64]         # (m,) those that see something, direction * n + point, rising
    features: NDArray[np.float32]    # (STEPS * CHANNELS, m) each number within -1..1

    def dense(self) -> NDArray[np.float32]:
        """(STEPS * CHANNELS, 25, n), zero where nothing is seen."""
        out = np.zeros((len(self.features), conformal.DIRECTION_COUNT * self.points), np.float32)
        out[:, self.cones] = self.features
        return out.reshape(len(out), -1, self.points)


def read(voxels: Pyramid, points: NDArray, normals: NDArray, frames: NDArray) -> Seen:
    """Read the pyramid along the cones of some points.

    Args:
        points: (n, 3). normals: (n, 3) unit. frames: (n, 3, 3) rotations that carry e_y to them.

    Where surfaces are farther than the last step, its voxel is the fullest of those from there on.
    """
    count = len(points)
    along = _turned(frames)
    facing = np.ascontiguousarray(normals.T, dtype=np.float32)
    places = np.ascontiguousarray(((points - voxels.low) / voxels.side).T)  # (3, n)
    steps = [along * np.float32(_distance(step) * FINEST) for step in range(_PER_LEVEL)]  # in voxels, at every level
    along = along.reshape(3, -1)
    fullest = np.zeros(along.shape[1], np.float32)  # of the last step
    some = np.zeros(along.shape[1], bool)
    found = []
    for step in range(max(STEPS, _PER_LEVEL * len(voxels.levels))):
        level = voxels.levels[step // _PER_LEVEL]
        index = _index(level, places, steps[step % _PER_LEVEL])
        seen = np.flatnonzero(level.filled(index))
        voxel = np.ascontiguousarray(level.at(index.take(seen)).view(np.float32).reshape(-1, 4).T)
        if step >= STEPS - 1:
            fuller = np.flatnonzero(voxel[0] > fullest.take(seen))
            seen, voxel = seen.take(fuller), voxel.take(fuller, 1)
            fullest[seen] = voxel[0]
        some[seen] = True
        faces = _dot(voxel[1:], along, seen), _dot(voxel[1:], facing, seen % count)
        found.append((min(step, STEPS - 1), seen, (voxel[0], *faces)))
    cones = np.flatnonzero(some)
    rank = np.empty(len(some), np.int64)
    rank[cones] = np.arange(len(cones))
    features = np.zeros((STEPS, CHANNELS, len(cones)), np.float32)
    for step, seen, channels in found:
        column = rank.take(seen)
        for row, values in zip(features[step], channels, strict=True):
            row[column] = values
    return Seen(count, cones, features.reshape(STEPS * CHANNELS, -1))


def _turned(frames: NDArray) -> NDArray[np.float32]:
    """The directions of the cones (3, 25, n) in frames (n, 3, 3). Not by einsum, which takes thrice as long."""
    rows = np.ascontiguousarray(frames.reshape(-1, 9).T, dtype=np.float32).reshape(3, 3, 1, -1)
    x, y, z = conformal.hemisphere_directions().T.astype(np.float32)[..., None]
    out = rows[:, 0] * x
    out += rows[:, 1] * y
    out += rows[:, 2] * z
    return out


def _dot(one: NDArray[np.float32], two: NDArray[np.float32], of: NDArray) -> NDArray[np.float32]:
    """Of vectors (3, m) and those of (3, n) that are at places (m,)."""
    out = one[0] * two[0].take(of)
    out += one[1] * two[1].take(of)
    out += one[2] * two[2].take(of)
    return out


def _index(level: Level, places: NDArray, away: NDArray[np.float32]) -> NDArray[np.int32]:
    """(25 * n,) of the voxels that are so many voxels (3, 25, n) away from places (3, n)."""
    here = (places / level.size - level.low[:, None]).astype(np.float32)
    # a ufunc casts as it goes, within the cache
    index = np.add(away[0], here[0], dtype=np.float32).astype(np.int32)
    cell = np.empty_like(index)
    for axis in (1, 2):
        index *= np.int32(level.shape[axis])
        np.add(away[axis], here[axis], out=cell, casting="unsafe")
        index += cell
    return index.ravel()
