# SPDX-License-Identifier: GPL-3.0-or-later
"""The graph that the paper's networks pass messages along: nearest neighbours joined with the mesh's edges."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .nearest import nearest
from .neighbours import Neighbours

NEAREST = 8


@dataclass(frozen=True, eq=False)
class Graph:
    """Edges by target: those of vertex i come from source[start[i]:start[i + 1]]; none twice, none to itself."""

    start: NDArray[np.int64]   # (N + 1,)
    source: NDArray[np.int64]  # (E,)


def graph(points: NDArray, links: Neighbours, k: int = NEAREST) -> Graph:
    """Join each point with its k nearest other places and with its neighbours on the mesh.

    Points in one place count as one for the search; each is joined with the first of them.

    Args:
        points: (N, 3) finite. links: of the same points.
    """
    count = len(points)
    places, first, of_point = np.unique(points, axis=0, return_index=True, return_inverse=True)
    of_point = of_point.reshape(-1)
    near = first[nearest(places, k)]
    every = np.arange(count)
    on_mesh = np.repeat(every, np.diff(links.start))
    source = np.concatenate([near[of_point].ravel(), first[of_point], links.points, on_mesh])
    target = np.concatenate([np.repeat(every, near.shape[1]), every, on_mesh, links.points])
    keys = np.unique((target * count + source)[target != source])
    return Graph(np.searchsorted(keys, np.arange(count + 1) * count), keys % count)
