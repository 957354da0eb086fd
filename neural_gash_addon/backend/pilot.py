# SPDX-License-Identifier: GPL-3.0-or-later
"""The planner's pilot: a few points of a mesh, traced twice with rays of their own, and what they say about all.

The product of the two traces gives the energy of transfer and of what is blocked, without noise; their difference the
noise of a number of rays; and the clock what a ray costs here and now, so no table of machine speeds is kept that could
prove wrong. The bake that is then picked goes on from it: it need not look again at what the pilot saw.
"""
from __future__ import annotations

import time
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import spherical_harmonics as sh
from .estimator import MAX_RAYS, RATE, BlockedEstimator
from .geometry import TriangleMesh
from .raycast import Occluders

POINTS = 256                  # or a 16th of them all, if that is less; or a 256th, if that is more
_FEWEST, _MOST = 128, 2048
_NOISE, _NOISE_RAYS = 0.035, 64  # the noise of so many rays is no more on most meshes
_LEAST_RAYS, _MOST_RAYS = 16, 128
_SETS = 4
_UNEVEN = 1.1                 # of the noise of rays that are no power of two, and so no whole net, to that of such
_BESIDES = 4.0                # what a point costs besides its rays, in rays


@dataclass(frozen=True, eq=False)
class Pilot:
    """What a few points say about all."""

    blocked: float    # |T_unshadowed - T| / |T|,
    most_blocked: float   # and a bound of it that is met in nine cases of ten
    noise: float      # relative to |T|, of so many
    rays: int         # rays
    scale: float      # root mean square of |T|
    ray: float        # seconds of one
    traced: int       # rays in all
    sample: tuple[NDArray, NDArray, NDArray]  # points (n,), and the blocked part (n, K) as each trace has it

    def noise_of(self, rays: float) -> float:
        """The relative error of a plain bake with so many rays."""
        uneven = _UNEVEN if np.log2(rays) % 1 else 1.0
        return uneven * self.noise * (self.rays / rays) ** (RATE / 2)

    def needed_rays(self, tolerance: float) -> float:
        """Rays of a plain bake that meet the tolerance."""
        if not np.isfinite(self.noise):
            return MAX_RAYS
        return float(np.clip(self.rays * (self.noise / tolerance) ** (2 / RATE), 1, MAX_RAYS))


def look(mesh: TriangleMesh, scene: Occluders, order: int, tolerance: float, seed: int, pool: ThreadPoolExecutor,
         threads: int) -> Generator[float, None, Pilot]:
    """Trace a few points twice, with rays whose noise is about the tolerance. Yields progress."""
    lit = np.flatnonzero(np.any(mesh.normals != 0, axis=1))
    rng = np.random.default_rng([seed, 5])
    wanted = sample_size(len(lit))
    points = np.sort(rng.choice(lit, wanted, replace=False))
    few = replace(mesh, points=mesh.points[points], normals=mesh.normals[points], clearance=mesh.clearance[points])
    rays = pilot_rays(tolerance)
    unshadowed = sh.cosine_lobe(few.normals, order)
    rows, found = np.arange(wanted), []
    began = time.perf_counter()
    for _ in range(2):
        twin = BlockedEstimator(few, scene, order, int(rng.integers(2**31)), rays, _SETS)
        sums = np.zeros_like(unshadowed)
        yield from twin.trace(pool, threads, rows, 0, rays, sums)
        found.append(twin.turned_here(rows, twin.means(rows, sums, 0, rays)))
    spent = time.perf_counter() - began
    one, two = found
    ray = spent / (2 * (rays + _BESIDES) * max(wanted, 1))
    lights = ((unshadowed - one) * (unshadowed - two)).sum(1)
    energy = float(lights.sum())
    sample = points, one, two
    if energy <= 0:
        return Pilot(np.inf, np.inf, np.inf, rays, 0.0, ray, 2 * rays * wanted, sample)
    shadows = (one * two).sum(1)
    share = max(float(shadows.sum()), 0.0) / energy
    unsure = float(np.square(shadows - share * lights).sum()) ** 0.5 / energy  # standard error of the share
    noise = float(np.square(one - two).sum()) / 2 / energy
    return Pilot(share ** 0.5, (share + 1.3 * unsure) ** 0.5, noise ** 0.5, rays, (energy / wanted) ** 0.5, ray,
                 2 * rays * wanted, sample)


def sample_size(points: int) -> int:
    """How many of some points speak for all."""
    return min(max(_FEWEST, min(POINTS, points // 16), min(_MOST, points // 256)), points)


def pilot_rays(tolerance: float) -> int:
    """Rays, a power of two, whose noise is about the tolerance: fewer say too little, more cost too much."""
    wanted = _NOISE_RAYS * (_NOISE / tolerance) ** (2 / RATE)
    return int(np.clip(2 ** round(float(np.log2(wanted))), _LEAST_RAYS, _MOST_RAYS))
