# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether the points of a bake are fine enough for its shadows, or a texture is wanted (of `auto`).

Points inside faces, by area, are traced twice with rays of their own, and compared with what their faces' corners
say between them. The product of both differences is the error without the noise of these rays. How large a texture has
to be is measured on its own UV map (`resolution`).
"""
from __future__ import annotations

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import sampling
from . import spherical_harmonics as sh
from .geometry import CORNER, TEXEL, Surface, TriangleMesh
from .pilot import dark, pilot_rays, twice
from .raster import Coverage
from .raycast import Occluders
from .texels import texel_points
from .workers import workers

_POINTS = 96
_FACES = 8192         # some of them all, among which points are chosen by area
# Rays of each trace of them at most; or as many as a pilot has at _EASIER of the tolerance, so that edges stand out.
_MOST_RAYS, _EASIER = 64, 4.0
_SURE = 2.0           # standard errors of their noise that an edge is above
_OWN_NOISE = 1.25     # of the tolerance: what corners that just keep to it may differ by inside faces that hold no edge


class Inside(NamedTuple):
    """How far what the corners of faces say is from what is inside them."""

    error: float  # relative L2, without the noise of the rays that measured it, or as large as can be told from that
    missed: bool  # whether that is more than the tolerance allows, and more than noise explains


def domain(mesh: TriangleMesh) -> str:
    """One sentence: what has a value of its own, and why; '' for texels, which the person asked for."""
    if mesh.domain == TEXEL:
        return ""
    if mesh.domain == CORNER:
        return "Normals split at edges, so each side of an edge has its own value."
    return "Shading is smooth, so each vertex has one value."


def inside_faces(mesh: TriangleMesh, scene: Occluders, coefficients: NDArray, order: int, tolerance: float,
                 seed: int, threads: int) -> Generator[float, None, Inside | None]:
    """Look at points inside faces, by area: what rays see there, and what the faces' corners say.

    Args:
        coefficients: (N, K) of the points of the mesh. scene: what blocks, the mesh first.
    Yields:
        Progress.
    Returns:
        None where the mesh does not say which points its faces lie between, or it is dark.
    """
    if mesh.domain == TEXEL or (mesh.domain == CORNER and mesh.corners is None):
        return None
    rng, count = np.random.default_rng([seed, 6]), len(mesh.triangles)
    some = rng.integers(count, size=_FACES) if count > 2 * _FACES else np.arange(count)
    areas = _areas(mesh.positions, mesh.triangles[some])
    if not areas.sum() > 0:
        return None
    chosen, u, v = sampling.on_triangles(np.cumsum(areas), rng.random((2, _POINTS)))
    faces = some[chosen]
    weights = np.stack([1 - u - v, u, v], 1)
    seen = _points(mesh, faces, weights)
    rays = min(pilot_rays(tolerance), max(pilot_rays(_EASIER * tolerance), _MOST_RAYS))
    open_sky = sh.cosine_lobe(seen.normals, order)
    with workers(threads, 2 * len(faces) * rays) as pool:
        *blocked, _ = yield from twice(seen, scene, order, rays, seed, pool, threads)
    one, two = (open_sky - trace for trace in blocked)
    energy = float((one * two).sum())
    if dark(energy, open_sky):
        return None
    baked = np.einsum("nc,nck->nk", weights, coefficients[_of_corner(mesh, faces)].astype(np.float64))
    squared, most = float(((one - baked) * (two - baked)).sum()) / energy, (_OWN_NOISE * tolerance) ** 2
    # The variance of (b + m) * (b + n), where noise m and n have a covariance C, is tr CC + 2 b C b. As if all of a
    # point's coefficients erred as one, which is the most: (tr C)^2 + 2 b^2 tr C. |m - n|^2 is 2 tr C, its square 12
    # of (tr C)^2; and b^2 is what is asked about, `most`.
    noise = np.square(one - two).sum(1) / energy
    unsure = (float(np.square(noise).sum()) / 12 + most * float(noise.mean())) ** 0.5
    return Inside(max(squared, unsure) ** 0.5, squared > most + _SURE * unsure)


def said(error: float, missed: bool, side: int = 0) -> str:
    """One sentence of it; side: of the texture that was baked for it."""
    if not missed:
        return f"Shadows inside faces follow their corners to {_percent(error)}: vertices are enough."
    texture = f"a texture of {side} has them." if side else "a texture would have them."
    return f"Shadow edges inside faces are missed by their corners ({_percent(error)}): {texture}"


def _percent(error: float) -> str:
    return f"{100 * error:.0f} %" if error > 0.1 else f"{max(100 * error, 0.01):.2g} %"


def _of_corner(mesh: TriangleMesh, faces: NDArray) -> NDArray[np.int32]:
    """(n, 3) points that faces (n,) lie between."""
    of_corner = mesh.triangles if mesh.corners is None else mesh.corners
    return mesh.elements[of_corner[faces]]


def _areas(positions: NDArray, triangles: NDArray) -> NDArray[np.float64]:
    one, two, three = triangles.T
    # axis by axis: NumPy is slow along short last ones
    (ax, bx), (ay, by), (az, bz) = ((axis[two] - axis[one], axis[three] - axis[one]) for axis in positions.T)
    return np.sqrt((ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2) / 2


def _points(mesh: TriangleMesh, faces: NDArray, weights: NDArray) -> TriangleMesh:
    """Points at barycentrics (n, 3) of faces (n,), as a texture has them."""
    count = len(faces)
    surface = Surface(mesh.positions, mesh.triangles[faces].ravel(),
                      mesh.normals[_of_corner(mesh, faces).ravel()].astype(np.float32), np.repeat(np.arange(count), 3),
                      np.arange(3 * count, dtype=np.int32).reshape(-1, 3), mesh.resolution)
    return texel_points(surface, Coverage(1, np.arange(count), np.arange(count, dtype=np.int32), weights, weights))
