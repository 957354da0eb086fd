# SPDX-License-Identifier: GPL-3.0-or-later
"""Trials in which the surface stays the same, or nearly: transformations, tessellation, encoding of normals.

Each gives the undisturbed cases and the disturbed ones.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from trial import (
    ORDER,
    Arrays,
    Pairs,
    Scale,
    Undisturbed,
    Variant,
    against,
    box,
    each,
    flat,
    join,
    own,
    rows_of,
    smooth,
    traced,
    turn,
    with_normals,
)

from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh

_TURNS = (((1, 0, 0), 90), ((0, 0, 1), 37), ((1, 2, 3), 141), ((-3, 1, 1), 73))


def rotate(scale: Scale) -> Pairs:
    """A turned mesh must get the turned answer: a method that knows up from down has learnt its training set."""
    def disturb(host: Undisturbed):
        for axis, degrees in _TURNS:
            matrix = turn(axis, degrees)
            mesh = smooth((host.geometry[0] @ matrix.T, host.geometry[1]))
            yield against(f"{host.name}, {degrees}° about {axis}", mesh, host.rows, sh.rotate(host.truth.T, matrix).T)

    return each(scale, disturb)


def translate_object(scale: Scale) -> Pairs:
    """An object 10,000 times its size away from the origin: scenes are built where the map puts them."""
    def disturb(host: Undisturbed):
        positions, triangles = host.geometry[0] + (1e4, -1e4, 1e4), host.geometry[1]
        corners = triangles.ravel()
        mesh = TriangleMesh.from_corners(positions, triangles, corners, host.mesh.normals[corners],
                                         np.repeat(np.arange(len(triangles)), 3), host.mesh.resolution)
        yield host.same("1e4 away", mesh)

    return each(scale, disturb)


def translate_coordinates(scale: Scale) -> Pairs:
    """The same with the distance in the mesh's own float32 coordinates, which then have steps of a thousandth of it."""
    def disturb(host: Undisturbed):
        away = (host.geometry[0] + (1e4, -1e4, 1e4)).astype(np.float32).astype(np.float64)
        # normals as they were: what is tried is the rays, not how normals are made of rounded faces
        corners = host.geometry[1].ravel()
        mesh = TriangleMesh.from_corners(away, host.geometry[1], corners, host.mesh.normals[corners],
                                         np.repeat(np.arange(len(host.geometry[1])), 3))
        yield host.same("float32 1e4 away", mesh)

    return each(scale, disturb)


def scaled(scale: Scale) -> Pairs:
    """A coin and a city: transfer has no unit of length."""
    def disturb(host: Undisturbed):
        for factor in (1e-3, 1e-1, 1e1, 1e3):
            yield host.same(f"{factor:g} times", smooth((host.geometry[0] * factor, host.geometry[1])))

    return each(scale, disturb)


def mirror(scale: Scale) -> Pairs:
    """A mirrored mesh must get the mirrored answer: half of most models is made so."""
    there, back = sh.evaluate(np.array([[0.3, 0.5, 0.8], [-0.3, 0.5, 0.8]]) / np.sqrt(0.98), ORDER)
    signs = np.where(np.isclose(there, back), 1.0, -1.0)  # of each harmonic in the mirror

    def disturb(host: Undisturbed):
        mesh = smooth((host.geometry[0] * (-1, 1, 1), host.geometry[1][:, ::-1]))
        yield against(f"{host.name}, mirrored", mesh, host.rows, host.truth * signs)

    return each(scale, disturb)


def permute_vertices(scale: Scale) -> Pairs:
    """Another numbering of the vertices: files and modifiers number them as they like."""
    def disturb(host: Undisturbed):
        order = np.random.default_rng(1).permutation(len(host.geometry[0]))
        where = np.argsort(order)
        yield host.same("permuted", smooth((host.geometry[0][order], where[host.geometry[1]])), where)

    return each(scale, disturb)


def shuffle_triangles(scale: Scale) -> Pairs:
    """Another order of the triangles, and of the corners in each."""
    def disturb(host: Undisturbed):
        rng = np.random.default_rng(2)
        triangles = rng.permutation(host.geometry[1])
        first = rng.integers(0, 3, len(triangles))
        turned = np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)
        yield host.same("shuffled", smooth((host.geometry[0], turned)))

    return each(scale, disturb)


