# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes to measure on: real ones where the folder is there, procedural ones where not."""
from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neural_gash_addon.backend.geometry import TriangleMesh

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "meshes"
# label -> (file, subdivisions), and the size of the procedural stand-in
_MESHES = {"8K": ("train/raptor.ply", 0, 8_800), "35K": ("train/skull_atlas.ply", 0, 36_000),
           "250K": ("train/inner_ear.ply", 2, 250_000)}


def read(path: Path) -> TriangleMesh:
    """A mesh file, shaded smooth."""
    import trimesh

    found = trimesh.load(path, process=False, force="mesh")
    return TriangleMesh.from_triangles(np.asarray(found.vertices), np.asarray(found.faces))


def load(label: str) -> tuple[str, TriangleMesh]:
    """Name and mesh of about `label` vertices: '8K', '35K' or '250K'."""
    file, subdivisions, size = _MESHES[label]
    path = FOLDER / file
    if not path.is_file():
        positions, triangles = knot(size)
        return f"knot {len(positions)}", TriangleMesh.from_triangles(positions, triangles)
    import trimesh

    read = trimesh.load(path, process=False)
    positions, triangles = np.asarray(read.vertices), np.asarray(read.faces)
    for _ in range(subdivisions):
        positions, triangles = trimesh.remesh.subdivide(positions, triangles)
    return f"{path.stem} {len(positions)}", TriangleMesh.from_triangles(positions, triangles)


def knot(count: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """A rippled tube along the (2, 3) torus knot with about `count` vertices: it shadows itself."""
    around = max(8, round((count / 12) ** 0.5))
    along = max(16, count // around)
    t = np.linspace(0, 2 * np.pi, along, endpoint=False)
    ring_radius = 2 + np.cos(3 * t)
    spine = np.stack([ring_radius * np.cos(2 * t), ring_radius * np.sin(2 * t), np.sin(3 * t)], 1)
    tangent = np.roll(spine, -1, 0) - np.roll(spine, 1, 0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    a = np.linspace(0, 2 * np.pi, around, endpoint=False)
    radius = 0.5 + 0.06 * np.sin(40 * t)[:, None] * np.sin(8 * a)[None]
    ring = np.cos(a)[None, :, None] * side[:, None] + np.sin(a)[None, :, None] * up[:, None]
    positions = (spine[:, None] + radius[..., None] * ring).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(along), np.arange(around), indexing="ij")
    following, beside = (i + 1) % along, (j + 1) % around
    p00, p01 = i * around + j, i * around + beside
    p10, p11 = following * around + j, following * around + beside
    triangles = np.concatenate([np.stack([p00, p11, p01], -1), np.stack([p00, p10, p11], -1)]).reshape(-1, 3)
    return positions, triangles.astype(np.int32)


def named(name: str) -> TriangleMesh:
    """The stem of a file of ../shared/meshes/validation, or 'knot' and a number of vertices."""
    if name.startswith("knot "):
        return TriangleMesh.from_triangles(*knot(int(name.split()[1])))
    return read(FOLDER / "validation" / f"{name}.ply")
