# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether anything rises above any point's horizon: where nothing does, unshadowed transfer is exact, without a ray.

A closed convex mesh is known by its edges, in a time that grows as its triangles do, and flat ones by their few planes.
What is neither is looked at point by point.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .estimator import morton_order
from .geometry import CORNER, POINT, TEXEL, TriangleMesh
from .raycast import Geometry, used
from .workers import product

_LEAF = 64              # vertices of a ball that are compared with a plane at a time
# Pairs of points and balls, 50 to 100 ms: what takes longer is not looked at, but traced. Tiles of a texture have so
# many points that a bake of them takes longer anyway.
_MOST_PAIRS, _MOST_OF_TEXELS = 1e6, 5e8
_LEVEL = 1e-6           # of the extent: heights over a plane that are rounding
_FEW = 64               # normals that are compared with every vertex
_SAME = 1e-7            # components of normals that do not differ by more are the same
_AT_ONCE = 1 << 16      # points that are compared with their neighbours

Floats = NDArray[np.float64]


def nothing_blocks(mesh: TriangleMesh, occluders: Sequence[Geometry]) -> bool:
    """Whether no triangle rises above the tangent plane of any point, so that every hemisphere is free.

    False also where it would take long to say.
    """
    parts = [(np.asarray(p, np.float64), t) for p, t in ((mesh.positions, mesh.triangles), *occluders) if len(t)]
    lit = mesh.lit()
    few = np.concatenate([p[t[::len(t) // 4096 + 1, 0]] for p, t in parts])
    level = _LEVEL * max(float(axis.max() - axis.min()) for axis in np.concatenate([p for p, _ in parts]).T)

    def handful(count: int) -> bool:
        chosen = lit[::len(lit) // count + 1]
        facing = mesh.normals[chosen]
        height = (facing * mesh.points[chosen]).sum(1) + level
        return bool((product(facing, few.T).max(1, initial=-np.inf) <= height).all())

    if not handful(32):  # almost every mesh is found out by these
        return False
    if not len(lit):
        return True
    vertices = np.concatenate([p[used(p, t)] for p, t in parts])
    level = _LEVEL * max(float(np.ptp(axis)) for axis in vertices.T)
    whole = mesh.domain == POINT or (mesh.domain == CORNER and mesh.corners is not None)
    if whole and len(parts) == 1 and convex(*parts[0], 2 * mesh.resolution):
        return handful(256) and _supported(mesh, level)  # what is bent the wrong way by less than rounding adds up
    normals = mesh.normals[lit]
    height = (normals * mesh.points[lit]).sum(1) + level
    flat = _of_few(normals, height, vertices)
    if flat is not None:
        return flat
    return _none_above(normals, height, vertices, _MOST_OF_TEXELS if mesh.domain == TEXEL else _MOST_PAIRS)


def convex(positions: NDArray, triangles: NDArray, rounding: float) -> bool:
    """Whether triangles (F, 3) are the whole boundary of a convex body, faces outwards.

    Mehlhorn et al. 1996, "Checking geometric programs or verification of geometric structures": at each edge two
    triangles meet, the far corner of one not above the other (by more than `rounding`); a point within is below all;
    and a ray from there meets one of them alone.
    """
    places, faces = np.asarray(positions, np.float64), len(triangles)
    corners = places[triangles]
    double = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if faces < 4 or not double.any(1).all():
        return False
    start, stop = triangles.T.ravel().astype(np.int64), np.roll(triangles, -1, 1).T.ravel().astype(np.int64)
    way = start < stop
    key = np.where(way, start * len(places) + stop, stop * len(places) + start)
    order = np.argsort(key, kind="stable")
    one, other = order[::2], order[1::2]
    if len(order) % 2 or (key[one] != key[other]).any() or (way[one] == way[other]).any() or (
            key[one][1:] == key[one][:-1]).any():
        return False
    far = corners[other % faces, (other // faces + 2) % 3] - corners[one % faces, 0]
    facing = double[one % faces]
    if (np.einsum("ex,ex->e", facing, far) > rounding * np.sqrt(np.einsum("ex,ex->e", facing, facing))).any():
        return False
    middle = corners.mean((0, 1))
    below = np.einsum("fx,fx->f", double, corners[:, 0] - middle)
    if not (below > 0).all():
        return False
    # which triangles a ray through the first meets: those of whose three planes through the middle it is within
    ray = corners[0].mean(0) - middle
    ahead = corners - middle
    side = [np.einsum("fx,x->f", np.cross(ahead[:, k], ahead[:, k - 2]), ray) for k in range(3)]
    return int(np.all([each > 0 for each in side], axis=0).sum()) == 1


def _supported(mesh: TriangleMesh, level: float) -> bool:
    """Whether a closed convex mesh lies below the tangent plane of every point.

    It does where the vertices beside each point do: a linear function on a convex body is greatest wherever no
    neighbour has more.
    """
    triangles, count = mesh.triangles.astype(np.int64), len(mesh.points)
    vertex, neighbour = triangles.T.ravel(), np.roll(triangles, -1, 1).T.ravel()  # each edge once from each end
    order = np.argsort(vertex, kind="stable")
    first = np.searchsorted(vertex[order], np.arange(len(mesh.positions) + 1))
    corners = mesh.triangles if mesh.corners is None else mesh.elements[mesh.corners]
    owners, points = np.divmod(np.unique(vertex * count + corners.T.ravel()), count)
    for start in range(0, len(owners), _AT_ONCE):
        owner, point = owners[start:start + _AT_ONCE], points[start:start + _AT_ONCE]
        many = first[owner + 1] - first[owner]
        row = np.repeat(np.arange(len(owner)), many)
        edge = order[np.arange(len(row)) + np.repeat(first[owner] - np.cumsum(many) + many, many)]
        way = mesh.positions[neighbour[edge]] - mesh.positions[owner[row]]
        if (np.einsum("px,px->p", way, mesh.normals[point[row]]) > level).any():
            return False
    return True


def _of_few(normals: Floats, height: Floats, vertices: Floats) -> bool | None:
    """Whether no vertex (V, 3) is above any of n planes of which few differ in their normals (n, 3); else None."""
    left = np.arange(len(normals))
    for number in range(_FEW):
        same = (np.abs(normals[left] - normals[left[0]]) < _SAME).all(1)
        if product(vertices, normals[left[:1]].T).max() > height[left[same]].min():
            return False
        left = left[~same]
        if not len(left):
            return True
        if (len(normals) - len(left)) * _FEW < (number + 1) * len(normals):
            return None
    return None


def _none_above(normals: Floats, height: Floats, vertices: Floats, most: float) -> bool:
    """Whether no vertex (V, 3) is above a plane with normal (n, 3) and height (n,). False above `most` pairs."""
    vertices = vertices[morton_order(vertices)]
    balls = -(-len(vertices) // _LEAF)
    if len(normals) * balls > most:
        return False
    vertices = np.concatenate([vertices, np.repeat(vertices[-1:], balls * _LEAF - len(vertices), 0)])
    leaves = vertices.reshape(balls, _LEAF, 3)
    centres = leaves.mean(1)
    radii = np.linalg.norm(leaves - centres[:, None], axis=2).max(1)
    step = max(1, (1 << 20) // balls)
    for start in range(0, len(normals), step):
        here = slice(start, start + step)
        one, ball = np.nonzero(product(normals[here], centres.T) + radii > height[here][:, None])
        for first in range(0, len(one), 1 << 14):
            part = slice(first, first + (1 << 14))
            reach = np.einsum("pvx,px->pv", leaves[ball[part]], normals[here][one[part]]).max(1)
            if (reach > height[here][one[part]]).any():
                return False
    return True