def subdivided(geometry: Arrays, chosen: NDArray | None = None) -> Arrays:
    """Triangles split into four at the middles of their edges; only the `chosen` (F,), which leaves T-junctions."""
    positions, triangles = geometry
    split = triangles if chosen is None else triangles[chosen]
    edges = np.sort(split[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, index = np.unique(edges, axis=0, return_inverse=True)
    m = index.reshape(-1, 3) + len(positions)
    parts = [np.stack(corners, 1) for corners in (
        (split[:, 0], m[:, 0], m[:, 2]), (m[:, 0], split[:, 1], m[:, 1]), (m[:, 2], m[:, 1], split[:, 2]),
        (m[:, 0], m[:, 1], m[:, 2]))]
    rest = triangles[:0] if chosen is None else triangles[~chosen]
    return (np.concatenate([positions, positions[pairs].mean(1)]),
            np.concatenate([rest, *parts]).astype(np.int32))


def fanned(geometry: Arrays, chosen: NDArray, weights: tuple[float, float, float]) -> Arrays:
    """The `chosen` triangles (F,) split into three at a point inside."""
    positions, triangles = geometry
    split = triangles[chosen]
    middle = np.arange(len(split)) + len(positions)
    parts = [np.stack([split[:, i], split[:, (i + 1) % 3], middle], 1) for i in range(3)]
    inside = np.einsum("c,fcx->fx", weights, positions[split])
    return (np.concatenate([positions, inside]), np.concatenate([triangles[~chosen], *parts]).astype(np.int32))


def decimated(geometry: Arrays, passes: int = 3) -> Arrays:
    """Vertices that are no neighbours of each other collapsed into a neighbour; those that stay do not move."""
    positions, triangles = geometry
    rng = np.random.default_rng(4)
    for _ in range(passes):
        edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        neighbours: dict[int, set[int]] = {}
        for a, b in edges.tolist():
            neighbours.setdefault(a, set()).add(b)
            neighbours.setdefault(b, set()).add(a)
        onto = np.arange(len(positions))
        taken: set[int] = set()
        for vertex in rng.permutation(len(positions)).tolist():
            around = neighbours.get(vertex, set())
            if not around or vertex in taken or around & taken:
                continue
            onto[vertex] = min(around, key=lambda n, v=vertex: float(np.square(positions[n] - positions[v]).sum()))
            taken |= around | {vertex}
        triangles = onto[triangles]
        triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(1)]
    used, index = np.unique(triangles, return_inverse=True)
    return positions[used], index.reshape(-1, 3).astype(np.int32)


def subdivide(scale: Scale) -> Pairs:
    """The same surface with four times the triangles: the answer at the old vertices must not move."""
    return each(scale, lambda host: [host.same("subdivided", smooth(subdivided(host.geometry)))])


def decimate(scale: Scale) -> Pairs:
    """Fewer triangles. The shape is another then, and so is the truth: each is held to its own."""
    return each(scale, lambda host: [own(f"{host.name}, decimated", smooth(decimated(host.geometry)), scale)])


def slivers(scale: Scale) -> Pairs:
    """Long thin triangles, as CAD programs leave them: the same surface, cut near its corners."""
    def disturb(host: Undisturbed):
        everywhere = np.ones(len(host.geometry[1]), bool)
        yield host.same("slivers", smooth(fanned(host.geometry, everywhere, (0.96, 0.02, 0.02))))

    return each(scale, disturb)


def uneven_density(scale: Scale) -> Pairs:
    """Half of the mesh nine times as dense as the other: detail is where somebody modelled it."""
    def disturb(host: Undisturbed):
        geometry = host.geometry
        for _ in range(2):
            centres = geometry[0][geometry[1]].mean(1)
            geometry = fanned(geometry, centres[:, 0] > 0, (1 / 3, 1 / 3, 1 / 3))
        yield host.same("uneven", smooth(geometry))

    return each(scale, disturb)


def t_junctions(scale: Scale) -> Pairs:
    """Half of the triangles split without their neighbours: no edges join there, and rays may slip through."""
    def disturb(host: Undisturbed):
        chosen = np.random.default_rng(3).random(len(host.geometry[1])) < 0.5
        yield host.same("T-junctions", smooth(subdivided(host.geometry, chosen)))

    return each(scale, disturb)


def _floor_and_post(pieces: int) -> Arrays:
    """Facing +z."""
    return join(box((1, 1, 0.1), pieces), box((0.2, 0.2, 0.5), max(2, pieces // 3), (0.1, 0.05, 0.3001)))


def pole(scale: Scale) -> Pairs:
    """Normals at and around -e_y, the pole of the motor (equation 5), where half angles change their sign."""
    geometry = _floor_and_post(max(3, round((scale.vertices / 8) ** 0.5)))
    base = flat(geometry)
    rows = rows_of(base, scale)
    truth = traced(base, rows)

    def turned(label: str, axis: tuple[int, int, int], degrees: float) -> Variant:
        matrix = turn(axis, degrees)  # as it is: made anew, its points would come in another order
        mesh = replace(base, **{name: getattr(base, name) @ matrix.T
                                for name in ("positions", "points", "normals", "clearance")})
        return against(label, mesh, rows, sh.rotate(truth.T, matrix).T)

    return [([turned(f"{degrees:g}° beside e_z", (0, 1, 0), degrees) for degrees in (1e-3, 1, 5)],
             [turned(f"{degrees:g}° beside -e_y", (1, 0, 0), 90 + degrees) for degrees in (0, 1e-5, 1e-3, 0.1, 1)])]


def flipped_normals(scale: Scale) -> Pairs:
    """Normals that point into the mesh, faces as they were: an import gone wrong. Points then see the inside."""
    def disturb(host: Undisturbed):
        yield own(f"{host.name}, flipped", with_normals(host.mesh, -host.mesh.normals), scale)

    return each(scale, disturb)


def averaged_normals(scale: Scale) -> Pairs:
    """Boxes shaded smooth: normals that belong to no face, a third of whose hemisphere is below the surface."""
    geometry = _floor_and_post(max(3, round((scale.vertices / 8) ** 0.5)))
    return [([own("flat", flat(geometry), scale)], [own("averaged", smooth(geometry), scale)])]


def split_normals(scale: Scale) -> Pairs:
    """A smooth mesh shaded flat: six points where there was one, each with a normal of its own."""
    return each(scale, lambda host: [own(f"{host.name}, flat", flat(host.geometry), scale)])


TRIALS = {"transformation": (rotate, translate_object, translate_coordinates, scaled, mirror, permute_vertices,
                             shuffle_triangles),
          "tessellation": (subdivide, decimate, slivers, uneven_density, t_junctions),
          "encoding": (pole, flipped_normals, averaged_normals, split_normals)}
