# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy lobes as zonal attenuation: by how much convolution with a lobe damps each band.

A lobe here is a density over directions, symmetric about the mirrored view direction, that
integrates to 1. Convolving a function with it multiplies band l by a_l = int lobe(w) P_l(r.w) dw
(Ramamoorthi and Hanrahan 2001, "A signal-processing framework for inverse rendering", section 4).
"""
from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

GGX, PHONG = "GGX", "PHONG"  # what a roughness may mean

_NODES = 2049  # roughnesses tabulated: linear interpolation between them errs by less than 1e-6


def attenuation(roughness: ArrayLike, order: int, lobe: str = GGX) -> Array:
    """Attenuation of the lobe that a material of Blender's roughness r has, for r (...,): (..., order) float64."""
    return phong_attenuation(phong_exponent(roughness), order) if lobe == PHONG else ggx_attenuation(roughness, order)


def phong_exponent(roughness: ArrayLike) -> Array:
    """Exponent n of the Phong lobe as wide as a microfacet lobe of Blender's roughness r, alpha = r*r: (...,) float64.

    2/alpha**2 - 2 is the exponent of the half vector, which makes half the angle that w makes with
    r; so of w it is a quarter of that (Fisher and Woo 1994, "R.E versus N.H specular highlights").
    1 is the even hemisphere (n = 0), 0 a mirror; r = (2n + 1)**-0.25 gives any exponent. Clamped.
    """
    with np.errstate(divide="ignore"):
        out: Array = 0.5 / np.clip(np.asarray(roughness, dtype=np.float64), 0, 1) ** 4 - 0.5
    return out


def phong_attenuation(exponent: ArrayLike, order: int) -> Array:
    """Attenuation of the Phong lobe (n+1)/(2 pi) max(r.w, 0)**n, exact.

    Args:
        exponent: (...,) real n >= 0; 0 is the hemisphere about r, infinity a mirror.
        order: bands.
    Returns:
        (..., order) float64. Positive for l < n + 2; bands that a wide lobe is too blunt for may be 0 or negative.

    a_0 = 1, a_1 = (n+1)/(n+2), a_l = a_{l-2} (n-l+2)/(n+l+1), by parts from Legendre's equation;
    written so that infinity gives 1.
    """
    n = np.asarray(exponent, dtype=np.float64)
    out = np.ones((*n.shape, order))
    if order > 1:
        out[..., 1] = 1 - 1 / (n + 2)
    for band in range(2, order):
        out[..., band] = out[..., band - 2] * (1 - (2 * band - 1) / (n + band + 1))
    return out


def ggx_attenuation(roughness: ArrayLike, order: int) -> Array:
    """Attenuation of the GGX lobe at normal incidence, for Blender's roughness r, alpha = r*r.

    Args:
        roughness: (...,) 0 (a mirror: 1 in every band) to 1 (even over the sphere: 1, 0, 0, ...);
            clamped.
        order: bands.
    Returns:
        (..., order) float64, within 1e-6; falls with roughness and with the band, never negative.

    The half vectors h between normal and w are distributed as D(h) cos(theta_h) (Walter et al.
    2007, equation 33); with dw_h/dw = 1/(4 cos(theta_h)) the density of w is D(h)/4, which
    integrates to 1 over the sphere as it is. Seen at a slant the real lobe is narrower across
    than along and leans; a zonal lobe cannot, and this one does not try.
    """
    r = np.asarray(roughness, dtype=np.float64)
    nodes, table = _ggx_table(order)
    return np.stack([np.interp(r, nodes, column) for column in table], -1)


@lru_cache(maxsize=8)
def _ggx_table(order: int) -> tuple[Array, Array]:
    """Roughnesses (_NODES,) and the attenuation there (order, _NODES)."""
    nodes = np.linspace(0, 1, _NODES)
    return nodes, ggx_quadrature(nodes, order).T.copy()


def ggx_quadrature(roughness: NDArray, order: int) -> Array:
    """What `ggx_attenuation` tabulates, to rounding: (N,) -> (N, order).

    With tan(theta_h)**2 = alpha**2 u/(1-u), u is even on [0, 1]; with u = 1/(1 + exp(-y)) the
    integral over y is of a function analytic for |Im y| < pi, for which the trapezoidal rule
    errs by exp(-2 pi pi/step) at any roughness.
    """
    step = 0.25
    y = np.arange(-38, 38 + step, step)
    weight = step / (2 + 2 * np.cosh(y))  # du/dy
    tangent = np.asarray(roughness, dtype=np.float64)[:, None] ** 4 * np.exp(y)
    cosine = (1 - tangent) / (1 + tangent)  # of the angle between r and w, twice that of h
    return np.polynomial.legendre.legvander(cosine, order - 1).transpose(0, 2, 1) @ weight
