# SPDX-License-Identifier: GPL-3.0-or-later
"""Real spherical harmonics: evaluation, rotation, the clamped-cosine lobe, windowing.

Real, orthonormal over the sphere, without the Condon-Shortley phase; flat index
``k = l*(l+1) + m``, so ``Y[1] = 0.488603 y``, ``Y[2] = 0.488603 z``, ``Y[3] = 0.488603 x``.
"Order n" means the bands l = 0..n-1, hence K = n*n coefficients.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_ORDER = 5
_BLOCK = 2048  # functions rotated at a time: their rows stay in the second-level cache
_THIRD = 3 ** -0.5  # of 3 z^2 - 1 beside x^2 - y^2, in band 2


def coefficient_count(order: int) -> int:
    """Number of coefficients K = order**2."""
    return order * order


def order_of(count: int) -> int:
    """Order whose coefficient count is `count`; ValueError where there is none."""
    order = math.isqrt(count)
    if order * order != count or order < 1:
        raise ValueError(f"{count} is not a number of spherical-harmonic coefficients")
    return order


def padded(coefficients: NDArray, count: int) -> NDArray:
    """Coefficients (N, n) followed by zeros: (N, count). The same function, at a higher order."""
    missing = count - coefficients.shape[1]
    return coefficients if not missing else np.pad(coefficients, ((0, 0), (0, missing)))


def band_slice(band: int) -> slice:
    """Where band l lies in the flat index."""
    return slice(band * band, (band + 1) * (band + 1))


def normalisation(band: int, m: int) -> float:
    """Norm of the real harmonic (l, m): sqrt((2l+1)/4pi (l-|m|)!/(l+|m|)!), times sqrt(2) off the axis."""
    m = abs(m)
    value = (2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m)
    return math.sqrt(value * (1 if m == 0 else 2))


def evaluate(directions: NDArray, order: int) -> Array:
    """Harmonics of unit directions.

    Args:
        directions: (N, 3) unit vectors.
        order: number of bands, 1 or more.
    Returns:
        (N, K) float64.

    Recurrences in Cartesian form (Sloan 2013, "Efficient spherical harmonic evaluation"): the
    associated Legendre part is a polynomial in z, the azimuthal part Re/Im (x + iy)^m, so nothing
    is singular at the poles.
    """
    d = np.asarray(directions, dtype=np.float64)
    return np.ascontiguousarray(_evaluate_rows(np.ascontiguousarray(d.T), order).T)


def _evaluate_rows(coordinates: Sequence[Array] | Array, order: int) -> Array:
    """`evaluate` from coordinates x, y, z (3, N) into contiguous rows (K, N), which NumPy does faster."""
    x, y, z = coordinates
    out = np.empty((coefficient_count(order), len(x)))
    cosine, sine = np.ones_like(x), np.zeros_like(x)  # Re and Im of (x + iy)^m
    diagonal = 1.0  # (2m-1)!!, P_mm without its sin^m, which is in (x + iy)^m
    for m in range(order):
        if m:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            diagonal *= 2 * m - 1
        before: Array | float = 0.0
        legendre: Array | float = diagonal
        for band in range(m, order):
            if band > m:
                step = ((2 * band - 1) / (band - m)) * z * legendre
                if band > m + 1:
                    step -= ((band + m - 1) / (band - m)) * before
                before, legendre = legendre, step
            scaled = normalisation(band, m) * legendre
            centre = band * (band + 1)
            np.multiply(cosine, scaled, out=out[centre + m])
            if m:
                np.multiply(sine, scaled, out=out[centre - m])
    return out


@lru_cache(maxsize=8)
def _sample_directions(order: int) -> tuple[Array, tuple[Array, ...]]:
    """2*order-1 directions D and, for each band, the inverse of Y_l(D[:2l+1]) transposed.

    The directions are chosen greedily from a Fibonacci sphere so that every leading 2l+1 of
    them determine band l well (condition numbers of at most 20 up to order 5).
    """
    count = 400
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    phi = i * math.pi * (3 - math.sqrt(5))
    candidates = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], 1)
    values = evaluate(candidates, order)
    chosen: list[int] = [0]
    for band in range(1, order):
        block = values[:, band_slice(band)]
        while len(chosen) < 2 * band + 1:
            best, best_value = -1, -1.0
            for c in range(count):
                smallest = np.linalg.svd(block[[*chosen, c]], compute_uv=False)[-1]
                if c not in chosen and smallest > best_value:
                    best, best_value = c, smallest
            chosen.append(best)
    directions = candidates[chosen]
    inverses = tuple(np.linalg.inv(values[chosen[:2 * b + 1], band_slice(b)]).T.copy() for b in range(order))
    return directions, inverses


def rotate(coefficients: NDArray, rotation: NDArray) -> Array:
    """Coefficients of the rotated function g(w) = f(R^T w).

    Args:
        coefficients: (K,) or (K, C), one function or C of them.
        rotation: (3, 3) orthonormal, determinant 1.
    Returns:
        float64, same shape.

    A band of f is a sum of 2l+1 zonal lobes about fixed directions; rotating f rotates the lobes
    (Nowrouzezahrai et al. 2012), which needs no recurrence over Wigner matrices.
    """
    c = np.asarray(coefficients, dtype=np.float64)
    flat = c.reshape(len(c), -1)
    order = order_of(len(c))
    directions, inverses = _sample_directions(order)
    turned = evaluate(directions @ np.asarray(rotation, dtype=np.float64).T, order)
    out = np.empty_like(flat)
    for band in range(order):
        s = band_slice(band)
        out[s] = turned[:2 * band + 1, s].T @ (inverses[band] @ flat[s])
    return out.reshape(c.shape)


def rotate_each(coefficients: NDArray, rotations: NDArray) -> Array:
    """`rotate` for many functions, each by a rotation of its own.

    Args:
        coefficients: (N, K).
        rotations: (N, 3, 3).
    Returns:
        (N, K) float64.
    """
    c = np.asarray(coefficients, dtype=np.float64)
    order = order_of(c.shape[1])
    out = np.empty_like(c)
    for start in range(0, len(c), _BLOCK):
        part = slice(start, start + _BLOCK)
        matrices = np.ascontiguousarray(rotations[part].transpose(1, 2, 0), dtype=np.float64).reshape(9, -1)
        rows = np.ascontiguousarray(c[part].T)
        total = np.zeros_like(rows)
        total[0] = rows[0]
        if order > 1:
            _turn_vector(matrices, rows[1:4], total[1:4])
        if order > 2:
            _turn_tensor(matrices, rows[4:9], total[4:9])
        if order > 3:
            _turn_lobes(matrices, rows, total, order)
        out[part] = total.T
    return out


def _turn_vector(matrices: Array, rows: Array, out: Array) -> None:
    """Band 1 (3, B), which is a vector (y, z, x), turned by matrices (9, B)."""
    y, z, x = rows
    for row, axis in enumerate((1, 2, 0)):
        first, second, third = matrices[3 * axis:3 * axis + 3]
        np.multiply(first, x, out=out[row])
        out[row] += second * y
        out[row] += third * z


def _turn_tensor(matrices: Array, rows: Array, out: Array) -> None:
    """Band 2 (5, B) turned by matrices R (9, B): a symmetric tensor M without trace becomes R M R^T."""
    xy, yz, mean, xz, apart = rows
    mean = mean * _THIRD
    half = ((apart - mean, xy, xz), (xy, -apart - mean, yz), (xz, yz, 2 * mean))  # M
    turned = [[matrices[3 * i] * half[0][k] + matrices[3 * i + 1] * half[1][k] + matrices[3 * i + 2] * half[2][k]
               for k in range(3)] for i in range(3)]  # R M

    def entry(i: int, j: int) -> Array:
        return turned[i][0] * matrices[3 * j] + turned[i][1] * matrices[3 * j + 1] + turned[i][2] * matrices[3 * j + 2]

    out[0], out[1], out[3] = entry(0, 1), entry(1, 2), entry(0, 2)
    np.multiply(entry(2, 2), 0.5 / _THIRD, out=out[2])
    np.multiply(entry(0, 0) - entry(1, 1), 0.5, out=out[4])


def _turn_lobes(matrices: Array, rows: Array, out: Array, order: int) -> None:
    """Bands from 3 on, as `rotate` does it, added to `out`."""
    directions, inverses = _sample_directions(order)
    lobes = {band: inverses[band] @ rows[band_slice(band)] for band in range(3, order)}
    for j, (dx, dy, dz) in enumerate(directions):
        turned = [matrices[3 * i] * dx + matrices[3 * i + 1] * dy + matrices[3 * i + 2] * dz for i in range(3)]
        values = _evaluate_rows(turned, order)
        for band in range(max(3, (j + 1) // 2), order):  # lobe j takes part where 2l+1 > j
            s = band_slice(band)
            out[s] += values[s] * lobes[band][j]


def cosine_lobe_bands(order: int) -> Array:
    """Zonal coefficients A_l / pi of max(cos, 0) / pi, one per band: (order,) float64.

    Convolving with the clamped cosine multiplies band l by A_l (Ramamoorthi and Hanrahan 2001,
    equation 8): pi, 2pi/3, then zero for odd l > 1.
    """
    out = np.zeros(order)
    for band in range(order):
        if band == 1:
            out[band] = 2 / 3
        elif band % 2 == 0:
            half = band // 2
            out[band] = (2 * (-1) ** (half - 1) / ((band + 2) * (band - 1))
                         * math.factorial(band) / (2 ** band * math.factorial(half) ** 2))
    return out


def cosine_lobe(normals: NDArray, order: int) -> Array:
    """Unshadowed diffuse transfer 1/pi * int max(n.w, 0) Y_k(w) dw, exact.

    Args:
        normals: (N, 3) unit vectors; a zero normal gives zero.
    Returns:
        (N, K) float64.
    """
    bands = np.repeat(cosine_lobe_bands(order), 2 * np.arange(order) + 1)
    valid = np.any(np.asarray(normals) != 0, axis=1, keepdims=True)
    return evaluate(normals, order) * bands * valid


def hann_window(order: int) -> Array:
    """Multipliers (K,) that damp ringing: the Hann window (1 + cos(pi l / n)) / 2 for band l.

    Sloan 2008, "Stupid spherical harmonics tricks", windowing.
    """
    bands = 0.5 * (1 + np.cos(np.pi * np.arange(order) / order))
    return np.repeat(bands, 2 * np.arange(order) + 1)
