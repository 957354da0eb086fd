# SPDX-License-Identifier: GPL-3.0-or-later
"""The sparse bake: the blocked part is traced at some points, and read off those at the others (`sparse`).

On a dense scan the blocked part varies slowly from vertex to vertex. Points are put in an order in which neighbours are
near and face alike (octant of the normal, then a Z-order curve). Every so many of them are traced, then the middle of
each gap whose ends differ most, until the error is within the tolerance. That error is measured in each round at a
pilot's points, or fresh ones that were held back, traced twice with rays of their own, so it has everything in it:
noise and reconstruction.
What is not blocked is exact everywhere, as in the other methods. Where points are too few for all this, every point is
traced, as by `embree`; or few rays from every point, as by `hybrid`, where a pilot says that this costs far less.
"""
from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import embree_bake, hybrid_bake
from . import spherical_harmonics as sh
from .estimator import MAX_RAYS, RATE, blocked_at, morton_order, places_along
from .geometry import TriangleMesh
from .hybrid import dot, levelled
from .pilot import DENSE, Apart, Pilot, dark, error_by_twins
from .progress import scaled
from .raycast import Geometry, Occluders
from .record import BakeRecord
from .transfer import Transfer
from .workers import default_threads, workers

WINDOW = 8             # samples along the curve that a point is read off
FIRST_STRIDE = 64      # points from one sample to the next at the beginning, or fewer where points are few
FEWEST = 4096          # samples at the beginning
_LEAST_STRIDE = 4      # with less than so many points for each of them, every point is traced
HELD = 512             # points held back in each round, without a pilot
_HELD_RAYS = 64        # of each of their two traces
_NOISE = 1.2           # times the tolerance: a sample's own noise, of which the mean over several leaves less than half
_LEAST_RAYS = 8
_WORTH = 0.5           # of the rays that a bake of every point takes: where more are still wanted, that is done instead
_POWER = 3.0           # of an error: how the samples that it takes grow (2.4 to 3.6 on dense meshes)
_TRIED = 8             # points from one sample to the next of a bake that is tried,
# The share that it traces of all points where it just stops there, and how that grows with the error (25 meshes of
# meshes/train, subdivided to 70,000 to 420,000 points; the share is told to a factor of 2).
_NEEDED, _GROW = 0.12, 4.0
_HOPELESS = 0.25       # share from which on it is expected to give up
# Of the tolerance, at which it stops, as of several measures the first that is too low is met; and at which it is
# content where more samples would cost as much as all points.
_MARGIN, _BARELY = 0.9, 0.95
_LOG_MOST = 60.0       # of a logarithm: more samples than there can be points
_LEAST_FALL = 0.03     # of an error as the samples double: with less it falls no more
_COVERED = 0.8         # of what the gaps' ends differ, closed in a round
_LEAST = 1e-18         # mean D: of points that are one
_TURN = 0.2            # of the extent: how far away a neighbour counts that faces a right angle away
SOFT = 0.05            # of the mean D of a window: what a sample's weight is bounded by
_HEIGHT = 8.0          # how much more a distance counts across the surface than along it, squared
_ROWS = 1 << 13        # reconstructed by one worker at a time


def bake(mesh: TriangleMesh, order: int, *, rays: int | None, tolerance: float | None,
         occluders: Sequence[Geometry], seed: int, threads: int | None, scene: Occluders | None = None,
         pilot: Pilot | None = None) -> Generator[float, None, Transfer]:
    """Trace some points of `mesh`, and reconstruct the rest; arguments as `methods.bake`. pilot: known beforehand.

    With a number of rays, the samples take so many each, and are as many as it takes for the whole to be as exact as
    if every point had been traced with them.
    """
    began = time.perf_counter()
    threads = threads or default_threads()
    if scene is None:
        scene = Occluders([(mesh.positions, mesh.triangles), *occluders], mesh.resolution)
    lit = mesh.lit()
    coefficients = np.zeros((len(mesh.points), sh.coefficient_count(order)), np.float32)
    spent = 0
    if len(lit) >= _LEAST_STRIDE * FEWEST:
        lit = lit[curve(mesh.points[lit], mesh.normals[lit])] if pilot is None or not pilot.apart else pilot.apart.curve
        with workers(threads) as pool:
            work = _Work(mesh, scene, order, seed, lit, pool, threads)
            error = yield from scaled(work.refine(rays, tolerance, pilot), 0, 0.8)
            traced = len(work.samples) * work.rays
            if error is not None:
                yield from scaled(work.fill(coefficients), 0.8, 0.2)
                return Transfer(coefficients, BakeRecord(
                    method="sparse", order=order, points=len(mesh.points), domain=mesh.domain, seed=seed, rays=traced,
                    probe_rays=work.probes, seconds=time.perf_counter() - began, error_estimate=error,
                    tolerance=tolerance))
        spent = traced + work.probes
    plainly: Callable[..., Generator[float, None, Transfer]] = embree_bake.bake
    if pilot is not None and tolerance is not None and pilot.scale:
        if pilot.near is None and len(lit) >= DENSE:
            before = pilot.traced
            with workers(threads) as pool:
                trying = hybrid_bake.tried(mesh, scene, order, pilot, tolerance, seed, pool, threads)
                pilot = yield from scaled(trying, 0.8, 0)
            spent += pilot.traced - before
        # half: what the network costs besides
        if hybrid_bake.expected_rays(pilot, len(lit), tolerance) < pilot.needed_rays(tolerance) / 2:
            plainly = hybrid_bake.bake
    every = yield from plainly(mesh, order, rays=rays, tolerance=tolerance, occluders=occluders, seed=seed,
                               threads=threads, scene=scene, pilot=pilot)
    return replace(every, record=replace(every.record, method="sparse", probe_rays=every.record.probe_rays + spent,
                                         seconds=time.perf_counter() - began))


