# SPDX-License-Identifier: GPL-3.0-or-later
"""Texture bakes: how long each part takes, rays a second beside bare embreex, and peak memory."""
from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from memory import _megabytes
from meshes import load
from numpy.typing import NDArray
from table import Table, interleaved, ratio, seconds
from throughput import bare_seconds

from neural_gash_addon.backend import exr, gloss, methods, texture
from neural_gash_addon.backend.geometry import Surface, TriangleMesh
from neural_gash_addon.backend.raster import Layout
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.backend.texels import texel_points
from neural_gash_addon.backend.unwrap import unwrap

ORDER, SIDE, TOLERANCE, RATE_RAYS = 5, 1024, 0.02, 256
_SAMPLE = 2000  # texels whose error is measured


def surface_of(mesh: TriangleMesh) -> Surface:
    """A smooth mesh of triangles as a Surface."""
    corners = np.arange(3 * len(mesh.triangles), dtype=np.int32).reshape(-1, 3)
    return Surface(mesh.positions, mesh.triangles.ravel(), mesh.normals[mesh.triangles.ravel()].astype(np.float32),
                   corners.ravel() // 3, corners, mesh.resolution)


def texels_of(surface: Surface, uv: NDArray, side: int) -> TriangleMesh:
    """All texel points at once: the G-buffer."""
    return texel_points(surface, Layout(uv[surface.corners], surface.triangles, side).coverage())


def measure(table: Table, threads: int, quick: bool) -> None:
    """Print the section."""
    table.heading("Texture bake", f"Seconds from mesh arrays to files at {SIDE} x {SIDE}, order {ORDER}, rel L2 "
                  f"{TOLERANCE:.0%}, part by part; the error of the median texel is measured against 4096 rays with "
                  "another seed at a sample of them. Rays a second as under Throughput; ours includes the G-buffer.")
    for label in ("8K",) if quick else ("8K", "35K"):
        _parts(table, label, threads)
    name, mesh = load("250K")
    surface = surface_of(mesh)
    uv = methods.run(unwrap(surface, side=SIDE)).uv
    spent = statistics.median(seconds(lambda: texels_of(surface, uv, SIDE)) for _ in range(3))
    table.add(f"{name}, {len(mesh.triangles):,} triangles: G-buffer", f"{spent:.2f} s", "", spent, 3, " s", most=True)
    _gloss(table)
    if not quick:
        _memory(table)


def _gloss(table: Table) -> None:
    """What a glossy preview computes when its light changes."""
    transfer = np.random.default_rng(0).normal(size=(SIDE * SIDE, ORDER ** 2)).astype(np.float32)
    out = np.empty((-(-3 * (ORDER ** 2 + 1) // 4), SIDE * SIDE, 4), np.float32)
    light = np.random.default_rng(1).normal(size=(ORDER ** 2, 3))
    gloss.lit_channels(transfer, light, 4, out)  # warm
    spent = statistics.median(seconds(lambda: gloss.lit_channels(transfer, light, 4, out)) for _ in range(5))
    table.add(f"glossy preview, {SIDE} x {SIDE}, order {ORDER}: a new light, but for handing 20 images to Blender "
              "(0.03 s)", f"{spent:.2f} s", "", spent, 0.25, " s", most=True)


def _parts(table: Table, label: str, threads: int) -> None:
    name, mesh = load(label)
    surface = surface_of(mesh)
    times = {"unwrap": seconds(lambda: methods.run(unwrap(surface, side=SIDE)))}
    uv = methods.run(unwrap(surface, side=SIDE)).uv
    times["G-buffer"] = seconds(lambda: texels_of(surface, uv, SIDE))
    points = texels_of(surface, uv, SIDE)
    found: list[texture.TextureTransfer] = []
    whole = seconds(lambda: found.append(methods.run(
        texture.bake(surface, order=ORDER, uv=uv, side=SIDE, tolerance=TOLERANCE, threads=threads))))
    times["trace and project"] = whole - times["G-buffer"]
    result = found[0]
    times["dilate"] = seconds(result.fill_map)
    filled = result.fill_map()
    with tempfile.TemporaryDirectory() as folder:
        times["write"] = seconds(lambda: [exr.write(
            Path(folder) / f"{i}.exr", result.image(i, filled).reshape(SIDE, SIDE, 4), "")
            for i in range(texture.image_count(ORDER ** 2))])
    sample = np.sort(np.random.default_rng(0).choice(len(points.points), _SAMPLE, replace=False))
    few = TriangleMesh(points.positions, points.triangles, points.points[sample], points.normals[sample],
                       points.clearance[sample], points.elements, points.domain, points.resolution)
    reference = methods.run(methods.bake(few, order=ORDER, rays=4096, seed=99)).coefficients
    error = np.concatenate(result.coefficients)[sample] - reference
    median = float(np.median(np.linalg.norm(error, axis=1) / np.maximum(np.linalg.norm(reference, axis=1), 1e-9)))
    parts = ", ".join(f"{part} {spent:.1f} s" for part, spent in times.items())
    table.add(f"{name}, {len(mesh.triangles):,} triangles, {result.record.points:,} texels, "
              f"{result.record.rays_per_point:.0f} rays each: {parts}", f"{sum(times.values()):.1f} s", "")
    table.add(f"{name}: error of the median texel (all: {result.record.error_estimate:.2%})", f"{median:.2%}", "",
              100 * median, 100 * TOLERANCE, " %", most=True)
    scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)

    def ours() -> float:
        record = methods.run(texture.bake(surface, order=ORDER, uv=uv, side=SIDE, rays=RATE_RAYS,
                                          threads=threads)).record
        return (record.rays + record.probe_rays) / record.seconds / 1e6

    def bare() -> float:
        spent, traced = bare_seconds(points, scene, RATE_RAYS, threads)
        return traced / spent / 1e6

    a, b = interleaved(3, ours, bare)
    table.add(f"{name}: {RATE_RAYS} rays a texel", f"{statistics.median(a):.2f} M/s", f"{statistics.median(b):.2f} M/s",
              ratio(a, b), 0.7)


def _memory(table: Table) -> None:
    """Peak of a 4096 x 4096 bake in a process of its own, tiles and files on disk."""
    here = Path(__file__).resolve()
    places = [str(here.parent), str(here.parents[1])]
    program = f"import sys; sys.path[:0] = {places}; import textures; textures.child()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    if done.returncode:
        table.absent("4096 x 4096", f"the bake failed: {done.stderr.strip().splitlines()[-1:]}")
        return
    got = json.loads(done.stdout.splitlines()[-1])
    table.add(f"4096 x 4096, order {ORDER}, {got['texels']:,} texels, 16 rays, {got['seconds']:.0f} s with the files: "
              "peak memory over the process's start", f"{got['peak']:.0f} MB", "", got["peak"], 4000, " MB", most=True)


def child() -> None:
    """Bake and write 4096 x 4096 texels, report."""
    _, mesh = load("8K")
    surface = surface_of(mesh)
    start, began = _megabytes("VmRSS"), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        result = methods.run(texture.bake(surface, order=ORDER, side=4096, rays=16, folder=Path(folder) / "tiles"))
        filled = result.fill_map()
        for i in range(texture.image_count(ORDER ** 2)):
            exr.write(Path(folder) / f"{i}.exr", result.image(i, filled).reshape(4096, 4096, 4), "")
    print(json.dumps({"texels": result.record.points, "seconds": time.perf_counter() - began,
                      "peak": _megabytes("VmHWM") - start}))

