# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures of error: one vocabulary for tests, reports and charts."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def _energy(array: NDArray) -> float:
    return float(np.sum(np.square(array, dtype=np.float64)))


def srr(transfer: NDArray, reference: NDArray, unshadowed: NDArray) -> float:
    """Shadow residual ratio |T - T_ref|^2 / |T_unshadowed - T_ref|^2; arrays (N, K).

    0 is perfect, 1 no better than having no shadows. NaN where the reference has none.
    """
    shadows = _energy(np.subtract(unshadowed, reference, dtype=np.float64))
    residual = _energy(np.subtract(transfer, reference, dtype=np.float64))
    return residual / shadows if shadows else float("nan")


def rel_l2(transfer: NDArray, reference: NDArray) -> float:
    """|T - T_ref| / |T_ref| over points and coefficients; NaN where the reference is all zero."""
    scale = _energy(reference)
    return (_energy(np.subtract(transfer, reference, dtype=np.float64)) / scale) ** 0.5 if scale else float("nan")


def relit_error(transfer: NDArray, reference: NDArray, light: NDArray) -> float:
    """Relative RMSE of radiance under a light (K, 3): rel_l2 of T @ L."""
    return rel_l2(np.asarray(transfer, np.float64) @ light, np.asarray(reference, np.float64) @ light)
