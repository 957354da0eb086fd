# SPDX-License-Identifier: GPL-3.0-or-later
"""UVs of a mesh's own for a bake, by xatlas: every face has a place that no other face has.

xatlas takes time that grows faster than its charts, rasters each chart at the size of the atlas, and
holds the interpreter's lock meanwhile. So the mesh is cut into pieces of neighbouring faces; xatlas
charts each by itself, at a tiny resolution, and `packing` places the charts of all. On 18,000 triangles
that takes a fifth of the time at the default options, and a window gets its turn between the pieces.

Some charts of xatlas lie over themselves, mostly beside a slit. `folds` says where, and the faces that it
takes become charts of their own, before anything is placed.
"""
from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .estimator import morton_order
from .folds import overlapping, taken_out
from .geometry import Surface, unit
from .packing import arranged, boxed
from .progress import scaled

PIECE = 1000           # triangles that xatlas charts at a time: 40 ms at most
_DRAFT_RESOLUTION = 16  # of a piece's own packing, which is thrown away
_FLAT = 1e-10          # of a face's area that is left in UVs: less, and it has collapsed


@dataclass(frozen=True, eq=False)
class Charts:
    """The faces of one or several meshes cut into charts, each flat in a plane of its own; not in a texture yet."""

    local: NDArray[np.float64]        # (F, 3, 2) of each triangle's corners, metres
    corners: NDArray[np.int32]        # (F, 3) face corners
    polygons: NDArray[np.int32]       # (F,)
    corner_count: int                 # C, of the mesh or of all together
    charts: NDArray[np.int64]         # (F,) number of each triangle's chart
    alone: NDArray[np.bool_]          # (F,) triangles of polygons that are a chart each, as xatlas cannot chart them

    @staticmethod
    def joined(parts: Sequence[Charts], scales: Sequence[float]) -> Charts:
        """The charts of several meshes, each as large as `scales` says, their corners counted on."""
        corners, polygons, charts = (
            np.concatenate([[0], np.cumsum(counts)]) for counts in (
                [p.corner_count for p in parts], [int(p.polygons.max()) + 1 for p in parts],
                [int(p.charts.max()) + 1 for p in parts]))
        return Charts(
            np.concatenate([p.local * scale for p, scale in zip(parts, scales, strict=True)]),
            np.concatenate([p.corners + n for p, n in zip(parts, corners, strict=False)]),
            np.concatenate([p.polygons + n for p, n in zip(parts, polygons, strict=False)]),
            int(corners[-1]), np.concatenate([p.charts + n for p, n in zip(parts, charts, strict=False)]),
            np.concatenate([p.alone for p in parts]))


@dataclass(frozen=True, eq=False)
class Atlas:
    """UVs, and what it took to get them."""

    uv: NDArray[np.float64]  # (C, 2) of each face corner, 0 to 1
    side: int                # texels a side
    texels_per_metre: float
    alone: NDArray[np.bool_]  # (F,) triangles of polygons that were laid out alone, as xatlas could not chart them


def unwrap(surface: Surface, *, side: int | None, texels_per_metre: float | None = None, padding: int = 2,
           ) -> Generator[float, None, Atlas]:
    """`cut` and `lay_out` in one."""
    charts = yield from scaled(cut(surface), 0, 0.7)
    return (yield from scaled(lay_out(charts, side=side, texels_per_metre=texels_per_metre, padding=padding), 0.7, 0.3))


def cut(surface: Surface) -> Generator[float, None, Charts]:
    """Cut the faces of a mesh into charts.

    Seams follow where normals split; the triangles of a polygon stay together.

    Yields:
        Progress, 0 to 1.
    Raises:
        UserError: xatlas is not installed.
    """
    xatlas = _xatlas()
    positions, triangles, corners = surface.positions, surface.triangles, surface.corners
    normals, polygons = surface.corner_normals, surface.polygons
    local, charts = np.zeros((len(triangles), 3, 2)), np.zeros(len(triangles), np.int64)
    alone = np.zeros(len(triangles), bool)
    pieces = _pieces(positions, triangles, polygons)
    count = 0
    for number, piece in enumerate(pieces):
        flat, found = _chart(xatlas, positions, triangles[piece], normals[corners[piece]])
        local[piece], found, alone[piece] = _apart(flat, found, positions[triangles[piece]], corners[piece],
                                                   polygons[piece])
        charts[piece] = found + count
        count += int(found.max()) + 1
        yield (number + 1) / len(pieces)
    return Charts(local, corners, polygons, len(normals), charts, alone)


