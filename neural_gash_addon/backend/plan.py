# SPDX-License-Identifier: GPL-3.0-or-later
"""The planner (`auto`): the cheapest way to get direct transfer within a tolerance, and why.

1. Where everything lies below the tangent plane of every point, nothing can be blocked: unshadowed transfer is exact,
   and neither a ray nor a scene is needed. A convex mesh is so.
2. Else a pilot: points spread over the surface are traced twice with rays of their own. The product of the two gives
   the energy of transfer and of what is blocked, without noise; their difference the noise of a number of rays; and the
   clock what a ray costs here and now, so no table of machine speeds is kept that could prove wrong.
3. Each candidate is given a number of rays that meets the tolerance, and a time; the cheapest is taken. What the noise
   becomes with other rays, and what a hybrid or a sparse bake saves, follow laws measured on meshes (below).

`gnn` is no candidate: what it saves is the scene, which the pilot has built, and at each point it costs as much as 100
rays, which are more exact.
"""
from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from . import spherical_harmonics as sh
from .embree_bake import RATE
from .estimator import MAX_RAYS, BlockedEstimator, morton_order
from .geometry import TriangleMesh
from .raycast import Geometry, Occluders
from .workers import product

PILOT_POINTS = 256           # or a 32nd of them all, if that is less, but at least
_FEWEST = 96
PILOT_RAYS = 64              # of each of two traces
_PILOT_SETS = 4
_SAFE = 1.2                  # what the pilot's estimates may be too low by
_MARGIN = 0.95               # of a tolerance, for who stops at its own measure: it stops where that is a little too low
_FEW_RAYS = (4, 8, 16, 32)   # of plain bakes below what an adaptive one takes at least, 64
_HYBRID_ERROR = 0.6          # of the hybrid's error to a plain bake's at equal rays (SRR 0.2-0.35 on 29 meshes)
_HYBRID_SECONDS = 2e-3       # ... and what it costs besides: at all,
_HYBRID_RAYS = 5.0           # and at each point, in rays
SPARSE_POINTS = 1 << 16      # from which on a sparse bake is a candidate; below, too many are samples
_SPARSE_SHARE = 0.15         # of the points that it then traces, about
_SPARSE_RAYS = 25.0          # what reconstruction costs at each point, in rays
_LEAF = 64                   # vertices of a ball that are compared with a plane at a time
_MOST_PAIRS = 5e8            # of points and balls: what takes longer is not looked at, but traced
_LEVEL = 1e-6                # of the extent: heights over a plane that are rounding


@dataclass(frozen=True)
class Plan:
    """What to run, and why."""

    method: str
    rays: int | None = None          # for every point, or
    tolerance: float | None = None   # to be met by measuring
    reason: str = ""                 # one sentence


@dataclass(frozen=True)
class Pilot:
    """What a few points say about all."""

    blocked: float    # |T_unshadowed - T| / |T|
    noise: float      # of PILOT_RAYS rays, relative to |T|
    ray: float        # seconds of one
    rays: int         # that were traced


