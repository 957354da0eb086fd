# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangles that lie over each other in a chart, found exactly: whatever texture it is placed in, it is free of them.

Looking at the texels of one texture instead misses the small overlaps between their centres, and another
scale or angle brings those up.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .raster import expand, pieces

# of a chart's extent by which triangles may reach into each other: more than the 32-bit numbers of xatlas and of a UV
# map are off, and less than `Layout.overlapping` sees at any side
_TOUCH = 1e-6


def overlapping(local: NDArray[np.float64], charts: NDArray[np.int64]) -> NDArray[np.int64]:
    """(m, 2) pairs of triangles of the same chart that lie over each other, each pair once.

    Two do unless a line along an edge of theirs separates them.

    Args:
        local: (f, 3, 2) of each triangle's corners. charts: (f,) number of its chart.
    """
    if not len(local):
        return np.zeros((0, 2), np.int64)
    order = np.lexsort((local[..., 0].min(1), charts))
    local = local[order]
    low, high = local.min(1), local.max(1)
    starts = np.flatnonzero(np.diff(charts[order], prepend=-1))
    sizes = np.diff(starts, append=len(order))
    extent = (np.maximum.reduceat(high, starts) - np.minimum.reduceat(low, starts)).max(1)
    touch = _TOUCH * np.repeat(extent, sizes)
    # each chart has a range of x to itself, so that one search serves all
    shift = np.repeat(np.arange(len(starts)), sizes) * 2 * np.ptp(local[..., 0])
    ends = np.searchsorted(low[:, 0] + shift, high[:, 0] + shift - touch)
    counts = np.maximum(ends - np.arange(len(order)) - 1, 0)
    found = [np.zeros((0, 2), np.int64)]
    for piece in pieces(counts):
        first, step = expand(counts[piece])
        first += piece.start
        second = first + 1 + step
        meet = np.minimum(high[first, 1], high[second, 1]) - np.maximum(low[first, 1], low[second, 1]) > touch[first]
        first, second = first[meet], second[meet]
        for side in range(6):
            a, b = (first, second) if side < 3 else (second, first)
            start, end, opposite = (local[a, (side + corner) % 3] for corner in range(3))
            edge = end - start
            own = _cross(edge, opposite - start)  # from the edge's line, times its length; 0 at the other two corners
            other = _cross(edge[:, None], local[b] - start[:, None])
            depth = np.minimum(np.maximum(own, 0), other.max(1)) - np.maximum(np.minimum(own, 0), other.min(1))
            through = depth > touch[first] * np.linalg.norm(edge, axis=1)
            first, second = first[through], second[through]
        found.append(np.sort(order[np.stack([first, second], 1)], axis=1))
    return np.concatenate(found)


def taken_out(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Few numbers that are in all of some pairs (m, 2) between them: time and again that which is in the most."""
    out = np.unique(pairs[pairs[:, 0] == pairs[:, 1], 0]).tolist()
    pairs = np.unique(np.sort(pairs[~np.isin(pairs, out).any(1)], axis=1), axis=0)
    while len(pairs):
        out.append(int(np.bincount(pairs.ravel()).argmax()))
        pairs = pairs[(pairs != out[-1]).all(1)]
    return np.array(out, np.int64)


def _cross(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
