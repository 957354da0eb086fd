# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertices or a texture, as *Target: Automatic* has it, and the error inside faces: `benchmarks/targets.py [mesh …]`.

For each mesh (those of ../shared/meshes/validation where none is named) and tolerance: what the bake of its vertices
measured inside faces, the side of the texture that it goes on to, and the error of what is kept, noise and all, at
1,000 points inside faces, by area. Two traces of these points, with seeds of their own, so that their noise cancels.
--looks: no texture is baked, and the errors are those of the vertices. Times are of the processor, on one thread.
"""
from __future__ import annotations

import argparse
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
from neural_gash_addon.backend.raster import Coverage
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.backend.resolution import fitting_side
from neural_gash_addon.backend.texels import texel_points

TOLERANCES = (0.1, 0.05, 0.02)
ORDER, TRUE_RAYS, POINTS = 3, 2048, 1000


def main() -> int:
    """Print a row a mesh and tolerance, and then the sums of each tolerance."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--tolerances", nargs="+", type=float, default=TOLERANCES)
    parser.add_argument("--looks", action="store_true", help="bake no texture")
    arguments = parser.parse_args()
    print("| mesh | tolerance | seen inside faces | target | error inside faces | vertices s | UVs and side s "
          "| texels s |\n|---|---|---|---|---|---|---|---|")
    found: dict[tuple[float, bool], list[float]] = {(t, to): [] for t in arguments.tolerances for to in (False, True)}
    for path in arguments.meshes or sorted((FOLDER / "validation").glob("*.ply")):
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
        for tolerance in arguments.tolerances:
            times = [time.process_time()]
            bake = methods.run(methods.bake(mesh, "auto", ORDER, tolerance=tolerance, threads=1))
            times.append(time.process_time())
            seen = bake.record.between_error
            values = np.einsum("nc,nck->nk", weights, bake.coefficients[mesh.triangles[faces]].astype(float))
            finer, target = bool(bake.record.between_missed), "vertices"
            if finer:
                target = "texture"
            if finer and not arguments.looks:
                trial = partial(fitting_side, surface, error=tolerance, method="auto", order=ORDER, threads=1)
                (placed,), side = methods.run(place([Part(surface, None, trial)]))
                times.append(time.process_time())
                result = methods.run(texture.bake(surface, "auto", ORDER, uv=placed.uv, side=side,
                                                  tolerance=tolerance, threads=1))
                times.append(time.process_time())
                values = lookups(result, np.einsum("nc,ncx->nx", weights, placed.uv[surface.corners[faces]]))
                target = f"texture {side}"
            off = [sh.padded(values, ORDER * ORDER) - truth for truth in exact]
            error = (max(float(np.vdot(*off)), 0.0) / float(np.vdot(*exact))) ** 0.5
            found[tolerance, finer].append(error / tolerance)
            spent = " | ".join(f"{spent:.2f}" for spent in np.diff(times))
            print(f"| {path.stem} | {tolerance:.0%} | {seen or 0:.1%} | {target} | {error:.1%} | {spent} |", flush=True)
    print("\n| tolerance | target | meshes | met | within 1.5 times | at worst |\n|---|---|---|---|---|---|")
    for (tolerance, to), parts in found.items():
        if parts:
            over = np.array(parts)
            print(f"| {tolerance:.0%} | {'texture' if to else 'vertices'} | {len(over)} | {(over <= 1).sum()} "
                  f"| {(over <= 1.5).sum()} | {over.max():.2f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