def nothing_blocks(mesh: TriangleMesh, occluders: Sequence[Geometry]) -> bool:
    """Whether no triangle rises above the tangent plane of any point, so that every hemisphere is free.

    False also where it would take long to say.
    """
    parts = [(mesh.positions, mesh.triangles), *((p, t) for p, t in occluders if len(t))]
    vertices = np.concatenate([np.asarray(p, np.float64)[np.unique(t)] for p, t in parts])
    lit = np.flatnonzero(np.any(mesh.normals != 0, axis=1))
    points, normals = mesh.points[lit], mesh.normals[lit]
    # a handful first: almost every mesh is found out by them
    level = _LEVEL * float(np.ptp(vertices, axis=0).max())
    some, few = points[::len(points) // 32 + 1], vertices[::len(vertices) // 4096 + 1]
    height = normals[::len(points) // 32 + 1]
    if (product(height, few.T).max(1, initial=-np.inf) > (height * some).sum(1) + level).any():
        return False
    vertices = vertices[morton_order(vertices)]
    balls = -(-len(vertices) // _LEAF)
    if len(points) * balls > _MOST_PAIRS:
        return False
    vertices = np.concatenate([vertices, np.repeat(vertices[-1:], balls * _LEAF - len(vertices), 0)])
    leaves = vertices.reshape(balls, _LEAF, 3)
    centres = leaves.mean(1)
    radii = np.linalg.norm(leaves - centres[:, None], axis=2).max(1)
    step = max(1, (1 << 20) // balls)
    for start in range(0, len(points), step):
        here = slice(start, start + step)
        plane = (normals[here] * points[here]).sum(1) + level
        one, ball = np.nonzero(product(normals[here], centres.T) + radii > plane[:, None])
        for first in range(0, len(one), 1 << 14):
            part = slice(first, first + (1 << 14))
            reach = np.einsum("pvx,px->pv", leaves[ball[part]], normals[here][one[part]]).max(1)
            if (reach > plane[one[part]]).any():
                return False
    return True


def pilot(mesh: TriangleMesh, scene: Occluders, order: int, seed: int, pool: ThreadPoolExecutor, threads: int
          ) -> Generator[float, None, Pilot]:
    """Trace a few points well. Yields progress."""
    lit = np.flatnonzero(np.any(mesh.normals != 0, axis=1))
    rng = np.random.default_rng([seed, 5])
    rows = np.sort(rng.choice(lit, min(max(min(PILOT_POINTS, len(lit) // 32), _FEWEST), len(lit)), replace=False))
    few = replace(mesh, points=mesh.points[rows], normals=mesh.normals[rows], clearance=mesh.clearance[rows])
    unshadowed = sh.cosine_lobe(few.normals, order)
    every, found = np.arange(len(rows)), []
    began = time.perf_counter()
    for _ in range(2):
        twin = BlockedEstimator(few, scene, order, int(rng.integers(2**31)), PILOT_RAYS, _PILOT_SETS)
        sums = np.zeros_like(unshadowed)
        yield from twin.trace(pool, threads, every, 0, PILOT_RAYS, sums)
        found.append(twin.turned_here(every, twin.means(every, sums, 0, PILOT_RAYS)))
    spent = time.perf_counter() - began
    one, two = found
    energy = float(((unshadowed - one) * (unshadowed - two)).sum())
    traced = 2 * PILOT_RAYS * len(rows)
    if energy <= 0:
        return Pilot(np.inf, np.inf, spent / traced, traced)
    blocked = max(float((one * two).sum()), 0.0) / energy
    noise = float(np.square(one - two).sum()) / 2 / energy
    return Pilot(blocked ** 0.5, noise ** 0.5, spent / traced, traced)


def choose(found: Pilot, points: int, tolerance: float) -> Plan:
    """The cheapest plan for so many points that meets the tolerance (relative L2)."""
    if _SAFE * found.blocked <= tolerance:
        return Plan("analytic", reason=f"Shadows are {_percent(found.blocked)} of the whole, less than the tolerance: "
                                       "none is traced.")
    candidates = [(_seconds(plan, found, points), plan) for plan in plans(found, points, tolerance)]
    return min(candidates, key=lambda candidate: candidate[0])[1]


def plans(found: Pilot, points: int, tolerance: float) -> list[Plan]:
    """Every plan that is expected to meet the tolerance by tracing."""
    measured = _MARGIN * tolerance
    out = [Plan("embree", tolerance=measured, reason="Rays from every point, more where shadows are harder, are the "
                                                      f"quickest way to {_percent(tolerance)}.")]
    enough = [rays for rays in _FEW_RAYS if _SAFE * noise_of(found, rays) <= tolerance]
    if enough:
        out.append(Plan("embree", rays=enough[0], reason=f"Shadows are {_percent(found.blocked)} of the whole, so "
                        f"{enough[0]} rays a point are enough for {_percent(tolerance)}."))
    out.append(Plan("hybrid", tolerance=measured, reason=f"{hybrid_rays(found, measured)} rays a point, averaged "
                    f"over neighbours by the network, are enough for {_percent(tolerance)}."))
    if points >= SPARSE_POINTS:
        out.append(Plan("sparse", tolerance=measured, reason=f"{points:,} points are dense: some are traced, and the "
                                                              "others read off them."))
    return out


def noise_of(found: Pilot, rays: float) -> float:
    """The relative error of a plain bake with so many rays."""
    return found.noise * (PILOT_RAYS / rays) ** (RATE / 2)


def needed_rays(found: Pilot, tolerance: float) -> float:
    """Rays of a plain bake that meet the tolerance."""
    if not np.isfinite(found.noise):
        return MAX_RAYS
    return float(np.clip(PILOT_RAYS * (found.noise / tolerance) ** (2 / RATE), 1, MAX_RAYS))


def hybrid_rays(found: Pilot, tolerance: float) -> int:
    """Rays, a power of two, at which a hybrid bake is expected to stop doubling."""
    wanted = needed_rays(found, tolerance / _HYBRID_ERROR)
    return int(2 ** np.ceil(np.log2(max(wanted, 4))))


def _seconds(plan: Plan, found: Pilot, points: int) -> float:
    """What a plan is expected to take, the scene aside, which all have alike."""
    assert plan.rays is not None or plan.tolerance is not None
    if plan.method == "embree":
        rays = plan.rays or max(needed_rays(found, plan.tolerance or 1.0), PILOT_RAYS)
        return found.ray * points * rays
    if plan.method == "hybrid":
        rays = hybrid_rays(found, plan.tolerance or 1.0)
        filters = np.log2(rays / 4) + 1  # one after each doubling
        return _HYBRID_SECONDS * filters + found.ray * points * (rays + _HYBRID_RAYS * filters)
    rays = max(needed_rays(found, plan.tolerance or 1.0), 8.0)
    return found.ray * points * (_SPARSE_RAYS + _SPARSE_SHARE * rays)


def _percent(part: float) -> str:
    return f"{100 * part:.2g} %"
