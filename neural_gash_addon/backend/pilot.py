# SPDX-License-Identifier: GPL-3.0-or-later
"""The planner's pilot: a few points of a mesh, traced twice with rays of their own, and what they say about all.

The product of the two traces gives the energy of transfer, of its bands and of what is blocked, without noise; their
difference the noise of a number of rays; and the clock what a ray costs here and now. The bake that is then picked goes
on from it: it need not look again at what the pilot saw.
"""
from __future__ import annotations

from collections.abc import Generator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import spherical_harmonics as sh
from .estimator import LEAST_RAYS_PER_JOB, MAX_RAYS, RATE, BlockedEstimator, morton_order
from .geometry import TriangleMesh
from .hybrid import levelled
from .progress import clocked
from .raycast import Occluders
from .workers import spread

POINTS = 256                  # or a 16th of them all, if that is less; or a 256th, if that is more
_FEWEST, _MOST = 128, 2048
DENSE = 1 << 16               # points from which on bakes are tried at some of them: one
_MOST_TRIED, _APART = 256, 1024  # of so many
_NOISE, _NOISE_RAYS = 0.035, 64  # the noise of so many rays is no more on most meshes
_LEAST_RAYS, _MOST_RAYS = 8, 256
_SETS = 8
_UNEVEN = 1.1                 # of the noise of rays that are no power of two, and so no whole net, to that of such
_BESIDES = 16.0               # what a point of these costs besides its rays, in rays
DARK = 1e-3                  # of the transfer in the open: less than this is as good as none
_FEEBLE = 2.0                 # of light: sizes of points' energies beside their sum, from which on that is mostly noise
_UNSEEN = 0.05                # of the noise: what differs less is not seen
_SURE = 1.3                   # standard errors of a share that are added to it, to be above it in nine cases of ten


@dataclass(frozen=True, eq=False)
class Near:
    """A hybrid bake, tried at m of a pilot's points and those beside them."""

    rays: int
    points: NDArray   # (m,) which of the sample
    traced: NDArray   # (m, K) what is blocked, by so many rays,
    taken: NDArray    # and as the network has it
    curve: Any        # `hybrid_bake.Curve`, of all points


@dataclass(frozen=True, eq=False)
class Apart:
    """A sparse bake, tried at m of a pilot's points."""

    points: NDArray   # (m,) which of the sample
    read: NDArray     # (m, K) what is blocked, read off samples some points apart
    curve: NDArray    # `sparse_bake.curve`, of all points: which of the mesh's they are


