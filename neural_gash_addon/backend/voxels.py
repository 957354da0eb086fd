# SPDX-License-Identifier: GPL-3.0-or-later
"""Surfaces pooled into a pyramid of voxels: how much area lies in each, and which way it faces.

Source: the pre-filtered voxels of Crassin et al. 2011, "Interactive Indirect Illumination Using Voxel Cone
Tracing", without octree: what cones (`cones`) read lies within a small box, so each level is a plain array of bits that
say where something is, and only those voxels are kept. (Fresh memory takes longer than what is done with it, on a small
mesh.)

Lengths are in units of the longest side of what is baked, from just below the low corner of its box.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .raycast import Geometry

FINEST = 192      # voxels of level 0 along the longest side of what is baked
_DENSITY = 1.5    # samples of a surface for each face of a voxel that it would cover
# of a voxel, from the low corner of what is baked to that of its first voxel: people build on round coordinates, and a
# wall that lay on a border of voxels would be on either side of it as floats are rounded
_SHIFT = 0.37
_GOLDEN = np.uint32(2654435769)  # the golden ratio's fraction, of 2**32
_WORD = 6         # bits of the index that count within a word
_PAIRS, _FOURS, _BYTES, _SUM = (np.uint64(int(8 * byte, 16)) for byte in ("55", "33", "0f", "01"))


@dataclass(frozen=True, eq=False)
class Level:
    """The voxels of one size, as far as they are read. Few have something in them, and only those are kept."""

    # (n,) four float32 each: the area a in the voxel, in its faces, as a / (1 + a), and the sum of area times normal,
    # over 1 + a, too. One item of 16 bytes, because NumPy gathers items faster than rows.
    voxels: NDArray[np.complex128]
    words: NDArray[np.uint64]  # which of each 64 of the shape's voxels, laid out flat, are kept: the lowest bit first
    first: NDArray[np.int32]   # of those of each word, the index of the first
    shape: tuple[int, int, int]
    low: NDArray[np.float64]   # (3,) index of the first voxel, counted from the low corner of what is baked
    size: float                # side of a voxel

    def filled(self, index: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Whether there is something in the voxels at places of the shape, laid out flat; (n,) each."""
        bits = self.words.view(np.uint8).take(index >> 3, mode="clip")
        within = index.astype(np.uint8)
        within &= 7
        bits >>= within
        bits &= 1
        return bits.view(bool)

    def at(self, index: NDArray[np.int32]) -> NDArray[np.complex128]:
        """The voxels at places that are `filled`."""
        return self.voxels.take(_rank(self.words, self.first, index), mode="clip")


