# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer: what a bake gives, coefficients and the record that explains them."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .record import BakeRecord


@dataclass(frozen=True, eq=False)
class Transfer:
    """Diffuse transfer T[k] = 1/pi int V(w) max(n.w, 0) Y_k(w) dw for N points."""

    coefficients: NDArray[np.float32]  # (N, K), or (N, K, 3) where light bounces off colours
    record: BakeRecord
    irradiance: NDArray[np.float32] | None = None  # (N, 3) W/m^2 from lamps, where those were baked too
