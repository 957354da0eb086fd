# SPDX-License-Identifier: GPL-3.0-or-later
"""Building blocks of the generated meshes: boxes, turned and swept shapes, and what is done to any mesh.

A mesh here is a pair (positions (V, 3) float64, triangles (F, 3) int32). Closed ones come with their
triangles counter-clockwise seen from outside. Lengths have no unit; meshes are normalised when labelled.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]
ALIKE = 1e-7   # corners closer than this, relative to the size of the mesh, are one vertex
_ROUNDS = 16   # halvings of an edge: far more than any target needs, and an end to the loop


def merge(parts: Sequence[Mesh]) -> Mesh:
    """One mesh of several, side by side; nothing is joined."""
    firsts = np.cumsum([0, *(len(p) for p, _ in parts)])
    return (np.concatenate([p for p, _ in parts]),
            np.concatenate([t + first for (_, t), first in zip(parts, firsts, strict=False)]).astype(np.int32))


def place(mesh: Mesh, offset: Sequence[float] | NDArray = (0, 0, 0), turn: Rotation | None = None,
          scale: float | Sequence[float] | NDArray = 1.0) -> Mesh:
    """Scaled (not mirrored), then turned, then moved."""
    p = mesh[0] * np.asarray(scale, dtype=np.float64)
    return (p if turn is None else turn.apply(p)) + np.asarray(offset, dtype=np.float64), mesh[1]


def about(axis: str, angle: float) -> Rotation:
    """Rotation about 'x', 'y' or 'z', radians."""
    return Rotation.from_euler(axis, angle)


def mirrored(mesh: Mesh) -> Mesh:
    """Mirrored in the plane x = 0; the winding stays outward."""
    return mesh[0] * [-1.0, 1.0, 1.0], mesh[1][:, ::-1]


def volume(mesh: Mesh) -> float:
    """Signed volume: positive where a closed mesh's winding is outward."""
    a, b, c = (mesh[0][mesh[1][:, k]] for k in range(3))
    return float(np.einsum("fx,fx->", a, np.cross(b, c)) / 6)