def _rank(words: NDArray[np.uint64], first: NDArray[np.int32], index: NDArray[np.int32]) -> NDArray[np.int64]:
    """Which of the kept voxels those at places are: how many bits are set before (Jacobson 1989, "Space-efficient
    static trees and graphs"), those within a word being counted as everywhere (Warren, "Hacker's Delight", 5-1).
    """
    word = (index >> _WORD).astype(np.intp)
    below = np.uint64(1) << (index & ((1 << _WORD) - 1)).astype(np.uint64)
    below -= np.uint64(1)
    below &= words.take(word, mode="clip")
    below -= (below >> np.uint64(1)) & _PAIRS
    below = (below & _FOURS) + ((below >> np.uint64(2)) & _FOURS)
    below += below >> np.uint64(4)
    below &= _BYTES
    below *= _SUM
    below >>= np.uint64(56)
    return first.take(word, mode="clip") + below.view(np.int64)


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Levels from the finest, each of voxels twice as large."""

    levels: list[Level]
    low: NDArray[np.float64]  # (3,) where places are counted from, metres
    side: float               # its longest side, metres; 1 where it has none

    @staticmethod
    def of(geometry: Sequence[Geometry], reaches: Sequence[float]) -> Pyramid:
        """Build.

        Args:
            geometry: parts (positions (V, 3), triangles (F, 3)), what is baked first.
            reaches: for each level, how far from the box of what is baked it is read; not falling. Further levels
                reach twice as far each, as long as there are surfaces beyond.
        """
        parts = [np.stack([np.ascontiguousarray(p.T, np.float64).take(corner, 1) for corner in t.T])
                 for p, t in geometry if len(t)]  # (3 corners, 3 coordinates, m): NumPy is quick along the last
        low, high = parts[0].min((0, 2)), parts[0].max((0, 2))
        side = float((high - low).max()) or 1.0
        low = low - _SHIFT * side / FINEST
        box = (high - low) / side
        for part in parts:
            part -= low[:, None]
            part *= 1 / side
        extent = max(float(np.maximum(-part.min((0, 2)), part.max((0, 2)) - box).max()) for part in parts)
        reaches = list(reaches)
        while 0 < extent > reaches[-1] - 1:  # seen from the other side of the box
            reaches.append(2 * reaches[-1])
        reaches = [reach + 2.0 ** level / FINEST for level, reach in enumerate(reaches)]  # whole voxels
        cut = [(parts[0], np.zeros(1)), *(_near(part, box, reaches) for part in parts[1:])]
        # what is far is not pooled from finer voxels, and sampled more densely instead
        samples = [_samples(part, 2.0 ** np.maximum(level - 1, 0) / FINEST) for part, level in cut]
        places, values = (_joined(column) for column in zip(*samples, strict=True))
        return Pyramid(_levels(places, values, box, reaches), low, side)


def _near(triangles: NDArray, box: NDArray, reaches: Sequence[float]) -> tuple[NDArray, NDArray[np.int64]]:
    """Parts (3, 3, m) of triangles, and of each the finest level that it reaches into; none that reaches into none.

    A floor may be a thousand times as wide as what stands on it: it is cut finely only where it is seen so.
    """
    done, levels = [triangles[..., :0]], [np.zeros(0, np.int64)]
    while triangles.shape[2]:
        first, last = triangles.min(0), triangles.max(0)
        away = np.maximum(np.maximum(-last, first - box[:, None]), 0).max(0)
        level = np.searchsorted(reaches, away)
        near = level < len(reaches)
        triangles, level, size = triangles[..., near], level[near], (last - first).max(0)[near]
        large = size > np.asarray(reaches)[level] + 0.5
        done.append(triangles[..., ~large])
        levels.append(level[~large])
        a, b, c = triangles[..., large]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))
        triangles = np.concatenate([np.stack(quarter) for quarter in quarters], 2)
    return np.concatenate(done, 2), np.concatenate(levels)


def _samples(triangles: NDArray, size: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Places (3, n) spread over triangles (3, 3, m), dense enough for voxels of `size` (m,); and what each stands for:
    (4, n) area and area times normal.
    """
    a, b, c = triangles  # each (3, m)
    ab, ac = b - a, c - a
    normal = 0.5 * np.stack([ab[1] * ac[2] - ab[2] * ac[1], ab[2] * ac[0] - ab[0] * ac[2],
                             ab[0] * ac[1] - ab[1] * ac[0]])
    area = np.sqrt(_square(normal))
    longest = np.sqrt(np.maximum(np.maximum(_square(ab), _square(ac)), _square(c - b)))
    count = np.ceil(np.maximum(_DENSITY * area / size ** 2, longest / size)).astype(np.int64)
    count[~(area > 0)] = 0
    value = np.stack([area, *normal])
    one, many = np.flatnonzero(count == 1), np.flatnonzero(count > 1)  # most triangles of a dense mesh have one
    count = count[many]
    of = np.repeat(np.arange(len(many)), count)
    number = np.arange(len(of), dtype=np.uint32) - (np.cumsum(count) - count).astype(np.uint32).take(of)
    # a lattice of the unit square, folded into the triangle by the root that keeps areas
    root = (number.astype(np.float32) + np.float32(0.5)) * (1 / count).astype(np.float32).take(of)
    np.sqrt(root, out=root)
    along = (number * _GOLDEN + np.uint32(1 << 31)).astype(np.float32)  # the product's overflow is what wraps it
    along *= np.float32(2.0 ** -32)
    along *= root
    root -= along
    places, values = (np.empty((rows, len(one) + len(of)), np.float32) for rows in (3, 4))
    places[:, :len(one)] = (a + b + c).take(one, 1) / 3
    values[:, :len(one)] = value.take(one, 1)
    a, ab, ac = (corner.take(many, 1).astype(np.float32) for corner in (a, ab, ac))
    for place, corner, first, second in zip(places[:, len(one):], a, ab, ac, strict=True):
        corner.take(of, out=place, mode="clip")
        place += root * first.take(of)
        place += along * second.take(of)
    for out, each in zip(values[:, len(one):], (value.take(many, 1) / count).astype(np.float32), strict=True):
        each.take(of, out=out, mode="clip")
    return places, values