def lay_out(charts: Charts, *, side: int | None, texels_per_metre: float | None = None, padding: int = 2,
            ) -> Generator[float, None, Atlas]:
    """Place charts in a square texture, without overlaps.

    Args:
        side: texels a side, or None and texels_per_metre, which decides it.
        padding: texels between charts.
    Yields:
        Progress, 0 to 1.
    Raises:
        UserError: the texture is too small for its charts.
    """
    numbers = np.unique(charts.charts, return_inverse=True)[1]
    turned, boxes = yield from scaled(boxed(charts.local, numbers), 0, 0.6)
    packing = arranged(boxes, _area(charts.local), side=side, density=texels_per_metre, padding=padding)
    corner, side, scale = yield from scaled(packing, 0.6, 0.4)
    uv = np.zeros((charts.corner_count, 2))
    uv[charts.corners] = (turned * scale + corner[numbers][:, None]) / side
    return Atlas(uv, side, scale, charts.alone)


def _xatlas():
    """The module. UserError where it is not installed."""
    try:
        import xatlas
    except ImportError as error:
        raise UserError("Textures need the Python package xatlas, which this Blender's Python has not; "
                        "bake to vertices, or to a UV map of your own.") from error
    return xatlas


def _pieces(positions: NDArray, triangles: NDArray, polygons: NDArray) -> list[NDArray[np.int64]]:
    """Triangles in groups of about PIECE that are near in space; none cuts a polygon."""
    starts = np.flatnonzero(np.concatenate([[True], np.diff(polygons) != 0]))
    centres = positions[triangles].mean(1)[starts]
    order = morton_order(centres)
    sizes = np.diff(np.concatenate([starts, [len(triangles)]]))[order]
    number = (np.cumsum(sizes) - 1) // PIECE
    piece_of_polygon = np.empty(len(starts), np.int64)
    piece_of_polygon[order] = number
    piece = np.repeat(piece_of_polygon, np.diff(np.concatenate([starts, [len(triangles)]])))
    by_piece = np.argsort(piece, kind="stable")
    return np.split(by_piece, np.flatnonzero(np.diff(piece[by_piece])) + 1)


def _chart(xatlas, positions: NDArray, triangles: NDArray, normals: NDArray) -> tuple[NDArray, NDArray[np.int64]]:
    """UVs (f, 3, 2) of some triangles in metres, from charts of theirs alone, and the number (f,) of their chart."""
    keys = np.concatenate([triangles.reshape(-1, 1), np.rint(1000 * normals.reshape(-1, 3)).astype(np.int64)], 1)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    vertices = positions[triangles.ravel()[first]]
    size = float(np.ptp(vertices, axis=0).max()) or 1.0  # xatlas's tolerances are absolute
    atlas = xatlas.Atlas()
    atlas.add_mesh(((vertices - vertices.min(0)) / size).astype(np.float32), index.reshape(-1, 3).astype(np.uint32),
                   normals.reshape(-1, 3)[first].astype(np.float32))
    pack = xatlas.PackOptions()
    pack.resolution, pack.bilinear, pack.rotate_charts = _DRAFT_RESOLUTION, False, False
    atlas.generate(xatlas.ChartOptions(), pack)
    _, indices, uv = atlas.get_mesh(0)
    flat = (uv * np.array([atlas.width, atlas.height]))[indices].astype(np.float64)
    points = positions[triangles]
    charts = np.zeros(len(triangles), np.int64)  # 0: of none, as it has no area
    for number in range(atlas.get_mesh_chart_count(0)):
        faces = np.asarray(atlas.get_mesh_chart(0, number).faces)
        flat[faces] *= _metres(points[faces], flat[faces])
        charts[faces] = number + 1
    flat[charts == 0] = 0
    return flat, charts


