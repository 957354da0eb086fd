# SPDX-License-Identifier: GPL-3.0-or-later
"""Ambient-occlusion refinement over a graph's neighbourhoods (Neural-GASh, section 4.3.2, after Bunnell 2005).

The paper says: where a neighbour lies above a vertex's tangent plane, it contributes to occlusion, and the vertex is
darkened. Here a neighbour contributes the sine of its height over the plane, a vertex is darkened by the mean of
these times a strength, and the graph is the one the networks had: one pass over its edges, where the paper's dense
search takes most of the time (its table 5). A convex shape has no neighbour above any plane, and stays as it is.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .graph import Graph

STRENGTH = 0.5  # fitted on meshes to train on; see docs/networks.md for what it is worth


def occlusion(points: NDArray, normals: NDArray, edges: Graph) -> NDArray[np.float64]:
    """Mean sine of the height of the neighbours above the tangent plane, those below counting as nothing: (N,), 0 to 1.

    Args:
        points: (N, 3). normals: (N, 3) unit; a zero one has no plane, and no neighbour above it.
    """
    count = np.diff(edges.start)
    target = np.repeat(np.arange(len(points)), count)
    away = points[edges.source] - points[target]
    length = np.sqrt(np.square(away).sum(1))
    height = (away * normals[target]).sum(1) / np.where(length > 0, length, 1)
    return np.bincount(target, np.maximum(height, 0), len(points)) / np.maximum(count, 1)


def refined(coefficients: NDArray, points: NDArray, normals: NDArray, edges: Graph, strength: float = STRENGTH
            ) -> NDArray:
    """Transfer (N, K), darkened where neighbours stand above the surface."""
    return coefficients * (1 - strength * occlusion(points, normals, edges))[:, None]