def _joined(parts: Sequence[NDArray]) -> NDArray:
    """(rows, n) of all parts' columns; no copy of one alone: fresh memory takes as long as what is done with it."""
    parts = [part for part in parts if part.shape[1]] or parts[:1]
    return parts[0] if len(parts) == 1 else np.concatenate(parts, 1)


def _square(vectors: NDArray) -> NDArray:
    return vectors[0] * vectors[0] + vectors[1] * vectors[1] + vectors[2] * vectors[2]


def _levels(places: NDArray[np.float32], values: NDArray[np.float32], box: NDArray, reaches: Sequence[float]
            ) -> list[Level]:
    """Add samples (3, n) with values (4, n) up in all levels, each from the one below and from what that had not."""
    out = []
    cells, sums = np.zeros((3, 0), np.int32), values[:, :0]  # indices counted from the low corner of what is baked
    for number, reach in enumerate(reaches):
        size = 2.0 ** number / FINEST
        low = int(np.floor(-reach / size))
        shape = np.floor((box + reach) / size).astype(np.int64) + 1 - low
        cells -= low
        if places.shape[1]:
            here = places * np.float32(1 / size)
            np.floor(here, out=here)
            here -= np.float32(low)
            if here.min() < 0 or (here.max(1) >= shape).any():
                inside = np.all((here >= 0) & (here < shape[:, None]), 0)
                here, value = here[:, inside], values[:, inside]
                places, values = places[:, ~inside], values[:, ~inside]
            else:
                value, places, values = values, places[:, :0], values[:, :0]
            cells, sums = _joined([cells, here.astype(np.int32)]), _joined([sums, value])
        x, y, z = shape.tolist()
        index = (cells[0] * np.int32(y) + cells[1]) * np.int32(z) + cells[2]
        words, first, at = _kept(index, x * y * z)
        index = _rank(words, first, index)
        part, sums = sums, np.zeros((4, len(at)), np.float32)
        for total, value in zip(sums, part, strict=True):
            np.add.at(total, index, value)
        found, scale = np.empty((len(at), 4), np.float32), np.float32(1 / size ** 2)
        scale = scale / (1 + sums[0] * scale)
        for column, total in zip(found.T, sums, strict=True):
            np.multiply(total, scale, out=column)
        out.append(Level(found.view(np.complex128)[:, 0], words, first, (x, y, z), np.full(3, float(low)), size))
        column = at // np.int32(z)
        row = column // np.int32(y)
        cells = np.stack([row, column - row * np.int32(y), at - column * np.int32(z)])
        cells = (cells + low) >> 1
    return out


def _kept(index: NDArray[np.int32], count: int) -> tuple[NDArray[np.uint64], NDArray[np.int32], NDArray[np.int32]]:
    """`Level`'s words and firsts for voxels at places (m,), of `count`; and the places (n,), each once, rising."""
    word = index >> _WORD
    filled = np.zeros((count >> _WORD) + 1, bool)
    filled[word] = True
    full = np.flatnonzero(filled).astype(np.int32)
    number = np.zeros(len(filled), np.int32)
    number[full] = np.arange(len(full), dtype=np.int32) << _WORD
    bits = np.zeros(len(full) << _WORD, bool)  # of full words alone, as the whole shape is large
    word = number.take(word)
    word += index & ((1 << _WORD) - 1)
    bits[word] = True
    at = np.flatnonzero(bits).astype(np.int32)
    words, first = np.zeros(len(filled), np.uint64), np.zeros(len(filled), np.int32)
    words[full] = np.packbits(bits, bitorder="little").view(np.uint64)
    of = at >> _WORD
    many = np.bincount(of, minlength=len(full))
    first[full] = np.cumsum(many) - many
    return words, first, (full.take(of) << _WORD) + (at & ((1 << _WORD) - 1))
