# SPDX-License-Identifier: GPL-3.0-or-later
"""Labels of a mesh by the project's own Embree baker: transfer and visibility at its points.

What is labelled is what the add-on would bake: the vertices, or, where creases split the shading, each
distinct (vertex, normal). Meshes are moved and scaled first so that their bounding box is centred on the
origin and its longest side is 1; transfer and visibility do not change by that.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from neural_gash_addon.backend import conformal, methods
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.geometry import POINT, TriangleMesh, unit
from neural_gash_addon.backend.raycast import Occluders

ORDER = 5        # bands, 25 coefficients: the paper's networks take the first 9
VERSION = 3      # raised whenever the same mesh gets other labels or another layout of file

Frames = Callable[[NDArray], NDArray]  # unit normals (N, 3) -> rotations (N, 3, 3) that carry e_y to the normal


@dataclass(frozen=True, eq=False)
class Sample:
    """A labelled mesh, as its file has it."""

    name: str
    category: str
    positions: NDArray[np.float32]     # (N, 3) points, normalised
    normals: NDArray[np.float32]       # (N, 3) unit; zero where there is none
    triangles: NDArray[np.int32]       # (F, 3) of points; where creases split vertices they do not share them
    coefficients: NDArray[np.float32]  # (N, 25) transfer with shadows
    visibility: NDArray[np.bool_]      # (N, 25) whether the ray along each direction is free
    directions: NDArray[np.float32]    # (25, 3) in the frame of each point
    record: str                        # JSON of the bake, with its error estimate

    @property
    def unshadowed(self) -> NDArray[np.float64]:
        """(N, 25) transfer without shadows, exact, from the normals."""
        return sh.cosine_lobe(self.normals, ORDER)


def motor_frames(normals: NDArray) -> NDArray[np.float64]:
    """Rotations (N, 3, 3) of the motors at normals (N, 3): they carry e_y to the normal (Neural-GASh, equation 4)."""
    return conformal.frames(conformal.motor(np.zeros_like(normals), normals))


def normalised(positions: NDArray) -> NDArray[np.float64]:
    """Positions (V, 3), box centred on the origin, longest side 1, rounded to the float32 that files keep.

    Raises:
        UserError: coordinates are not finite, or all in one place.
    """
    p = np.asarray(positions, dtype=np.float64)
    low, high = p.min(0), p.max(0)
    side = float((high - low).max())
    if not np.isfinite(side) or side <= 0:
        raise UserError("The mesh has no size, or coordinates that are not finite.")
    return ((p - (low + high) / 2) / side).astype(np.float32).astype(np.float64)


def shaded(positions: NDArray, triangles: NDArray, crease: float | None) -> TriangleMesh:
    """A mesh shaded smooth, or with creases at edges between faces that turn by more than `crease` radians.

    As Blender's "Shade Auto Smooth": a corner's normal is the mean, weighted by angle, of the faces that
    reach it around its vertex without a crease.
    """
    if crease is None:
        return TriangleMesh.from_triangles(positions, triangles)
    p = np.asarray(positions, dtype=np.float64)
    t = np.asarray(triangles, dtype=np.int64)
    corners = p[t]
    face_normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    # pairs of faces that meet in an edge; at an edge of three or more, neighbours in the list only
    sides = np.stack([t, np.roll(t, -1, 1)], -1).reshape(-1, 2)  # side s runs from corner s to corner s + 1
    key = np.sort(sides, 1) @ [len(p), 1]
    order = np.argsort(key, kind="stable")
    first, second = (order[:-1], order[1:])
    meet = key[first] == key[second]
    first, second = first[meet], second[meet]
    soft = (face_normals[first // 3] * face_normals[second // 3]).sum(1) > np.cos(crease)
    first, second = first[soft], second[soft]
    # of the two sides, the corners at the same vertex are one corner of the shading
    following = np.arange(3 * len(t)).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    opposed = sides[first, 0] == sides[second, 1]
    ends = [(first, np.where(opposed, following[second], second)),
            (following[first], np.where(opposed, second, following[second]))]
    links = np.concatenate([np.stack(pair) for pair in ends], 1)
    graph = coo_matrix((np.ones(links.shape[1]), (links[0], links[1])), shape=(3 * len(t),) * 2)
    count, fan = connected_components(graph, directed=False)
    along = unit(np.roll(corners, -1, 1) - corners)
    angles = np.arccos(np.clip(-(along * np.roll(along, 1, 1)).sum(-1), -1, 1)).ravel()
    weighted = np.repeat(face_normals, 3, axis=0) * angles[:, None]
    normals = unit(np.stack([np.bincount(fan, weighted[:, axis], count) for axis in range(3)], 1))[fan]
    return TriangleMesh.from_corners(p, t, t.ravel(), normals, np.repeat(np.arange(len(t)), 3),
                                     corners=np.arange(t.size, dtype=np.int32).reshape(-1, 3))


def label(positions: NDArray, triangles: NDArray, crease: float | None, *, name: str, category: str, rays: int,
          seed: int, frames: Frames = motor_frames) -> Sample:
    """Bake and look about, on one thread.

    Args:
        positions: (V, 3). triangles: (F, 3). crease: see `shaded`.
        rays: for each point's transfer. seed: of those rays.
        frames: what each point's 25 directions are laid out in.
    Raises:
        UserError: nothing to bake.
    """
    mesh = shaded(normalised(positions), triangles, crease)
    scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    transfer = methods.run(methods.bake(mesh, "embree", ORDER, rays=rays, seed=seed, threads=1, scene=scene))
    directions = conformal.hemisphere_directions()
    of_points = mesh.triangles if mesh.domain == POINT else mesh.elements.reshape(-1, 3)
    return Sample(name, category, mesh.points.astype(np.float32), mesh.normals.astype(np.float32),
                  of_points.astype(np.int32), transfer.coefficients, visible(mesh, scene, directions, frames),
                  directions.astype(np.float32), transfer.record.to_json())


def visible(mesh: TriangleMesh, scene: Occluders, directions: NDArray, frames: Frames) -> NDArray[np.bool_]:
    """Whether the rays from each point along directions (D, 3) of its own frame are free: (N, D).

    A point without a normal sees nothing, as its transfer is zero.
    """
    lit = np.any(mesh.normals != 0, axis=1)
    world = np.einsum("nij,dj->ndi", frames(mesh.normals[lit]), directions).astype(np.float32)
    origins = np.repeat(scene.origins(mesh.points[lit], mesh.clearance[lit]), len(directions), axis=0)
    out = np.zeros((len(mesh.points), len(directions)), dtype=bool)
    out[lit] = scene.blocked(origins, np.ascontiguousarray(world.reshape(-1, 3))).reshape(-1, len(directions)) != 0
    return out


ARRAYS = ("positions", "normals", "triangles", "coefficients", "visibility", "directions")
TEXTS = ("name", "category", "record")


def load(path: Path) -> Sample:
    """A file that `data` wrote. Raises what NumPy and zipfile raise where it is none."""
    with np.load(path, allow_pickle=False) as found:
        return Sample(**{key: found[key] if key in ARRAYS else str(found[key]) for key in (*ARRAYS, *TEXTS)})
