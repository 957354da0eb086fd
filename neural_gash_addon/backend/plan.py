# SPDX-License-Identifier: GPL-3.0-or-later
"""The planner (`auto`): the cheapest way to get direct transfer within a tolerance, and why.

1. Where everything lies below the tangent plane of every point, nothing can be blocked: unshadowed transfer is exact,
   and neither a ray nor a scene is needed (`horizon`). A convex mesh is so.
2. Else a pilot says how large shadows are, and what rays bring and cost (`pilot`).
3. Bands whose energy would not be seen are dropped (`bands`); the rest of the tolerance is for the others.
4. Each candidate is given a number of rays that meets the tolerance, and a time; the cheapest is taken. What the noise
   becomes with other rays, and what a hybrid bake saves, follow laws measured on meshes (below); on dense meshes hybrid
   and sparse bakes are tried at some of the pilot's points.

`gnn` and `embedding` are candidates that hardly ever win: what the former saves is the scene, which the
pilot has built, and at each point it costs as much as 100 rays, which are more exact; the latter costs more than that.
"""
from __future__ import annotations

import importlib.util
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np

from . import bands, hybrid_bake, sparse_bake
from .bands import Bands
from .embree_bake import FIRST_RAYS
from .geometry import TriangleMesh
from .pilot import DENSE, Pilot
from .raycast import Occluders
from .transfer import Transfer
from .workers import workers

_SAFE = 1.06                 # what the pilot's noise may be too low by
_FEW_RAYS = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)  # of plain bakes; with more, not to take all alike saves more
_EMBREE_SECONDS, _HYBRID_SECONDS = 5e-4, 7e-4  # what a bake costs at all,
_PLAIN_RAYS, _EMBREE_RAYS, _HYBRID_RAYS = 3.0, 11.0, 8.0  # and at each point besides its rays, in rays
_EMBREE_MORE = 1.07  # the rays of one to a tolerance beside those that are needed if all take as many
_SPARSE_RAYS = 4.0           # what reconstruction costs at each point, in rays
_GNN_RAYS, _EMBEDDING_RAYS = 110.0, 130.0  # what networks cost at each point, in rays,
_EMBEDDING_SECONDS = 0.3     # and for its scene points;
_GNN_LEFT, _EMBEDDING_LEFT = 0.4, 0.4  # their error as a part of shadows: the root of an SRR that few meshes exceed


@dataclass(frozen=True)
class Plan:
    """What to run, and why."""

    method: str
    rays: int | None = None          # for every point, or
    tolerance: float | None = None   # to be met by measuring
    reason: str = ""                 # one sentence
    seconds: float = 0.0             # expected, but for what this machine has otherwise (`costs`)


# of what a pilot saw, of how many points, with which tolerance, and how that is called: what could be done
Way = Callable[[Pilot, int, float, str], list[Plan]]
Ways = Iterable[Way]


@dataclass(frozen=True)
class Candidate:
    """A method that a plan may name."""

    bake: Callable[..., Generator[float, None, Transfer]]
    traces: bool          # takes rays or a tolerance, the scene and the pilot, and measures its error
    ways: Way | None      # None: where nothing is traced


def tried(mesh: TriangleMesh, scene: Occluders, order: int, found: Pilot, tolerance: float, seed: int, threads: int
          ) -> Generator[float, None, Pilot]:
    """What a pilot saw, and, if the mesh is dense, what is shown by bakes that are tried at some of its points."""
    points = len(mesh.lit())
    if not found.scale or points < DENSE:
        return found
    with workers(threads) as pool:  # the hybrid, which costs more to be tried, only where it may be the cheaper one
        found = yield from sparse_bake.tried(mesh, scene, order, found, tolerance, seed, pool, threads)
        if sparse_bake.expected_rays(found, points, tolerance) + _SPARSE_RAYS > _HYBRID_RAYS + 2:
            found = yield from hybrid_bake.tried(mesh, scene, order, found, tolerance, seed, pool, threads)
    return found


def unshadowed_bands(found: Pilot, order: int, tolerance: float) -> tuple[Plan, Bands] | None:
    """Unshadowed transfer, if that is near enough, at the lowest order at which that and what is dropped are."""
    for fewer in range(bands.LEAST_ORDER, order + 1):
        if found.without_shadows(fewer)[1] <= tolerance:
            return _unshadowed(found.to_order(fewer)), bands.chosen(fewer, order, tolerance, _parts(found, order))
    return None


