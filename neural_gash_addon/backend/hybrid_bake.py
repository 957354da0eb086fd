# SPDX-License-Identifier: GPL-3.0-or-later
"""The hybrid bake: few rays from every point, then the network's mean of neighbours (`hybrid`)."""
from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from . import embree_bake
from . import spherical_harmonics as sh
from .estimator import MAX_RAYS, RATE, BlockedEstimator, blocked_at, morton_order, places_along
from .geometry import TriangleMesh
from .hybrid import SIZE, between, evenness, filtered, placed, second_curve
from .pilot import Near, Pilot, dark, pilot_rays, sample_size
from .progress import run, scaled
from .raycast import Geometry, Occluders
from .record import BakeRecord
from .shares import error_at, nearest
from .transfer import Transfer
from .weights import load_hybrid
from .workers import default_threads, workers

FIRST_RAYS = 4        # of a bake to a tolerance, where nothing is known beforehand
# Rays of one to a tolerance. A quarter more than a power of two takes 6 % off the noise, a half 21 %, three quarters
# 29 %, and twice as many 41 %: so three quarters are not among them.
_LADDER = sorted([2, 3, *(n << k for k in range(10) for n in (4, 5, 6)), MAX_RAYS])
# The error beside that of a plain bake: the more what is blocked varies from one point of the pilot to the next, beside
# the noise, and the more normals turn from one to the next, the less neighbours save; and of more points, more.
# (Least squares of logarithms, 204 bakes of 60 meshes of meshes/train: the rays wanted are told to 30 %.)
_BESIDE, _VARIES, _TURNS, _MANY = 0.67, 0.29, 0.46, 0.06
# On dense meshes what neighbours save is tried: with each of some of the pilot's points the ones beside it, two blocks
# of both passes; with so much of the rays that the law above expects. The bake's own error is so much of that, as most
# of its blocks are not cut off. (24 meshes of meshes/train, subdivided to 70,000 to 180,000 points: the rays wanted are
# told to 28 %, by the law, which is 1.5 times too high there, to 50 %.)
_TRIED, _TRIED_RAYS, _INSIDE = 2 * SIZE, 0.25, 0.9
_FALLS = 0.55         # the error falls as rays**-_FALLS, for saying how many rays more are wanted
_MOST_STEP = 2.0      # from a number of rays to the next
_MARGIN = 0.97        # of the tolerance at which it stops: of several measures the first that is too low is met
# With fewer points, what the network costs whatever their number is worth more as rays: twice as many are traced, up to
# so many. (Tuned on meshes/train: of its four of 500 to 650 points two had a larger error with the network than Embree
# in the same time, of larger ones none.)
FEWEST, MOST_DOUBLED = 20 * SIZE, 64
# As many where the normals of a block face all ways, as those of leaves and wires do: neighbours tell nothing there.
# (Length of their mean, squared, in the mean of the blocks; of 49 meshes of meshes/train two have less, and only these
# had a larger error with the network than Embree in the same time, estimated.)
_LEAST_EVEN = 0.1
_PASSES = 4           # what the network costs at each point, in rays
_ROWS = 1 << 14       # whose unshadowed transfer one worker computes at a time
_SAMPLE = 128         # points at which the error is measured, or a 256th of them if that is more
_MOST_SAMPLE = 2048
# Rays of each of two independent traces there, where the bake's are given: as many as those, or twice as many where
# that is little beside the rays of all points. A larger error needs fewer to be measured; but with 4 it comes out too
# low, perhaps as means over few rays err alike in the sample and in the bake.
_TWICE_FROM, _LEAST_SAMPLE_RAYS, _MOST_SAMPLE_RAYS = 8192, 8, 128


