# SPDX-License-Identifier: GPL-3.0-or-later
"""The k nearest other points of each of N, exactly, in about N log N whatever their density.

A balanced tree of boxes, halved along their longest side (Friedman, Bentley & Finkel 1977, "An algorithm for finding
best matches in logarithmic expected time"), all leaves of one size, so that each step is one of whole arrays. A
point's k-th neighbour within its own leaf is at least as far as its k-th of all; whatever box is nearer than that is
searched. A grid of cells would be simpler, but meshes have a detailed part on a large ground, and there its cells
hold too many points or none.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_POINTS = 1024  # searched at a time: what is compared with them stays in the cache

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


def nearest(points: NDArray, k: int) -> Indices:
    """The nearest others of N points, nearest first; of those equally far, the lower index first.

    Args:
        points: (N, 3), finite, of any size and place, no two the same.
        k: 1 or more.
    Returns:
        (N, min(k, N - 1)) int64.
    """
    count = len(points)
    k = min(k, count - 1)
    if k < 1:
        return np.empty((count, 0), dtype=np.int64)
    # by a power of two, which is exact: squares of distances neither overflow nor vanish
    _, exponent = np.frexp(np.abs(points).max())
    scaled = np.ldexp(np.asarray(points, dtype=np.float64), -exponent)
    # a leaf of 2 (k + 1) or more, half of which may be copies, has k other points
    depth = max(int(np.ceil(np.log2(count / (4 * (k + 1))))), 0)
    order = _leaves(scaled, depth)
    # points that fill the last slots of leaves are copies, and are never found
    copy = order >= count
    order[copy] -= count
    return _search(scaled, order, copy, k)


def _leaves(points: Floats, depth: int) -> Indices:
    """(2**depth, M) indices of points, halved `depth` times. Those of N and above are copies of those N below."""
    size = -(-len(points) // 2 ** depth)
    order = np.arange(size * 2 ** depth)[None]
    filled = np.concatenate([points, points[:order.size - len(points)]])
    for _ in range(depth):
        inside = filled[order]
        axis = (inside.max(1) - inside.min(1)).argmax(1)
        along = np.take_along_axis(inside, axis[:, None, None], 2)[..., 0]
        half = order.shape[1] // 2
        order = np.take_along_axis(order, np.argpartition(along, half, axis=1), 1).reshape(-1, half)
    return order


def _search(points: Floats, order: Indices, copy: NDArray[np.bool_], k: int) -> Indices:
    """The neighbours of all points, a block of leaves at a time."""
    places = [np.ascontiguousarray(points[:, axis])[order] for axis in range(3)]
    low, high = [np.stack([p.min(1) for p in places])], [np.stack([p.max(1) for p in places])]
    while low[-1].shape[1] > 1:  # from the leaves to the root, (3, boxes)
        low.append(low[-1].reshape(3, -1, 2).min(2))
        high.append(high[-1].reshape(3, -1, 2).max(2))
    out = np.empty((len(points), k), dtype=np.int64)
    step = max(_POINTS // order.shape[1], 1)
    for start in range(0, len(order), step):
        leaves = np.arange(start, min(start + step, len(order)))
        reach = _within(places, order, copy, leaves, k)  # (L, M) squared
        one, box = _near_boxes(low, high, leaves, reach.max(1))
        here = [p[leaves][one] for p in places]
        gap = _square(*(_gap(p, p, low[0][axis, box, None], high[0][axis, box, None])
                        for axis, p in enumerate(here)))
        pair, member = np.nonzero((gap <= reach[one]) & ~copy[leaves][one])
        box, query = box[pair], order[leaves][one[pair], member]
        square = _square(*(there[box] - mine[pair, member, None] for there, mine in zip(places, here, strict=True)))
        row, slot = np.nonzero((square <= reach[one[pair], member][:, None]) & ~copy[box])
        found, asked = order[box[row], slot], query[row]
        other = found != asked
        found, asked, square = found[other], asked[other], square[row[other], slot[other]]
        rank = np.lexsort((found, square, asked))
        found, asked = found[rank], asked[rank]
        begins = np.flatnonzero(np.concatenate([[True], asked[1:] != asked[:-1]]))
        out[asked[begins]] = found[begins[:, None] + np.arange(k)]
    return out


def _within(places: list[Floats], order: Indices, copy: NDArray[np.bool_], leaves: Indices, k: int) -> Floats:
    """Squared distance of each point of some leaves to the k-th other one in its leaf: (L, M)."""
    square = _square(*(p[leaves][:, :, None] - p[leaves][:, None, :] for p in places))
    same = order[leaves][:, :, None] == order[leaves][:, None, :]
    again = copy[leaves] & (same.sum(2) > 1)  # the copy's original is in this leaf, too
    square[same | again[:, None, :]] = np.inf
    square.partition(k - 1, axis=2)
    return square[..., k - 1]


def _near_boxes(low: list[Floats], high: list[Floats], leaves: Indices, reach: Floats) -> tuple[Indices, Indices]:
    """Pairs (number of a leaf among `leaves`, box of a leaf) no farther apart than reach (L,), squared."""
    one, box = np.arange(len(leaves)), np.zeros(len(leaves), dtype=np.int64)
    for lower, upper in zip(low[-2::-1], high[-2::-1], strict=True):
        one, box = np.tile(one, 2), np.concatenate([2 * box, 2 * box + 1])
        mine = leaves[one]
        gap = _square(*(_gap(low[0][axis, mine], high[0][axis, mine], lower[axis, box], upper[axis, box])
                        for axis in range(3)))
        near = gap <= reach[one]
        one, box = one[near], box[near]
    return one, box


def _gap(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> Floats:
    """Between intervals; 0 where they meet. Rounded as differences of points are, so never above those."""
    return np.maximum(np.maximum(other_low - high, low - other_high), 0)


def _square(x: Floats, y: Floats, z: Floats) -> Floats:
    """Squared length, always summed in this order: what is compared is rounded alike."""
    return x * x + y * y + z * z