def area(mesh: Mesh) -> float:
    """Surface area."""
    a, b, c = (mesh[0][mesh[1][:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def outward(mesh: Mesh) -> Mesh:
    """A closed mesh with its winding turned outward."""
    return mesh if volume(mesh) >= 0 else (mesh[0], mesh[1][:, ::-1])


def weld(mesh: Mesh) -> Mesh:
    """Corners in one place made one vertex; collapsed triangles and vertices without any are dropped."""
    positions, triangles = mesh
    step = ALIKE * float(np.ptp(positions, axis=0).max() or 1.0)
    _, first, group = np.unique(np.rint(positions / step).astype(np.int64), axis=0, return_index=True,
                                return_inverse=True)
    return tidy((positions[first], group.reshape(-1)[triangles].astype(np.int32)))


def tidy(mesh: Mesh) -> Mesh:
    """Triangles with a repeated corner and vertices without triangles are dropped."""
    positions, triangles = mesh
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    used, triangles = np.unique(triangles, return_inverse=True)
    return positions[used], triangles.reshape(-1, 3).astype(np.int32)


# --- shapes ---

def grid(rows: NDArray, around: bool = False, along: bool = False) -> Mesh:
    """Quads, halved, between rows of points (R, C, 3); `along` closes the rows' order, `around` each row.

    They are seen from where (next row) x (next column) points.
    """
    count, columns = rows.shape[:2]
    i, j = np.meshgrid(np.arange(count if along else count - 1), np.arange(columns if around else columns - 1),
                       indexing="ij")
    i, j, below, beside = i.ravel(), j.ravel(), (i.ravel() + 1) % count, (j.ravel() + 1) % columns
    a, b, c, d = i * columns + j, i * columns + beside, below * columns + beside, below * columns + j
    triangles = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    return rows.reshape(-1, 3).astype(np.float64), triangles.astype(np.int32)


def box(size: Sequence[float] = (1, 1, 1), centre: Sequence[float] = (0, 0, 0)) -> Mesh:
    """Twelve triangles; `refine` makes more."""
    solid = trimesh.creation.box(size)
    return np.array(solid.vertices, dtype=np.float64) + np.asarray(centre, float), np.array(solid.faces, np.int32)


def ball(radius: float = 1.0, subdivisions: int = 3) -> Mesh:
    """Icosphere: 10 * 4**subdivisions + 2 vertices."""
    solid = trimesh.creation.icosphere(subdivisions, radius)
    return np.array(solid.vertices, dtype=np.float64), np.array(solid.faces, dtype=np.int32)


def turned(profile: Sequence[Sequence[float]] | NDArray, sections: int = 32, ring: bool = False) -> Mesh:
    """A profile of (radius, height) turned about z; it ends on the axis, or is a closed loop (`ring`)."""
    outline = np.asarray(profile, dtype=np.float64)
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    rows = np.stack([outline[:, :1] * np.cos(angle), outline[:, :1] * np.sin(angle),
                     np.repeat(outline[:, 1:], sections, 1)], -1)
    return outward(weld(grid(rows, around=True, along=ring)))


def cylinder(radius: float = 1.0, height: float = 1.0, sections: int = 32, top: float | None = None) -> Mesh:
    """From z = 0 to `height`; a cone or its frustum where `top`, the upper radius, is given."""
    return turned([(0, 0), (radius, 0), (radius if top is None else top, height), (0, height)], sections)


def torus(major: float = 1.0, minor: float = 0.3, sections: int = 48, around: int = 20) -> Mesh:
    """About z."""
    a = np.linspace(0, 2 * np.pi, around, endpoint=False)
    return turned(np.stack([major + minor * np.cos(a), minor * np.sin(a)], 1), sections, ring=True)


def prism(outline: NDArray, height: float) -> Mesh:
    """A star-shaped outline (P, 2), seen from the origin, raised from z = 0 to `height`."""
    base, top = np.insert(outline, 2, 0.0, 1), np.insert(outline, 2, height, 1)
    rows = np.stack([np.zeros_like(base), base, top, np.zeros_like(top) + [0, 0, height]])
    return outward(weld(grid(rows, around=True)))


def swept(spine: NDArray, radii: NDArray | float, sections: int = 16, closed: bool = False, power: float = 2.0,
          side: Sequence[float] | None = None) -> Mesh:
    """A tube along a line of points.

    Args:
        spine: (S, 3). radii: broadcastable to (S, 2), across and along `side`.
        closed: whether the spine is a loop; if not, the ends are capped.
        power: of the superellipse that is the section: 2 is round, 8 almost a box.
        side: a direction that the sections keep to, where a twist would be seen.
    """
    spine = np.asarray(spine, dtype=np.float64)
    radii = np.broadcast_to(np.asarray(radii, dtype=np.float64).reshape(len(np.atleast_1d(radii)), -1), (len(spine), 2))
    if closed:
        tangent = np.roll(spine, -1, 0) - np.roll(spine, 1, 0)
    else:
        tangent = np.gradient(spine, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    across = np.empty_like(spine)
    start = np.asarray(side, float) if side is not None else np.eye(3)[np.abs(tangent[0]).argmin()]
    for k, t in enumerate(tangent):  # carried along the spine, so that nothing twists
        start = start - (start @ t) * t
        start = start / max(float(np.linalg.norm(start)), 1e-12)
        across[k] = start
    if closed and side is None:  # what the loop has turned it by is spread over the loop
        first, last = across[0], across[-1]
        gap = np.arctan2(np.cross(last, first) @ tangent[0], last @ first)
        angles = np.linspace(0, gap, len(spine), endpoint=False)
        across = Rotation.from_rotvec(tangent * angles[:, None]).apply(across)
    other = np.cross(tangent, across)
    a = np.linspace(0, 2 * np.pi, sections, endpoint=False) + np.pi / sections
    x, y = (np.sign(w) * np.abs(w) ** (2 / power) for w in (np.cos(a), np.sin(a)))
    rows = (spine[:, None] + (radii[:, 1:] * x)[..., None] * across[:, None]
            + (radii[:, :1] * y)[..., None] * other[:, None])
    if not closed:
        ends = [np.repeat(spine[k][None, None], sections, 1) for k in (0, -1)]
        rows = np.concatenate([ends[0], rows, ends[1]])
    return outward(weld(grid(rows, around=True, along=closed)))


# --- what is done to any mesh ---

def refine(mesh: Mesh, longest: float) -> Mesh:
    """Edges longer than `longest` halved until there are none; no T-junctions arise."""
    positions, triangles = mesh
    for _ in range(_ROUNDS):
        sides = np.stack([triangles, np.roll(triangles, -1, 1)], -1)  # (F, 3, 2)
        edges, which = np.unique(np.sort(sides.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
        split = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1) > longest
        if not split.any():
            break
        middle = np.where(split, len(positions) + np.cumsum(split) - 1, -1)[which.reshape(-1)].reshape(-1, 3)
        positions = np.concatenate([positions, positions[edges[split]].mean(1)])
        triangles = _halved(positions, triangles, middle)
    return positions, triangles


def _halved(positions: NDArray, triangles: NDArray, middle: NDArray) -> NDArray[np.int32]:
    """Triangles cut at the middles (F, 3) of their sides; -1 where a side is whole."""
    count = (middle >= 0).sum(1)
    whole = triangles[count == 0]
    # turned so that the one cut side comes first, or the one whole side last
    (a, b, c), (m, _, _) = _turned(triangles, middle, count == 1, lambda cut: cut.argmax(1))
    one = [(a, m, c), (m, b, c)]
    (a, b, c), (m, n, _) = _turned(triangles, middle, count == 2, lambda cut: (~cut).argmax(1) + 1)
    shorter = (np.linalg.norm(positions[a] - positions[n], axis=1)
               <= np.linalg.norm(positions[m] - positions[c], axis=1))
    two = [(m, b, n), (a, m, np.where(shorter, n, c)), (np.where(shorter, a, m), n, c)]
    (a, b, c), (m, n, o) = _turned(triangles, middle, count == 3, lambda cut: np.zeros(len(cut), int))
    three = [(a, m, o), (m, b, n), (o, n, c), (m, n, o)]
    return np.concatenate([whole, *(np.stack(t, 1) for t in (*one, *two, *three))]).astype(np.int32)


def _turned(triangles, middle, chosen, first):  # type: ignore[no-untyped-def]
    """Corners and middles, as columns, of the chosen triangles, started at side `first(cut)`."""
    t, m = triangles[chosen], middle[chosen]
    order = (first(m >= 0)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(t, order, 1).T, np.take_along_axis(m, order, 1).T


def to_size(mesh: Mesh, target: int) -> Mesh:
    """Refined to about `target` vertices, evenly over its area; one that has more stays as it is."""
    if len(mesh[0]) >= target:
        return mesh
    # Equilateral triangles of edge e: V = F/2 of them cover 2V e^2 sqrt(3)/4. Halving leaves edges from
    # half the limit to the limit, and slivers; so look what came, and once more.
    longest = 1.55 * np.sqrt(area(mesh) / (0.866 * target))
    fine = refine(mesh, float(longest))
    if 0.75 * target < len(fine[0]) < 1.35 * target:
        return fine
    return refine(mesh, float(longest * np.sqrt(len(fine[0]) / target)))


def ripples(rng: np.random.Generator, wavelength: float, waves: int = 24) -> tuple[NDArray, NDArray]:
    """A smooth random field: wave vectors (W, 3) and phases (W,), for `noise`."""
    directions = rng.normal(size=(waves, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (directions * (2 * np.pi / wavelength) * rng.uniform(0.6, 1.4, (waves, 1)),
            rng.uniform(0, 2 * np.pi, waves))


def noise(points: NDArray, field: tuple[NDArray, NDArray]) -> NDArray[np.float64]:
    """The field at points (N, 3): about normally distributed, variance 1."""
    vectors, phases = field
    return np.sin(points @ vectors.T + phases).sum(1) * np.sqrt(2 / len(phases))