def traced_bands(found: Pilot, points: int, order: int, tolerance: float, ways: Ways) -> tuple[Plan, Bands]:
    """The cheapest plan for so many points that meets the tolerance (relative L2) by one of the ways, and its bands.

    These are the fewest of the order that take no more time than all. Noise goes with the bands, so that the others
    mostly need fewer rays, though less of the tolerance is left for them.
    """
    parts = _parts(found, order)
    every = cheapest(found, points, tolerance, ways)
    for fewer in range(bands.LEAST_ORDER, order):
        if parts[fewer][1] <= bands.MOST_DROPPED * tolerance:
            enough = bands.chosen(fewer, order, tolerance, parts)
            plan = cheapest(found.to_order(fewer), points, enough.left, ways, tolerance)
            if plan.seconds <= every.seconds:
                return plan, enough
    return every, bands.chosen(order, order, tolerance, parts)


def _parts(found: Pilot, order: int) -> list[tuple[float, float]]:
    return [found.beyond(fewer) for fewer in range(order)]


def unshadowed(found: Pilot, tolerance: float) -> Plan | None:
    """Unshadowed transfer, if that is near enough, all bands of it."""
    return _unshadowed(found) if found.most_blocked <= tolerance else None


def cheapest(found: Pilot, points: int, tolerance: float, ways: Ways, asked: float | None = None,
             measuring: bool = False) -> Plan:
    """The cheapest of all ways; the tolerance is what is left of another, if one was asked for.

    measuring: of those that go on until they have measured that it is met, as other plans missed it.
    """
    return min((plan for way in ways for plan in way(found, points, tolerance, _percent(asked or tolerance))
                if plan.tolerance or not measuring), key=lambda plan: plan.seconds)


def _unshadowed(found: Pilot) -> Plan:
    return Plan("analytic", reason=f"Shadows are {_percent(found.blocked)} of the whole, less than the tolerance: "
                                   "none is traced.")


# The ways: what a method could do within a tolerance, and what that is expected to take (the scene aside, which all
# that trace have alike). A method of the table (`methods.Method.ways`) is a candidate by these.

def embree_ways(found: Pilot, points: int, tolerance: float, said: str) -> list[Plan]:
    """Rays until the tolerance is met, or so many as are enough."""
    rays = max(_EMBREE_MORE * found.needed_rays(tolerance), 2.0 * FIRST_RAYS) + _EMBREE_RAYS
    out = [Plan("embree", tolerance=tolerance, seconds=_EMBREE_SECONDS + found.seconds(points, rays),
                reason=f"Rays from every point, more where shadows are harder, are the quickest way to {said}.")]
    enough = next((rays for rays in _FEW_RAYS if _SAFE * found.noise_of(rays) <= tolerance), None)
    if enough:
        out.append(Plan("embree", rays=enough, seconds=_EMBREE_SECONDS + found.seconds(points, enough + _PLAIN_RAYS),
                        reason=f"Shadows are {_percent(found.blocked)} of the whole, so {enough} rays a point are "
                               f"enough for {said}."))
    return out


def hybrid_ways(found: Pilot, points: int, tolerance: float, said: str) -> list[Plan]:
    """Few rays; of few points it asks no network, and what it does without takes longer than plain rays."""
    rays = hybrid_bake.expected_rays(found, points, tolerance) + _HYBRID_RAYS
    return [] if points < hybrid_bake.FEWEST else [Plan(
        "hybrid", tolerance=tolerance, seconds=_HYBRID_SECONDS + found.seconds(points, rays),
        reason=f"Few rays, averaged over neighbours by the network, are the quickest way to {said}.")]


def sparse_ways(found: Pilot, points: int, tolerance: float, said: str) -> list[Plan]:
    """Some of many points, if that was tried."""
    if found.apart is None:
        return []
    rays = sparse_bake.expected_rays(found, points, tolerance) + _SPARSE_RAYS
    return [] if not np.isfinite(rays) else [Plan(
        "sparse", tolerance=tolerance, seconds=found.seconds(points, rays),
        reason=f"{points:,} points are dense: some are traced, and the others read off them.")]


def gnn_ways(found: Pilot, points: int, tolerance: float, said: str) -> list[Plan]:
    """The network alone, where its usual error is within the tolerance; what it is here is measured afterwards."""
    return [] if _GNN_LEFT * found.blocked > tolerance else [Plan(
        "gnn", seconds=found.seconds(points, _GNN_RAYS), reason=f"The network alone is the quickest way to {said}.")]


def embedding_ways(found: Pilot, points: int, tolerance: float, said: str) -> list[Plan]:
    """Rays from scene points alone, if there is PyTorch, as `gnn_ways`."""
    if _EMBEDDING_LEFT * found.blocked > tolerance or not _torch_is_here():
        return []
    return [Plan("embedding", seconds=_EMBEDDING_SECONDS + found.seconds(points, _EMBEDDING_RAYS),
                 reason=f"Rays from some points, read by the embedding anywhere, are the quickest way to {said}.")]


@cache
def _torch_is_here() -> bool:
    """Asked once: to look takes as long as a thousand rays."""
    return importlib.util.find_spec("torch") is not None


def _percent(part: float) -> str:
    return f"{100 * part:.2g} %"