def bake(mesh: TriangleMesh, order: int, *, rays: int | None, tolerance: float | None,
         occluders: Sequence[Geometry], seed: int, threads: int | None, scene: Occluders | None = None,
         pilot: Pilot | None = None) -> Generator[float, None, Transfer]:
    """Trace `mesh` against itself and `occluders`, and take from neighbours; arguments as `methods.bake`.

    With a tolerance there are more rays until the measured error is within it, or they are MAX_RAYS. Of fewer than
    FEWEST points, and of leaves and wires, up to twice the rays are traced, and the network is not asked; nor is it in
    the dark, with a tolerance. Of others, one ray from each point is two from every other one.

    pilot: what is known beforehand; its points are those at which the error is measured.
    """
    began, asked = time.perf_counter(), tolerance
    threads = threads or default_threads()
    if scene is None:
        scene = Occluders([(mesh.positions, mesh.triangles), *occluders], mesh.resolution)
    if tolerance is not None:
        tolerance *= _MARGIN
    lit = mesh.lit()
    if pilot is not None and pilot.near is not None:
        curve = pilot.near.curve
    else:
        curve = Curve(mesh, lit) if len(lit) >= FEWEST else None

    def plainly(spent: int = 0) -> Generator[float, None, Transfer]:
        more = None if rays is None else max(rays, min(2 * rays, MOST_DOUBLED))
        found = yield from embree_bake.bake(mesh, order, rays=more, tolerance=tolerance, occluders=occluders, seed=seed,
                                            threads=threads, scene=scene, pilot=pilot, fewest=_SAMPLE)
        return Transfer(found.coefficients, replace(
            found.record, method="hybrid", tolerance=asked, probe_rays=found.record.probe_rays + spent,
            seconds=time.perf_counter() - began))

    if curve is None or evenness(curve.normals) < _LEAST_EVEN or (pilot is not None and not pilot.scale):
        return (yield from plainly())
    coefficients = np.zeros((len(mesh.points), sh.coefficient_count(order)), np.float32)
    last = stop = rays or MAX_RAYS
    used, probes, left = 0, 0, 1.0
    if tolerance is not None:
        stop = FIRST_RAYS if pilot is None else expected_rays(pilot, len(lit), tolerance)
    with workers(threads, len(lit) * (stop + _PASSES)) as pool:
        work = _Work(mesh, scene, order, seed, last, curve, pool, threads, asked, pilot.rays if pilot else None,
                     samples=pilot is None)
        # beside the rest, which waits for rays
        sample = pool.submit(work.sample) if pilot is None else pool.submit(work.along, *pilot.sample)
        while True:
            share = left if tolerance is None else left / 2
            traced, taken = yield from scaled(work.trace(used, stop), 1 - left, share)
            used, left, probes = stop, left - share, work.probes if pilot is None else 0
            if tolerance is not None and work.dark(*sample.result()):
                return (yield from scaled(plainly(probes + used * len(lit)), 1 - left, left))
            blocked, here = work.blended(traced, taken, *sample.result())
            error = work.error(here, traced, used, *sample.result())
            if used == last or (error is not None and tolerance is not None and error <= tolerance):
                coefficients[work.lit] = work.unshadowed - blocked
                break
            stop = _more(used, error, tolerance)
    return Transfer(coefficients, BakeRecord(
        method="hybrid", order=order, points=len(mesh.points), domain=mesh.domain, seed=seed, rays=used * len(lit),
        probe_rays=probes, seconds=time.perf_counter() - began, error_estimate=error, tolerance=asked))


def expected_rays(pilot: Pilot, points: int, tolerance: float) -> int:
    """Rays with which a bake of so many points is expected to meet a tolerance."""
    near = pilot.near
    if near is not None and (error := _error_near(pilot, near)) is not None:
        return _on_ladder(near.rays * (_INSIDE * error / tolerance) ** (1 / _FALLS))
    saved = _BESIDE * pilot.turns ** _TURNS * points ** -_MANY
    plain = pilot.needed_rays(tolerance)  # the noise with these is the tolerance
    # saved * (varies / noise) ** _VARIES * noise = tolerance, if that is less than the noise
    beside = saved * (pilot.varies / tolerance) ** _VARIES
    fewer = min(beside, 1.0) ** (2 / RATE / (1 - _VARIES))
    return _on_ladder(plain * fewer)


def _error_near(pilot: Pilot, near: Near) -> float | None:
    """Of the bake that was tried; None where it cannot be told."""
    one, two = (trace[near.points] for trace in pilot.sample[1:])
    moved = near.taken - near.traced
    _, others = nearest(near.traced, moved, one, two)
    return error_at(near.traced + others * moved, near.traced, near.rays, one, two, pilot.rays,
                    pilot.unshadowed[near.points])


