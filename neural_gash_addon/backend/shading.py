# SPDX-License-Identifier: GPL-3.0-or-later
"""What the node group computes, in NumPy."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def radiance(transfer: NDArray, light: NDArray, albedo: NDArray | float = 1.0) -> NDArray[np.float64]:
    """Outgoing radiance albedo * (T . L).

    Args:
        transfer: (N, K) or (N, K, 3). light: (K, 3), in the bake frame. albedo: (3,), (N, 3) or a number.
    Returns:
        (N, 3) float64, linear, scene-referred; may be slightly negative where the light rings.
    """
    transfer, light = np.asarray(transfer, dtype=np.float64), np.asarray(light, dtype=np.float64)
    return np.asarray(albedo) * (np.einsum("nkc,kc->nc", transfer, light) if transfer.ndim == 3 else transfer @ light)
