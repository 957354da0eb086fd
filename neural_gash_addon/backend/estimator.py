# SPDX-License-Identifier: GPL-3.0-or-later
"""The traced blocked part of transfer at many points, over worker threads.

B[k] = 1/pi int (1 - V(w)) max(n.w, 0) Y_k(w) dw is the mean of Y_k over the blocked ones of
cosine-distributed directions. Each point sees one of SETS scrambled nets in a frame of its own,
turned at random about its normal, so neighbours' errors are independent. Sums are kept in the
local frame, where they are one matrix product for many points, and rotated once at the end.
"""
from __future__ import annotations

import copy
from collections.abc import Generator, Iterator
from concurrent.futures import Executor
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from . import sampling
from . import spherical_harmonics as sh
from .geometry import TriangleMesh
from .raycast import Occluders
from .workers import product, results

SETS = 16
MAX_RAYS = 4096
RATE = 1.5              # the variance falls as rays**-RATE (scrambled nets, measured)
RAYS_PER_JOB = 1 << 16  # about 15 ms of one thread: short enough to stop at once, long enough to be efficient
# Directions up to which a job mixes points of all sets, if there are more rays than one job has, or not: with more, one
# matrix product for all points of a set is quicker, with fewer, not having to go from set to set is.
_MIXED, _MIXED_ONE_JOB = 16, 64
LEAST_RAYS_PER_JOB = 1 << 14  # with fewer, handing over to another thread costs more than it saves

_TURNED_AT_ONCE = 2048  # points rotated by one worker at a time