def tried(mesh: TriangleMesh, scene: Occluders, order: int, pilot: Pilot, tolerance: float, seed: int, pool: Executor,
          threads: int) -> Generator[float, None, Pilot]:
    """Try what neighbours save on a dense mesh, of which a pilot's points, far apart, say little: around some of them.

    Those and the ones beside them along the curve are baked, with fewer rays than the tolerance will want.

    Returns:
        The pilot, with that in it where the network would be asked at all.
    """
    lit = mesh.lit()
    curve = Curve(mesh, lit)
    if evenness(curve.normals) < _LEAST_EVEN:
        return pilot
    some = pilot.some(len(lit))
    at = curve.place(len(mesh.points))[pilot.sample[0][some]]
    first = np.clip(at - _TRIED // 2, 0, len(lit) - _TRIED)
    along = (first[:, None] + np.arange(_TRIED)).ravel()
    rows = curve.lit[along]
    rays = _on_ladder(max(_TRIED_RAYS * expected_rays(pilot, len(lit), tolerance), FIRST_RAYS))
    own = int(np.random.default_rng([seed, 6]).integers(2**31))
    curved = pool.submit(lambda: curve.second)  # beside the rest, which waits for rays
    traced = yield from blocked_at(mesh, rows, scene, order, own, rays, pool, threads)
    rank = places_along(curved.result(), len(lit))
    second = np.argsort(rank[along].reshape(-1, _TRIED), 1) + np.arange(0, len(along), _TRIED)[:, None]
    taken = filtered(curve.places[along], curve.normals[along], (None, second.ravel()), traced,
                     sh.cosine_lobe(mesh.normals[rows], order).astype(np.float32), rays, load_hybrid(), pool)
    here = np.arange(0, len(along), _TRIED) + at - first
    return replace(pilot, near=Near(rays, some, traced[here], taken[here], curve),
                   traced=pilot.traced + rays * len(rows))


def _more(rays: int, error: float | None, tolerance: float | None) -> int:
    """Rays with which a bake meets the tolerance, if with so many it has this error."""
    times = 2.0 if error is None or tolerance is None else (error / tolerance) ** (1 / _FALLS)
    return _on_ladder(max(rays * min(times, _MOST_STEP), rays + _PASSES))


def _on_ladder(rays: float) -> int:
    """At least so many."""
    return next((number for number in _LADDER if number >= rays), MAX_RAYS)


def at_once(mesh: TriangleMesh, occluders: Sequence[Geometry], order: int, rays: int, seed: int) -> NDArray[np.float32]:
    """Transfer (N, K) as the network has it, for frames that come one after another: nothing is measured, so the
    network is followed wholly. That is right where rays are few.
    """
    scene = Occluders([(mesh.positions, mesh.triangles), *occluders], mesh.resolution)
    coefficients = np.zeros((len(mesh.points), sh.coefficient_count(order)), np.float32)
    threads = default_threads()
    lit = mesh.lit()
    if len(lit):
        with workers(threads, len(lit) * (rays + _PASSES)) as pool:
            work = _Work(mesh, scene, order, seed, rays, Curve(mesh, lit), pool, threads)
            coefficients[work.lit] = work.unshadowed - run(work.trace(0, rays))[1]
    return coefficients


class Curve:
    """The n points (at least one) that have a normal, along the first curve."""

    def __init__(self, mesh: TriangleMesh, lit: NDArray) -> None:
        places, normals = placed(mesh.points[lit], mesh.normals[lit])
        order = morton_order(places)
        self.lit = lit[order]          # (n,) which of the mesh's they are
        self.places = places[order]    # (n, 3) as `filtered` wants them,
        self.normals = normals[order]  # (n, 3) likewise

    @cached_property
    def second(self) -> NDArray[np.int64]:
        """(n,) the second curve, of places along the first."""
        return second_curve(self.places)

    def place(self, points: int) -> NDArray[np.int64]:
        """Where along the curve each of the mesh's points is; anything, of those that have no normal."""
        return places_along(self.lit, points)


class _Work:
    """The arrays of one bake, of the n points that have a normal, along the first curve."""

    def __init__(self, mesh: TriangleMesh, scene: Occluders, order: int, seed: int, rays: int, curve: Curve,
                 pool: Executor, threads: int, tolerance: float | None = None, sample_rays: int | None = None,
                 samples: bool = False) -> None:
        """rays: the most. sample_rays: of a pilot's points. samples: whether `sample` is wanted."""
        self._order, self._seed, self._curve, self._points = order, seed, curve, len(mesh.points)
        self._pool, self._threads, self._network = pool, threads, load_hybrid()
        self.lit, count = curve.lit, len(curve.lit)
        self._second = pool.submit(lambda: curve.second)  # beside the rest, which waits for rays
        self.unshadowed = np.empty((count, sh.coefficient_count(order)), np.float32)  # (n, K), `filled`

        def fill(start: int) -> None:
            rows = slice(start, start + _ROWS)
            self.unshadowed[rows] = sh.cosine_lobe(mesh.normals[self.lit[rows]], order)

        self._filled = pool.map(fill, range(0, count, _ROWS))
        self._sums = np.zeros(self.unshadowed.shape)
        times = float(np.clip(2 * count / _TWICE_FROM, 1, 2))
        self._sample_size = min(count, max(_SAMPLE, min(count // 256, _MOST_SAMPLE)))
        self._sample_rays = int(np.clip(round(times * rays), _LEAST_SAMPLE_RAYS, _MOST_SAMPLE_RAYS))
        if tolerance is not None:
            self._sample_size, self._sample_rays = sample_size(count), sample_rays or pilot_rays(tolerance)
        self.probes = 2 * self._sample_size * self._sample_rays
        self._estimator = BlockedEstimator(mesh, scene, order, seed, max(rays, self._sample_rays), spare=samples)
        if samples:
            self._estimator.prepare(self._sample_rays)  # once for both

    def trace(self, start: int, stop: int) -> Generator[float, None, tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """The blocked part of all points from directions start..stop in addition to those before.

        Where `stop` is 1, two rays are traced from every other point along the curve.

        Returns:
            (n, K) as it was traced, and as the network has it.
        """
        half = stop == 1  # one ray says nothing of where it came from, two do
        if half:
            stop = 2
        lit, sums = (self.lit[::2], self._sums[::2]) if half else (self.lit, self._sums)
        yield from self._estimator.trace(self._pool, self._threads, lit, start, stop, sums)
        list(self._filled)
        traced = self._estimator.blocked(self._pool, lit, sums, stop)
        if half:
            traced = between(traced, self.unshadowed, self._pool)
        return traced, filtered(self._curve.places, self._curve.normals, (None, self._second.result()), traced,
                                self.unshadowed, stop, self._network, self._pool)

    def sample(self) -> tuple[NDArray, NDArray, NDArray]:
        """Some of the points (s,), and two independent traces (s, K) of their blocked part; on the calling thread."""
        rng = np.random.default_rng([self._seed, 1])
        points = np.sort(rng.choice(len(self.lit), self._sample_size, replace=False))
        twins = self._estimator.apart(self.lit[points], rng)
        rows = np.arange(2 * len(points))
        sums = twins.summed(rows, 0, self._sample_rays)
        one, two = np.split(twins.turned_here(rows, twins.means(rows, sums, 0, self._sample_rays)), 2)
        return points, one, two

    def along(self, points: NDArray, one: NDArray, two: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """What `sample` gives, of points of the mesh that were traced before."""
        return self._curve.place(self._points)[points], one, two

    def blended(self, traced: NDArray, taken: NDArray, points: NDArray, one: NDArray, two: NDArray
                ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """traced + share * (taken - traced), with the share of each band that is nearest the truth (`shares`).

        Returns:
            (n, K) of all points; and (s, K) of the sample, each with the shares that all others say are nearest.
        """
        moved = taken - traced
        here, was = moved[points], traced[points]
        every, others = nearest(was, here, one, two)
        moved *= every.astype(np.float32)
        moved += traced
        return moved, was + others * here

    def dark(self, points: NDArray, one: NDArray, two: NDArray) -> bool:
        """Whether it is, at the sample."""
        open_sky = self.unshadowed[points]
        return dark(float(((open_sky - one) * (open_sky - two)).sum()), open_sky)

    def error(self, blocked: NDArray, traced: NDArray[np.float32], rays: int, points: NDArray, one: NDArray,
              two: NDArray) -> float | None:
        """Relative L2 error at the sample, where `blocked` (s, K) is the answer, and `traced` (n, K) had `rays`."""
        return error_at(blocked, traced[points], rays, one, two, self._sample_rays, self.unshadowed[points])
