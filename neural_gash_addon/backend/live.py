# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer of a mesh that deforms, as well as it can be had in a given time.

What depends on the topology is kept from frame to frame: a pyramid of coarser meshes (`coarsen`), each with a quarter
of the vertices. A frame traces or asks a network at the vertices of one of them, against its own triangles, so that
also the acceleration structure is small; what is blocked there is given to all vertices. Which level, which method and
how many rays is measured once, on the mesh as it stands, against the time that there is.
"""
from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import hybrid_bake, methods
from . import spherical_harmonics as sh
from .coarsen import Coarsening, coarsened
from .geometry import POINT, TriangleMesh
from .hybrid import levelled
from .raycast import Geometry

COARSEST = 512         # vertices: fewer are no quicker, as what each call costs is more than they do
_RAYS = (2, 4, 8, 16, 32, 64)
# Errors below this are alike, and the plan that does most is taken: a mesh at rest may have no shadow at all, and then
# says nothing of what the next pose needs.
_ALIKE = 0.01
_ATTEMPTS = 4  # before a plan is said to take too long: others than the one that is timed use the machine too
_SAMPLE, _SAMPLE_RAYS = 512, 256  # points at which errors are measured


@dataclass(frozen=True)
class LivePlan:
    """How each frame is made."""

    method: str
    rays: int | None  # of each point that is traced
    level: int        # 0: at every vertex; each further one at about a quarter of them
    points: int       # of that level
    seconds: float    # a frame took when it was tried
    error: float      # rel L2, then


def best(plans: Sequence[LivePlan], seconds: float) -> LivePlan:
    """The plan with the smallest error of those that take no more than `seconds`; the quickest, where none does."""
    within = [plan for plan in plans if plan.seconds <= seconds]
    if not within:
        return min(plans, key=lambda plan: plan.seconds)
    return min(within, key=lambda plan: (max(plan.error, _ALIKE), -plan.seconds))


class Live:
    """A deforming mesh: fixed topology, baked again and again."""

    def __init__(self, mesh: TriangleMesh, order: int, seed: int = 0) -> None:
        """mesh: as it stands. Split normals are baked at every point: their vertices are several points each."""
        self._order, self._seed = order, seed
        self._triangles, self._elements = mesh.triangles, mesh.elements
        self._levels: list[Coarsening] = []
        while mesh.domain == POINT and len(mesh.points) > 2 * COARSEST:
            level = coarsened(mesh, seed)
            if level is None or len(level.rows) < COARSEST // 2:
                break
            self._levels.append(level)
            mesh = level.mesh(mesh)

    def fits(self, mesh: TriangleMesh) -> bool:
        """Whether the topology is still the one that this was made for."""
        return np.array_equal(mesh.triangles, self._triangles) and np.array_equal(mesh.elements, self._elements)

    def bake(self, mesh: TriangleMesh, occluders: Sequence[Geometry], plan: LivePlan) -> NDArray[np.float32]:
        """Transfer (N, K) of the mesh as it stands, by a plan of `tried`."""
        steps = self._levels[:plan.level]
        meshes = [mesh]
        for level in steps:
            meshes.append(level.mesh(meshes[-1]))
        coarse = meshes[-1]
        if plan.rays is None:
            found = methods.run(methods.bake(coarse, plan.method, self._order, occluders=occluders)).coefficients
        else:
            found = hybrid_bake.at_once(coarse, occluders, self._order, plan.rays, self._seed)
        if not steps:
            return found
        # as `hybrid.filtered`: neighbours pass on the share that is blocked, and how the rest differs from that share
        # of all light; so one that faces another way is read as it would be here
        unshadowed = sh.cosine_lobe(mesh.normals, self._order).astype(np.float32)
        rows = np.arange(len(mesh.points))
        for level in steps:
            rows = rows[level.rows]
        blocked = levelled(unshadowed[rows] - found, unshadowed[rows], -1)
        for level in reversed(steps):
            blocked = level.spread(blocked)
        return unshadowed - levelled(blocked, unshadowed, 1)

    def tried(self, mesh: TriangleMesh, occluders: Sequence[Geometry], seconds: float) -> list[LivePlan]:
        """Plans with what they take and how they err, tried on the mesh as it stands: from the coarsest level and the
        fewest rays up to the first that take longer than `seconds`. Some of them always are.
        """
        rng = np.random.default_rng([self._seed, 3])
        sample = mesh.lit()
        sample = np.sort(rng.permutation(sample)[:_SAMPLE])
        few = replace(mesh, points=mesh.points[sample], normals=mesh.normals[sample],
                      clearance=mesh.clearance[sample])
        truth = methods.run(methods.bake(few, "embree", self._order, rays=_SAMPLE_RAYS, occluders=occluders,
                                         seed=self._seed + 1)).coefficients
        energy = float(np.square(truth).sum()) or 1.0
        tried: list[LivePlan] = []
        for plan in self._plans():
            if any(t.seconds > seconds and t.method == plan.method and t.level >= plan.level
                   and (t.rays or 0) <= (plan.rays or 0) for t in tried):
                continue  # less of the same took too long
            took = np.inf
            for attempt in range(_ATTEMPTS):
                if attempt > 1 and took <= seconds:  # the first has caches to fill
                    break
                began = time.perf_counter()
                found = self.bake(mesh, occluders, plan)
                took = min(took, time.perf_counter() - began)
            error = float(np.square(found[sample] - truth).sum() / energy) ** 0.5
            tried.append(replace(plan, seconds=took, error=error))
        return tried

    def _plans(self) -> Iterator[LivePlan]:
        """Every plan, from the coarsest level."""
        counts = [len(self._levels[0].beside) if self._levels else 0, *(len(level.rows) for level in self._levels)]
        for level in reversed(range(len(counts))):
            for rays in _RAYS:
                yield LivePlan("hybrid", rays, level, counts[level], 0.0, 0.0)
            yield LivePlan("gnn", None, level, counts[level], 0.0, 0.0)