class BlockedEstimator:
    """Sums of Y_k over blocked rays, in each point's local frame."""

    def __init__(self, mesh: TriangleMesh, occluders: Occluders, order: int, seed: int, rays: int, sets: int = SETS,
                 twins: bool = False, spare: bool = False) -> None:
        """rays: the most that any point will take. seed: independent seeds give independent estimates.

        sets: fewer cost less where points are few, whose errors are then less independent. twins: the second half of
        the points is the first again, whose errors have to be independent: none has the set of its twin. spare: as
        many sets more are made, for `apart`.
        """
        rng = np.random.default_rng([seed, 0])
        self._occluders = occluders
        self._order = order
        self._sets_each, self._count = sets, 2 * sets if spare else sets
        self._most, self._scramble = rays, int(rng.integers(2**31))
        self._made = np.zeros((self._count, 0, 3))  # directions so far: most bakes stop long before the most rays
        self._points, self._clearance = mesh.points, mesh.clearance
        self._normals = mesh.normals
        self._angles = rng.uniform(0, 2 * np.pi, len(mesh.points)).astype(np.float32)
        self._set_of_point = rng.integers(0, sets, len(mesh.points), dtype=np.uint8)
        if twins:
            first, second = np.split(self._set_of_point, 2)
            second[:] = (first + rng.integers(1, sets, len(second), dtype=np.uint8)) % sets
        self._excess: dict[tuple[int, int], NDArray] = {}
        self._evaluated: tuple[tuple[int, int], NDArray] | None = None  # of which directions, and their harmonics

    def prepare(self, stop: int) -> None:
        """Make the directions 0..stop now, and what is known of them."""
        self._harmonics(0, stop)

    def apart(self, points: NDArray, rng: np.random.Generator) -> BlockedEstimator:
        """Of some of the points (n,), and of the same again (2n), by the spare nets: independent of this one.

        Neither has the set of its twin. `rng` must be independent of the seed. What was prepared is shared.
        """
        twice = np.tile(points, 2)
        out = copy.copy(self)
        out._points, out._clearance, out._normals = (a[twice] for a in (self._points, self._clearance, self._normals))
        out._angles = rng.uniform(0, 2 * np.pi, len(twice)).astype(np.float32)
        first = rng.integers(0, self._sets_each, len(points), dtype=np.uint8)
        second = (first + rng.integers(1, self._sets_each, len(points), dtype=np.uint8)) % self._sets_each
        out._set_of_point = np.concatenate([first, second]) + np.uint8(self._sets_each)
        out._excess = {}
        return out

    def trace(self, pool: Executor, threads: int, points: NDArray, start: int, stop: int,
              sums: NDArray[np.float64]) -> Generator[float, None, None]:
        """Add directions start..stop of each point to its sum.

        Args:
            points: (n,) indices of points, in an order that is coherent in space.
            sums: (n, K) accumulated in place.
        Yields:
            The share of the rays done, after every job. Closing the generator stops the workers.
        """
        def work(rows: NDArray, tables: tuple[NDArray, NDArray]) -> tuple[NDArray, NDArray]:
            return rows, self._blocked_sums(points[rows], *tables)

        done = 0
        tracing = results(pool, threads, self._jobs(points, start, stop), work)
        try:
            for rows, found in tracing:
                sums[rows] += found
                done += len(rows)
                yield done / len(points)
        finally:
            tracing.close()  # at once: a worker may be waiting

    def summed(self, points: NDArray, start: int, stop: int) -> NDArray[np.float64]:
        """What `trace` adds for a few points, at once and on the calling thread: (n, K)."""
        sums = np.zeros((len(points), self._order ** 2))
        for rows, tables in self._jobs(points, start, stop):
            sums[rows] += self._blocked_sums(points[rows], *tables)
        return sums

    def jobs(self, points: NDArray, start: int, stop: int) -> int:
        """Among how many threads `trace` can be spread, at most."""
        return sum(1 for _ in self._jobs(points, start, stop))

    def _jobs(self, points: NDArray, start: int, stop: int) -> Iterator[tuple[NDArray, tuple[NDArray, NDArray]]]:
        """Rows of `points`, and what `_blocked_sums` wants of directions start..stop: of their set, or of all sets."""
        size = max(1, RAYS_PER_JOB // (stop - start))
        set_of_row = self._set_of_point[points]
        harmonics = self._harmonics(start, stop)
        if stop - start <= (_MIXED if len(points) * (stop - start) > RAYS_PER_JOB else _MIXED_ONE_JOB):
            size = max(1, LEAST_RAYS_PER_JOB // (stop - start))
            every = self._sets(stop)[:, start:stop].astype(np.float32)
            for part in np.array_split(np.arange(len(points)), -(-len(points) // size)):
                yield part, (every, harmonics)
            return
        rows_by_set = np.argsort(set_of_row, kind="stable")
        bounds = np.searchsorted(set_of_row[rows_by_set], np.arange(self._count + 1))
        for s in range(self._count):
            rows = rows_by_set[bounds[s]:bounds[s + 1]]
            if not len(rows):
                continue
            local = self._sets(stop)[s, start:stop]
            # (9, 3r): frame (row-major, 9) @ lift = the r directions' world coordinates in a row,
            # so that one matrix product makes the rays of many points in the layout Embree reads
            lift = np.einsum("cd,ja->cajd", np.eye(3), local).reshape(9, -1).astype(np.float32)
            for part in np.array_split(rows, -(-len(rows) // size)):  # even, so that no worker waits for a rest
                yield part, (lift, harmonics[s])

    def _harmonics(self, start: int, stop: int) -> NDArray[np.float64]:
        """(sets, stop - start, K) of the directions of each set."""
        known = self._evaluated
        if known is None or start < known[0][0] or stop > known[0][1]:
            local = self._sets(stop)[:, start:stop]
            known = (start, stop), sh.evaluate(local.reshape(-1, 3), self._order).reshape(*local.shape[:2], -1)
            self._evaluated = known
        (first, _), harmonics = known
        return harmonics[:, start - first:stop - first]

    def _sets(self, stop: int) -> NDArray[np.float64]:
        """(sets, at least stop, 3) directions. A longer net begins with the shorter ones."""
        if self._made.shape[1] < stop:
            count = min(1 << (stop - 1).bit_length(), self._most)
            self._made = sampling.hemisphere_sets(self._count, count, self._scramble)
        return self._made

    def _blocked_sums(self, points: NDArray, directions: NDArray, harmonics: NDArray) -> NDArray[np.float64]:
        """Worker: (n, K) sums of Y_k over the blocked ones of some directions at some points.

        directions: of one set, as `_jobs` lifts them, with harmonics (r, K); or (sets, r, 3) with (sets, r, K).
        """
        frames = sampling.frames(self._normals[points].astype(np.float32), self._angles[points])
        count = harmonics.shape[-2]
        if mixed := harmonics.ndim == 3:
            here = self._set_of_point[points]
            local = np.ascontiguousarray(directions.transpose(2, 1, 0)).take(here, 2)  # (3, r, n): points are last
            world = np.empty((len(points), count, 3), np.float32)
            part = np.empty(local.shape[1:], np.float32)
            for axis, row in enumerate(frames.transpose(1, 2, 0)):
                along = local[0] * row[0]
                for component, way in zip(local[1:], row[1:], strict=True):
                    along += np.multiply(component, way, out=part)
                world[:, :, axis] = along.T
            world = world.reshape(-1, 3)
        else:
            world = product(np.ascontiguousarray(frames).reshape(-1, 9), directions).reshape(-1, 3)
        origins = np.repeat(self._occluders.origins(self._points[points], self._clearance[points]), count, axis=0)
        free = self._occluders.blocked(origins, world)  # 0 blocked, -1 free
        blocked = np.add(free, 1, dtype=np.float64).reshape(-1, count)
        return np.einsum("nr,nrk->nk", blocked, harmonics[here]) if mixed else product(blocked, harmonics)

    def means(self, points: NDArray, sums: NDArray, start: int, stop: int) -> NDArray[np.float64]:
        """Blocked part (n, K) in the local frame, from sums over directions start..stop.

        What is known of the directions is used: the mean of Y_k over all of them misses the exact
        unblocked integral by some excess, and a point of which a share b is blocked has had about b
        of it (a control variate). So a point that is all blocked gets exactly the unshadowed
        transfer, one that is all free exactly nothing.
        """
        if (start, stop) not in self._excess:
            self._excess[start, stop] = _upright_lobe(self._order) - self._harmonics(start, stop).mean(1)
        mean = sums / (stop - start)
        share = mean[:, :1] / sh.normalisation(0, 0)  # Y_0 is constant, so this counts the blocked rays
        return mean + share * self._excess[start, stop][self._set_of_point[points]]

    def transfer(self, pool: Executor, points: NDArray, local: NDArray) -> NDArray[np.float64]:
        """Transfer (n, K) in the bake frame: the exact unshadowed part minus the blocked part (n, K), local."""
        out = np.empty(local.shape)

        def part(start: int) -> None:
            here = slice(start, start + _TURNED_AT_ONCE)
            out[here] = sh.cosine_lobe(self._normals[points[here]], self._order)
            out[here] -= self.turned_here(points[here], local[here])

        list(pool.map(part, range(0, len(points), _TURNED_AT_ONCE)))
        return out

    def blocked(self, pool: Executor, points: NDArray, sums: NDArray, stop: int) -> NDArray[np.float32]:
        """The blocked part (n, K) in the bake frame, from sums over directions 0..stop."""
        out = np.empty(sums.shape, np.float32)

        def part(start: int) -> None:
            here = slice(start, start + _TURNED_AT_ONCE)
            out[here] = self.turned_here(points[here], self.means(points[here], sums[here], 0, stop))

        list(pool.map(part, range(0, len(points), _TURNED_AT_ONCE)))
        return out

    def turned_here(self, points: NDArray, local: NDArray) -> NDArray[np.float64]:
        """The blocked part (n, K), local, in the bake frame; on the calling thread.

        Where nothing is blocked, nothing is turned.
        """
        out = np.zeros(local.shape)
        some = np.flatnonzero(local[:, 0])
        out[some] = sh.rotate_each(local[some], self._frames(points[some]))
        return out

    def _frames(self, points: NDArray) -> NDArray[np.float64]:
        return sampling.frames(self._normals[points], self._angles[points].astype(np.float64))


@lru_cache(maxsize=sh.MAX_ORDER)
def _upright_lobe(order: int) -> NDArray[np.float64]:
    """(K,) unshadowed transfer in every local frame."""
    return sh.cosine_lobe(np.array([[0.0, 0.0, 1.0]]), order)[0]


def blocked_at(mesh: TriangleMesh, rows: NDArray, occluders: Occluders, order: int, seed: int, rays: int,
               pool: Executor, threads: int) -> Generator[float, None, NDArray[np.float32]]:
    """The blocked part (n, K) in the bake frame of some of a mesh's points (n,), each with so many rays.

    rows: in an order that is coherent in space. Yields progress, as `BlockedEstimator.trace`.
    """
    few = replace(mesh, points=mesh.points[rows], normals=mesh.normals[rows], clearance=mesh.clearance[rows])
    estimator, every = BlockedEstimator(few, occluders, order, seed, rays), np.arange(len(rows))
    sums = np.zeros((len(rows), sh.coefficient_count(order)))
    yield from estimator.trace(pool, threads, every, 0, rays, sums)
    return estimator.blocked(pool, every, sums, rays)


def places_along(curve: NDArray, points: int) -> NDArray[np.int64]:
    """Where along a curve (n,) of some of so many points each of them lies (points,); 0 of those that it leaves out."""
    out = np.zeros(points, np.int64)
    out[curve] = np.arange(len(curve))
    return out


def morton_order(points: NDArray) -> NDArray[np.int64]:
    """Indices (N,) that walk the points (N, 3) along a Z-order curve: neighbours in it are near in space.

    Points in one cell, a 65,536th of the extent or so, keep their order.
    """
    rows = np.ascontiguousarray(points.T)  # NumPy is quick along long last axes
    low = rows.min(1, keepdims=True)
    extent = float((rows.max(1, keepdims=True) - low).max()) or 1.0
    # not at the corner of the cube that the curve fills: planes of symmetry would lie between its halves, and rounding
    # would decide on which side a point is
    cells = ((rows - (low - 0.0618 / 0.8 * extent)) * (0.8 * 2**16 / extent)).astype(np.uint64)
    for shift, mask in ((16, 0xFF0000FF), (8, 0xF00F00F00F), (4, 0xC30C30C30C3), (2, 0x249249249249)):
        cells |= cells << np.uint64(shift)
        cells &= np.uint64(mask)
    key = cells[0] | cells[1] << np.uint64(1) | cells[2] << np.uint64(2)
    # NumPy sorts 16 bits by their digits, in a fifth of the time that comparing takes: the lowest of three first
    order = np.argsort(key.astype(np.uint16), kind="stable")
    for shift in (16, 32):
        order = order[np.argsort((key >> np.uint64(shift)).astype(np.uint16)[order], kind="stable")]
    return order
