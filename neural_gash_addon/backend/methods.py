# SPDX-License-Identifier: GPL-3.0-or-later
"""The table of methods: one entry each, from which the menu, the command line and the charts are read."""
from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from . import auto_bake, embree_bake, gnn_bake, hybrid_bake, paper_bake, plan, sky_bake, sparse_bake
from . import spherical_harmonics as sh
from .bounce import BLACK, Reflection
from .errors import UserError
from .estimator import MAX_RAYS
from .geometry import TEXEL, TriangleMesh
from .horizon import nothing_blocks
from .lamps import Lamps
from .progress import run as run  # the callers of `bake` drive it
from .progress import scaled
from .raycast import Geometry, Occluders
from .record import BakeRecord
from .transfer import Transfer

Baking = Generator[float, None, Transfer]
MIN_ORDER = 2
MIN_TOLERANCE = 1e-4
_FREE = "No point sees another surface: no bounce is computed."


@dataclass(frozen=True)
class Method:
    """One way to get transfer."""

    name: str
    label: str
    description: str
    traces: bool  # takes rays or a tolerance, and has bounces added to what it gives
    bake: Callable[..., Baking]
    # what makes of a mesh and its occluders what the method sees of them; None: it sees no shadows
    sees: Callable[[TriangleMesh, Sequence[Geometry]], Any] | None = None
    plans: bool = False  # to a tolerance, the order is the most that it bakes
    ways: plan.Way | None = None  # by what a pilot saw, what it could do within a tolerance: a plan may then take it
    reflects: bool = False  # takes a `reflection`, and follows bounces itself

    @property
    def bounces(self) -> bool:
        """Whether light can bounce in its bakes."""
        return self.traces or self.reflects


def _analytic(mesh: TriangleMesh, order: int, *, rays: int | None, tolerance: float | None,
              occluders: Sequence[Geometry], seed: int, threads: int | None, scene: None = None) -> Baking:
    """Unshadowed transfer, exact; only `mesh` and `order` matter."""
    began = time.perf_counter()
    coefficients = np.empty((len(mesh.points), sh.coefficient_count(order)), dtype=np.float32)
    for start in range(0, len(coefficients), embree_bake.BLOCK):
        part = slice(start, start + embree_bake.BLOCK)
        coefficients[part] = sh.cosine_lobe(mesh.normals[part], order)
        yield min(1.0, (start + embree_bake.BLOCK) / len(coefficients))
    return Transfer(coefficients, BakeRecord(
        method="analytic", order=order, points=len(mesh.points), domain=mesh.domain, rays=0, seed=seed,
        seconds=time.perf_counter() - began, error_estimate=None))


def _embree_scene(mesh: TriangleMesh, occluders: Sequence[Geometry]) -> Occluders:
    return Occluders([(mesh.positions, mesh.triangles), *occluders], mesh.resolution)


def _auto(mesh: TriangleMesh, order: int, **arguments: Any) -> Baking:
    return auto_bake.bake(mesh, order, **arguments, candidates=candidates())


def candidates() -> dict[str, plan.Candidate]:
    """What a plan may name."""
    return {name: plan.Candidate(entry.bake, entry.traces, entry.ways) for name, entry in METHODS.items()
            if entry.ways or name == "analytic"}


METHODS: dict[str, Method] = {m.name: m for m in (
    Method("analytic", "Unshadowed", "Exact shading of the normals alone, without any shadows; instant",
           traces=False, bake=_analytic),
    Method("embree", "Ray traced", "Traces rays with Embree to find what blocks the light; the reference",
           traces=True, bake=embree_bake.bake, sees=_embree_scene, ways=plan.embree_ways),
    Method("auto", "Automatic", "Looks at a few points, and takes the cheapest method, and the fewest bands, that meet "
           "the tolerance",
           traces=True, bake=_auto, sees=_embree_scene, plans=True),
    Method("hybrid", "Few rays and network", "Traces few rays, and a small network takes the rest from neighbours: "
           "smooth at once, and exact with many rays", traces=True, bake=hybrid_bake.bake, sees=_embree_scene,
           ways=plan.hybrid_ways),
    Method("sparse", "Ray traced, sparse", "Traces some points, more where shadows change, and reads the others off "
           "them; for dense meshes", traces=True, bake=sparse_bake.bake, sees=_embree_scene,
           ways=plan.sparse_ways),
    Method("gnn", "Network", "A network reads the surface around each point, with no ray: soft shadows, quickly",
           traces=False, bake=gnn_bake.bake, sees=gnn_bake.voxels_of, ways=plan.gnn_ways),
    Method("embedding", "Embedding (PyTorch)", "Traces rays at some thousand points of the surface, and a network says "
           "from them what blocks the light anywhere; what a point costs does not grow with the scene", traces=False,
           bake=sky_bake.bake, sees=sky_bake.encoded, reflects=True, ways=plan.embedding_ways),
    Method("gnn-paper", "Paper's network (PyTorch)", "The two-stage graph network of Neural-GASh, for comparison: "
           "no rays; soft shadows of the mesh on itself", traces=False, bake=paper_bake.bake_gnn),
    Method("gnn-paper-ao", "Paper's network with AO (PyTorch)", "The same, darkened where neighbours stand above the "
           "surface", traces=False, bake=paper_bake.bake_gnn_ao),
    Method("mlp", "Paper's perceptron (PyTorch)", "The first version of Neural-GASh, for comparison: each point by "
           "itself, with no shadows seen", traces=False, bake=paper_bake.bake_mlp),
)}


