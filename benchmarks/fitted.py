# SPDX-License-Identifier: GPL-3.0-or-later
"""Do textures of the size that an error asks for have that error? `python benchmarks/fitted.py [mesh.ply ...]`.

For each mesh and tolerance: the side that `resolution.fitting_side` gives, and the error of bilinear lookups in a
texture of that side, over the surface by area. Two textures and two traces of the points themselves, with seeds of
their own, so that what the rays get wrong cancels in the product of the two differences.
"""
from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes import FOLDER, read
from textures import surface_of

from neural_gash_addon.backend import methods, texture
from neural_gash_addon.backend.raster import Coverage
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.backend.resolution import MAX_FIT, fitting_side
from neural_gash_addon.backend.texels import texel_points
from neural_gash_addon.backend.unwrap import unwrap

NAMES = ("airplane_vtk", "armadillo", "asian_dragon_coarse", "holey_block", "pipe_joint", "feature_plate")
TOLERANCES = (0.05, 0.02)
ORDER, TEXEL_RAYS, TRUE_RAYS, POINTS = 3, 128, 4096, 2000


def lookups(result: texture.TextureTransfer, places: np.ndarray) -> np.ndarray:
    """Coefficients (n, K) that a shader would get at uv (n, 2)."""
    side, filled = result.record.side, result.fill_map()
    x = places * side - 0.5
    low = np.floor(x).astype(int)
    along = (x - low)[..., None]
    columns, rows = (np.clip(np.stack([low[:, axis], low[:, axis] + 1]), 0, side - 1) for axis in (0, 1))
    found = []
    for number in range(texture.image_count(result.record.terms)):
        image = result.image(number, filled).reshape(side, side, 4)
        near, far = (image[row, columns[0]] * (1 - along[:, 0]) + image[row, columns[1]] * along[:, 0] for row in rows)
        found.append(near * (1 - along[:, 1]) + far * along[:, 1])
    return np.concatenate(found, 1)[:, :result.record.order ** 2]


def main() -> int:
    """Print a row a mesh and tolerance; exit code 1 where an error is 1.5 times what was asked for, or more."""
    paths = [Path(name) for name in sys.argv[1:]] or [FOLDER / "train" / f"{name}.ply" for name in NAMES]
    print("| mesh | tolerance | side | error | to find the side |\n|---|---|---|---|---|")
    wrong = 0
    for path in paths:
        mesh = surface_of(read(path))
        uv = methods.run(unwrap(mesh, side=1024)).uv
        rng = np.random.default_rng(7)
        area = np.linalg.norm(np.cross(*(mesh.positions[mesh.triangles[:, i]] - mesh.positions[mesh.triangles[:, 0]]
                                         for i in (1, 2))), axis=1)
        faces = rng.choice(len(area), POINTS, p=area / area.sum()).astype(np.int32)
        weights = rng.dirichlet([1, 1, 1], POINTS)
        points = texel_points(mesh, Coverage(1, np.arange(POINTS), faces, weights, weights))
        scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
        exact = [methods.run(methods.bake(points, "embree", ORDER, rays=TRUE_RAYS, seed=seed, scene=scene)).coefficients
                 for seed in (3, 4)]
        for tolerance in TOLERANCES:
            began = time.perf_counter()
            side = methods.run(fitting_side(mesh, uv, error=tolerance, order=ORDER))
            spent = time.perf_counter() - began
            differences = []
            for seed, truth in enumerate(exact):
                result = methods.run(texture.bake(mesh, "embree", ORDER, uv=uv, side=side, rays=TEXEL_RAYS, seed=seed))
                differences.append(lookups(result, np.einsum("nc,ncx->nx", weights, uv[mesh.corners[faces]])) - truth)
            error = max(np.vdot(*differences) / np.vdot(*exact), 0.0) ** 0.5
            wrong += error > 1.5 * tolerance and side < MAX_FIT
            print(f"| {path.stem} | {tolerance:.0%} | {side} | {error:.1%} | {spent:.1f} s |", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
