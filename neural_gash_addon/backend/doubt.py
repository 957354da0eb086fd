# SPDX-License-Identifier: GPL-3.0-or-later
"""How sure a bake is of each point: how much it differs from the same bake made in another way that is as good.

The other way is with other rays, and with the mesh turned. Rays that are independent show what chance does (two
estimates differ by sqrt(2) standard errors); a network has no chance, but its grids and frames lie elsewhere in a mesh
that was turned, and where it answers otherwise, it does not know. What both ways have wrong alike is not seen: for
that there is `compare`.
"""
from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from . import methods, sampling
from . import spherical_harmonics as sh
from .geometry import TriangleMesh
from .neighbours import Neighbours, neighbours
from .progress import scaled
from .raycast import Geometry

_TURN = sampling.frames(np.array([[0.48, -0.64, 0.6]]), np.ones(1))[0]  # under which no grid is like itself
_SMOOTHINGS = 2  # over neighbours: one difference says little of the spread it is drawn from


def doubt(mesh: TriangleMesh, baked: NDArray[np.float32], method: str, occluders: Sequence[Geometry] = (),
          seed: int = 1, **quality: float) -> Generator[float, None, NDArray[np.float64]]:
    """Standard error (N,) of each point of a bake.

    Args:
        baked: (N, K) coefficients. method, quality: how they were baked, as `methods.bake` takes it.
        seed: not the bake's.
    Yields:
        The share that is done.
    Raises:
        UserError: as `methods.bake`.
    """
    def turned(vectors: NDArray) -> NDArray:
        return vectors @ _TURN.T

    other = replace(mesh, positions=turned(mesh.positions), points=turned(mesh.points), normals=turned(mesh.normals),
                    clearance=turned(mesh.clearance))
    around = [(turned(np.asarray(positions, np.float64)), triangles) for positions, triangles in occluders]
    order = sh.order_of(baked.shape[1])
    work = methods.bake(other, method, order, occluders=around, seed=seed, whole=True,
                        **quality)  # type: ignore[arg-type]
    again = (yield from scaled(work, 0, 1)).coefficients
    back = sh.rotate_each(again, np.broadcast_to(_TURN.T, (len(again), 3, 3)))
    squares = np.square(back - baked).sum(1) / 2
    beside = neighbours(mesh)
    for _ in range(_SMOOTHINGS):
        squares = _mean_of_neighbours(squares, beside)
    return np.sqrt(squares)


def _mean_of_neighbours(values: NDArray[np.float64], beside: Neighbours) -> NDArray[np.float64]:
    """(N,) means of each point and those beside it."""
    count = np.diff(beside.start)
    sums = values + np.bincount(np.repeat(np.arange(len(values)), count), values[beside.points], len(values))
    return sums / (1 + count)
