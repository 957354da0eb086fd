# SPDX-License-Identifier: GPL-3.0-or-later
"""Ambient-occlusion refinement over a graph's neighbourhoods (Neural-GASh, section 4.3.2, after Bunnell 2005).

The paper says that neighbours above a point's tangent plane contribute to its occlusion, not how much. A horizon at
elevation e all round takes sin^2 e of a point's irradiance (the integral of the clamped cosine below e); so each
neighbour takes the square of its sine, for its share of the way round. The graph is the one that the networks had: one
pass over its edges, where the paper's dense search takes most of the time (its table 5).

What it is worth, on 129 labelled meshes (median shadow residual ratio, before -> after): no shadows at all 1.000 ->
0.930; 70 % of the true shadow 0.090 -> 0.084; 90 % 0.010 -> 0.010; the truth 0.000 -> 0.001. It helps, a little, where
shadows are clearly too weak, and harms those that are right.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .geometry import unit
from .graph import Graph

LEVEL = 1e-3  # sines up to this are of the tangent plane: well above the noise of float32 coordinates


def occlusion(points: NDArray, normals: NDArray, edges: Graph) -> NDArray[np.float64]:
    """Share of each point's irradiance that its neighbours take: (N,), 0 to 1.

    Zero on convex shapes, and where a point has no neighbours or no normal.

    Args:
        points: (N, 3). normals: (N, 3) unit or zero.
    """
    count = np.diff(edges.start)
    target = np.repeat(np.arange(len(points)), count)
    sine = (unit(points[edges.source] - points[target]) * normals[target]).sum(1)
    taken = np.square(np.where(sine > LEVEL, np.minimum(sine, 1), 0))
    return np.bincount(target, taken, len(points)) / np.maximum(count, 1)


def refined(coefficients: NDArray, points: NDArray, normals: NDArray, edges: Graph) -> NDArray:
    """Transfer (N, K), darkened by its `occlusion`."""
    return coefficients * (1 - occlusion(points, normals, edges))[:, None]
