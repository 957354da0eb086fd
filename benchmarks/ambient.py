# SPDX-License-Identifier: GPL-3.0-or-later
"""Ambient occlusion, the one coefficient that others bake, beside our first coefficient."""
from __future__ import annotations

import contextlib
import os
import statistics
import sys
from collections.abc import Callable, Iterator

import numpy as np
from meshes import load
from numpy.typing import NDArray
from table import Table, interleaved, ratio, seconds

from neural_gash_addon.backend import methods
from neural_gash_addon.backend.geometry import TriangleMesh

RAYS = 64
MOST = 1 << 14  # samples of a peer at most


def _ours(mesh: TriangleMesh, seed: int, threads: int) -> NDArray[np.float64]:
    """Our openness, from an order-2 bake (the least there is: four coefficients, not one)."""
    return methods.run(methods.bake(mesh, order=2, rays=RAYS, seed=seed, threads=threads)).coefficients[:, 0]


def _igl(mesh: TriangleMesh) -> Callable[[int, int], NDArray]:
    from igl import embree

    vertices, faces = np.ascontiguousarray(mesh.positions), mesh.triangles.astype(np.int64)
    points, normals = np.ascontiguousarray(mesh.points), np.ascontiguousarray(mesh.normals)

    def bake(samples: int, seed: int) -> NDArray:  # its seed goes on from call to call
        return 1 - embree.ambient_occlusion(vertices, faces, points, normals, samples)

    return bake


def cycles_openness(mesh: TriangleMesh) -> Callable[[int, int], NDArray]:
    """Cycles' bake of ambient occlusion to a mesh's vertices (V,), by samples and seed; empties the file."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    data = bpy.data.meshes.new("mesh")
    data.from_pydata(mesh.positions.tolist(), [], mesh.triangles.tolist())
    data.shade_smooth()
    colours = data.attributes.new("ao", "FLOAT_COLOR", "POINT")
    data.attributes.active_color = colours
    thing = bpy.data.objects.new("object", data)
    scene = bpy.context.scene
    scene.collection.objects.link(thing)
    bpy.context.view_layer.objects.active = thing
    thing.select_set(True)
    scene.world = bpy.data.worlds.new("world")
    scene.world.light_settings.distance = 1e6 * float(np.ptp(mesh.positions))
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.use_denoising = False
    scene.cycles.use_adaptive_sampling = False
    scene.render.bake.target = "VERTEX_COLORS"

    def bake(samples: int, seed: int) -> NDArray:
        scene.cycles.samples, scene.cycles.seed = samples, seed
        with _quiet():
            bpy.ops.object.bake(type="AO")
        out = np.empty(4 * len(mesh.positions), np.float32)
        data.attributes["ao"].data.foreach_get("color", out)
        return out.reshape(-1, 4)[:, 0]

    return bake


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what Blender's own code prints out of the table."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "w", encoding="ascii") as sink:
        os.dup2(sink.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _error(bake: Callable[[int], NDArray]) -> float:
    """Relative L2 error of a bake from two with other seeds, so that each is held to its own limit."""
    first, second = (np.asarray(bake(seed), np.float64) for seed in (1, 2))
    return float(np.linalg.norm(first - second) / np.sqrt(2) / np.linalg.norm(first))


def measure(table: Table, threads: int) -> None:
    """Print the section."""
    table.heading(
        "Ambient occlusion", f"Seconds to a like error (rel L2 of the openness, from two seeds) as ours with {RAYS} "
        "rays, whose bake gives all four coefficients of order 2. libigl weights the hemisphere evenly, not by the "
        "cosine, and gives all vertices the same directions; Cycles bakes corners and averages them.")
    name, mesh = load("8K")

    def ours(seed: int) -> NDArray:
        return _ours(mesh, seed, threads)

    goal = _error(ours)
    for label, make in (("libigl embree.ambient_occlusion", _igl), ("Cycles AO bake", cycles_openness)):
        try:
            peer = make(mesh)
        except (ImportError, OSError, RuntimeError) as reason:
            table.absent(f"{name}: {label}", reason)
            continue
        samples = 32
        error = _error(lambda seed, n=samples, p=peer: p(n, seed))
        while error > goal * 1.05 and samples < MOST:
            samples = min(MOST, int(samples * np.clip((error / goal) ** 2, 1.25, 4)))
            error = _error(lambda seed, n=samples, p=peer: p(n, seed))
        a, b = interleaved(3, lambda: seconds(lambda: ours(0)),
                           lambda n=samples, p=peer: seconds(lambda: p(n, 3)))
        table.add(f"{name}: {label}, {samples} samples", f"{statistics.median(a):.2f} s ({goal:.2%})",
                  f"{statistics.median(b):.2f} s ({error:.2%})", ratio(b, a))
