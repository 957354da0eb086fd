# SPDX-License-Identifier: GPL-3.0-or-later
"""Diffuse bounces: what they cost beside direct transfer, and beside tracing each bounce anew."""
from __future__ import annotations

import statistics
from pathlib import Path

import numpy as np
from meshes import FOLDER
from table import Table, interleaved, ratio, seconds

from neural_gash_addon.backend import methods
from neural_gash_addon.backend.bounce import MAX_BOUNCES, Reflection
from neural_gash_addon.backend.geometry import TriangleMesh

RAYS, ORDER = 64, 3


def scenes() -> list[tuple[str, TriangleMesh, np.ndarray]]:
    """Name, mesh and albedo (F, 3) of the shared scenes."""
    out = []
    for path in sorted((FOLDER / "scenes").glob("*.npz")):
        with np.load(path) as found:
            mesh = TriangleMesh.from_triangles(found["verts"], found["faces"])
            out.append((Path(path).stem.removeprefix("scene_"), mesh, found["face_albedo"].astype(np.float64)))
    return out


def measure(table: Table, threads: int) -> None:
    """Print the section."""
    table.heading("Bounces", f"Seconds of an order-{ORDER} bake of all vertices with {RAYS} rays, direct light alone "
                  "and with bounces until no more is seen; a path tracer would trace all of its rays again for each.")
    found = scenes()
    if not found:
        table.absent("bounces", "../shared/meshes/scenes is not there")
    for name, mesh, albedo in found:
        used: list[int] = []

        def spent(bounces: int, mesh: TriangleMesh = mesh, albedo: np.ndarray = albedo, used: list[int] = used
                  ) -> float:
            reflection = Reflection(albedo, bounces) if bounces else None
            return seconds(lambda: used.append(methods.run(methods.bake(
                mesh, "embree", ORDER, rays=RAYS, threads=threads, reflection=reflection)).record.bounces))

        direct, one, all_of_them = interleaved(3, lambda: spent(0), lambda: spent(1), lambda: spent(MAX_BOUNCES))
        count = max(used)
        texts = [f"{statistics.median(times):.2f} s" for times in (direct, one, all_of_them)]
        table.add(f"{name}, {len(mesh.points):,} vertices: {count} bounces beside none", texts[2], texts[0],
                  ratio(all_of_them, direct))
        table.add(f"{name}: {count} bounces beside one (traced once, so nearly the same)", texts[2], texts[1],
                  ratio(all_of_them, one), 1.5, most=True)


if __name__ == "__main__":
    measure(Table(), methods.embree_bake.default_threads())
