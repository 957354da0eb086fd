# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether the points of a bake are fine enough for its shadows, and how large a texture would have to be (of `auto`).

Points inside faces, by area, are traced twice with rays of their own, and compared with what their faces' corners
say between them. The product of both differences is the error without the noise of these rays. For the size of a
texture, the same is done with lookups as a texture has them: four points of the surface, a texel apart. How the error
falls from a coarse to a fine one says which is enough.
"""
from __future__ import annotations

from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import sampling
from . import spherical_harmonics as sh
from .geometry import CORNER, TEXEL, Surface, TriangleMesh, unit
from .pilot import pilot_rays, twice
from .raster import Coverage
from .raycast import Occluders
from .texels import texel_points

_POINTS = 96
_MOST_RAYS = 32       # of each trace of them,
_TRIAL_RAYS = 16      # and of each texel's: four of them are averaged
_OWN_NOISE = 1.25     # of the tolerance: what corners that just keep to it may differ by inside faces that hold no edge
_CORNER_RAYS = 16     # of each corner's, of which three are averaged
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


class Inside(NamedTuple):
    """What n points inside faces say."""

    error: float      # of what corners say between them, relative L2, without the noise of these rays
    noise: float      # of the tolerance: what the corners' own may add to that
    energy: float     # squares of transfer, summed
    faces: NDArray[np.int64]     # (n,) in which they lie, and
    weights: NDArray[np.float64]  # (n, 3) where
    traced: Traced    # (n, K) transfer, twice


def inside_faces(mesh: TriangleMesh, scene: Occluders, coefficients: NDArray | None, order: int, tolerance: float,
                 seed: int, threads: int) -> Generator[float, None, Inside | None]:
    """Look whether shadows inside faces follow their corners.

    Args:
        coefficients: (N, K) of the points of the mesh; None: not known yet, so corners are traced as well.
        scene: what blocks, the mesh first.
    Yields:
        Progress.
    Returns:
        None where the mesh does not say which points its faces lie between, or it is dark.
    """
    areas = _areas(mesh)
    if mesh.domain == TEXEL or (mesh.domain == CORNER and mesh.corners is None) or not areas.sum() > 0:
        return None
    rng = np.random.default_rng([seed, 6])
    faces, u, v = sampling.on_triangles(np.cumsum(areas), rng.random((2, _POINTS)))
    weights = np.stack([1 - u - v, u, v], 1)
    some = _points(mesh, faces, weights)
    one, two = yield from _traced(some, scene, order, min(pilot_rays(tolerance), _MOST_RAYS), rng, threads)
    energy = float((one * two).sum())
    if energy <= _DARK ** 2 * float(np.square(sh.cosine_lobe(some.normals, order)).sum()):
        return None
    between = _of_corner(mesh, faces)
    if coefficients is None:
        used, between = np.unique(between, return_inverse=True)
        few = replace(mesh, points=mesh.points[used], normals=mesh.normals[used], clearance=mesh.clearance[used])
        corners = yield from _traced(few, scene, order, _CORNER_RAYS, rng, threads)
        between, noise = between.reshape(len(faces), 3), 1.0
    else:
        corners, noise = (coefficients, coefficients), _OWN_NOISE
    off = [true - np.einsum("nc,nck->nk", weights, at[between].astype(np.float64))
           for true, at in zip((one, two), corners, strict=True)]
    return Inside(_product(off[0], off[1], energy), noise, energy, faces, weights, (one, two))


def missed(inside: Inside, tolerance: float) -> bool:
    """Whether shadows inside faces are missed by their corners."""
    return inside.error > inside.noise * tolerance


def said(inside: Inside, tolerance: float, texture: str = "a texture would have them") -> str:
    """One sentence of it; texture: what of one, where corners miss."""
    if missed(inside, tolerance):
        return f"Shadow edges inside faces are missed by their corners ({100 * inside.error:.0f} %): {texture}."
    return f"Shadows inside faces follow their corners to {max(100 * inside.error, 1):.0f} %: vertices are enough."


def side(mesh: TriangleMesh, scene: Occluders, inside: Inside, order: int, tolerance: float, seed: int, threads: int
         ) -> Generator[float, None, int]:
    """The side of the texture, a power of two, that would have the shadows inside faces. Yields progress."""
    area, rng, errors = float(_areas(mesh).sum()), np.random.default_rng([seed, 7]), []
    for tried in _TRIALS:
        spacing = (area / _FULL) ** 0.5 / tried
        near, at, mix = around(mesh, scene, inside.faces, inside.weights, spacing, rng)
        read = yield from _traced(_points(mesh, near, at), scene, order, _TRIAL_RAYS, rng, threads)
        seen = mix.any(1)[:, None]
        off = [seen * (true - np.einsum("nc,nck->nk", mix, texels.reshape(*mix.shape, -1)))
               for true, texels in zip(inside.traced, read, strict=True)]
        errors.append(max(_product(off[0], off[1], inside.energy), 1e-3 * tolerance))
    rate = np.clip(np.log(errors[0] / errors[1]) / np.log(_TRIALS[1] / _TRIALS[0]), _LEAST_RATE, _MOST_RATE)
    nearest = int(abs(np.log(errors[1] / tolerance)) < abs(np.log(errors[0] / tolerance)))
    found = _TRIALS[nearest] * (errors[nearest] / tolerance) ** (1 / rate)
    return int(2 ** round(float(np.log2(np.clip(found, *_SIDES)))))


def _of_corner(mesh: TriangleMesh, faces: NDArray) -> NDArray[np.int32]:
    """(n, 3) points that faces (n,) lie between."""
    of_corner = mesh.triangles if mesh.corners is None else mesh.corners
    return mesh.elements[of_corner[faces]]


def _areas(mesh: TriangleMesh) -> NDArray[np.float64]:
    one, two, three = mesh.triangles.T
    # axis by axis: NumPy is slow along short last ones
    (ax, bx), (ay, by), (az, bz) = ((axis[two] - axis[one], axis[three] - axis[one])
                                    for axis in np.ascontiguousarray(mesh.positions.T))
    return np.sqrt((ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2) / 2


def _traced(points: TriangleMesh, scene: Occluders, order: int, rays: int, rng: np.random.Generator, threads: int
            ) -> Generator[float, None, Traced]:
    """Transfer of points, twice, with rays of their own. Yields progress."""
    with ThreadPoolExecutor(threads, thread_name_prefix="neural_gash") as pool:
        blocked = yield from twice(points, scene, order, rays, int(rng.integers(2**31)), pool, threads)
    unshadowed = sh.cosine_lobe(points.normals, order)
    return unshadowed - blocked[0], unshadowed - blocked[1]


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


def _points(mesh: TriangleMesh, faces: NDArray, weights: NDArray) -> TriangleMesh:
    """Points at barycentrics (n, 3) of faces (n,), as a texture has them."""
    count = len(faces)
    surface = Surface(mesh.positions, mesh.triangles[faces].ravel(),
                      mesh.normals[_of_corner(mesh, faces).ravel()].astype(np.float32), np.repeat(np.arange(count), 3),
                      np.arange(3 * count, dtype=np.int32).reshape(-1, 3), mesh.resolution)
    return texel_points(surface, Coverage(1, np.arange(count), np.arange(count, dtype=np.int32), weights, weights))


def _product(one: NDArray, two: NDArray, energy: float) -> float:
    return (max(float((one * two).sum()), 0.0) / energy) ** 0.5
