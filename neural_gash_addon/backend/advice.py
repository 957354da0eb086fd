# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether the points of a bake are fine enough for its shadows, and how large a texture would be (advice of `auto`).

Where to bake to is the person's choice, so this changes nothing. Points inside faces, spread by area, are traced twice
with rays of their own, and compared with what their faces' corners say between them. The product of both differences is
the error without the noise of these rays. Where it misses the tolerance, the same is done with lookups as a texture has
them: four points of the surface, a texel apart. How the error falls from a coarse to a fine one says which is enough.
"""
from __future__ import annotations

from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from . import sampling
from . import spherical_harmonics as sh
from .estimator import BlockedEstimator
from .geometry import CORNER, TEXEL, Surface, TriangleMesh, unit
from .pilot import pilot_rays
from .raster import Coverage
from .raycast import Occluders
from .texels import texel_points

_POINTS = 96
_MOST_RAYS = 32       # of each trace of them,
_TRIAL_RAYS = 16      # and of each texel's: four of them are averaged
_SETS = 4
_OWN_NOISE = 1.25     # of the tolerance: what corners that just keep to it may differ by inside faces that hold no edge
_TRIALS = 128, 512    # texels a side of the textures that are tried
_LEAST_RATE, _MOST_RATE = 0.5, 2.0  # powers of the side by which an error falls: at a shadow's edge, where smooth
_FULL = 0.6           # of a texture that its charts cover, about
_DARK = 1e-3          # of the transfer in the open: less than this on the whole is not seen
_FACING = 0.5         # cosine from which on neighbours are of one chart
_SIDES = 64, 4096     # of a texture that is advised, powers of two

Traced = tuple[NDArray[np.float64], NDArray[np.float64]]


def domain(mesh: TriangleMesh) -> str:
    """One sentence: what has a value of its own, and why; '' for texels, which the person asked for."""
    if mesh.domain == TEXEL:
        return ""
    if mesh.domain == CORNER:
        return "Normals split at edges, so each side of an edge has its own value."
    return "Shading is smooth, so each vertex has one value."


def inside_faces(mesh: TriangleMesh, scene: Occluders, coefficients: NDArray[np.float32], order: int, tolerance: float,
                 seed: int, threads: int) -> Generator[float, None, str]:
    """One sentence: whether shadows inside faces follow their corners, or the texture that would have them.

    Args:
        coefficients: (N, K) of the points of the mesh. scene: what blocks, the mesh first.
    Yields:
        Progress.
    Returns:
        '' where the mesh does not say which points its faces lie between, or it is dark.
    """
    of_corner = mesh.corners if mesh.domain == CORNER else mesh.triangles
    places = mesh.positions[mesh.triangles]
    areas = np.linalg.norm(np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]), axis=1) / 2
    if mesh.domain == TEXEL or of_corner is None or not areas.sum() > 0:
        return ""
    of_corner = mesh.elements[of_corner]
    rng = np.random.default_rng([seed, 6])

    def traced(points: TriangleMesh, rays: int) -> Generator[float, None, Traced]:
        rows, found = np.arange(len(points.points)), []
        with ThreadPoolExecutor(threads, thread_name_prefix="neural_gash") as pool:
            for _ in range(2):
                twin = BlockedEstimator(points, scene, order, int(rng.integers(2**31)), rays, _SETS)
                sums = np.zeros((len(rows), order * order))
                yield from twin.trace(pool, threads, rows, 0, rays, sums)
                blocked = twin.turned_here(rows, twin.means(rows, sums, 0, rays))
                found.append(sh.cosine_lobe(points.normals, order) - blocked)
        return found[0], found[1]

    faces, u, v = sampling.on_triangles(np.cumsum(areas), rng.random((2, _POINTS)))
    weights = np.stack([1 - u - v, u, v], 1)
    some = _points(mesh, of_corner, faces, weights)
    one, two = yield from traced(some, min(pilot_rays(tolerance), _MOST_RAYS))
    energy = float((one * two).sum())
    if energy <= _DARK ** 2 * float(np.square(sh.cosine_lobe(some.normals, order)).sum()):
        return ""
    baked = np.einsum("nc,nck->nk", weights, coefficients[of_corner[faces]].astype(np.float64))
    error = _product(one - baked, two - baked, energy)
    if error <= _OWN_NOISE * tolerance:
        return f"Shadows inside faces follow their corners to {max(100 * error, 1):.0f} %: vertices are enough."
    errors = []
    for side in _TRIALS:
        spacing = float(areas.sum() / _FULL) ** 0.5 / side
        near, at, mix = around(mesh, scene, faces, weights, spacing, rng)
        first, second = yield from traced(_points(mesh, of_corner, near, at), _TRIAL_RAYS)
        seen = mix.any(1)[:, None]
        first, second = (np.einsum("nc,nck->nk", mix, found.reshape(*mix.shape, -1)) for found in (first, second))
        errors.append(max(_product(seen * (one - first), seen * (two - second), energy), 1e-3 * tolerance))
    rate = np.clip(np.log(errors[0] / errors[1]) / np.log(_TRIALS[1] / _TRIALS[0]), _LEAST_RATE, _MOST_RATE)
    nearest = int(abs(np.log(errors[1] / tolerance)) < abs(np.log(errors[0] / tolerance)))
    side = _TRIALS[nearest] * (errors[nearest] / tolerance) ** (1 / rate)
    side = 2 ** round(float(np.log2(np.clip(side, *_SIDES))))
    return f"Shadow edges inside faces are missed by their corners ({100 * error:.0f} %): a texture of about {side} " \
           "would have them."


def around(mesh: TriangleMesh, scene: Occluders, faces: NDArray, weights: NDArray, spacing: float,
           rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """What a texture whose texels are `spacing` apart would read at n points, wherever its texels fall.

    Args:
        faces, weights: (n,) and barycentrics (n, 3) of the points.
    Returns:
        Of each point's four texels, in a row: faces (4n,) of the mesh and barycentrics (4n, 3); their shares (n, 4).
        A texel that is beyond an edge, where another chart begins, has none.
    """
    count = len(faces)
    places = mesh.positions[mesh.triangles[faces]]                               # (n, 3, 3)
    flat = unit(np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]))
    frames = sampling.frames(flat, rng.uniform(0, 2 * np.pi, count))
    inside = rng.random((count, 1, 2))
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    steps = spacing * (corners - inside)                                         # (n, 4, 2)
    level = np.einsum("nc,ncx->nx", weights, places)[:, None] + np.einsum("nxa,nca->ncx", frames[..., :2], steps)
    over = scene.normalise((level + spacing * flat[:, None]).reshape(-1, 3))
    down = np.repeat(-flat, 4, axis=0).astype(np.float32)
    met, second, third, normals = scene.first(over, down)
    found = (met >= 0) & (met < len(mesh.triangles))
    met = np.where(found, met, 0)
    at = np.stack([1 - second - third, second, third], 1).astype(np.float64)
    at[~found] = 1 / 3
    there = np.einsum("rc,rcx->rx", at, mesh.positions[mesh.triangles[met]])
    found &= np.abs(np.einsum("rx,rx->r", there - level.reshape(-1, 3), down)) <= spacing
    found &= np.abs(np.einsum("rx,rx->r", unit(normals), down)) > _FACING
    shares = np.where(corners == 1, inside, 1 - inside).prod(2) * found.reshape(count, 4)
    return met, at, shares / np.maximum(shares.sum(1, keepdims=True), 1e-9)


def _points(mesh: TriangleMesh, of_corner: NDArray, faces: NDArray, weights: NDArray) -> TriangleMesh:
    """Points at barycentrics (n, 3) of faces (n,), as a texture has them; of_corner: (F, 3) points of the mesh."""
    count = len(faces)
    surface = Surface(mesh.positions, mesh.triangles[faces].ravel(),
                      mesh.normals[of_corner[faces].ravel()].astype(np.float32), np.repeat(np.arange(count), 3),
                      np.arange(3 * count, dtype=np.int32).reshape(-1, 3), mesh.resolution)
    return texel_points(surface, Coverage(1, np.arange(count), np.arange(count, dtype=np.int32), weights, weights))


def _product(one: NDArray, two: NDArray, energy: float) -> float:
    return (max(float((one * two).sum()), 0.0) / energy) ** 0.5
