# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy reflection from the same coefficients as diffuse: triple products with fixed light.

Incoming light times visibility times cosine is a product of two functions on the sphere. Its
coefficients come from those of the light and of the transfer through the tripling tensor (PRTT,
section 3, equation 2; Ng et al. 2004), and with the light fixed through one matrix for all points
(Sloan 2008, "Stupid spherical harmonics tricks", products). A glossy lobe then damps their bands
(`lobes`), and the harmonics' value in the mirrored view direction is the radiance.
"""
from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from . import spherical_harmonics as sh
from .workers import default_threads

Array = NDArray[np.float64]

_ROWS = 256       # of one small matrix product: its operands stay in the second-level cache
_LIT_ROWS = 2048  # their products stay in the second-level cache while they are dealt out to the images
_BLOCK = 1 << 16  # points at a time, so that memory does not grow with their number


@lru_cache(maxsize=8)
def tripling_tensor(order: int, light_order: int | None = None) -> Array:
    """tau_ijk = int Y_i Y_j Y_k dw, exact to rounding (PRTT, equation 2).

    Args:
        order: bands of i and k.
        light_order: bands of j, as many as `order` where not given. Bands beyond 2*order - 1 are
            zero by the triangle rule.
    Returns:
        (K, J, K) float64, read-only, cached; exactly 0 where a selection rule says so.

    Gauss-Legendre in z times even steps in phi: the azimuthal sums vanish unless sqrt(1 - z*z)
    is left in an even power, so the rest is a polynomial in z, of degree at most the sum of the
    bands.
    """
    light_order = order if light_order is None else light_order
    degree = 2 * (order - 1) + light_order - 1
    z, weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    phi = 2 * np.pi * np.arange(degree + 1) / (degree + 1)
    radius = np.sqrt(1 - z * z)[:, None]
    directions = np.stack(np.broadcast_arrays(radius * np.cos(phi), radius * np.sin(phi), z[:, None]), -1)
    weight = np.repeat(weights * 2 * np.pi / (degree + 1), degree + 1)
    values = sh.evaluate(directions.reshape(-1, 3), max(order, light_order))
    count, light_count = sh.coefficient_count(order), sh.coefficient_count(light_order)
    pairs = (values[:, :light_count, None] * values[:, None, :count]).reshape(len(weight), -1)
    tensor = ((values[:, :count] * weight[:, None]).T @ pairs).reshape(count, light_count, count)
    tensor = 0.5 * (tensor + tensor.transpose(2, 1, 0))
    tensor[np.abs(tensor) < 1e-13] = 0.0
    tensor.flags.writeable = False
    return tensor


def light_matrix(light: NDArray, order: int | None = None) -> Array:
    """M_ki = sum_j tau_ijk L_j, which multiplies a function by the light (PRTT, section 3; Sloan 2008).

    Args:
        light: (J, 3), in the bake frame. order: bands of the function, the light's where not given.
    Returns:
        (K, K, 3) float64, symmetric in k and i.

    A light of 2*order - 1 bands costs the points nothing (M is as large) and makes the product
    exact for any light: further bands cannot reach K coefficients from K.
    """
    values = np.asarray(light, dtype=np.float64)
    light_order = sh.order_of(len(values))
    order = light_order if order is None else order
    return np.einsum("ijk,jc->kic", tripling_tensor(order, light_order), values, optimize=True)


def transferred(transfer: NDArray, light: NDArray, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """Coefficients of incoming light times visibility times cosine: L^p_k = pi sum_i M_ki T_i.

    Args:
        transfer: (N, K), with the 1/pi of diffuse reflection in it, which the pi takes out again.
        light: (J, 3), in the bake frame; J need not be K (see `light_matrix`).
        out: (N, K, 3) float32, C-contiguous, to write to; fresh memory costs half as much again.
    Returns:
        (N, K, 3) float32, `out` where given.
    """
    count, coefficients = transfer.shape
    matrix = np.pi * light_matrix(light, sh.order_of(coefficients)).transpose(1, 0, 2)
    matrix = np.ascontiguousarray(matrix.reshape(coefficients, -1), dtype=np.float32)  # (K, 3K)
    if out is None:
        out = np.empty((count, coefficients, 3), dtype=np.float32)
    elif out.shape != (count, coefficients, 3) or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise ValueError(f"out must be C-contiguous float32 of shape {(count, coefficients, 3)}")
    flat = out.reshape(count, 3 * coefficients)
    for start in range(0, count, _BLOCK):
        block = np.ascontiguousarray(transfer[start:start + _BLOCK], dtype=np.float32)
        target = flat[start:start + _BLOCK]
        whole = len(block) - len(block) % _ROWS
        np.matmul(block[:whole].reshape(-1, _ROWS, coefficients), matrix,
                  out=target[:whole].reshape(-1, _ROWS, matrix.shape[1]))
        np.matmul(block[whole:], matrix, out=target[whole:])
    return out


def lit_channels(transfer: NDArray[np.float32], light: NDArray, channels: int, out: NDArray[np.float32]) -> None:
    """What a shader needs of a light at each point, a few channels an image: radiance, then `transferred`.

    Args:
        transfer: (N, K) C-contiguous. light: (K, 3), in the bake frame. channels: of an image.
        out: (images, N, channels) C-contiguous, written to: in order T . L (3), L^p_k (K, 3), zeros.
    """
    count, coefficients = transfer.shape
    matrix = np.zeros((coefficients, len(out) * channels), np.float32)
    matrix[:, :3] = light
    products = np.pi * light_matrix(light, sh.order_of(coefficients)).transpose(1, 0, 2)
    matrix[:, 3:3 + 3 * coefficients] = products.reshape(coefficients, -1)

    pixel = np.dtype((np.void, 4 * channels))  # moved whole: twice as quick as channel by channel
    pixels = out.view(pixel)[..., 0]

    def block(start: int) -> None:
        found = transfer[start:start + _LIT_ROWS] @ matrix
        pixels[:, start:start + _LIT_ROWS] = found.view(pixel).T

    with ThreadPoolExecutor(default_threads()) as pool:
        list(pool.map(block, range(0, count, _LIT_ROWS)))


def mirrored(view: NDArray, normals: NDArray) -> Array:
    """Directions r = 2 (n.v) n - v that a mirror at the points would show.

    Args:
        view: (N, 3) unit vectors towards the eye. normals: (N, 3) unit vectors.
    Returns:
        (N, 3) float64 unit vectors.
    """
    v, n = np.asarray(view, dtype=np.float64), np.asarray(normals, dtype=np.float64)
    return 2 * np.einsum("nd,nd->n", v, n)[:, None] * n - v


def reflected_radiance(coefficients: NDArray, view: NDArray, normals: NDArray, attenuation: NDArray) -> Array:
    """Glossy radiance B = sum_k a_l L^p_k Y_k(r), r the mirrored view direction (PRTT, section 3).

    Args:
        coefficients: (N, K, 3) from `transferred`.
        view: (N, 3) unit vectors towards the eye. normals: (N, 3) unit vectors.
        attenuation: (order,), or (N, order) for a lobe at each point (see `lobes`).
    Returns:
        (N, 3) float64, linear, scene-referred; slightly negative where it rings.
    """
    order = sh.order_of(coefficients.shape[1])
    bands = np.broadcast_to(attenuation, (len(coefficients), order))
    out = np.empty((len(coefficients), 3))
    for start in range(0, len(out), _BLOCK):
        here = slice(start, start + _BLOCK)
        harmonics = sh.evaluate(mirrored(view[here], normals[here]), order)
        harmonics *= np.repeat(bands[here], 2 * np.arange(order) + 1, axis=1)
        np.einsum("nk,nkc->nc", harmonics, coefficients[here], out=out[here])
    return out
