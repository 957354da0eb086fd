# SPDX-License-Identifier: GPL-3.0-or-later
"""What a trial of stability is made of: disturbed meshes, and what a method's answer on them should be.

Errors are parts of the open sky: |T - T_true| of a point over |T_unshadowed|, which is one number for all normals. So
they mean the same on a mesh that is all dark as on one that is all in the open.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from meshes import FOLDER, knot, read
from numpy.typing import NDArray

from neural_gash_addon.backend import compare, methods
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh

ORDER, REFERENCE_SEED = 3, 77
OPEN = float(np.linalg.norm(sh.cosine_lobe(np.array([[0.0, 0, 1]]), ORDER)))  # |T| under an open sky
Arrays = tuple[NDArray, NDArray]  # positions (V, 3), triangles (F, 3)


@dataclass(frozen=True, eq=False)
class Variant:
    """One disturbance."""

    label: str
    meshes: Sequence[TriangleMesh]                            # to bake, one after another
    errors: Callable[[Sequence[NDArray]], NDArray[np.float64]]  # of their coefficients (N, K): (n,) of points


Pairs = list[tuple[list[Variant], list[Variant]]]  # undisturbed, and what is to be as good as that


@dataclass(frozen=True)
class Scale:
    """How much a run looks at."""

    vertices: int      # of procedural meshes
    points: int        # of a mesh at which errors are measured
    real: tuple[str, ...]  # meshes of ../shared/meshes/validation besides the knot
    pairs: int         # of frames of each sequence
    seeds: int


FULL = Scale(2000, 800, ("fist", "coupling"), 2, 16)
SMALL = Scale(300, 60, (), 1, 4)


def placed(positions: NDArray) -> NDArray[np.float64]:
    """Centred, longest side 1."""
    low, high = positions.min(0), positions.max(0)
    return (np.asarray(positions, np.float64) - (low + high) / 2) / float((high - low).max())


@lru_cache(maxsize=2)
def hosts(scale: Scale) -> list[tuple[str, Arrays]]:
    """The meshes that are disturbed, of size 1 about the origin."""
    positions, triangles = knot(scale.vertices)
    found = [("knot", (placed(positions), triangles))]
    for name in scale.real:
        path = FOLDER / "validation" / f"{name}.ply"
        if path.is_file():
            mesh = read(path)
            found.append((name, (placed(mesh.positions), mesh.triangles)))
    return found


def smooth(geometry: Arrays) -> TriangleMesh:
    """Shaded smooth."""
    return TriangleMesh.from_triangles(*geometry)


def flat(geometry: Arrays) -> TriangleMesh:
    """Shaded flat, so that normals split."""
    return TriangleMesh.from_triangles(*geometry, smooth=False)


def box(size: Sequence[float], pieces: int, centre: Sequence[float] = (0, 0, 0)) -> Arrays:
    """A box whose sides are grids of `pieces` squares along each edge, vertices merged."""
    line = np.linspace(-0.5, 0.5, pieces + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(line, line, indexing="ij"))
    i = np.arange((pieces + 1) ** 2).reshape(pieces + 1, -1)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    square = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    sides = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            corners = np.empty((len(x), 3))
            corners[:, axis], corners[:, (axis + 1) % 3], corners[:, (axis + 2) % 3] = sign, x, y
            sides.append((corners, square if sign > 0 else square[:, ::-1]))
    positions, triangles = join(*sides)
    keys, inverse = np.unique(np.round(positions * pieces * 2).astype(int), axis=0, return_inverse=True)
    return keys / (pieces * 2) * np.asarray(size) + np.asarray(centre), inverse.reshape(-1)[triangles].astype(np.int32)


def sphere(subdivisions: int, radius: float) -> Arrays:
    """A ball about the origin."""
    ball = trimesh.creation.icosphere(subdivisions, radius)
    return np.array(ball.vertices), np.array(ball.faces, np.int32)


def join(*parts: Arrays) -> Arrays:
    """Several as one."""
    starts = np.cumsum([0, *(len(positions) for positions, _ in parts[:-1])])
    return (np.concatenate([positions for positions, _ in parts]),
            np.concatenate([triangles + start for (_, triangles), start in zip(parts, starts, strict=True)])
            .astype(np.int32))


def turn(axis: Sequence[float], degrees: float) -> NDArray[np.float64]:
    """Rotation (3, 3) about an axis."""
    return np.asarray(trimesh.transformations.rotation_matrix(np.radians(degrees), axis)[:3, :3])


def rows_of(mesh: TriangleMesh, scale: Scale, among: int | None = None) -> NDArray[np.int64]:
    """The points that are looked at, at random among the first `among` or all."""
    return compare.sample(among or len(mesh.points), scale.points, REFERENCE_SEED)


def traced(mesh: TriangleMesh, rows: NDArray) -> NDArray[np.float64]:
    """Transfer (n, K) at points of a mesh, by a reference of 2 x 4096 rays."""
    return methods.run(compare.reference(mesh, ORDER, rows, seed=REFERENCE_SEED)).transfer


def against(label: str, mesh: TriangleMesh, rows: NDArray, truth: NDArray) -> Variant:
    """The answer on a mesh, beside what it should be at some points."""
    return Variant(label, [mesh], lambda found: np.linalg.norm(found[0][rows] - truth, axis=1) / OPEN)


def own(label: str, mesh: TriangleMesh, scale: Scale) -> Variant:
    """The answer on a mesh beside its own reference: where the shape is another, so is the truth."""
    rows = rows_of(mesh, scale)
    return against(label, mesh, rows, traced(mesh, rows))


class Undisturbed:
    """A host as it is, with its truth; traced once for all trials."""

    def __init__(self, name: str, geometry: Arrays, scale: Scale) -> None:
        self.name, self.geometry, self.scale = name, geometry, scale
        self.mesh = smooth(geometry)
        self.rows = rows_of(self.mesh, scale)
        self.truth = traced(self.mesh, self.rows)

    @property
    def variant(self) -> Variant:
        """Itself."""
        return against(self.name, self.mesh, self.rows, self.truth)

    def same(self, label: str, mesh: TriangleMesh, where: NDArray | None = None) -> Variant:
        """A mesh on which nothing should change at the host's points; `where` (V,) they are in it."""
        rows = self.rows if where is None else where[self.rows]
        return against(f"{self.name}, {label}", mesh, rows, self.truth)


@lru_cache(maxsize=2)
def undisturbed(scale: Scale) -> list[Undisturbed]:
    """All hosts."""
    return [Undisturbed(name, geometry, scale) for name, geometry in hosts(scale)]


def each(scale: Scale, disturb: Callable[[Undisturbed], Iterable[Variant]]) -> Pairs:
    """Each host, and what `disturb` makes of it."""
    return [([host.variant], list(disturb(host))) for host in undisturbed(scale)]


def with_normals(mesh: TriangleMesh, normals: NDArray) -> TriangleMesh:
    """The mesh with other normals at its points."""
    return replace(mesh, normals=normals, clearance=normals)


def sequences() -> list[Path]:
    """Files of deforming meshes, where they are there."""
    return sorted((FOLDER / "animated").glob("*.npz"))
