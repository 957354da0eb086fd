# SPDX-License-Identifier: GPL-3.0-or-later
"""Which point of the mesh each texel shows: exact scanline coverage in UV space, with a border.

Texel (i, j) of a texture with `side` texels a side is the square [i, i+1] x [j, j+1] after scaling
UVs by `side`; row 0 is at the bottom, as in Blender. A texel belongs to the triangle that holds its
centre. Texels around a chart whose centre is outside, but which a bilinear lookup inside the chart
reads, belong to the nearest point of its outline.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import UserError

CHECKED_SIDE = 1024   # at which overlaps are looked for: a finer look would find slivers that no one sees
_REACH = 2 ** 0.5     # texels: a bilinear lookup reads texels whose centre is less than 1 away in x and in y
_STEP = 0.5           # texels between the samples of an outline that find the texels beside it
_FARTHEST = 1.0       # barycentric coordinates of centres outside a sliver run away; normals must not
_TOUCH = 0.01         # texels from an edge, within which a centre is not taken for inside of two triangles
_PIECE = 1 << 20      # what is expanded at a time


@dataclass(frozen=True, eq=False)
class Coverage:
    """The n covered texels of a square texture, in rising order."""

    side: int
    texels: NDArray[np.int64]         # (n,) row * side + column
    faces: NDArray[np.int32]          # (n,) triangle
    barycentric: NDArray[np.float64]  # (n, 3) of the nearest point of the triangle to the texel's centre
    centres: NDArray[np.float64]      # (n, 3) of the centre itself: the same inside, beyond 0..1 in the border

    def only(self, rows: NDArray[np.int64]) -> Coverage:
        """Some of the texels, by rising row of these arrays."""
        return Coverage(self.side, self.texels[rows], self.faces[rows], self.barycentric[rows], self.centres[rows])


class Layout:
    """Triangles laid out in a square texture; tells what its texels cover, some rows at a time."""

    def __init__(self, uv: NDArray, triangles: NDArray, side: int) -> None:
        """Take triangles in.

        Args:
            uv: (F, 3, 2) of each triangle's corners, 0 to 1. triangles: (F, 3) their vertices, which
                tell where triangles are joined. side: texels a side.
        Raises:
            UserError: UVs that are not finite or outside 0 to 1.
        """
        check_range(uv)
        self.side = side
        self._corners = np.asarray(uv, dtype=np.float64) * side
        self._low, self._high = self._corners[..., 1].min(1), self._corners[..., 1].max(1)
        self._outline = _outline(uv, triangles)

    def coverage(self, start: int = 0, stop: int | None = None) -> Coverage:
        """What the texels of rows start..stop cover (all rows where not given)."""
        stop = self.side if stop is None else stop
        near = np.flatnonzero((self._high > start - _REACH) & (self._low < stop + _REACH))
        corners = self._corners[near]
        texels, faces = _centres_inside(corners, self.side, start, stop)
        order = np.lexsort((faces, texels))
        order = order[np.concatenate([[True], np.diff(texels[order]) > 0])] if len(order) else order
        texels, faces = texels[order], faces[order]  # where faces overlap, the first
        free = np.ones((stop - start) * self.side, bool)
        free[texels - start * self.side] = False
        here = np.zeros(len(self._corners), bool)
        here[near] = True
        outline = self._outline[here[self._outline // 3]]
        border, owners, nearest = _border(self._corners, outline, self.side, start, free)
        inside = _barycentric(corners, faces, _centre(texels, self.side))
        at_centre = _barycentric(self._corners, owners, _centre(border, self.side))
        # on the way from the nearest point to the centre, as far as a sliver allows
        away = at_centre - nearest
        reach = np.minimum(1, _FARTHEST / np.maximum(np.abs(away).max(1, initial=0), 1e-9))
        at_centre = nearest + away * reach[:, None]
        all_texels = np.concatenate([texels, border])
        order = np.argsort(all_texels, kind="stable")
        return Coverage(self.side, all_texels[order], np.concatenate([near[faces], owners])[order].astype(np.int32),
                        np.concatenate([inside, nearest])[order], np.concatenate([inside, at_centre])[order])

    def overlapping(self) -> NDArray[np.int64]:
        """(m, 2) pairs of triangles that hold the same texel's centre, each pair once.

        Not those that only touch: islands side by side in 32-bit UVs lie over each other by a rounding.
        """
        texels, faces = _centres_inside(self._corners, self.side, 0, self.side)
        order = np.lexsort((faces, texels))
        texels, faces = texels[order], faces[order]
        same = texels[1:] == texels[:-1]
        shared = np.flatnonzero(np.append(same, False) | np.append(False, same))
        deep = shared[_deep(self._corners, faces[shared], _centre(texels[shared], self.side))]
        texels, faces = texels[deep], faces[deep]
        again = np.flatnonzero(texels[1:] == texels[:-1])
        return np.unique(np.stack([faces[again], faces[again + 1]], 1), axis=0)


def check_range(uv: NDArray) -> None:
    """UserError for UVs that no texture without tiling can hold."""
    if not np.isfinite(uv).all():
        raise UserError("The UVs hold values that are infinite or not numbers.")
    beyond = np.any((uv < -1e-6) | (uv > 1 + 1e-6), axis=(1, 2))
    if beyond.any():
        raise UserError(f"{int(beyond.sum()):,} of {len(uv):,} triangles have UVs outside 0 to 1 (the first is "
                        f"triangle {int(beyond.argmax())}); a bake needs a place of its own for every face.")


def expand(counts: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For counts (n,): the owner of each of their sum's entries, and its number within the owner's."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)


def pieces(counts: NDArray[np.int64]):
    """Slices of `counts` whose sums are about _PIECE."""
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        before = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, before + _PIECE, side="right")))
        yield slice(start, stop)
        start = stop


def _centres_inside(corners: NDArray, side: int, start: int, stop: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(texel, triangle) of every texel centre of rows start..stop in every triangle.

    Half-open on every edge, and edges are cut from their lower end on both sides of them, so a
    centre on a shared edge is exactly one triangle's.
    """
    low, high = corners[..., 1].min(1), corners[..., 1].max(1)
    first_row = np.maximum(np.ceil(low - 0.5).astype(np.int64), start)
    rows = np.maximum(np.minimum(np.ceil(high - 0.5).astype(np.int64), stop) - first_row, 0)
    swap = (corners[:, :, 1] > np.roll(corners, -1, 1)[:, :, 1])[..., None]
    lower = np.where(swap, np.roll(corners, -1, 1), corners)   # (F, 3, 2) lower end of each edge
    upper = np.where(swap, corners, np.roll(corners, -1, 1))
    found_texels, found_faces = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for piece in pieces(rows):
        face, row = expand(rows[piece])
        face += piece.start
        row += first_row[face]
        y = row + 0.5
        cuts = np.full((len(face), 3), np.nan)
        for e in range(3):
            (x0, y0), (x1, y1) = lower[face, e].T, upper[face, e].T
            crosses = (y0 <= y) & (y < y1)
            slope = np.divide(x1 - x0, y1 - y0, out=np.zeros_like(x0), where=crosses)
            cuts[crosses, e] = (x0 + (y - y0) * slope)[crosses]
        left, right = np.nanmin(cuts, 1), np.nanmax(cuts, 1)
        column = np.maximum(np.ceil(left - 0.5).astype(np.int64), 0)
        count = np.maximum(np.minimum(np.ceil(right - 0.5).astype(np.int64), side) - column, 0)
        for part in pieces(count):
            span, step = expand(count[part])
            span += part.start
            found_texels.append(row[span] * side + column[span] + step)
            found_faces.append(face[span])
    return np.concatenate(found_texels), np.concatenate(found_faces)


