# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertices or a texture, as the planner has it, and the error inside faces. `benchmarks/targets.py [mesh.ply ...]`.

For each mesh (those of ../shared/meshes/validation where none is named) and tolerance: the target, what corners miss as
the planner's look says, the side of a texture, and the error of the bake that came of it, noise and all, at 1,000
points inside faces, by area. Two traces of these points, with seeds of their own, so that their noise cancels. Times
are of the processor, on one thread.
"""
from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fitted import lookups
from meshes import FOLDER, read
from textures import surface_of

from neural_gash_addon.backend import methods, texture
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.atlas import Part, place
from neural_gash_addon.backend.auto_bake import Elsewhere
from neural_gash_addon.backend.raster import Coverage
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.backend.resolution import AUTO_SIDE, fitting_side
from neural_gash_addon.backend.texels import texel_points

TOLERANCES = (0.1, 0.05, 0.02)
ORDER, TRUE_RAYS, POINTS = 3, 2048, 1000


def main() -> int:
    """Print a row a mesh and tolerance, and then one a tolerance."""
    paths = [Path(name) for name in sys.argv[1:]] or sorted((FOLDER / "validation").glob("*.ply"))
    print("| mesh | tolerance | missed by corners | target | error inside faces | placing s | all s |\n"
          "|---|---|---|---|---|---|---|")
    found: dict[tuple[float, bool], list[float]] = {(t, to): [] for t in TOLERANCES for to in (False, True)}
    for path in paths:
        mesh = read(path)
        surface = surface_of(mesh)
        rng = np.random.default_rng(7)
        one, two, three = mesh.positions[mesh.triangles].transpose(1, 0, 2)
        area = np.linalg.norm(np.cross(two - one, three - one), axis=1)
        faces = rng.choice(len(area), POINTS, p=area / area.sum()).astype(np.int32)
        weights = rng.dirichlet([1, 1, 1], POINTS)
        points = texel_points(surface, Coverage(1, np.arange(POINTS), faces, weights, weights))
        scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
        exact = [methods.run(methods.bake(points, "embree", ORDER, rays=TRUE_RAYS, seed=seed, scene=scene, threads=1)
                             ).coefficients for seed in (3, 4)]
        for tolerance in TOLERANCES:
            wish, began, placing, missed = {"tolerance": tolerance, "threads": 1}, time.process_time(), 0.0, ""
            try:
                bake = methods.run(methods.bake(mesh, "auto", ORDER, movable=True, **wish))
                values = np.einsum("nc,nck->nk", weights, bake.coefficients[mesh.triangles[faces]].astype(float))
                target = "vertices"
            except Elsewhere as wanted:
                missed, start = f"{wanted.inside.error:.0%}", time.process_time()
                trial = partial(fitting_side, surface, error=tolerance, method="auto", order=ORDER, threads=1,
                                near=wanted.side, most=AUTO_SIDE)
                (placed,), side = methods.run(place([Part(surface, None, trial)]))
                placing = time.process_time() - start
                result = methods.run(texture.bake(surface, "auto", ORDER, uv=placed.uv, side=side, **wish))
                values = lookups(result, np.einsum("nc,ncx->nx", weights, placed.uv[surface.corners[faces]]))
                target = f"texture {side}"
            spent = time.process_time() - began
            off = [sh.padded(values, ORDER * ORDER) - truth for truth in exact]
            error = max(float(np.vdot(*off)) / float(np.vdot(*exact)), 0.0) ** 0.5
            found[tolerance, target != "vertices"].append(error / tolerance)
            print(f"| {path.stem} | {tolerance:.0%} | {missed} | {target} | {error:.1%} | {placing:.2f} "
                  f"| {spent:.2f} |", flush=True)
    print("\n| tolerance | target | meshes | met | within 1.5 times | at worst |\n|---|---|---|---|---|---|")
    for (tolerance, to), parts in found.items():
        if parts:
            over = np.array(parts)
            print(f"| {tolerance:.0%} | {'texture' if to else 'vertices'} | {len(over)} | {(over <= 1).sum()} "
                  f"| {(over <= 1.5).sum()} | {over.max():.2f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
