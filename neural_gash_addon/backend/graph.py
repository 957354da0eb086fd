# SPDX-License-Identifier: GPL-3.0-or-later
"""The graph that the paper's networks pass messages along: nearest neighbours joined with the mesh's edges."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .neighbours import Neighbours

NEAREST = 8
_CROWD = 8             # places in a cell, at most, where most places are
_MOST_CELLS = 1 << 20  # along an axis
_ROOM = 1 << 21        # distances at a time


@dataclass(frozen=True, eq=False)
class Graph:
    """Edges by target: those of vertex i come from source[start[i]:start[i + 1]]; none twice, none to itself."""

    start: NDArray[np.int64]   # (N + 1,)
    source: NDArray[np.int64]  # (E,)


def graph(points: NDArray, links: Neighbours, k: int = NEAREST) -> Graph:
    """Join each point with its k nearest other places and with its neighbours on the mesh.

    Points in one place count as one for the search; each is joined with the first of them.

    Args:
        points: (N, 3) finite. links: of the same points.
    """
    count = len(points)
    places, first, of_point = np.unique(points, axis=0, return_index=True, return_inverse=True)
    of_point = of_point.reshape(-1)
    near = first[nearest(places, k)]
    every = np.arange(count)
    on_mesh = np.repeat(every, np.diff(links.start))
    source = np.concatenate([near[of_point].ravel(), first[of_point], links.points, on_mesh])
    target = np.concatenate([np.repeat(every, near.shape[1]), every, on_mesh, links.points])
    keys = np.unique((target * count + source)[target != source])
    return Graph(np.searchsorted(keys, np.arange(count + 1) * count), keys % count)


def nearest(places: NDArray, k: int) -> NDArray[np.int64]:
    """The k nearest others of distinct places (N, 3), or all where there are fewer: (N, min(k, N - 1)), nearest first.

    Exact. Places are sorted into cubic cells; whose neighbours do not all lie in the cells around it is tried again
    with cells twice as large: time grows about linearly, however places are spread.
    """
    count = len(places)
    k = min(k, count - 1)
    out = np.empty((count, max(k, 0)), np.int64)
    if k <= 0:
        return out
    low = places.min(0)
    extent = float((places.max(0) - low).max())
    size = extent / count ** 0.5
    while _crowd(places, low, size) > _CROWD and extent / size < _MOST_CELLS / 2:
        size /= 2
    left = np.arange(count)
    while len(left):
        grid = _Grid(places, low, size)
        left = _filled(grid, left, k, out, size > extent)
        size *= 2
    return out


def _crowd(places: NDArray, low: NDArray, size: float) -> float:
    """How many places share a cell, where most of them are."""
    _, counts = np.unique(_Grid(places, low, size).keys, return_counts=True)
    return float(np.repeat(counts, counts)[int(0.9 * len(places))]) if counts.max() > _CROWD else 0.0


class _Grid:
    """Places sorted by cell."""

    def __init__(self, places: NDArray, low: NDArray, size: float) -> None:
        cells = np.floor((places - low) / size).astype(np.int64) + 1
        self.shape = cells.max(0) + 2
        keys = (cells[:, 0] * self.shape[1] + cells[:, 1]) * self.shape[2] + cells[:, 2]
        self.order = np.argsort(keys, kind="stable")
        self.keys, self.key_of = keys[self.order], keys
        self.places, self.size = places, size

    def around(self, queries: NDArray) -> tuple[NDArray, NDArray]:
        """Where the places of 27 cells around (n,) queries begin and end in `order`: (n, 9) runs of three cells."""
        steps = np.array([dx * self.shape[1] + dy for dx in (-1, 0, 1) for dy in (-1, 0, 1)]) * self.shape[2]
        middle = self.key_of[queries, None] + steps
        return np.searchsorted(self.keys, middle - 1), np.searchsorted(self.keys, middle + 1, side="right")


def _filled(grid: _Grid, left: NDArray, k: int, out: NDArray[np.int64], all_of_them: bool) -> NDArray[np.int64]:
    """Fill rows of `out` whose neighbours are surely among those found; the indices of the others."""
    begin, end = grid.around(left)
    totals = (end - begin).sum(1)
    enough = totals > k
    rest = [left[~enough]]
    order = np.flatnonzero(enough)[np.argsort(totals[enough], kind="stable")]  # so that rows of a part are as long
    at = 0
    while at < len(order):
        step = max(1, int(_ROOM // totals[order[min(at + 4096, len(order) - 1)]]))
        rows = order[at:at + min(step, 4096)]
        at += len(rows)
        queries, lengths = left[rows], (end - begin)[rows].ravel()
        of_run = np.repeat(np.arange(len(lengths)), lengths)
        number = np.arange(len(of_run)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        found = grid.order[begin[rows].ravel()[of_run] + number]
        row = of_run // 9
        column = np.arange(len(row)) - np.repeat(np.cumsum(totals[rows]) - totals[rows], totals[rows])
        away = np.square(grid.places[found] - grid.places[queries][row]).sum(1)
        away[found == queries[row]] = np.inf
        table = np.full((len(rows), int(totals[rows].max())), np.inf)
        which = np.zeros(table.shape, np.int64)
        table[row, column], which[row, column] = away, found
        best = np.argpartition(table, k - 1, axis=1)[:, :k]
        distance = np.take_along_axis(table, best, 1)
        by_distance = np.argsort(distance, axis=1, kind="stable")
        sure = all_of_them | (distance.max(1) <= grid.size ** 2)
        best = np.take_along_axis(np.take_along_axis(which, best, 1), by_distance, 1)
        out[queries[sure]] = best[sure]
        rest.append(queries[~sure])
    return np.concatenate(rest)
