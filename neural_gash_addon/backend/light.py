# SPDX-License-Identifier: GPL-3.0-or-later
"""Light as SH coefficients: environment maps, plain colours, suns. L[k] = int env(w) Y_k(w) dw."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from . import spherical_harmonics as sh

Array = NDArray[np.float64]

_GAUSS_NODES = 16  # exact to rounding for the smooth theta integrals, even of a one-row image


def project_equirect(image: NDArray, order: int) -> Array:
    """Project an equirectangular map exactly: the integral of env * Y_k over every texel.

    Args:
        image: (H, W, 3) or more channels (the first three count), linear radiance; row 0 at the
            bottom, as Blender stores pixels. Negative texels count as 0, as do NaN ones.
        order: number of bands.
    Returns:
        (K, 3) float64.

    The map is looked up as Cycles does, u = 0.5 - atan2(y, x)/2pi, v = 0.5 + asin(z)/pi, constant
    over a texel. On a latitude-longitude grid the integral of Y_lm over a texel is a product: a
    closed form in the longitude, Gauss-Legendre quadrature in the colatitude, where the integrand
    is a smooth trigonometric polynomial. So no resolution is too low, and two small matrix
    products do the whole map.
    """
    height, width, channels = image.shape
    longitude = _longitude_integrals(width, order)      # (W, 2*order-1)
    colatitude = _colatitude_integrals(height, order)   # (H, K)
    bands = [(m, band * (band + 1)) for m in range(order) for band in range(m, order)]  # -m has the same colatitude
    legendre = np.ascontiguousarray(colatitude[:, [zero + m for m, zero in bands]].T)
    texels = image.reshape(height, width * channels)    # all channels: their rows lie in one piece
    columns = np.zeros((len(bands), width * channels))
    step = max(1, (1 << 18) // (width * channels))      # rows at a time, which stay in the cache
    for start in range(0, height, step):
        block = np.fmax(texels[start:start + step], 0)  # NaN, too, becomes 0
        np.minimum(block, np.finfo(np.float32).max, out=block)
        columns += legendre[:, start:start + step] @ block.astype(np.float64)
    columns = columns.reshape(len(bands), width, channels)[:, :, :3]
    out = np.empty((sh.coefficient_count(order), 3))
    for (m, zero), column in zip(bands, columns, strict=True):
        out[zero + m] = longitude[:, order - 1 + m] @ column
        out[zero - m] = longitude[:, order - 1 - m] @ column
    return out


def _longitude_integrals(width: int, order: int) -> Array:
    """Integral of cos(m phi) (m >= 0) or sin(|m| phi) (m < 0) over each column: (W, 2*order-1)."""
    edges = np.pi - 2 * np.pi * np.arange(width + 1) / width  # phi falls as u grows
    low, high = edges[1:], edges[:-1]
    out = np.empty((width, 2 * order - 1))
    for m in range(-(order - 1), order):
        if m == 0:
            value = high - low
        elif m > 0:
            value = (np.sin(m * high) - np.sin(m * low)) / m
        else:
            value = (np.cos(m * high) - np.cos(m * low)) / m
        out[:, order - 1 + m] = value
    return out


def _colatitude_integrals(height: int, order: int) -> Array:
    """Integral of Y_lm(theta, azimuthal part 1) sin(theta) over each row, bottom first: (H, K)."""
    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS_NODES)
    edges = np.pi * (1 - np.arange(height + 1) / height)
    centre, half = 0.5 * (edges[:-1] + edges[1:]), 0.5 * (edges[:-1] - edges[1:])
    theta = centre[:, None] + half[:, None] * nodes                     # (H, G)
    flat = theta.ravel()
    weight = half[:, None] * weights * np.sin(theta)                    # (H, G)
    # where the azimuthal part is 1: phi = 0 for cosines, phi = pi/2m for sines; both share the
    # Legendre part, so the cosine's value serves for +m and -m
    values = sh.evaluate(np.stack([np.sin(flat), np.zeros_like(flat), np.cos(flat)], 1), order)
    for l in range(1, order):  # noqa: E741
        for m in range(1, l + 1):
            values[:, l * (l + 1) - m] = values[:, l * (l + 1) + m]
    return np.einsum("hg,hgk->hk", weight, values.reshape(height, _GAUSS_NODES, -1))


def constant(colour: NDArray, order: int) -> Array:
    """A sky of one radiance (3,) everywhere: (K, 3); only L[0] = sqrt(4 pi) * colour."""
    out = np.zeros((sh.coefficient_count(order), 3))
    out[0] = np.sqrt(4 * np.pi) * np.asarray(colour, dtype=np.float64)
    return out


def sun(direction: NDArray, irradiance: NDArray, order: int) -> Array:
    """A distant lamp: (K, 3).

    Args:
        direction: (3,) unit vector towards the sun. irradiance: (3,) W/m^2 on a facing plane.
    """
    value = sh.evaluate(np.asarray(direction, dtype=np.float64).reshape(1, 3), order)[0]
    return np.outer(value, np.asarray(irradiance, dtype=np.float64))


def window(light: NDArray, order: int) -> Array:
    """The light (K, 3) with its ringing damped (Hann window); it also blurs the light a little."""
    return np.asarray(light, dtype=np.float64) * sh.hann_window(order)[:, None]
