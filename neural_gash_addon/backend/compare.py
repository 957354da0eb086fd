# SPDX-License-Identifier: GPL-3.0-or-later
"""Methods compared on one mesh: how long each takes, and how far it is from a reference.

The chart of the benchmarks and the operator in Blender are both made of this.
"""
from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import methods, metrics
from . import spherical_harmonics as sh
from .errors import UserError
from .geometry import TriangleMesh
from .progress import scaled
from .raycast import Geometry
from .record import BakeRecord

REFERENCE_RAYS = 4096  # of each of the two traces that a reference is the mean of
BASELINE_RAYS = 64     # of the plain Embree bake that times are quoted beside
TOLERANCES = (0.2, 0.1, 0.05, 0.02, 0.01)  # of methods that plan
ENOUGH = 1.0           # seconds of a setting, after which it is not repeated
_ROUND_UP = 32         # rays that cost about as much as what a bake does besides: for the progress only
_TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array(
    [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@dataclass(frozen=True)
class Setting:
    """A method, and what it is told."""

    method: str
    order: int
    rays: int | None = None
    tolerance: float | None = None
    threads: int | None = None  # None: one a core

    @property
    def name(self) -> str:
        """Short enough for a mark in a chart."""
        if self.tolerance is not None:
            return f"{self.method} {100 * self.tolerance:.3g} %"
        return self.method if self.rays is None else f"{self.method} {self.rays}"


Bake = Callable[[Setting, int], Generator[float, None, tuple[NDArray, BakeRecord | None]]]


@dataclass(frozen=True, eq=False)
class Reference:
    """Transfer at some points of a mesh, traced well and apart from what is compared with it."""

    rows: NDArray[np.int64]          # (n,) the points
    transfer: NDArray[np.float64]    # (n, K) mean of two traces with seeds of their own
    unshadowed: NDArray[np.float64]  # (n, K)
    noise: NDArray[np.float64]       # (n, K) half of what the two differ by: what the mean is off by, in expectation

    def floor(self, lights: Sequence[NDArray]) -> dict[str, float]:
        """The errors that its own noise would have: what is measured to be as small as that may be smaller."""
        return _figures(self.transfer + self.noise, self, lights)


@dataclass(frozen=True, eq=False)
class Measurement:
    """What a setting takes and gives, over all rounds."""

    setting: Setting
    seconds: list[float] = field(default_factory=list)  # of each run, arrays to coefficients
    ratio: float = float("nan")        # to plain Embree with BASELINE_RAYS in the same round, median
    srr: float = float("nan")          # medians over runs, each with a seed of its own
    rel_l2: float = float("nan")
    openness: float = float("nan")     # rel_l2 of the first coefficient alone, which ambient occlusion is
    relit_mean: float = float("nan")   # relative RMSE of radiance, over the lights
    relit_worst: float = float("nan")
    claimed: float | None = None       # error that the bakes say that they have, median
    errors: NDArray[np.float64] | None = None  # (n,) |T - T_ref| over RMS |T_ref|, of the first run
    refused: str = ""                  # why there is none

    @property
    def median(self) -> float:
        """Seconds."""
        return statistics.median(self.seconds) if self.seconds else float("nan")


def settings_of(order: int, rays: Sequence[int], threads: int | None = None,
                tolerances: Sequence[float] = TOLERANCES) -> list[Setting]:
    """Every method in the table: those that plan with each tolerance, which is what they plan by; those that trace with
    each number of rays, the others once.
    """
    found: list[Setting] = []
    for method in methods.METHODS.values():
        plain = Setting(method.name, order, threads=threads)
        if method.plans:
            found += [replace(plain, tolerance=tolerance) for tolerance in tolerances]
        elif method.traces:
            found += [replace(plain, rays=count) for count in rays]
        else:
            found.append(plain)
    return found


def baseline(order: int, threads: int | None = None) -> Setting:
    """The plain Embree bake that times are quoted beside."""
    return Setting("embree", order, BASELINE_RAYS, threads=threads)


def sample(count: int, most: int, seed: int) -> NDArray[np.int64]:
    """All of `count` points, or `most` of them at random, rising."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng([seed, 2]).choice(count, most, replace=False))


def vertex_bake(mesh: TriangleMesh, occluders: Sequence[Geometry] = ()) -> Bake:
    """How a setting is baked at the points of a mesh; bands that a plan leaves out are zero."""
    def bake(setting: Setting, seed: int) -> Generator[float, None, tuple[NDArray, BakeRecord]]:
        found = yield from methods.bake(mesh, setting.method, setting.order, rays=setting.rays, seed=seed,
                                        tolerance=setting.tolerance, occluders=occluders, threads=setting.threads)
        return sh.padded(found.coefficients, sh.coefficient_count(setting.order)), found.record

    return bake


def reference(mesh: TriangleMesh, order: int, rows: NDArray, occluders: Sequence[Geometry] = (), seed: int = 0,
              rays: int = REFERENCE_RAYS, threads: int | None = None, scene: Any = None
              ) -> Generator[float, None, Reference]:
    """Trace the points `rows` (n,) twice; `seed` must be none that is compared with it.

    scene: mesh and occluders as Embree sees them, where they are there already.
    """
    few = replace(mesh, points=mesh.points[rows], normals=mesh.normals[rows], clearance=mesh.clearance[rows])
    if scene is None:
        sees = methods.METHODS["embree"].sees
        assert sees is not None
        scene = sees(mesh, occluders)
    traces = []
    for number in range(2):
        own = int(np.random.SeedSequence([seed, 3, number]).generate_state(1)[0])
        baking = methods.bake(few, "embree", order, rays=rays, seed=own, threads=threads, scene=scene)
        found = yield from scaled(baking, number / 2, 0.5)
        traces.append(found.coefficients.astype(np.float64))
    return Reference(np.asarray(rows), (traces[0] + traces[1]) / 2, sh.cosine_lobe(few.normals, order),
                     (traces[0] - traces[1]) / 2)


def warm(settings: Sequence[Setting]) -> None:
    """Run each method once on a tetrahedron, so that no time has imports and weights in it."""
    mesh = TriangleMesh.from_triangles(*_TETRAHEDRON)
    first = {setting.method: setting for setting in settings if setting.method in methods.METHODS}
    for setting in first.values():
        with suppress(UserError):  # it will be told where it is measured
            methods.run(vertex_bake(mesh)(setting, 0))


def compare(bake: Bake, settings: Sequence[Setting], truth: Reference, lights: Sequence[NDArray], rounds: int,
            seed: int = 0) -> Generator[float, None, list[Measurement]]:
    """Run all settings in turns and measure them.

    Args:
        bake: gives all points' coefficients (N, K) and the record of a setting with a seed. Coefficients (N, 1) are
            of openness alone. Timed is what it yields and returns, not the call itself.
        settings: with `baseline` among them; taken in another order in each round.
        truth: of some of the points. lights: each (K, 3) or more; their first K count.
        rounds: how often each is run, but those that have had ENOUGH seconds are not run again.
    Yields:
        Progress, 0 to 1.
    Returns:
        One Measurement for each setting, in their order; a setting that is refused says why.
    """
    settings = list(dict.fromkeys(settings))
    yield 0.0
    warm(settings)
    runs: list[list[tuple[int, float, dict[str, float], float | None]]] = [[] for _ in settings]
    errors: list[NDArray | None] = [None] * len(settings)
    refused = [""] * len(settings)
    cost = np.array([1.0 + (setting.rays or _ROUND_UP) / _ROUND_UP for setting in settings])
    order = np.random.default_rng([seed, 4])
    done, whole = 0.0, rounds * float(cost.sum())
    for number in range(rounds):
        for index in order.permutation(len(settings)):
            share, start = cost[index] / whole, done
            done += share
            yield start
            if refused[index] or sum(run[1] for run in runs[index]) > ENOUGH:
                continue
            try:
                baking = bake(settings[index], seed + number)
                began = time.perf_counter()
                found, record = yield from scaled(baking, start, share)
            except UserError as error:
                refused[index] = str(error)
                continue
            spent = time.perf_counter() - began
            at = np.asarray(found, np.float64)[truth.rows]
            runs[index].append((number, spent, _figures(at, truth, lights), record and record.error_estimate))
            if errors[index] is None and at.shape == truth.transfer.shape:
                errors[index] = point_errors(at, truth)
    beside = {run[0]: run[1] for s, own in zip(settings, runs, strict=True) for run in own
              if s == baseline(s.order, s.threads)}
    return [_measurement(*each, beside) for each in zip(settings, runs, errors, refused, strict=True)]


def point_errors(found: NDArray, truth: Reference) -> NDArray[np.float64]:
    """(n,) |T - T_ref| of each point, over the RMS of |T_ref|."""
    scale = float(np.square(truth.transfer).sum(1).mean()) ** 0.5
    return np.linalg.norm(found - truth.transfer, axis=1) / (scale or 1.0)


def _figures(found: NDArray, truth: Reference, lights: Sequence[NDArray]) -> dict[str, float]:
    """Errors of coefficients (n, K) or (n, 1) at the reference's points."""
    figures = {"openness": metrics.rel_l2(found[:, :1], truth.transfer[:, :1])}
    if found.shape == truth.transfer.shape:
        figures["srr"] = metrics.srr(found, truth.transfer, truth.unshadowed)
        figures["rel_l2"] = metrics.rel_l2(found, truth.transfer)
        relit = [metrics.relit_error(found, truth.transfer, light[:found.shape[1]]) for light in lights]
        if relit:
            figures["relit_mean"], figures["relit_worst"] = statistics.fmean(relit), max(relit)
    return figures


def _measurement(setting: Setting, runs: Sequence[tuple[int, float, dict[str, float], float | None]],
                 errors: NDArray | None, refused: str, beside: dict[int, float]) -> Measurement:
    """All runs of a setting as one; `beside` has the seconds of the baseline in each round."""
    if not runs:
        return Measurement(setting, refused=refused)
    ratios = [spent / beside[number] for number, spent, _, _ in runs if number in beside]
    claims = [claim for *_, claim in runs if claim is not None]
    medians = {name: statistics.median(figures[name] for _, _, figures, _ in runs) for name in runs[0][2]}
    return Measurement(setting, [spent for _, spent, _, _ in runs],
                       statistics.median(ratios) if ratios else float("nan"),
                       claimed=statistics.median(claims) if claims else None, errors=errors, refused=refused, **medians)


def front(times: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Indices of the Pareto front, quickest first: nothing else is both quicker and nearer. NaN never is on it."""
    best, found = float("inf"), []
    for index in sorted(range(len(times)), key=lambda i: (times[i], errors[i])):
        if errors[index] < best and np.isfinite(times[index]):
            best = errors[index]
            found.append(index)
    return found