def bake(mesh: TriangleMesh, method: str = "embree", order: int = 3, *, rays: int | None = None,
         tolerance: float | None = None, occluders: Sequence[Geometry] = (), seed: int = 0,
         threads: int | None = None, scene: Any = None, reflection: Reflection | None = None,
         lamps: Lamps | None = None, whole: bool = False) -> Baking:
    """Bake the transfer of a mesh's points.

    Args:
        mesh: what to bake; it blocks its own light.
        method: a name in METHODS. order: bands, 2 to 5; with a tolerance, a method that `plans` leaves out those
            that would not be seen, and the record's order says how many there are.
        rays: rays for every point, or
        tolerance: relative L2 error to reach with as few rays as that takes (at most MAX_RAYS a
            point). A method that traces wants exactly one of the two.
        occluders: what else blocks, parts (positions (V, 3), triangles (F, 3)) in the same frame.
        scene: mesh and occluders as the method `sees` them, where they are there already from another bake.
        reflection: light that bounces, if any shall; for methods with `bounces`.
        lamps: what lights the points besides, if anything shall.
        seed: independent seeds give independent errors. threads: one a core where not given.
        whole: all bands, whatever a plan says: for what must be alike in several bakes.
    Yields:
        Progress, 0 to 1, many times a second. `close()` stops the workers.
    Returns:
        Transfer, whose record's frame, occluders and fingerprint are the caller's to fill.
    Raises:
        UserError: arguments out of range.
    """
    check(method, order, rays, tolerance)
    if seed < 0 or (threads is not None and threads < 0):
        raise UserError("Seed and threads are 0 or more.")
    entry = METHODS[method]
    direct = partial(entry.bake, mesh, order, rays=rays, tolerance=tolerance, occluders=occluders, seed=seed,
                     threads=threads, **({"whole": whole} if entry.plans else {}))
    if reflection is None or not entry.bounces:
        baking = direct(scene=scene)
    else:
        baking = _with_bounces(entry, direct, mesh, occluders, scene, threads, reflection)
    return baking if lamps is None else _with_lamps(baking, mesh, lamps, seed, threads)


def check(method: str, order: int, rays: int | None, tolerance: float | None) -> None:
    """UserError where `bake` has no such method, or arguments are out of range."""
    if method not in METHODS:
        raise UserError(f"There is no method '{method}'; choose one of: {', '.join(METHODS)}.")
    if not MIN_ORDER <= order <= sh.MAX_ORDER:
        raise UserError(f"The order must be {MIN_ORDER} to {sh.MAX_ORDER}, not {order}.")
    if METHODS[method].traces:
        if (rays is None) == (tolerance is None):
            raise UserError("Give either a number of rays or a tolerance.")
        if rays is not None and not 1 <= rays <= 16 * MAX_RAYS:
            raise UserError(f"The number of rays must be 1 to {16 * MAX_RAYS}, not {rays}.")
        if tolerance is not None and not MIN_TOLERANCE * (1 - 1e-6) <= tolerance <= 1:  # Blender keeps float32
            raise UserError(f"The tolerance must be {MIN_TOLERANCE:g} to 1, not {tolerance:g}.")


def _with_bounces(entry: Method, direct: Callable[..., Baking], mesh: TriangleMesh, occluders: Sequence[Geometry],
                  scene: Any, threads: int | None, reflection: Reflection) -> Baking:
    """A bake of direct transfer, and then what bounces add to it; where nothing can bounce, nothing is looked at."""
    if reflection.black or (mesh.domain != TEXEL and nothing_blocks(mesh, occluders)):  # tiles must be alike
        found = yield from direct(scene=scene)
        return Transfer(found.coefficients, found.record.also(BLACK if reflection.black else _FREE))
    if entry.reflects:
        return (yield from direct(scene=scene, reflection=reflection))
    if scene is None:
        scene = _embree_scene(mesh, occluders)
    transfer = yield from scaled(direct(scene=scene), 0, 0.6)
    return (yield from scaled(reflection.add(transfer, mesh, occluders, scene, threads), 0.6, 0.4))


def _with_lamps(baking: Baking, mesh: TriangleMesh, lamps: Lamps, seed: int, threads: int | None) -> Baking:
    """A bake of transfer, and then the irradiance from lamps."""
    transfer = yield from scaled(baking, 0, 0.5)
    return (yield from scaled(lamps.add(transfer, mesh, seed, threads), 0.5, 0.5))