def _area(uv: NDArray) -> float:
    """Area of triangles (f, 3, 2)."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return 0.5 * float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())


def _metres(points: NDArray, flat: NDArray) -> NDArray[np.float64]:
    """(2,) metres per unit of u and of v of a chart: xatlas rounds the size of its charts to whole texels.

    Median over the area of how far a point of the mesh moves with u, and with v: slivers that collapsed
    would outweigh a mean.
    """
    e, f = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    (a, b), (c, d) = (flat[:, 1] - flat[:, 0]).T, (flat[:, 2] - flat[:, 0]).T
    det = a * d - b * c
    weight = np.linalg.norm(np.cross(e, f), axis=1)
    good = (np.abs(det) > _FLAT) & (weight > 0)
    if not good.any():
        return np.ones(2)
    e, f, a, b, c, d, det, weight = e[good], f[good], a[good], b[good], c[good], d[good], det[good], weight[good]
    along_u = (d[:, None] * e - b[:, None] * f) / det[:, None]
    along_v = (a[:, None] * f - c[:, None] * e) / det[:, None]
    return np.array([_median(np.linalg.norm(along, axis=1), weight) for along in (along_u, along_v)])


def _median(values: NDArray, weights: NDArray) -> float:
    """Weighted median of values (n,)."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def _apart(local: NDArray, charts: NDArray[np.int64], points: NDArray, corners: NDArray, polygons: NDArray
           ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """UVs and charts as `_chart` found them, but for polygons that these do not suit: each of those is a chart.

    Args:
        local: (f, 3, 2) UVs of triangles, metres. charts: (f,). points: (f, 3, 3) of their corners.
        corners: (f, 3) face corners. polygons: (f,).
    Returns:
        UVs, charts, and which triangles (f,) are of such polygons.
    """
    corners = np.unique(corners, return_inverse=True)[1].reshape(-1, 3)
    polygons = np.unique(polygons, return_inverse=True)[1]
    alone = _torn(local, points, corners, polygons)
    rest = np.flatnonzero(~alone)
    alone |= np.isin(polygons, taken_out(polygons[rest[overlapping(local[rest], charts[rest])]]))
    if alone.any():
        local = local.copy()
        local[alone] = _laid_flat(points[alone], corners[alone], polygons[alone])
        charts = np.where(alone, charts.max() + 1 + polygons, charts)
    return local, charts, alone


def _torn(local: NDArray, points: NDArray, corners: NDArray, polygons: NDArray) -> NDArray[np.bool_]:
    """(f,) triangles of polygons that were collapsed, or cut by a seam between their triangles."""
    bad = _collapsed(local, points)
    one = np.zeros((int(corners.max()) + 1, 2))
    one[corners] = local  # any one triangle's, to compare the others with
    grain = 1e-6 * float(np.abs(local).max(initial=0.0)) + 1e-300
    bad |= np.any(np.abs(one[corners] - local) > grain, axis=(1, 2))
    return np.isin(polygons, polygons[bad])


def _collapsed(local: NDArray, points: NDArray) -> NDArray[np.bool_]:
    """(f,) triangles (f, 3, 3) that have an area, but none in UVs (f, 3, 2)."""
    area = 0.5 * np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1)
    a, b = local[:, 1] - local[:, 0], local[:, 2] - local[:, 0]
    flat = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return (area > 0) & ~(flat > _FLAT * area)


def _laid_flat(points: NDArray, corners: NDArray, polygons: NDArray) -> NDArray[np.float64]:
    """(f, 3, 2) UVs in metres of triangles (f, 3, 3): each polygon projected on its mean plane.

    Where that folds it, its corners (f, 3) go on a circle instead: there no triangles lie over each other.
    """
    face = np.unique(polygons, return_inverse=True)[1]
    cross = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    normal = unit(np.stack([np.bincount(face, cross[:, axis]) for axis in range(3)], 1))
    first = unit(np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)]))
    axes = np.stack([first, np.cross(normal, first)], 1)[face]       # (f, 2, 3)
    flat: NDArray[np.float64] = np.einsum("fcx,fax->fca", points - points.reshape(-1, 3).mean(0), axes)
    folded = np.isin(face, np.concatenate([face[overlapping(flat, face)[:, 0]], face[_collapsed(flat, points)]]))
    if folded.any():
        flat[folded] = _on_circle(np.linalg.norm(cross[folded], axis=1) / 2, corners[folded], face[folded])
    return flat


def _on_circle(areas: NDArray, corners: NDArray, polygons: NDArray) -> NDArray[np.float64]:
    """(f, 3, 2) UVs in metres of triangles: the corners (f, 3) of each polygon evenly on a circle.

    Args:
        areas: (f,) of the triangles; a polygon has as much as its own together.
    """
    _, face = np.unique(polygons, return_inverse=True)
    _, first, corner = np.unique(corners, return_index=True, return_inverse=True)
    owner = face[first // 3]                                # of each corner; they rise around a polygon
    count = np.bincount(owner)
    order = np.argsort(owner, kind="stable")
    rank = np.empty(len(owner), np.int64)
    rank[order] = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    angle = 2 * np.pi * rank / count[owner]
    radius = np.sqrt(2 * np.bincount(face, areas) / (count * np.sin(2 * np.pi / count)))[owner]
    places: NDArray[np.float64] = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    return places[corner.reshape(-1, 3)]