def tried(mesh: TriangleMesh, scene: Occluders, order: int, pilot: Pilot, tolerance: float, seed: int, pool: Executor,
          threads: int) -> Generator[float, None, Pilot]:
    """Try to read some of a pilot's points off samples that are _TRIED apart, as a bake to a tolerance would.

    Returns:
        The pilot, with that in it.
    """
    lit = mesh.lit()
    lit = lit[curve(mesh.points[lit], mesh.normals[lit])]
    some, rng = pilot.some(len(lit)), np.random.default_rng([seed, 7])
    wanted = places_along(lit, len(mesh.points))[pilot.sample[0][some]]
    first = wanted - rng.integers((WINDOW // 2 - 1) * _TRIED, WINDOW // 2 * _TRIED, len(wanted))
    at = np.clip(first, 0, len(lit) - WINDOW * _TRIED)[:, None] + np.arange(0, WINDOW * _TRIED, _TRIED)
    rows = lit[at.ravel()]
    rays = _rays(pilot.noise_of(_HELD_RAYS), _MARGIN * tolerance)
    blocked = yield from blocked_at(mesh, rows, scene, order, int(rng.integers(2**31)), rays, pool, threads)
    values = levelled(blocked, sh.cosine_lobe(mesh.normals[rows], order), -1)
    samples, here = Samples.at(scene.normalise(mesh.points[rows]), mesh.normals[rows], values), lit[wanted]
    read = samples.read(np.arange(at.size).reshape(at.shape).T, scene.normalise(mesh.points[here]), mesh.normals[here])
    return replace(pilot, apart=Apart(some, levelled(read, pilot.unshadowed[some], 1), lit),
                   traced=pilot.traced + rays * len(rows))


def expected_rays(pilot: Pilot, points: int, tolerance: float) -> float:
    """Rays a point of a bake that was tried; infinite where so many samples are wanted that it would give up."""
    assert pilot.apart is not None
    some, read = pilot.apart.points, pilot.apart.read
    one, two = (trace[some] for trace in pilot.sample[1:])
    error = error_by_twins(read, one, two, pilot.unshadowed[some])
    if error is None:
        return np.inf
    goal = _MARGIN * tolerance
    share = max(_NEEDED * (error / goal) ** _GROW, 1 / FIRST_STRIDE, FEWEST / points)
    return share * _rays(pilot.noise_of(_HELD_RAYS), goal) if share < _HOPELESS else np.inf


def _rays(noise: float, tolerance: float) -> int:
    """Of a sample, if _HELD_RAYS have so much noise, relative."""
    wanted = _HELD_RAYS * (noise / (_NOISE * tolerance)) ** (2 / RATE) if noise else 0.0
    return int(2 ** np.ceil(np.log2(np.clip(wanted, _LEAST_RAYS, MAX_RAYS))))


def curve(points: NDArray, normals: NDArray) -> NDArray[np.int64]:
    """An order (N,) of points (N, 3) in which neighbours are near and have normals (N, 3) of one octant."""
    order = morton_order(points)
    octant = ((normals > 0) @ np.array([1, 2, 4])).astype(np.uint8)
    return order[np.argsort(octant[order], kind="stable")]


@dataclass(frozen=True, eq=False)
class Samples:
    """Some of the points, in the scene's coordinates (`Occluders.normalise`), and values at them.

    Points are along the last axis, as NumPy is quick along long ones.
    """

    places: NDArray[np.float32]  # (3, M)
    facing: NDArray[np.float32]  # (3, M) normals
    values: NDArray[np.float32]  # (K, M)

    @classmethod
    def at(cls, places: NDArray, normals: NDArray, values: NDArray) -> Samples:
        """Of rows (M, 3), (M, 3) and (M, K)."""
        return cls(*(np.ascontiguousarray(rows.T, np.float32) for rows in (places, normals, values)))

    def read(self, which: NDArray[np.int64], places: NDArray, normals: NDArray) -> NDArray[np.float32]:
        """Values (n, K) at other points (n, 3) with normals (n, 3), each the mean of those of some samples (w, n).

        A sample weighs 1 / (D + SOFT mean D)**2, where D = distance**2 + HEIGHT height**2 + TURN**2 (1 - cosine of the
        normals). So a sample, too, takes something of others: that is less noise.
        """
        here, normal = (np.ascontiguousarray(rows.T, np.float32) for rows in (places, normals))
        squares = np.empty(which.shape, np.float32)
        for square, chosen in zip(squares, which, strict=True):
            away = self.places.take(chosen, 1)
            away -= here
            np.square(dot(away, normal), out=square)
            square *= np.float32(_HEIGHT)
            square += dot(away, away)
            turned = self.facing.take(chosen, 1)
            turned -= normal
            square += np.float32(_TURN ** 2 / 2) * dot(turned, turned)  # 1 - cosine, exact where that is 0
        squares /= np.maximum(squares.mean(0), np.float32(_LEAST))
        squares += np.float32(SOFT)
        weights = 1 / np.square(squares, out=squares)
        weights /= weights.sum(0)
        out = np.zeros((len(self.values), which.shape[1]), np.float32)
        for weight, chosen in zip(weights, which, strict=True):
            part = self.values.take(chosen, 1)
            part *= weight
            out += part
        return out.T


def beside(samples: NDArray, wanted: NDArray) -> NDArray[np.int64]:
    """The WINDOW samples (M,), rising along a curve, that are nearest to other points (n,): rows of these (w, n)."""
    width = min(WINDOW, len(samples))
    first = np.clip(np.searchsorted(samples, wanted) - width // 2, 0, len(samples) - width)
    return first + np.arange(width)[:, None]


class _Work:
    """The samples of one bake; points are counted along the curve."""

    def __init__(self, mesh: TriangleMesh, scene: Occluders, order: int, seed: int, lit: NDArray,
                 pool: Executor, threads: int) -> None:
        self._scene, self._order, self._pool, self._threads = scene, order, pool, threads
        self._mesh = mesh
        self._lit = lit
        self._rng = np.random.default_rng([seed, 4])
        self.samples = np.zeros(0, np.int64)
        self._values = np.zeros((0, sh.coefficient_count(order)), np.float32)  # blocked part, see `levelled`
        self._sampled = Samples.at(*self._there(self.samples), self._values)
        self.rays, self.probes = 0, 0

    def refine(self, rays: int | None, tolerance: float | None, pilot: Pilot | None
               ) -> Generator[float, None, float | None]:
        """Add samples until the measured error is well within the tolerance; that error.

        None where every point had better be traced: that is known as soon as the error says how many samples are
        wanted, mostly after the first. If the tolerance is met by then, if barely, it is enough.
        """
        count = len(self._lit)
        known = None
        if pilot is not None and np.isfinite(pilot.noise):
            noise = pilot.noise_of(_HELD_RAYS)
            known = places_along(self._lit, len(self._mesh.points))[pilot.sample[0]], *pilot.sample[1:]
        else:
            held = yield from self._held(np.arange(count))
            noise = self._noise(*held)  # of _HELD_RAYS, relative
        if rays is not None:
            self.rays = rays
        else:
            assert tolerance is not None
            self.rays = _rays(noise, _MARGIN * tolerance)
        goal = noise * (_HELD_RAYS / self.rays) ** (RATE / 2) if tolerance is None else _MARGIN * tolerance
        if not goal:
            return None
        plain = self.rays if rays is not None else max(_HELD_RAYS * (noise / goal) ** (2 / RATE), _LEAST_RAYS)
        stride = max(1, min(FIRST_STRIDE, count // FEWEST))
        fresh = np.unique(np.append(np.arange(0, count, stride), count - 1))
        left = 1.0
        before: list[tuple[int, float]] = []  # samples, and the error with them
        while True:
            yield from scaled(self._sample(fresh), 1 - left, left / 2)
            left /= 2
            if known is None:
                apart = np.ones(count, bool)
                apart[self.samples] = False
                held = yield from scaled(self._held(np.flatnonzero(apart)), 1 - left, 0)
            error = self._error(*(known or held))
            if error is None or error <= goal:
                return error
            before.append((len(self.samples), error))
            fresh = self._to_close()
            wanted = max(self._wanted(before, goal, known is not None), len(fresh))
            if self.rays * wanted > _WORTH * plain * count:
                return error if tolerance is not None and error <= _BARELY * tolerance else None

    def _wanted(self, before: Sequence[tuple[int, float]], goal: float, same: bool) -> float:
        """How many more samples, by how many there were in each round and the errors with them; infinite where all are.

        same: whether all errors are of the same points, so that what they fell by is no accident.
        """
        count, error = before[-1]
        power, half = _POWER, [each for each in before if 2 * each[0] <= count]
        if not same:
            error = (error * before[max(len(before) - 2, 0)][1]) ** 0.5  # a single measure of few points errs much
        elif half:
            fell = np.log(half[-1][1] / error) / np.log(count / half[-1][0])
            power = max(power, 1 / max(float(fell), _LEAST_FALL))
        if count == len(self._lit):
            return np.inf
        return count * float(np.expm1(min(power * np.log(error / goal), _LOG_MOST)))

    def fill(self, coefficients: NDArray[np.float32]) -> Generator[float, None, None]:
        """Transfer (N, K) of all points that have a normal."""
        count = len(self._lit)

        def part(start: int) -> None:
            rows = np.arange(start, min(start + _ROWS, count))
            unshadowed = self._unshadowed(rows).astype(np.float32)
            blocked = self._at(rows, unshadowed)
            coefficients[self._lit[rows]] = unshadowed - blocked

        starts = range(0, count, _ROWS)
        for number, _ in enumerate(self._pool.map(part, starts)):
            yield (number + 1) / len(starts)

    def _at(self, rows: NDArray, unshadowed: NDArray) -> NDArray[np.float32]:
        """Blocked part (n, K) at some points, reconstructed."""
        return levelled(self._sampled.read(beside(self.samples, rows), *self._there(rows)), unshadowed, 1)

    def _there(self, rows: NDArray) -> tuple[NDArray[np.float32], NDArray]:
        """Some points (n, 3), in the scene's coordinates, and their normals."""
        chosen = self._lit[rows]
        return self._scene.normalise(self._mesh.points[chosen]), self._mesh.normals[chosen]

    def _unshadowed(self, rows: NDArray) -> NDArray[np.float64]:
        """Transfer (n, K) of some points, were nothing blocked."""
        return sh.cosine_lobe(self._mesh.normals[self._lit[rows]], self._order)

    def _sample(self, fresh: NDArray) -> Generator[float, None, None]:
        """Trace some points and add them to the samples."""
        blocked = yield from self._traced(fresh, self.rays)
        values = levelled(blocked.astype(np.float32), self._unshadowed(fresh), -1)
        samples = np.concatenate([self.samples, fresh])
        order = np.argsort(samples, kind="stable")
        self.samples, self._values = samples[order], np.concatenate([self._values, values])[order]
        self._sampled = Samples.at(*self._there(self.samples), self._values)

    def _to_close(self) -> NDArray[np.int64]:
        """The middles of the gaps between samples whose ends differ most, times the points between."""
        length = np.diff(self.samples)
        gap = np.flatnonzero(length > 1)
        if not len(gap):
            return gap
        differ = np.square(self._values[gap + 1] - self._values[gap]).sum(1, dtype=np.float64) * (length[gap] - 1)
        rank = np.argsort(-differ, kind="stable")
        total = np.cumsum(differ[rank])
        most = max(int(np.searchsorted(total, _COVERED * total[-1])) + 1, len(gap) // 8 + 1)
        chosen = np.sort(gap[rank[:most]])
        return self.samples[chosen] + length[chosen] // 2

    def _held(self, among: NDArray) -> Generator[float, None, tuple[NDArray, NDArray, NDArray]]:
        """Some points (h,), and two independent traces (h, K) of their blocked part."""
        points = np.sort(self._rng.choice(among, min(HELD, len(among)), replace=False))
        one = yield from self._traced(points, _HELD_RAYS)
        two = yield from self._traced(points, _HELD_RAYS)
        self.probes += 2 * _HELD_RAYS * len(points)
        return points, one, two

    def _error(self, points: NDArray, one: NDArray, two: NDArray) -> float | None:
        """Relative L2 error at points that were traced twice; None in the dark, or where it can hardly be told."""
        unshadowed = self._unshadowed(points)
        return error_by_twins(self._at(points, unshadowed), one, two, unshadowed)

    def _noise(self, points: NDArray, one: NDArray, two: NDArray) -> float:
        """Relative error of one of two traces, from how they differ; 0 in the dark."""
        unshadowed = self._unshadowed(points)
        energy = float(((unshadowed - one) * (unshadowed - two)).sum())
        return 0.0 if dark(energy, unshadowed) else (float(np.square(one - two).sum()) / 2 / energy) ** 0.5

    def _traced(self, points: NDArray, rays: int) -> Generator[float, None, NDArray]:
        """The blocked part (n, K) at some points, with rays of their own."""
        blocked = yield from blocked_at(self._mesh, self._lit[points], self._scene, self._order,
                                        int(self._rng.integers(2**31)), rays, self._pool, self._threads)
        return blocked.astype(np.float64)