def _outline(uv: NDArray, triangles: NDArray) -> NDArray[np.int64]:
    """(n,) 3 * triangle + edge of the edges that no second triangle shares in UV space."""
    keys = np.empty((len(uv) * 3, 3), np.float64)
    keys[:, 0] = np.asarray(triangles).ravel()
    keys[:, 1:] = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    order = np.lexsort(keys.T)
    differs = np.any(keys[order[1:]] != keys[order[:-1]], axis=1)
    corner = np.empty(len(keys), np.int64)
    corner[order] = np.concatenate([[0], np.cumsum(differs)])
    start = corner.reshape(-1, 3)
    end = np.roll(start, -1, 1)
    edge = (np.minimum(start, end) * len(keys) + np.maximum(start, end)).ravel()
    _, which, counts = np.unique(edge, return_inverse=True, return_counts=True)
    return np.flatnonzero(counts[which] == 1)


def _border(corners: NDArray, outline: NDArray[np.int64], side: int, start: int, free: NDArray[np.bool_]
            ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Free texels beside the outline: texel, triangle, barycentrics (n, 3) of the outline's nearest point.

    free: flags of the texels of some whole rows, from row `start` on.
    """
    rows = len(free) // side
    face, edge = outline // 3, outline % 3
    a, b = corners[face, edge], corners[face, (edge + 1) % 3]
    samples = np.ceil(np.abs(b - a).max(1, initial=0) / _STEP).astype(np.int64) + 1
    near = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(-1, 2)
    best = np.full(len(free), np.inf)
    texels: list[NDArray] = []
    owners, places, squared = list(texels), list(texels), list(texels)
    for piece in pieces(samples * 9):
        which, step = expand(samples[piece])
        which += piece.start
        share = step / np.maximum(samples[which] - 1, 1)
        cell = np.floor(a[which] + share[:, None] * (b - a)[which]).astype(np.int64)
        cell = (cell[:, None] + near).reshape(-1, 2)
        which = np.repeat(which, 9)
        column, row = cell[:, 0], cell[:, 1] - start
        texel = row * side + column
        keep = (column >= 0) & (column < side) & (row >= 0) & (row < rows)
        keep[keep] = free[texel[keep]]
        cell, which, texel = cell[keep], which[keep], texel[keep]
        along, centre = (b - a)[which], cell + 0.5
        length = np.maximum((along ** 2).sum(1), 1e-300)
        t = np.clip(((centre - a[which]) * along).sum(1) / length, 0, 1)
        away = centre - (a[which] + t[:, None] * along)
        distance = (away ** 2).sum(1)
        keep = (distance <= _REACH ** 2) & (distance <= best[texel])
        np.minimum.at(best, texel[keep], distance[keep])
        for store, values in ((texels, texel), (owners, which), (places, t), (squared, distance)):
            store.append(values[keep])
    if not texels:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))
    texel, owner, place, distance = (np.concatenate(s) for s in (texels, owners, places, squared))
    nearest = np.flatnonzero(distance == best[texel])
    _, first = np.unique(texel[nearest], return_index=True)
    chosen = nearest[first]
    weights = np.zeros((len(chosen), 3))
    each = np.arange(len(chosen))
    weights[each, edge[owner[chosen]]] = 1 - place[chosen]
    weights[each, (edge[owner[chosen]] + 1) % 3] = place[chosen]
    return texel[chosen] + start * side, face[owner[chosen]], weights


def _centre(texels: NDArray[np.int64], side: int) -> NDArray[np.float64]:
    return np.stack([texels % side, texels // side], 1) + 0.5


def _barycentric(corners: NDArray, faces: NDArray, points: NDArray) -> NDArray[np.float64]:
    """(n, 3) of points (n, 2) in some of the triangles (F, 3, 2); of one without area, those of its centre."""
    a, b, c = (corners[faces, corner] for corner in range(3))
    area = _cross(b - a, c - a)
    flat = area == 0
    area = np.where(flat, 1.0, area)
    out = np.stack([_cross(b - points, c - points) / area, _cross(c - points, a - points) / area,
                    np.zeros(len(points))], 1)
    out[:, 2] = 1 - out[:, 0] - out[:, 1]
    out[flat] = 1 / 3
    return out


def _deep(corners: NDArray, faces: NDArray, points: NDArray) -> NDArray[np.bool_]:
    """(n,) points (n, 2) inside some of the triangles (F, 3, 2) that are not at an edge of theirs."""
    out = np.ones(len(faces), bool)
    for corner in range(3):
        start, edge = corners[faces, corner], corners[faces, (corner + 1) % 3] - corners[faces, corner]
        out &= np.abs(_cross(edge, points - start)) > _TOUCH * np.linalg.norm(edge, axis=1)
    return out


def _cross(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
