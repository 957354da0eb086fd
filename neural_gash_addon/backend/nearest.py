# SPDX-License-Identifier: GPL-3.0-or-later
"""The k nearest of N points to each of Q places, exactly, in about (N + Q) log N whatever their density.

Balanced trees of boxes, halved along their longest side (Friedman, Bentley & Finkel 1977, "An algorithm for finding
best matches in logarithmic expected time"), all leaves of one size, so that each step is one of whole arrays. The
places are gathered in leaves of their own. Each place is in the part of space of some leaf of points; its k-th nearest
of these is at least as far as its k-th of all; whatever box is nearer than that is searched. A grid of cells would be
simpler, but meshes have a detailed part on a large ground, and there its cells hold too many points or none.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_POINTS = 1024  # searched at a time: what is compared with them stays in the cache
_TIE = 2.0 ** -20  # of the second longest side, which parts points that are level along the longest
_LEAF = 16      # places of a leaf, at least half of it: of few, the boxes are small

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
    found = nearest_to(points, points, k + 1)
    itself = found == np.arange(len(points))[:, None]
    itself[~itself.any(1), -1] = True  # lost among others so near that the squares vanish
    return found[~itself].reshape(len(points), found.shape[1] - 1)


def nearest_to(places: NDArray, points: NDArray, k: int) -> Indices:
    """The nearest of N points to each place, nearest first; of those equally far, the lower index first.

    Args:
        places: (Q, 3). points: (N, 3), N >= 1, which may coincide. All finite, of any size and place.
        k: 1 or more.
    Returns:
        (Q, min(k, N)) int64.
    """
    k = min(k, len(points))
    if not len(places):
        return np.empty((0, k), dtype=np.int64)
    # by a power of two, which is exact: squares of distances neither overflow nor vanish
    _, exponent = np.frexp(max(np.abs(points).max(), np.abs(places).max()))
    of_points = _Tree(np.ldexp(np.asarray(points, dtype=np.float64), -exponent), k)
    return _search(_Tree(np.ldexp(np.asarray(places, dtype=np.float64), -exponent), _LEAF // 2), of_points, k)


class _Tree:
    """Points in 2**depth leaves of one size, each with `least` or more of them (all, where there are fewer)."""

    def __init__(self, points: Floats, least: int) -> None:
        self.count = len(points)
        # half of a leaf of twice that may be copies
        depth = max(int(np.ceil(np.log2(len(points) / (4 * least)))), 0)
        self.order, self.splits = _leaves(points, depth)  # (leaves, M)
        # points that fill the last slots of leaves are copies, and are never found
        self.copy = self.order >= len(points)
        self.order[self.copy] -= len(points)
        self.places = [np.ascontiguousarray(points[:, axis])[self.order] for axis in range(3)]
        self.low = [np.stack([p.min(1) for p in self.places])]          # from the leaves to the root, (3, boxes)
        self.high = [np.stack([p.max(1) for p in self.places])]
        while self.low[-1].shape[1] > 1:
            self.low.append(self.low[-1].reshape(3, -1, 2).min(2))
            self.high.append(self.high[-1].reshape(3, -1, 2).max(2))


def _leaves(points: Floats, depth: int) -> tuple[Indices, list[tuple[Indices, Indices, Floats]]]:
    """(2**depth, M) indices of points, halved `depth` times. Those of N and above are copies of those N below.

    And of each step, for each box: its longest side, the next one, and the `_key` at which the upper half begins.
    """
    size = -(-len(points) // 2 ** depth)
    order, splits = np.arange(size * 2 ** depth)[None], []
    filled = np.concatenate([points, points[:order.size - len(points)]])
    for _ in range(depth):
        inside = filled[order]
        next_, axis = (inside.max(1) - inside.min(1)).argsort(1)[:, 1:].T
        key = _key(*(np.take_along_axis(inside, each[:, None, None], 2)[..., 0] for each in (axis, next_)))
        half = order.shape[1] // 2
        parted = np.argpartition(key, half, axis=1)
        splits.append((axis, next_, np.take_along_axis(key, parted[:, half:half + 1], 1)[:, 0]))
        order = np.take_along_axis(order, parted, 1).reshape(-1, half)
    return order, splits


def _key(along: Floats, across: Floats) -> Floats:
    """What points are halved by. Walls and floors have many level points, which must not be on both sides all over."""
    return along + _TIE * across


def _search(asking: _Tree, tree: _Tree, k: int) -> Indices:
    """The nearest to all places, a block of their leaves at a time."""
    out = np.empty((asking.count, k), dtype=np.int64)
    home = _home(asking, tree)
    step = max(_POINTS // asking.order.shape[1], 1)
    for start in range(0, len(home), step):
        leaves = slice(start, start + step)
        here = [p[leaves] for p in asking.places]  # (L, m)
        reach = _within(here, tree, home[leaves], k)
        low, high = asking.low[0][:, leaves], asking.high[0][:, leaves]
        one, box = _near_boxes(low, high, tree, reach.max(1))
        gap = _square(*(_gap(p[one], p[one], tree.low[0][axis, box, None], tree.high[0][axis, box, None])
                        for axis, p in enumerate(here)))
        pair, member = np.nonzero((gap <= reach[one]) & ~asking.copy[leaves][one])
        one, box = one[pair], box[pair]
        square = _square(*(there[box] - mine[one, member, None] for there, mine in zip(tree.places, here, strict=True)))
        row, slot = np.nonzero((square <= reach[one, member][:, None]) & ~tree.copy[box])
        found, asked = tree.order[box[row], slot], asking.order[leaves][one[row], member[row]]
        rank = np.lexsort((found, square[row, slot], asked))
        found, asked = found[rank], asked[rank]
        begins = np.flatnonzero(np.concatenate([[True], asked[1:] != asked[:-1]]))
        out[asked[begins]] = found[begins[:, None] + np.arange(k)]
    return out


def _home(asking: _Tree, tree: _Tree) -> Indices:
    """The leaf of points in whose part of space each place is: (leaves of places, m)."""
    places = np.stack(asking.places)
    box = np.zeros(places.shape[1:], dtype=np.int64)
    row, member = np.indices(box.shape)
    for axis, next_, at in tree.splits:
        key = _key(places[axis[box], row, member], places[next_[box], row, member])
        box = 2 * box + (key >= at[box])
    return box


def _within(here: list[Floats], tree: _Tree, home: Indices, k: int) -> Floats:
    """Squared distance of each place of some leaves to the k-th point in the leaf that is its home: (L, m)."""
    square = _square(*(mine[:, :, None] - there[home] for mine, there in zip(here, tree.places, strict=True)))
    square[tree.copy[home]] = np.inf
    square.partition(k - 1, axis=2)
    return square[..., k - 1]


def _near_boxes(low: Floats, high: Floats, tree: _Tree, reach: Floats) -> tuple[Indices, Indices]:
    """Pairs (number of a box low..high (3, L), leaf of the tree) no farther apart than reach (L,), squared."""
    one, box = np.arange(len(reach)), np.zeros(len(reach), dtype=np.int64)
    for lower, upper in zip(tree.low[-2::-1], tree.high[-2::-1], strict=True):
        one, box = np.tile(one, 2), np.concatenate([2 * box, 2 * box + 1])
        gap = _square(*_gap(low[:, one], high[:, one], lower[:, box], upper[:, box]))
        near = gap <= reach[one]
        one, box = one[near], box[near]
    return one, box


def _gap(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> Floats:
    """Between intervals; 0 where they meet. Rounded as differences of points are, so never above those."""
    return np.maximum(np.maximum(other_low - high, low - other_high), 0)


def _square(x: Floats, y: Floats, z: Floats) -> Floats:
    """Squared length, always summed in this order: what is compared is rounded alike."""
    return x * x + y * y + z * z
