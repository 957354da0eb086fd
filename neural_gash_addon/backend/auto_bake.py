# SPDX-License-Identifier: GPL-3.0-or-later
"""The bake as planned (`auto`): plan, run the method that was chosen, and say what would be seen better.

The record has a sentence for each choice: method and rays, order, domain, target (and bounces, see `bounce`).
"""
from __future__ import annotations

import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace

from . import advice, costs
from .bands import Bands, all_of, of_open_sky
from .geometry import TriangleMesh
from .horizon import nothing_blocks
from .pilot import Pilot, look, looking
from .plan import Candidate, Plan, cheapest, traced_bands, tried, unshadowed, unshadowed_bands
from .progress import clocked, scaled
from .raycast import Geometry, Occluders
from .transfer import Transfer
from .workers import default_threads, workers

_PILOT_SHARE = 0.05  # of the progress
# Of the tolerance: what the error with a number of rays may seem to be, as the pilot errs too (by 13 %, standard
# deviation on meshes/train, none of which tells this from 1.1: it was set when a mesh of meshes/validation went on).
_BY_THE_LAW = 1.2
_MANY = 1 << 18  # points that are baked at a time, where those that are looked at are but some of them


@dataclass(frozen=True, eq=False)
class Planned:
    """What is to be run, and what is there for it already."""

    plan: Plan
    scene: Occluders | None
    pilot: Pilot | None  # of the order that is baked; None: nothing was traced
    bands: Bands


def bake(mesh: TriangleMesh, order: int, *, rays: int | None, tolerance: float | None, occluders: Sequence[Geometry],
         seed: int, threads: int | None, scene: Occluders | None = None, whole: bool = False,
         candidates: Mapping[str, Candidate]) -> Generator[float, None, Transfer]:
    """Bake as cheaply as the tolerance allows; arguments as `methods.bake`.

    candidates: by name. With a number of rays there is nothing to plan but whether any is needed. What a method without
    rays gives, or a number of them, is compared with the pilot, and baked by one that measures where that is not within
    the tolerance.
    """
    began, count = time.perf_counter(), threads or default_threads()
    planning = planned(mesh, order, rays, tolerance, occluders, seed, threads, scene, whole, candidates)
    found = yield from scaled(planning, 0, _PILOT_SHARE)
    plan, pilot, order = found.plan, found.pilot, found.bands.order

    def work(plan: Plan) -> Generator[float, None, Transfer]:
        known = {"scene": found.scene, "pilot": pilot} if candidates[plan.method].traces else {}
        done, taken = yield from clocked(candidates[plan.method].bake(
            mesh, order, rays=plan.rays, tolerance=plan.tolerance, occluders=occluders, seed=seed, threads=threads,
            **known))
        if not whole:  # the parts of one bake are planned alike
            costs.learn(plan, count, taken)
        return done

    transfer = yield from scaled(work(plan), _PILOT_SHARE, 1 - _PILOT_SHARE)
    error = transfer.record.error_estimate
    if plan.method == "analytic":
        error = pilot.blocked if pilot is not None else 0.0
    elif pilot is not None and tolerance is not None and plan.tolerance is None:
        left = tolerance if whole else found.bands.left
        if candidates[plan.method].traces:
            missed = error is not None and error > _BY_THE_LAW * left
        else:
            error = pilot.error_of(transfer.coefficients)
            missed = error is None or error > left
        if missed:
            ways = yield from scaled(costs.ways(candidates, count, len(mesh.lit())), _PILOT_SHARE, 0)
            plan = cheapest(pilot, len(mesh.lit()), left, ways.values(), tolerance, measuring=True)
            transfer = yield from scaled(work(plan), _PILOT_SHARE, 1 - _PILOT_SHARE)
            error = transfer.record.error_estimate
    record = replace(transfer.record, plan=plan.reason).also(found.bands.reason).also(advice.domain(mesh))
    probes = record.probe_rays
    if pilot is not None and tolerance is not None:
        assert found.scene is not None
        asking = advice.inside_faces(mesh, found.scene, transfer.coefficients, order, tolerance, seed,
                                     threads or default_threads())
        inside = yield from scaled(asking, 1, 0)
        if inside is not None:
            record = replace(record, between_error=inside.error, between_missed=inside.missed).also(
                advice.said(*inside))
    if pilot is not None:
        probes += pilot.traced
    return Transfer(transfer.coefficients, replace(record, probe_rays=probes, seconds=time.perf_counter() - began,
                                                   tolerance=tolerance,
                                                   error_estimate=found.bands.whole(error)))


def planned(mesh: TriangleMesh, order: int, rays: int | None, tolerance: float | None, occluders: Sequence[Geometry],
            seed: int, threads: int | None, scene: Occluders | None, whole: bool, candidates: Mapping[str, Candidate]
            ) -> Generator[float, None, Planned]:
    """Look, and choose among the candidates; other arguments as `methods.bake`. Yields progress."""
    every = all_of(order, tolerance)
    if nothing_blocks(mesh, occluders):
        return Planned(Plan("analytic", reason="Nothing rises above any point's horizon: unshadowed is exact."), scene,
                       None, every if whole or tolerance is None else of_open_sky(order, tolerance))
    if tolerance is None:
        return Planned(Plan("embree", rays=rays, reason="A number of rays was asked for: they are traced from every "
                                                        "point."), scene, None, every)
    threads, points, enough = threads or default_threads(), len(mesh.lit()), tolerance
    ways = list((yield from costs.ways(candidates, threads, points)).values())

    def without_rays(found: Pilot) -> tuple[Plan, Bands] | None:
        if not whole:
            return unshadowed_bands(found, order, enough)
        plan = unshadowed(found, enough)
        return (plan, every) if plan else None

    def with_rays(found: Pilot) -> tuple[Plan, Bands]:
        if not found.scale:
            return Plan("embree", tolerance=enough,
                        reason="Hardly any light comes in: rays from every point look for it."), every
        if whole:
            return cheapest(found, points, enough, ways), every
        return traced_bands(found, points, order, enough, ways)

    with workers(threads, looking(points, tolerance)) as pool:
        if scene is None:
            scene = Occluders([(mesh.positions, mesh.triangles), *occluders], mesh.resolution)
        pilot = yield from look(mesh, scene, order, tolerance, seed, pool, threads)
    picked = without_rays(pilot)
    if picked is None:
        pilot = yield from scaled(tried(mesh, scene, order, pilot, tolerance, seed, threads), 1, 0)
    plan, bands = picked or with_rays(pilot)
    return Planned(plan, scene, pilot if bands.order == order else pilot.to_order(bands.order), bands)


def enough_bands(mesh: TriangleMesh, order: int, tolerance: float, occluders: Sequence[Geometry], seed: int,
                 threads: int | None, scene: Occluders, candidates: Mapping[str, Candidate]
                 ) -> Generator[float, None, Bands]:
    """The fewest bands that are enough where the points of a mesh are but some of many, which are baked in parts.

    Arguments as `planned`. Yields progress.
    """
    if nothing_blocks(mesh, occluders):
        return of_open_sky(order, tolerance)
    threads = threads or default_threads()
    ways = (yield from costs.ways(candidates, threads, _MANY)).values()
    with workers(threads, looking(len(mesh.points), tolerance)) as pool:
        pilot = yield from look(mesh, scene, order, tolerance, seed, pool, threads)
    return traced_bands(pilot, _MANY, order, tolerance, ways)[1]