@dataclass(frozen=True, eq=False)
class Pilot:
    """What a few points say about all."""

    blocked: float    # |T_unshadowed - T| / |T|,
    most_blocked: float   # and a bound of it that is met in nine cases of ten
    noise: float      # relative to |T|, of so many
    rays: int         # rays
    scale: float      # root mean square of |T|; 0 in the dark
    ray: float        # seconds of one, on one thread
    traced: int       # rays in all
    sample: tuple[NDArray, NDArray, NDArray]  # points (n,) along a curve, and the blocked part (n, K) of each trace
    varies: float     # what is blocked, from one of them to the next, root mean square of |T|
    turns: float      # their normals, likewise
    unshadowed: NDArray = field(default_factory=lambda: np.zeros((0, 0)))  # (n, K), of these points
    threads: int = 1  # that a bake has
    near: Near | None = None    # where points are many: what bakes for such meshes
    apart: Apart | None = None  # have shown

    def to_order(self, order: int) -> Pilot:
        """What it would be, had it been traced at a lower order."""
        points, one, two = self.sample
        terms = sh.coefficient_count(order)
        said = _said((points, one[:, :terms], two[:, :terms]), self.turns, self.unshadowed[:, :terms], self.rays,
                     self.ray, self.traced, self.threads)
        near, apart = self.near, self.apart
        return replace(
            said, near=near and replace(near, traced=near.traced[:, :terms], taken=near.taken[:, :terms]),
            apart=apart and replace(apart, read=apart.read[:, :terms]))

    def some(self, points: int) -> NDArray[np.int64]:
        """Which of the sample (m,) a bake of so many points, dense as they are, is tried at: spread over all of it."""
        count = min(len(self.sample[0]), _MOST_TRIED, points // _APART)
        return np.linspace(0, len(self.sample[0]) - 1, count).astype(np.int64)

    def beyond(self, order: int) -> tuple[float, float]:
        """What the bands from `order` on are of |T|, and a bound as of `most_blocked`; infinite in the dark."""
        lights, _ = self._energies()
        if dark(float(lights.sum()), self.unshadowed):
            return np.inf, np.inf
        return _part(lights[:, sh.coefficient_count(order):].sum(1), lights.sum(1))

    def without_shadows(self, order: int) -> tuple[float, float]:
        """The error of unshadowed transfer at a lower order, of |T|, and a bound as above."""
        lights, shadows = self._energies()
        terms = sh.coefficient_count(order)
        return _part(shadows[:, :terms].sum(1) + lights[:, terms:].sum(1), lights.sum(1))

    def _energies(self) -> tuple[NDArray, NDArray]:
        """(n, K) squares of transfer and of what is blocked, without noise."""
        _, one, two = self.sample
        return (self.unshadowed - one) * (self.unshadowed - two), one * two

    def error_of(self, coefficients: NDArray) -> float | None:
        """The relative L2 error of transfer (N, K) of all points, by these; None in the dark, or where little more than
        noise is left of the light, which it is relative to.

        Both traces' noise is independent, so it cancels in the product. An error that is too small to be told from what
        is left of it (the standard error of its square) is said to be as large as that.
        """
        points, one, two = self.sample
        return error_by_twins(self.unshadowed - coefficients[points], one, two, self.unshadowed)

    def seconds(self, points: int, rays: float) -> float:
        """Of so many rays, or what takes as long, from each of some points."""
        every = points * rays
        among = min(self.threads, max(every / LEAST_RAYS_PER_JOB, 1)) if spread(self.threads, every) else 1
        return self.ray * every / among

    def noise_of(self, rays: float) -> float:
        """The relative error of a plain bake with so many rays."""
        return self.noise * noise_beside(self.rays, rays)

    def needed_rays(self, tolerance: float) -> float:
        """Rays of a plain bake that meet the tolerance."""
        if not np.isfinite(self.noise):
            return MAX_RAYS
        return float(np.clip(self.rays * (self.noise / tolerance) ** (2 / RATE), 1, MAX_RAYS))


def look(mesh: TriangleMesh, scene: Occluders, order: int, tolerance: float, seed: int, pool: Executor,
         threads: int) -> Generator[float, None, Pilot]:
    """Trace a few points twice, with rays whose noise is about the tolerance. Yields progress."""
    lit = mesh.lit()
    rng = np.random.default_rng([seed, 5])
    wanted = sample_size(len(lit))
    points = rng.choice(lit, wanted, replace=False)
    points = points[morton_order(mesh.points[points])] if wanted else points
    few = replace(mesh, points=mesh.points[points], normals=mesh.normals[points], clearance=mesh.clearance[points])
    rays = pilot_rays(tolerance)
    unshadowed = sh.cosine_lobe(few.normals, order)
    (one, two, jobs), taken = yield from clocked(twice(few, scene, order, rays, seed, pool, threads))
    among = min(threads, jobs) if isinstance(pool, ThreadPoolExecutor) else 1
    ray = taken * among / (2 * (rays + _BESIDES) * max(wanted, 1))
    turns = float(np.square(np.diff(few.normals, axis=0)).sum(1).mean()) ** 0.5 if wanted > 1 else 0.0
    return _said((points, one, two), turns, unshadowed, rays, ray, 2 * rays * wanted, threads)


def twice(few: TriangleMesh, scene: Occluders, order: int, rays: int, seed: int, pool: Executor, threads: int
          ) -> Generator[float, None, tuple[NDArray[np.float64], NDArray[np.float64], int]]:
    """The blocked part (n, K) of the points of a mesh, twice, with independent rays; in how many jobs. Yields progress.

    Independent of a bake with the same seed too, but not of each other: where they are as many, directions are at hand.
    """
    own = int(np.random.default_rng([seed, 5]).integers(2**31))
    rows = np.tile(np.arange(len(few.points)), 2)  # at once: what a trace costs at all is much, where points are few
    of = replace(few, points=few.points[rows], normals=few.normals[rows], clearance=few.clearance[rows])
    twins, every = BlockedEstimator(of, scene, order, own, rays, _SETS, twins=True), np.arange(len(rows))
    sums = np.zeros((len(rows), sh.coefficient_count(order)))
    yield from twins.trace(pool, threads, every, 0, rays, sums)
    one, two = np.split(twins.turned_here(every, twins.means(every, sums, 0, rays)), 2)
    return one, two, twins.jobs(every, 0, rays)


def dark(energy: float, unshadowed: NDArray) -> bool:
    """Whether so much energy of transfer at some points is as good as none beside that in the open (n, K)."""
    return energy <= DARK ** 2 * float(np.square(unshadowed).sum())


def least_scale(order: int) -> float:
    """Root mean square of |T| below which it is dark: a tolerance is of no less than that."""
    return DARK * float(np.linalg.norm(sh.cosine_lobe(np.array([[0.0, 0.0, 1.0]]), order)))


def relative(squared: float, lights: NDArray, unshadowed: NDArray) -> float | None:
    """The root of a squared error beside the energies of transfer (n,) at the same points, (n, K) in the open.

    None in the dark, or where little more than noise is left of the light.
    """
    energy = float(lights.sum())
    if dark(energy, unshadowed) or float(np.abs(lights).sum()) > _FEEBLE * energy:
        return None
    return (max(squared, 0.0) / energy) ** 0.5


def error_by_twins(blocked: NDArray, one: NDArray, two: NDArray, open_sky: NDArray) -> float | None:
    """The relative L2 error of an answer at points, by two traces of their own; None as of `relative`.

    Both traces' noise is independent, so it cancels in the product. An error that is too small to be told from the
    standard error of its square is said to be as large as that.

    blocked: (n, K), the answer's blocked part. one, two: (n, K). open_sky: (n, K) unshadowed transfer.
    """
    squares = ((blocked - one) * (blocked - two)).sum(1)
    least = float(np.square(squares).sum()) ** 0.5
    return relative(max(float(squares.sum()), least), ((open_sky - one) * (open_sky - two)).sum(1), open_sky)


def noise_beside(rays: float, others: float) -> float:
    """The noise of a plain bake with other rays, as a part of that with a power of two of them."""
    uneven = _UNEVEN if np.log2(others) % 1 else 1.0
    return float(uneven * (rays / others) ** (RATE / 2))


def _said(sample: tuple[NDArray, NDArray, NDArray], turns: float, unshadowed: NDArray, rays: int, ray: float,
          traced: int, threads: int) -> Pilot:
    """What a sample says."""
    _, one, two = sample
    lights = ((unshadowed - one) * (unshadowed - two)).sum(1)
    energy = float(lights.sum())
    if dark(energy, unshadowed):
        return Pilot(np.inf, np.inf, np.inf, rays, 0.0, ray, traced, sample, np.inf, turns, unshadowed, threads)
    noise = float(np.square(one - two).sum()) / 2 / energy
    first, second = (np.diff(levelled(trace, unshadowed, -1), axis=0) for trace in (one, two))
    apart = float((first * second).sum(dtype=np.float64)) * len(one) / max(len(one) - 1, 1) / energy
    return Pilot(*_part((one * two).sum(1), lights), noise ** 0.5, rays, (energy / len(one)) ** 0.5, ray, traced,
                 sample, max(apart, _UNSEEN ** 2 * noise) ** 0.5, turns, unshadowed, threads)


def _part(energies: NDArray, of: NDArray) -> tuple[float, float]:
    """Root of the share of energies (n,) in others (n,), summed over points; and with its standard error added."""
    whole = float(of.sum())
    if whole <= 0:
        return np.inf, np.inf
    share = max(float(energies.sum()), 0.0) / whole
    unsure = float(np.square(energies - share * of).sum()) ** 0.5 / whole
    return share ** 0.5, (share + _SURE * unsure) ** 0.5


def sample_size(points: int) -> int:
    """How many of some points speak for all."""
    return min(max(_FEWEST, min(POINTS, points // 16), min(_MOST, points // 256)), points)


def looking(points: int, tolerance: float) -> int:
    """Rays of a look at some of so many points."""
    return 2 * sample_size(points) * pilot_rays(tolerance)


def pilot_rays(tolerance: float) -> int:
    """Rays, a power of two, whose noise is about the tolerance: fewer say too little, more cost too much."""
    wanted = _NOISE_RAYS * (_NOISE / tolerance) ** (2 / RATE)
    return int(np.clip(2 ** round(float(np.log2(wanted))), _LEAST_RAYS, _MOST_RAYS))
