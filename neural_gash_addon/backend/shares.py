# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a hybrid bake follows its network, and what its error then is, by points that were traced twice besides."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from . import spherical_harmonics as sh
from .pilot import error_by_twins, noise_beside, relative


def nearest(was: NDArray, moved: NDArray, one: NDArray, two: NDArray) -> tuple[NDArray, NDArray]:
    """The share of each band of what the network moves the blocked part by that brings it nearest the truth.

    The two traces (s, K) of the points are independent of what was traced before, `was` (s, K), and of what the
    network moved that by, `moved` (s, K). So the sum of (was + share moved - one) (was + share moved - two) is the
    squared error and a constant, and is least where its derivative vanishes. So a network that errs on a mesh, or where
    rays are many, is not followed.

    Returns:
        (K,); and (s, K), of each point what all others say: what a share was chosen by would seem nearer than it is.
    """
    bands = sh.order_of(was.shape[1])
    starts, widths = np.square(np.arange(bands)), 2 * np.arange(bands) + 1
    slope = np.add.reduceat(moved * (one + two - 2 * was), starts, 1)  # (s, bands)
    curvature = np.add.reduceat(2 * np.square(moved, dtype=np.float64), starts, 1)
    all_slope, all_curvature = slope.sum(0), curvature.sum(0)
    return (np.repeat(_share(all_slope, all_curvature), widths),
            np.repeat(_share(all_slope - slope, all_curvature - curvature), widths, 1))


def _share(slope: NDArray, curvature: NDArray) -> NDArray:
    """Of the network's answer: all of it where that moves nothing."""
    return np.clip(np.divide(slope, curvature, out=np.ones_like(slope), where=curvature > 1e-12), 0, 1)


def error_at(blocked: NDArray, was: NDArray, rays: int, one: NDArray, two: NDArray, traced: int, open_sky: NDArray
             ) -> float | None:
    """Relative L2 error of an answer at points; None in the dark.

    Both traces' noise is independent, so it cancels in the product. Where they have less rays than the bake, though,
    what is left of it is most of the measure. The same measure of what was traced has the same noise, and its truth is
    known otherwise: by how the two differ. So that is a control variate. An error that is too small to be told from the
    standard error of its square is said to be as large as that.

    Args:
        blocked: (s, K), the answer. was: (s, K), what was traced with `rays` rays for it.
        one, two: (s, K), with `traced` rays. open_sky: (s, K) unshadowed transfer.
    """
    if rays <= traced:
        return error_by_twins(blocked, one, two, open_sky)
    here, plain = (((answer - one) * (answer - two)).sum(1) for answer in (blocked, was))
    apart, off = plain - plain.mean(), here - here.mean()
    noise = float(np.square(one - two).sum()) / 2 * noise_beside(traced, rays) ** 2
    share = float(np.clip(apart @ off / max(apart @ apart, 1e-300), 0, 1))
    squared = float(here.sum()) - share * (float(plain.sum()) - noise)
    least = float(np.square(off - share * apart).sum()) ** 0.5
    return relative(max(squared, least), ((open_sky - one) * (open_sky - two)).sum(1), open_sky)
