# SPDX-License-Identifier: GPL-3.0-or-later
"""Traced rays per second of the whole bake beside bare embreex on the same rays."""
from __future__ import annotations

import statistics
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import numpy as np
from meshes import load
from table import Table, interleaved, ratio, seconds

from neural_gash_addon.backend import methods
from neural_gash_addon.backend.estimator import BlockedEstimator, morton_order
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.raycast import Occluders

ORDER = 3
HELD = 1 << 23  # rays held at a time: 200 MB


def bare_seconds(mesh: TriangleMesh, scene: Occluders, rays: int, threads: int) -> tuple[float, int]:
    """Time that embreex alone takes for the rays of a bake, and how many they are; the scene is committed.

    The very origins and directions of the bake, in its order and its chunks, made beforehand and
    not timed, a batch at a time so that they fit into memory.
    """
    estimator = BlockedEstimator(mesh, scene, ORDER, 0, rays)
    lit = np.flatnonzero(np.any(mesh.normals != 0, axis=1))
    points = lit[morton_order(mesh.points[lit])]
    jobs = estimator._jobs(points, 0, rays)  # the bake's own chunks: there is no public way to them
    per_batch = max(1, HELD // (1 << 16))
    spent, traced = 0.0, 0
    with ThreadPoolExecutor(threads) as pool:
        while batch := list(islice(jobs, per_batch)):
            arrays = []
            for rows, (lift, harmonics) in batch:
                chosen = points[rows]
                frames = np.ascontiguousarray(estimator._frames(chosen), np.float32).reshape(-1, 9)
                origins = scene.origins(mesh.points[chosen], mesh.clearance[chosen])
                arrays.append((np.repeat(origins, len(harmonics), axis=0),
                               (frames @ lift).reshape(-1, 3)))
                traced += len(arrays[-1][0])
            spent += seconds(lambda held=arrays: list(pool.map(lambda ray: scene.blocked(*ray), held)))
    return spent, traced


def measure(table: Table, threads: int, quick: bool) -> None:
    """Print the section."""
    table.heading(
        "Throughput", "Million traced rays per second: the whole bake (order 3; directions, tracing, sums, "
        "rotation and the error measurement) beside bare embreex 'OCCLUDED' queries on the same rays in the "
        "same chunks and threads. The scene's commit is left out on both sides: it is timed by itself and "
        "taken off the bake.")
    for label in ("8K", "35K") if quick else ("8K", "35K", "250K"):
        name, mesh = load(label)
        geometry = [(mesh.positions, mesh.triangles)]
        scene = Occluders(geometry, mesh.resolution)
        commit = statistics.median(
            seconds(lambda g=geometry, m=mesh: Occluders(g, m.resolution)) for _ in range(3))
        for rays in (64, 256):
            reps = {"8K": 5, "35K": 3, "250K": 3 if rays == 64 else 1}[label]

            def ours(mesh: TriangleMesh = mesh, rays: int = rays, commit: float = commit) -> float:
                record = methods.run(methods.bake(mesh, order=ORDER, rays=rays, threads=threads)).record
                return (record.rays + record.probe_rays) / (record.seconds - commit) / 1e6

            def bare(mesh: TriangleMesh = mesh, rays: int = rays, scene: Occluders = scene) -> float:
                spent, traced = bare_seconds(mesh, scene, rays, threads)
                return traced / spent / 1e6

            ours()  # warm
            a, b = interleaved(reps, ours, bare)
            table.add(f"{name} vertices, {rays} rays (commit {commit * 1e3:.0f} ms)",
                      f"{statistics.median(a):.2f} M/s", f"{statistics.median(b):.2f} M/s", ratio(a, b), 0.75)
