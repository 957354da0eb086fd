# SPDX-License-Identifier: GPL-3.0-or-later
"""What the hybrid's network learns from: blocked parts traced with few rays, and the same with many.

One .npz a mesh in a cache that git ignores; a mesh that is there already is skipped, so that the
making of the data can be stopped and goes on.
"""
from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
import trimesh
from tqdm import tqdm, trange

from neural_gash_addon.backend import methods
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.exchange import atomic
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.neighbours import neighbours
from neural_gash_addon.backend.raycast import Occluders

from . import labels, meshes

ORDER = 5
RAYS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 64, 128, 256)
REFERENCE_RAYS = 1024
CACHE = Path(__file__).parent / "cache" / "hybrid"
MEASURES = {"order": ORDER, "rays": RAYS, "reference": REFERENCE_RAYS, "version": 1}


def load(path: Path) -> TriangleMesh:
    """A mesh file, shaded smooth, as the bake sees it."""
    found = trimesh.load(path, process=False, force="mesh")
    return TriangleMesh.from_triangles(np.asarray(found.vertices), np.asarray(found.faces))


def make(name: str, mesh: TriangleMesh, cache: Path = CACHE) -> Path:
    """The file of one mesh, made where it is not there."""
    key = hashlib.blake2b(json.dumps(MEASURES).encode(), digest_size=4).hexdigest()
    path = cache / f"{name}-{key}.npz"
    if path.exists():
        return path
    cache.mkdir(parents=True, exist_ok=True)
    scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    unshadowed = sh.cosine_lobe(mesh.normals, ORDER)

    def blocked(rays: int, seed: int) -> np.ndarray:
        baking = methods.bake(mesh, "embree", ORDER, rays=rays, seed=seed, scene=scene)
        return (unshadowed - methods.run(baking).coefficients).astype(np.float32)

    links = neighbours(mesh)
    arrays = {f"rays_{rays}": blocked(rays, rays) for rays in RAYS}
    with atomic(path) as draft, draft.open("wb") as file:
        np.savez(file, points=mesh.points.astype(np.float32), normals=mesh.normals.astype(np.float32),
                 start=links.start, links=links.points, reference=blocked(REFERENCE_RAYS, 1), **arrays)
    return path


def main() -> None:
    """`python -m training.hybrid_data`: the files of all meshes of a folder, and of some that are generated."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--folder", type=Path, default=Path(__file__).resolve().parents[2] / "shared/meshes/train")
    parser.add_argument("--count", type=int, default=100, help="of generated meshes")
    parser.add_argument("--seed", type=int, default=1, help="of the first of those")
    arguments = parser.parse_args()
    for path in tqdm(sorted(arguments.folder.glob("*.ply")), desc="tracing the folder", unit="mesh"):
        make(path.stem, load(path))
    for seed in trange(arguments.seed, arguments.seed + arguments.count, desc="tracing generated", unit="mesh"):
        found = meshes.generate(seed)
        make(f"{found.category}-{seed:06d}", labels.shaded(found.positions, found.triangles, found.crease))


if __name__ == "__main__":
    main()
