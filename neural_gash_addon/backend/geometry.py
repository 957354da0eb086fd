# SPDX-License-Identifier: GPL-3.0-or-later
"""The mesh to bake as arrays: geometry that blocks, and the points whose transfer is wanted.

A point is a vertex, unless the shading has split normals; then each distinct (vertex, normal)
is a point, and the face corners that share it read the same coefficients.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import UserError

POINT, CORNER, TEXEL = "POINT", "CORNER", "TEXEL"
NO_FACES = "The mesh has no faces, so there is nothing to bake."
NOT_FINITE = "The mesh has coordinates that are infinite or not numbers."

# Corner normals of one vertex closer than this are one normal: above float32 noise of averaged
# normals, below any split that can be seen (0.06 degrees).
SAME_NORMAL = 1e-3
# Rays start this many times as far inside the point's own faces as they start off the surface.
INSET = 4.0


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh in the bake frame (world axes, metres) as it is shaded; points of either target come from it."""

    positions: NDArray[np.float64]       # (V, 3)
    corner_vertices: NDArray[np.int32]   # (C,) vertex of each face corner
    corner_normals: NDArray[np.float32]  # (C, 3) shading normals
    corner_faces: NDArray[np.int32]      # (C,) polygon of each face corner, non-decreasing
    corners: NDArray[np.int32]           # (F, 3) face corners that make each triangle
    resolution: float                    # spacing of the coordinates' floats, metres

    @property
    def triangles(self) -> NDArray[np.int32]:
        """(F, 3) vertices of each triangle."""
        return self.corner_vertices[self.corners]

    @property
    def polygons(self) -> NDArray[np.int32]:
        """(F,) polygon of each triangle."""
        return self.corner_faces[self.corners[:, 0]]

    def vertex_points(self) -> TriangleMesh:
        """Points at the vertices, or at the corners where normals split. Raises UserError as `from_corners`."""
        return TriangleMesh.from_corners(self.positions, self.triangles, self.corner_vertices, self.corner_normals,
                                         self.corner_faces, self.resolution, self.corners)


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A mesh in the bake frame (world axes, metres) and its N points."""

    positions: NDArray[np.float64]  # (V, 3) vertices
    triangles: NDArray[np.int32]    # (F, 3)
    points: NDArray[np.float64]     # (N, 3)
    normals: NDArray[np.float64]    # (N, 3) unit shading normals; zero where there is none
    clearance: NDArray[np.float64]  # (N, 3) from each point to where its rays start, in Occluders' offsets
    elements: NDArray[np.int32]     # (E,) point of each vertex (POINT), face corner (CORNER) or texel (TEXEL)
    domain: str                     # POINT or CORNER, Blender's attribute domains; or TEXEL
    resolution: float               # spacing of the coordinates' floats, metres
    corners: NDArray[np.int32] | None = None  # (F, 3) of CORNER: face corners of each triangle, indices of `elements`
    texels: NDArray[np.int64] | None = None   # (N,) of TEXEL: row * side + column, rising
    side: int = 0                             # of TEXEL: texels a side

    def lit(self) -> NDArray[np.int64]:
        """(n,) points that have a normal, rising."""
        x, y, z = self.normals.T  # not any(1): NumPy is slow along short last axes
        return np.flatnonzero((x != 0) | (y != 0) | (z != 0))

    @staticmethod
    def from_corners(positions: NDArray, triangles: NDArray, corner_vertices: NDArray, corner_normals: NDArray,
                     corner_faces: NDArray, resolution: float | None = None, corners: NDArray | None = None,
                     ) -> TriangleMesh:
        """Decide the domain from the shading, and build the points.

        Args:
            positions: (V, 3). triangles: (F, 3) vertex indices, as many as trace.
            corner_vertices: (C,) vertex of each polygon corner. corner_normals: (C, 3) its shading
                normal. corner_faces: (C,) its polygon, non-decreasing.
            resolution: spacing of the floats the coordinates came in; float32's at the largest
                coordinate where not given.
            corners: (F, 3) face corners of each triangle, to know which points lie beside which.
        Raises:
            UserError: no faces, or coordinates that are not finite.
        """
        positions = np.ascontiguousarray(positions, dtype=np.float64)
        triangles = np.ascontiguousarray(triangles, dtype=np.int32)
        corner_vertices = np.asarray(corner_vertices)
        if not len(triangles) or not len(corner_vertices):
            raise UserError(NO_FACES)
        if not np.isfinite(positions).all():
            raise UserError(NOT_FINITE)
        if resolution is None:
            resolution = float(np.spacing(np.float32(np.abs(positions).max())))
        vertex_normals = np.zeros_like(positions)
        vertex_normals[corner_vertices] = corner_normals  # any one corner's, to compare the others with
        vertex_normals = unit(vertex_normals)
        split = any(np.abs(unit(corner_normals[s]) - vertex_normals[corner_vertices[s]]).max() > SAME_NORMAL
                    for s in _blocks(len(corner_vertices)))
        if not split:
            count = len(positions)
            return TriangleMesh(positions, triangles, positions, vertex_normals, vertex_normals,
                                np.arange(count, dtype=np.int32), POINT, resolution)
        first, elements = _distinct(corner_vertices, corner_normals)
        point_vertices, normals = corner_vertices[first], unit(corner_normals[first])
        insets = _insets(positions, corner_vertices, corner_faces, elements, normals)
        return TriangleMesh(positions, triangles, positions[point_vertices], normals, normals + INSET * insets,
                            elements, CORNER, resolution, corners)

    @staticmethod
    def from_triangles(positions: NDArray, triangles: NDArray, smooth: bool = True) -> TriangleMesh:
        """A triangle soup shaded smooth (angle-weighted normals, as Blender's) or flat; see `from_corners`."""
        positions = np.asarray(positions, dtype=np.float64)
        triangles = np.asarray(triangles, dtype=np.int32)
        if not len(triangles):
            raise UserError(NO_FACES)
        if not np.isfinite(positions).all():
            raise UserError(NOT_FINITE)
        corners = positions[triangles]                                   # (F, 3, 3)
        face_normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        corner_normals = np.repeat(face_normals, 3, axis=0)
        if smooth:
            following = unit(np.roll(corners, -1, 1) - corners)
            angles = np.arccos(np.clip(-(following * np.roll(following, 1, 1)).sum(-1), -1, 1))
            vertex_normals = np.zeros_like(positions)
            np.add.at(vertex_normals, triangles.ravel(), corner_normals * angles.reshape(-1, 1))
            corner_normals = unit(vertex_normals)[triangles.ravel()]
        faces = np.repeat(np.arange(len(triangles)), 3)
        return TriangleMesh.from_corners(positions, triangles, triangles.ravel(), corner_normals, faces,
                                         corners=np.arange(triangles.size, dtype=np.int32).reshape(-1, 3))


def unit(vectors: NDArray) -> NDArray[np.float64]:
    """Vectors (..., 3) scaled to length 1; zero where they are zero or not finite."""
    v = np.asarray(vectors, dtype=np.float64)
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    good = np.isfinite(length) & (length > 0)
    return np.divide(v, length, out=np.zeros_like(v), where=good)


def _blocks(count: int) -> Iterator[slice]:
    """Slices of 2**18 that cover range(count): what is computed a block at a time takes little memory."""
    return (slice(start, start + (1 << 18)) for start in range(0, count, 1 << 18))


def _distinct(corner_vertices: NDArray, corner_normals: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Corners grouped by vertex and (nearly) equal normal: first corner of each group, group of each corner.

    Equal is decided on a grid of SAME_NORMAL, so a pair across a cell's border may stay apart:
    that costs a point, never a wrong one.
    """
    key = np.empty(len(corner_vertices), dtype=np.int64)
    steps = round(1 / SAME_NORMAL)
    side = 2 * steps + 1
    for s in _blocks(len(key)):
        cells = np.rint(unit(corner_normals[s]) * steps).astype(np.int64) + steps
        key[s] = (cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]
    order = np.lexsort((key, corner_vertices))
    v, k = corner_vertices[order], key[order]
    starts = np.concatenate([[True], (v[1:] != v[:-1]) | (k[1:] != k[:-1])])
    elements = np.empty(len(order), dtype=np.int32)
    elements[order] = np.cumsum(starts, dtype=np.int32) - 1
    return order[starts], elements


def _insets(positions: NDArray, corner_vertices: NDArray, corner_faces: NDArray, elements: NDArray,
            point_normals: NDArray) -> NDArray[np.float64]:
    """Tangent directions from each point into the faces it belongs to: (N, 3), length at most 1.

    A corner of a flat wall lies in the plane of the next wall too; a ray that starts exactly there
    may pass behind it. A step into the point's own faces settles on which side it is.
    """
    face = np.cumsum(np.concatenate([[0], np.diff(corner_faces) != 0]))
    size = np.bincount(face)
    centres = np.stack([np.bincount(face, positions[corner_vertices, a]) for a in range(3)], 1) / size[:, None]
    mean = np.zeros_like(point_normals)
    for s in _blocks(len(elements)):
        towards = unit(centres[face[s]] - positions[corner_vertices[s]])
        np.add.at(mean, elements[s], towards)
    mean -= (mean * point_normals).sum(1, keepdims=True) * point_normals
    return unit(mean)
