# SPDX-License-Identifier: GPL-3.0-or-later
"""Low-discrepancy directions: scrambled Sobol' points on the cosine-weighted hemisphere."""
from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray


def sobol2(count: int) -> NDArray[np.uint32]:
    """First `count` (at most 2**32) points of the two-dimensional Sobol' sequence: (count, 2) uint32.

    The first dimension is the van der Corput sequence, the second the Pascal matrix modulo 2:
    every aligned run of 2**m points is a (0, m, 2)-net (Sobol' 1967).
    """
    index = np.arange(count, dtype=np.uint32)
    out = np.zeros((count, 2), dtype=np.uint32)
    vector = np.uint32(1 << 31)
    for bit in range(max(count - 1, 0).bit_length()):  # of the indices; the others are 0
        set_here = (index >> np.uint32(bit)) & np.uint32(1)
        out[:, 0] ^= set_here * np.uint32(1 << (31 - bit))
        out[:, 1] ^= set_here * vector
        vector ^= vector >> np.uint32(1)
    return out


def owen_scramble(values: NDArray[np.uint32], seeds: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Nested uniform scramble of 32-bit fractions by hashing (Laine and Karras 2011; Burley 2020).

    Keeps every elementary interval's count and makes the points unbiased. Shapes broadcast.
    """
    x = _reverse_bits(values) + seeds
    for shift_constant in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x = x ^ (x * np.uint32(shift_constant))
    return _reverse_bits(x)


def _reverse_bits(x: NDArray[np.uint32]) -> NDArray[np.uint32]:
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        s, m = np.uint32(shift), np.uint32(mask)
        x = ((x >> s) & m) | ((x & m) << s)
    return (x >> np.uint32(16)) | (x << np.uint32(16))


@lru_cache(maxsize=4)
def hemisphere_sets(sets: int, count: int, seed: int) -> NDArray[np.float64]:
    """Independent scrambles of the same net, mapped to the cosine-weighted hemisphere about +z.

    Args:
        sets: how many. count: directions in each. seed: which scrambles.
    Returns:
        (sets, count, 3) float64 unit vectors, density cos(theta)/pi, z > 0; each aligned run of
        2**m directions of a set is a net of its own.
    """
    seeds = np.random.default_rng(seed).integers(0, 2**32, (sets, 1, 2), dtype=np.uint32)
    bits = owen_scramble(sobol2(count)[None], seeds)
    u = (bits.astype(np.float64) + 0.5) / 2**32
    radius, phi = np.sqrt(u[..., 0]), 2 * np.pi * u[..., 1]
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), np.sqrt(1 - u[..., 0])], -1)


def frames(normals: NDArray, angles: NDArray) -> NDArray:
    """Rotations that carry +z to each normal, turned by an angle about it.

    Args:
        normals: (N, 3) unit vectors. angles: (N,) radians. Both of one type of float, in which all is done.
    Returns:
        (N, 3, 3) whose columns are tangent, bitangent and normal; in memory the points are last, as NumPy likes it.
        Nowhere singular (Duff et al. 2017, "Building an orthonormal basis, revisited").
    """
    x, y, z = np.ascontiguousarray(normals.T)
    sign = np.where(z >= 0, x.dtype.type(1), x.dtype.type(-1))
    a = -1 / (sign + z)
    b = x * y * a
    c, s = np.cos(angles), np.sin(angles)
    out = np.empty((3, 3, len(x)), x.dtype)
    first = 1 + sign * x * x * a, sign * b, -sign * x
    second = b, sign + y * y * a, -y
    for row, normal, one, two in zip(out, (x, y, z), first, second, strict=True):
        row[0] = c * one + s * two
        row[1] = c * two - s * one
        row[2] = normal
    return out.transpose(2, 0, 1)


def on_triangles(cumulative: NDArray, pairs: NDArray) -> tuple[NDArray[np.int64], NDArray, NDArray]:
    """Points of triangles, chosen by weight and uniform within each; nets stay stratified over all of them.

    Args:
        cumulative: (F,) sums of the triangles' weights up to and with each one; the last is positive.
        pairs: (2, n) uniform in 0 to 1, of the same dtype. The first chooses the triangle, and what is left of it
            the place.
    Returns:
        Triangles (n,), of positive weight, and barycentric coordinates u, v (n,) of their second and third corner.
    """
    at = pairs[0] * cumulative[-1]
    last = np.searchsorted(cumulative, cumulative[-1])  # of positive weight
    faces = np.minimum(np.searchsorted(cumulative, at, side="right"), last)
    before = np.concatenate([np.zeros(1, cumulative.dtype), cumulative[:-1]])[faces]
    root = np.sqrt(np.clip((at - before) / (cumulative[faces] - before), 0, 1))
    v = root * pairs[1]
    return faces, root - v, v
