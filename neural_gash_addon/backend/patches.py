# SPDX-License-Identifier: GPL-3.0-or-later
"""Surfaces cut into patches of about equal size, on which light that bounces is taken to be constant.

A triangle is cut into n x n equal ones, so the patch that a ray meets follows from the triangle and
the barycentric coordinates by arithmetic; where triangles are smaller than patches should be,
neighbouring ones that face alike make one patch.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .estimator import morton_order
from .pictures import PLACES, Picture
from .raycast import Geometry, Hits

_MOST_CUTS = 256  # of a triangle's edge


class Patches:
    """M patches, each with a front and a back."""

    def __init__(self, parts: Sequence[Geometry], budget: int) -> None:
        """Cut `parts` (positions (V, 3), triangles (F, 3)) into about `budget` patches."""
        self.corners = np.concatenate([np.asarray(p, np.float64)[t] for p, t in parts])  # (F, 3, 3)
        normals = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        double = np.linalg.norm(normals, axis=1)
        self.areas = 0.5 * double                                                        # (F,)
        self.normals = normals / np.maximum(double, 1e-300)[:, None]                     # (F, 3) of the fronts
        size = (self.areas.sum() / max(budget, 1)) ** 0.5
        edges = np.linalg.norm(self.corners - np.roll(self.corners, -1, 1), axis=2).max(1)
        cuts = np.clip(np.ceil(edges / max(2.0 * size, 1e-300)), 1, _MOST_CUTS)
        self._cuts = np.where(self.areas > 0, cuts, 1).astype(np.int64)                  # (F,)
        self._start = np.concatenate([[0], np.cumsum(self._cuts ** 2)])                  # (F + 1,) of its pieces
        self.faces = np.repeat(np.arange(len(self._cuts)), self._cuts ** 2)              # (pieces,)
        self._patch = self._grouped(budget)                                              # (pieces,)
        self.count = int(self._patch.max()) + 1 if len(self._patch) else 0

    def _grouped(self, budget: int) -> NDArray[np.int64]:
        """The patch of each piece: pieces of whole triangles are joined until there are few enough."""
        patch = np.arange(len(self.faces))
        whole = np.flatnonzero(self._cuts[self.faces] == 1)
        share = -(-len(whole) // max(budget, 1))
        if share <= 1:
            return patch
        faces = self.faces[whole]
        octant = (self.normals[faces] > 0) @ [1, 2, 4]
        order = morton_order(self.corners[faces].mean(1))
        order = order[np.argsort(octant[order], kind="stable")]
        sorted_octants = octant[order]
        within = np.arange(len(order)) - np.searchsorted(sorted_octants, sorted_octants)
        new = np.concatenate([[True], (within[1:] % share == 0)])
        joined = np.empty(len(whole), np.int64)
        joined[order] = np.cumsum(new) - 1
        patch[whole] = len(patch) + joined
        joined_patches: NDArray[np.int64] = np.unique(patch, return_inverse=True)[1]
        return joined_patches

    @property
    def patch_areas(self) -> NDArray[np.float64]:
        """(M,)."""
        piece = self.areas[self.faces] / self._cuts[self.faces] ** 2
        return np.bincount(self._patch, piece, self.count).astype(np.float64)

    def of_hits(self, hits: Hits) -> NDArray[np.int64]:
        """(h,) patch and side that rays met: 2 * patch, plus 1 for its back."""
        n = self._cuts[hits.faces]
        i, a = _cell(hits.u, n)
        j, b = _cell(hits.v, n)
        upper = (a + b > 1) & (i + j < n - 1)
        piece = self._start[hits.faces] + np.clip(i * (2 * n - i) + 2 * j + upper, 0, n * n - 1)
        return 2 * self._patch[piece] + ~hits.front

    def mean(self, values: NDArray, pictures: Sequence[Picture] = ()) -> NDArray[np.float64]:
        """Of values (F, C) of the triangles, the mean over each patch (M, C); where triangles are cut, of pictures."""
        of_pieces = np.asarray(values, np.float64)[self.faces]
        for picture in pictures:
            row = np.full(len(self._cuts), -1)
            row[picture.triangles] = np.arange(len(picture.triangles))
            pieces = np.flatnonzero((row[self.faces] >= 0) & (self._cuts[self.faces] > 1))
            known = picture.columns < of_pieces.shape[1]
            u, v = self._within(np.repeat(pieces, len(PLACES)), *np.tile(PLACES[:, 1:], (len(pieces), 1)).T)
            found = picture.at(np.repeat(row[self.faces[pieces]], len(PLACES)), np.stack([1 - u - v, u, v], 1))
            found = found.reshape(len(pieces), len(PLACES), found.shape[1]).mean(1)
            of_pieces[pieces[:, None], picture.columns[known]] = found[:, known]
        weight = np.maximum(self.areas[self.faces] / self._cuts[self.faces] ** 2, 1e-300)
        total = np.bincount(self._patch, weight, self.count)[:, None]
        return np.stack([np.bincount(self._patch, weight * column, self.count) for column in of_pieces.T], 1) / total

    def _within(self, piece: NDArray[np.int64], a: NDArray, b: NDArray) -> tuple[NDArray, NDArray]:
        """Barycentric coordinates u, v in its triangle of those in a piece, a and b."""
        face = self.faces[piece]
        n, t = self._cuts[face], piece - self._start[face]
        i = n - np.ceil(np.sqrt(n * n - t)).astype(np.int64)
        j, upper = np.divmod(t - i * (2 * n - i), 2)
        return np.where(upper, i + 1 - a, i + a) / n, np.where(upper, j + 1 - b, j + b) / n

    def sample(self, sides: NDArray[np.int64], rays: int, rng: np.random.Generator
               ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Points spread over some sides (2 * patch + back): (n, rays, 3), their normals, and the way inwards."""
        order = np.argsort(self._patch, kind="stable")
        piece_area = np.maximum(self.areas[self.faces] / self._cuts[self.faces] ** 2, 1e-300)[order]
        total = np.concatenate([[0.0], np.cumsum(piece_area)])
        first = np.searchsorted(self._patch[order], np.arange(self.count + 1))
        patches = sides // 2
        low, high = total[first[patches]], total[first[patches + 1]]
        place = (np.arange(rays) + rng.uniform(size=(len(sides), rays))) / rays  # stratified over the area
        at = np.searchsorted(total, low[:, None] + place * (high - low)[:, None], side="right") - 1
        piece = order[np.clip(at, first[patches][:, None], first[patches + 1][:, None] - 1)]
        face = self.faces[piece]
        a, b = rng.uniform(size=(2, *face.shape))
        u, v = self._within(piece, *np.where(a + b > 1, [1 - a, 1 - b], [a, b]))
        corners = self.corners[face]
        points = (corners[..., 0, :] * (1 - u - v)[..., None] + corners[..., 1, :] * u[..., None]
                  + corners[..., 2, :] * v[..., None])
        normals = self.normals[face] * np.where(sides % 2 == 0, 1.0, -1.0)[:, None, None]
        return points, normals, corners.mean(-2) - points


def _cell(x: NDArray, n: NDArray) -> tuple[NDArray, NDArray]:
    """Which of n equal cells of 0..1 a number is in, and how far along it."""
    scaled = np.clip(x.astype(np.float64), 0, 1) * n
    cell = np.minimum(scaled.astype(np.int64), n - 1)
    return cell, scaled - cell
