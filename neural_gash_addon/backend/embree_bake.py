# SPDX-License-Identifier: GPL-3.0-or-later
"""The Embree reference bake: exact unshadowed transfer minus the traced blocked part, adaptively."""
from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from concurrent.futures import Executor

import numpy as np
from numpy.typing import NDArray

from . import spherical_harmonics as sh
from .estimator import MAX_RAYS, RATE, BlockedEstimator, morton_order
from .geometry import TriangleMesh
from .pilot import Pilot, dark, least_scale
from .progress import scaled
from .raycast import Geometry, Occluders
from .record import BakeRecord
from .transfer import Transfer
from .workers import default_threads, workers

BLOCK = 1 << 16         # points accumulated at a time, so that memory does not grow with the mesh
FIRST_RAYS = 32         # of an adaptive point; it has twice that before it may stop
KEPT = 0.7              # squared error left after a doubling, as a part of the squared change (calibrated)
POOL = 9                # neighbours along the Z-order curve whose error estimates are averaged
SCALE_POINTS = 1024     # that say what a tolerance is relative to
REPLICATES = 1024       # points baked twice to measure the error; a 16th of them, if that is less, or a 32nd, if more
FEWEST, _MOST = 256, 8192


def bake(mesh: TriangleMesh, order: int, *, rays: int | None, tolerance: float | None,
         occluders: Sequence[Geometry], seed: int, threads: int | None, scene: Occluders | None = None,
         pilot: Pilot | None = None, fewest: int = FEWEST) -> Generator[float, None, Transfer]:
    """Trace `mesh` against itself and `occluders`; arguments as `methods.bake`.

    pilot: what is known beforehand; at its points the error is measured. fewest: points baked twice without, at least.
    """
    began = time.perf_counter()
    threads = threads or default_threads()
    if scene is None:
        scene = Occluders([(mesh.positions, mesh.triangles), *occluders], mesh.resolution)
    count = len(mesh.points)
    coefficients = np.zeros((count, sh.coefficient_count(order)), dtype=np.float32)
    rays_of_point = np.zeros(count, dtype=np.int32)
    lit = mesh.lit()
    lit = lit[morton_order(mesh.points[lit])] if len(lit) else lit
    most = MAX_RAYS if rays is None else rays
    estimator = BlockedEstimator(mesh, scene, order, seed, most)
    probes = 0
    error: float | None = 0.0
    with workers(threads, len(lit) * (rays or 2 * FIRST_RAYS)) as pool:
        scale = pilot.scale if pilot is not None and tolerance is not None else None
        if scale is None and tolerance is not None and len(lit):
            scale, probes = yield from _pilot(estimator, lit, order, pool, threads)
        for start in range(0, len(lit), BLOCK):
            block = lit[start:start + BLOCK]
            done, share = start / len(lit), len(block) / len(lit)
            work = _trace_block(estimator, block, order, rays, None if scale is None or tolerance is None
                                else (tolerance * max(scale, least_scale(order))) ** 2, pool, threads)
            coefficients[block], rays_of_point[block] = yield from scaled(work, 0.95 * done, 0.95 * share)
        if pilot is not None:
            error = pilot.error_of(coefficients)
        elif len(lit):
            work_error = _measured_error(mesh, scene, order, seed, coefficients, rays_of_point, lit, fewest, pool,
                                         threads)
            error, extra = yield from scaled(work_error, 0.95, 0.05)
            probes += extra
    return Transfer(coefficients, BakeRecord(
        method="embree", order=order, points=count, domain=mesh.domain, seed=seed,
        rays=int(rays_of_point.sum(dtype=np.int64)), probe_rays=probes,
        seconds=time.perf_counter() - began, error_estimate=error, tolerance=tolerance))


