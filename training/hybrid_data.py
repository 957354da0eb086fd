# SPDX-License-Identifier: GPL-3.0-or-later
"""What the hybrid's network learns from: blocked parts traced with few rays, and the same with many.

One .npz a mesh in a cache that git ignores; a mesh that is there already is skipped, so that the
making of the data can be stopped and goes on.
"""
from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh
from tqdm import tqdm

from neural_gash_addon.backend import methods
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.exchange import atomic
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.neighbours import neighbours
from neural_gash_addon.backend.raycast import Occluders

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


def make_all(folder: Path, cache: Path = CACHE) -> Iterator[Path]:
    """The files of all meshes of a folder."""
    for path in tqdm(sorted(folder.glob("*.ply")), desc="tracing", unit="mesh"):
        yield make(path.stem, load(path), cache)


if __name__ == "__main__":
    shared = Path(__file__).resolve().parents[2] / "shared" / "meshes"
    list(make_all(shared / "train"))
