# SPDX-License-Identifier: GPL-3.0-or-later
"""The bake as planned (`auto`): plan, then run the method that was chosen; the record says which and why."""
from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from .geometry import TriangleMesh
from .plan import Plan, choose, nothing_blocks, pilot
from .progress import scaled
from .raycast import Geometry, Occluders
from .transfer import Transfer
from .workers import default_threads

_PILOT_SHARE = 0.05  # of the progress


def bake(mesh: TriangleMesh, order: int, *, rays: int | None, tolerance: float | None, occluders: Sequence[Geometry],
         seed: int, threads: int | None, scene: Occluders | None = None,
         bakers: Mapping[str, Callable[..., Generator[float, None, Transfer]]],
         ) -> Generator[float, None, Transfer]:
    """Bake as cheaply as the tolerance allows; arguments as `methods.bake`.

    bakers: the methods that a plan may name. With a number of rays there is nothing to plan but whether any is needed.
    """
    began = time.perf_counter()
    probes = 0
    unseen = 0.0  # relative error of an unshadowed bake
    if nothing_blocks(mesh, occluders):
        plan = Plan("analytic", reason="Nothing rises above any point's horizon: unshadowed is exact.")
    elif tolerance is None:
        plan = Plan("embree", rays=rays, reason="A number of rays was asked for: they are traced from every point.")
    else:
        threads = threads or default_threads()
        if scene is None:
            scene = Occluders([(mesh.positions, mesh.triangles), *occluders], mesh.resolution)
        with ThreadPoolExecutor(threads, thread_name_prefix="neural_gash") as pool:
            found = yield from scaled(pilot(mesh, scene, order, seed, pool, threads), 0, _PILOT_SHARE)
        probes = found.rays
        plan = choose(found, len(mesh.points), tolerance)
        unseen = found.blocked
    work = bakers[plan.method](mesh, order, rays=plan.rays, tolerance=plan.tolerance, occluders=occluders, seed=seed,
                               threads=threads, scene=scene)
    transfer = yield from scaled(work, _PILOT_SHARE, 1 - _PILOT_SHARE)
    error = unseen if plan.method == "analytic" else transfer.record.error_estimate
    return Transfer(transfer.coefficients, replace(
        transfer.record, probe_rays=transfer.record.probe_rays + probes, seconds=time.perf_counter() - began,
        tolerance=tolerance, error_estimate=error, plan=plan.reason))
