# SPDX-License-Identifier: GPL-3.0-or-later
"""The planner (`auto`): the cheapest way to get direct transfer within a tolerance, and why.

1. Where everything lies below the tangent plane of every point, nothing can be blocked: unshadowed transfer is exact,
   and neither a ray nor a scene is needed (`horizon`). A convex mesh is so.
2. Else a pilot says how large shadows are, and what rays bring and cost (`pilot`). Where the scene that it traces would
   take longer than it may, the mesh is merged first to see whether shadows are wanted at all (`merged`).
3. Bands whose energy would not be seen are dropped (`bands`); the rest of the tolerance is for the others.
4. Each candidate is given a number of rays that meets the tolerance, and a time; the cheapest is taken. What the noise
   becomes with other rays, and what a hybrid or a sparse bake saves, follow laws measured on meshes (below).

`gnn` is no candidate: what it saves is the scene, which the pilot has built, and at each point it costs as much as 100
rays, which are more exact.
"""
from __future__ import annotations

from dataclasses import dataclass

from . import bands
from .bands import Bands
from .embree_bake import FIRST_RAYS
from .hybrid_bake import FEWEST, expected_rays
from .pilot import Pilot

_SAFE = 1.1                  # what the pilot's noise may be too low by
_MARGIN = 0.95               # of a tolerance, for who measures it: the measure is a little too low where it stops
_FEW_RAYS = (4, 6, 8, 12, 16, 24, 32, 48)  # of plain bakes below what an adaptive one takes at least
_EMBREE_SECONDS, _HYBRID_SECONDS = 1e-3, 5e-3  # what a bake costs at all,
_EMBREE_RAYS, _HYBRID_RAYS = 6.0, 10.0  # and at each point besides its rays, in rays
SPARSE_POINTS = 1 << 16      # from which on a sparse bake is a candidate; below, too many are samples
_SPARSE_SHARE = 0.15         # of the points that it then traces, about
_SPARSE_RAYS = 25.0          # what reconstruction costs at each point, in rays


@dataclass(frozen=True)
class Plan:
    """What to run, and why."""

    method: str
    rays: int | None = None          # for every point, or
    tolerance: float | None = None   # to be met by measuring
    reason: str = ""                 # one sentence


def unshadowed_bands(found: Pilot, order: int, tolerance: float, safe: float = 1.0) -> tuple[Plan, Bands] | None:
    """Unshadowed transfer, if that is near enough, at the lowest order at which that and what is dropped are.

    safe: what that error may be larger by.
    """
    for fewer in range(bands.LEAST_ORDER, order + 1):
        if safe * found.without_shadows(fewer)[1] <= tolerance:
            return _unshadowed(found.to_order(fewer)), bands.chosen(fewer, order, tolerance, _parts(found, order))
    return None


def traced_bands(found: Pilot, points: int, order: int, tolerance: float) -> tuple[Plan, Bands]:
    """The cheapest plan for so many points that meets the tolerance (relative L2) by tracing, and its bands.

    These are the fewest of the order that take no more time than all. Noise goes with the bands, so that the others
    mostly need fewer rays, though less of the tolerance is left for them.
    """
    parts = _parts(found, order)
    every = cheapest(found, points, tolerance)
    for fewer in range(bands.LEAST_ORDER, order):
        if parts[fewer][1] <= bands.MOST_DROPPED * tolerance:
            enough, cut = bands.chosen(fewer, order, tolerance, parts), found.to_order(fewer)
            plan = cheapest(cut, points, enough.left, tolerance)
            if seconds(plan, cut, points) <= seconds(every, found, points):
                return plan, enough
    return every, bands.chosen(order, order, tolerance, parts)


def _parts(found: Pilot, order: int) -> list[tuple[float, float]]:
    return [found.beyond(fewer) for fewer in range(order)]


def unshadowed(found: Pilot, tolerance: float, safe: float = 1.0) -> Plan | None:
    """Unshadowed transfer, if that is near enough, all bands of it; safe: what its error may be larger by."""
    return _unshadowed(found) if safe * found.most_blocked <= tolerance else None


def cheapest(found: Pilot, points: int, tolerance: float, asked: float | None = None) -> Plan:
    """The cheapest that traces; the tolerance is what is left of another, if one was asked for."""
    candidates = [(seconds(plan, found, points), plan) for plan in plans(found, points, tolerance, asked)]
    return min(candidates, key=lambda candidate: candidate[0])[1]


def _unshadowed(found: Pilot) -> Plan:
    return Plan("analytic", reason=f"Shadows are {_percent(found.blocked)} of the whole, less than the tolerance: "
                                   "none is traced.")


def plans(found: Pilot, points: int, tolerance: float, asked: float | None = None) -> list[Plan]:
    """Every plan that is expected to meet the tolerance by tracing; people read of what was `asked`."""
    measured, said = _MARGIN * tolerance, _percent(asked or tolerance)
    out = [Plan("embree", tolerance=measured, reason="Rays from every point, more where shadows are harder, are the "
                                                      f"quickest way to {said}.")]
    enough = [rays for rays in _FEW_RAYS if _SAFE * found.noise_of(rays) <= tolerance]
    if enough:
        out.append(Plan("embree", rays=enough[0], reason=f"Shadows are {_percent(found.blocked)} of the whole, so "
                        f"{enough[0]} rays a point are enough for {said}."))
    if points >= FEWEST:  # with fewer it asks no network, and what it does without takes longer than plain rays
        out.append(Plan("hybrid", tolerance=tolerance, reason="Few rays, averaged over neighbours by the network, are "
                                                              f"the quickest way to {said}."))
    if points >= SPARSE_POINTS:
        out.append(Plan("sparse", tolerance=measured, reason=f"{points:,} points are dense: some are traced, and the "
                                                              "others read off them."))
    return out


def seconds(plan: Plan, found: Pilot, points: int) -> float:
    """What a plan is expected to take, the scene aside, which all have alike."""
    if plan.method == "analytic":
        return 0.0
    assert plan.rays is not None or plan.tolerance is not None
    if plan.method == "embree":
        rays = plan.rays or max(found.needed_rays(plan.tolerance or 1.0), 2.0 * FIRST_RAYS)
        return _EMBREE_SECONDS + found.ray * points * (rays + _EMBREE_RAYS)
    if plan.method == "hybrid":
        rays = expected_rays(found, plan.tolerance or 1.0)
        return _HYBRID_SECONDS + found.ray * points * (rays + _HYBRID_RAYS)
    rays = max(found.needed_rays(plan.tolerance or 1.0), 8.0)
    return found.ray * points * (_SPARSE_RAYS + _SPARSE_SHARE * rays)


def _percent(part: float) -> str:
    return f"{100 * part:.2g} %"
