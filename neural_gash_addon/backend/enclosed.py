# SPDX-License-Identifier: GPL-3.0-or-later
"""Which points lie in gaps that are narrower than what the light-transport embedding tells apart."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from . import sampling
from .raycast import Occluders

NEAR = 1.0    # of the distance between codes: what is nearer stands between the point and the codes about it
SHARE = 0.4   # of the sky, by cosine, that is so near; in a corner of a room it is a half at most
_LOOKS = 16   # rays from a point
_SETS = 16
_AT_ONCE = 1 << 15  # points, so that memory does not grow with their number


def enclosed(points: NDArray, normals: NDArray, clearance: NDArray, reach: NDArray, occluders: Occluders, seed: int
             ) -> NDArray[np.bool_]:
    """Whether something within reach blocks SHARE of the sky of points, by _LOOKS rays from each.

    Args:
        points, normals, clearance: (N, 3) as `irradiance.irradiance` has them. reach: (N,) metres.
    Returns:
        (N,); False where the normal is zero.
    """
    sets = sampling.hemisphere_sets(_SETS, _LOOKS, seed)
    rng = np.random.default_rng([seed, 13])
    out = np.zeros(len(points), bool)
    for start in range(0, len(points), _AT_ONCE):
        rows = slice(start, start + _AT_ONCE)
        count = len(points[rows])
        frames = sampling.frames(normals[rows], rng.uniform(0, 2 * np.pi, count))
        directions = np.einsum("nxy,nky->nkx", frames, sets[rng.integers(0, _SETS, count)]).astype(np.float32)
        origins = np.repeat(occluders.origins(points[rows], clearance[rows]), _LOOKS, axis=0)
        lengths = np.repeat((reach[rows] * occluders.scale).astype(np.float32), _LOOKS)
        met = occluders.blocked(origins, np.ascontiguousarray(directions.reshape(-1, 3)), lengths) == 0
        out[rows] = met.reshape(count, _LOOKS).mean(1) >= SHARE
    return out & np.any(normals, axis=1)
