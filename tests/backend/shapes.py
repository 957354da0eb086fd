# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes with known answers, as (positions, triangles)."""
import numpy as np
import trimesh

from neural_gash_addon.backend.geometry import POINT, TriangleMesh

Arrays = tuple[np.ndarray, np.ndarray]


def cube(inside: bool = False, subdivisions: int = 1) -> Arrays:
    box = trimesh.creation.box((1, 1, 1))
    for _ in range(subdivisions):
        box = box.subdivide()
    return np.array(box.vertices), np.array(box.faces[:, ::-1] if inside else box.faces)


def sphere(subdivisions: int = 3) -> Arrays:
    ball = trimesh.creation.icosphere(subdivisions)
    return np.array(ball.vertices), np.array(ball.faces)


def torus(major: float = 1.0, minor: float = 0.45, sections: int = 32) -> Arrays:
    ring = trimesh.creation.torus(major, minor, sections, sections // 2)
    return np.array(ring.vertices), np.array(ring.faces)


def grid(count: int = 20) -> Arrays:
    """Unit square in z = 0, facing up."""
    line = np.linspace(0, 1, count)
    x, y = np.meshgrid(line, line)
    i = np.arange(count * count).reshape(count, count)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    return (np.stack([x.ravel(), y.ravel(), np.zeros(count * count)], 1),
            np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def at_points(geometry: Arrays, points: np.ndarray, normals: np.ndarray) -> TriangleMesh:
    """The geometry with points of one's own choosing on it."""
    points, normals = np.atleast_2d(points).astype(float), np.atleast_2d(normals).astype(float)
    return TriangleMesh(np.asarray(geometry[0], float), np.asarray(geometry[1], np.int32), points, normals,
                        normals, np.arange(len(points), dtype=np.int32), POINT, 0.0)
