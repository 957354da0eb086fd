# SPDX-License-Identifier: GPL-3.0-or-later
"""The bake by network alone (`gnn`): no rays."""
from __future__ import annotations

import time
from collections.abc import Generator, Sequence

import numpy as np
from numpy.typing import NDArray

from . import cones, gnn, weights
from . import spherical_harmonics as sh
from .estimator import morton_order
from .geometry import TriangleMesh
from .raycast import Geometry
from .record import BakeRecord
from .transfer import Transfer
from .voxels import Pyramid
from .workers import default_threads, results, workers

_BUILDING = 0.2  # of the progress: pooling the surface


def bake(mesh: TriangleMesh, order: int, *, rays: int | None, tolerance: float | None,
         occluders: Sequence[Geometry], seed: int, threads: int | None, scene: Pyramid | None = None,
         ) -> Generator[float, None, Transfer]:
    """Ask the network at every point; arguments as `methods.bake`. Rays, tolerance and seed do not matter."""
    began = time.perf_counter()
    network = weights.load_gnn()
    threads = threads or default_threads()
    if scene is None:
        scene = voxels_of(mesh, occluders)
        yield _BUILDING
    voxels = scene
    coefficients = np.zeros((len(mesh.points), sh.coefficient_count(order)), np.float32)
    lit = mesh.lit()
    lit = lit[morton_order(mesh.points[lit])] if len(lit) else lit
    done = 0

    def work(rows: NDArray) -> tuple[NDArray, NDArray]:
        blocked = gnn.blocked(mesh, voxels, network, order, rows)
        return rows, sh.cosine_lobe(mesh.normals[rows], order) - blocked

    rounds = max(1, -(-len(lit) // (threads * gnn.CHUNK)))
    jobs = ((rows,) for rows in np.array_split(lit, threads * rounds) if len(rows))  # the threads end together
    with workers(threads) as pool:
        asking = results(pool, threads, jobs, work)
        try:
            for rows, found in asking:
                coefficients[rows] = found
                done += len(rows)
                yield _BUILDING + (1 - _BUILDING) * done / len(lit)
        finally:
            asking.close()
    return Transfer(coefficients, BakeRecord(
        method="gnn", order=order, points=len(mesh.points), domain=mesh.domain, rays=0, seed=seed,
        seconds=time.perf_counter() - began, error_estimate=None))


def voxels_of(mesh: TriangleMesh, occluders: Sequence[Geometry]) -> Pyramid:
    """What the network reads of a mesh and of what else blocks its light."""
    return cones.pyramid([(mesh.positions, mesh.triangles), *occluders])