def _pilot(estimator: BlockedEstimator, lit: NDArray, order: int, pool: Executor, threads: int
           ) -> Generator[float, None, tuple[float, int]]:
    """RMS of |T| over the mesh from a sample of points: what a relative tolerance is relative to."""
    sample = lit[::max(1, len(lit) // SCALE_POINTS)]
    sums = np.zeros((len(sample), sh.coefficient_count(order)))
    for _ in estimator.trace(pool, threads, sample, 0, FIRST_RAYS, sums):
        yield 0.0
    transfer = estimator.transfer(pool, sample, estimator.means(sample, sums, 0, FIRST_RAYS))
    return float(np.sqrt(np.square(transfer).sum(1).mean())), len(sample) * FIRST_RAYS


def _trace_block(estimator: BlockedEstimator, block: NDArray, order: int, rays: int | None,
                 variance: float | None, pool: Executor, threads: int
                 ) -> Generator[float, None, tuple[NDArray, NDArray]]:
    """Transfer (n, K) of a block of points and the rays each took (n,).

    Either `rays` each, or doubling until the mean squared error is `variance` (see `_to_continue`).
    """
    count = len(block)
    sums = np.zeros((count, sh.coefficient_count(order)))
    if rays is not None:
        yield from estimator.trace(pool, threads, block, 0, rays, sums)
        return estimator.transfer(pool, block, estimator.means(block, sums, 0, rays)), np.full(count, rays)
    assert variance is not None
    local, squared_error, taken = np.zeros_like(sums), np.zeros(count), np.zeros(count, dtype=np.int32)
    active = np.arange(count)
    start, stop, left = 0, FIRST_RAYS, 1.0
    while len(active):
        points = block[active]
        fresh = np.zeros((len(active), sums.shape[1]))
        yield from scaled(estimator.trace(pool, threads, points, start, stop, fresh), 1 - left, left / 2)
        left /= 2
        sums[active] += fresh
        now = estimator.means(points, sums[active], 0, stop)
        if start:
            squared_error[active] = KEPT * _pooled(np.square(now - local[active]).sum(1))
        local[active] = now
        taken[active] = stop
        if start:
            active = active[_to_continue(squared_error, taken, variance)[active]]
        if stop >= MAX_RAYS:
            break
        start, stop = stop, 2 * stop
    return estimator.transfer(pool, block, local), taken


def _pooled(values: NDArray) -> NDArray:
    """Running mean over POOL neighbours in (Z-)order: one point's change is too noisy to stop it by."""
    padded = np.pad(values, POOL // 2, mode="reflect" if len(values) > POOL // 2 else "edge")
    total = np.cumsum(np.concatenate([[0.0], padded]))
    return np.maximum(total[POOL:] - total[:-POOL], 0.0) / POOL


def _to_continue(squared_error: NDArray, taken: NDArray, variance: float) -> NDArray[np.bool_]:
    """Which points to double, so that the mean squared error reaches `variance` with the fewest rays.

    Doubling a point with R rays and error e costs R and gains in proportion to e. So at the
    optimum e/R is one number for all points that went on (the Lagrange multiplier of "fewest rays
    at this error"); it is found by bisection, with the errors predicted to fall as rays**-RATE.
    """
    if squared_error.mean() <= variance:
        return np.zeros(len(taken), dtype=bool)
    sample = slice(None, None, max(1, len(taken) // 4096))
    gain = np.log2(np.maximum(squared_error, 1e-300) / taken)

    def doublings(level: float, of: slice = slice(None)) -> NDArray:
        return np.maximum((gain[of] - level) / (RATE + 1), 0.0)

    low, high = float(gain.max()) - 120, float(gain.max())
    for _ in range(24):
        level = 0.5 * (low + high)
        mean = (squared_error[sample] * np.exp2(-RATE * doublings(level, sample))).mean()
        low, high = (low, level) if mean > variance else (level, high)
    return doublings(low) > 0.5


def _measured_error(mesh: TriangleMesh, scene: Occluders, order: int, seed: int, coefficients: NDArray,
                    rays_of_point: NDArray, lit: NDArray, fewest: int, pool: Executor, threads: int
                    ) -> Generator[float, None, tuple[float | None, int]]:
    """Relative L2 error of the bake, from a second, independent bake of a sample of its points.

    Two independent estimates with the same rays differ by sqrt(2) standard errors; nothing is
    assumed of how fast the error falls. None in the dark.
    """
    size = min(len(lit), max(fewest, min(REPLICATES, len(lit) // 16), min(_MOST, len(lit) // 32)))
    rng = np.random.default_rng([seed, 1])
    sample = lit[np.sort(rng.choice(len(lit), size, replace=False))]
    taken = rays_of_point[sample]
    twin = BlockedEstimator(mesh, scene, order, int(rng.integers(2**31)), int(taken.max()))
    squared, traced = 0.0, 0
    for rays in np.unique(taken):
        points = sample[taken == rays]
        sums = np.zeros((len(points), coefficients.shape[1]))
        for share in twin.trace(pool, threads, points, 0, int(rays), sums):
            yield (traced + share * len(points) * rays) / max(1, int(taken.sum()))
        again = twin.transfer(pool, points, twin.means(points, sums, 0, int(rays)))
        squared += float(np.square(again - coefficients[points]).sum()) / 2
        traced += len(points) * int(rays)
    energy = float(np.square(coefficients[sample], dtype=np.float64).sum())
    open_sky = sh.cosine_lobe(mesh.normals[sample], order)
    return None if dark(energy, open_sky) else (squared / energy) ** 0.5, traced
