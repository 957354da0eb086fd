# SPDX-License-Identifier: GPL-3.0-or-later
"""How fine a texture has to be: as fine as the shadows on the object ask for, and no finer.

The error of a texture is what a lookup between its texels gets wrong. It is measured: transfer is
traced at random points of the surface and at the four texels around each, for textures that double
in size. What the rays get wrong cancels, as two traces with seeds of their own are multiplied. Past
the largest trial, the error is taken to fall on at the rate that it fell last.
"""
from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from . import methods
from . import spherical_harmonics as sh
from .errors import UserError
from .geometry import Surface, TriangleMesh
from .pilot import DARK, pilot_rays
from .progress import scaled
from .raster import Coverage, Layout
from .raycast import Geometry, Occluders
from .texels import NormalMap, scattered, texel_points
from .unwrap import Charts, lay_out

TRIALS = (32, 64, 128, 256, 512, 1024, 2048)  # texels a side
MAX_FIT = 4096                    # the largest texture that an error asks for
_POINTS = 4096                    # of the surface that are looked at
_TIMES = 2                        # the rays of a pilot, from each and from its texels, for each of two traces
_LEAST_RATE, _MOST_RATE = 0.5, 2.0  # powers of the size by which an error falls: at a shadow's edge, where smooth
_STEP = 16                        # texels to which sizes are rounded up

Trial = Callable[[NDArray], Generator[float, None, int]]


def fitting_side(surface: Surface, uv: NDArray, *, error: float, method: str = "embree", order: int = 5,
                 occluders: Sequence[Geometry] = (), normal_maps: Sequence[NormalMap] = (), seed: int = 0,
                 threads: int | None = None) -> Generator[float, None, int]:
    """The side of the smallest texture whose lookups have an error.

    Args:
        uv: (C, 2) of each face corner, 0 to 1, without overlaps.
        error: relative L2, over the surface by area, of transfer looked up bilinearly.
        method, order, occluders, normal_maps, seed, threads: as `texture.bake`.
    Yields:
        Progress, 0 to 1.
    Returns:
        Texels a side, TRIALS[0] to MAX_FIT, a multiple of 16.
    """
    sample = scattered(surface, _POINTS, np.random.default_rng(seed))
    places = np.einsum("nc,ncx->nx", sample.barycentric, uv[surface.corners[sample.faces]])
    points = texel_points(surface, sample, normal_maps)
    scene = None
    if methods.METHODS[method].sees:
        scene = Occluders([(points.positions, points.triangles), *occluders], points.resolution)
    trace = partial(_traced, method=method, order=order, scene=scene, seed=seed, threads=threads,
                    rays=_TIMES * pilot_rays(error))
    yield 0.0
    exact = trace(points, first=0)
    dark = DARK ** 2 * float(np.square(sh.cosine_lobe(points.normals, order)).sum())
    energy = max(float((exact[0] * exact[1]).sum()), dark)
    errors: list[float] = []
    for number, side in enumerate(TRIALS):
        yield (number + 1) / (len(TRIALS) + 1)
        coverage = Layout(uv[surface.corners], surface.triangles, side).coverage()
        if not len(coverage.texels):
            errors.append(1.0)
            continue
        rows, mix = _around(coverage, places)
        used, index = np.unique(rows, return_inverse=True)
        found = trace(texel_points(surface, coverage.only(used), normal_maps), first=2)
        wrong = [np.einsum("nc,nck->nk", mix, f[index.reshape(rows.shape)]) - e
                 for f, e in zip(found, exact, strict=True)]
        errors.append(max(float((wrong[0] * wrong[1]).sum()) / max(energy, 1e-300), 0.0) ** 0.5)
        if errors[-1] <= error:
            break
    return min(int(np.ceil(_reached(TRIALS[:len(errors)], errors, error) / _STEP)) * _STEP, MAX_FIT)


def fitting_density(charts: Charts, trial: Trial) -> Generator[float, None, float]:
    """Texels a metre at which the texture of some charts is as fine as a trial of its UVs says."""
    side = TRIALS[-1]
    while True:
        try:
            atlas = yield from scaled(lay_out(charts, side=side, padding=1), 0, 0.5)
            break
        except UserError:  # too small for the charts
            if side >= MAX_FIT:
                raise
            side *= 2
    fitting = yield from scaled(trial(atlas.uv), 0.5, 0.5)
    return atlas.texels_per_metre * fitting / atlas.side


def _around(coverage: Coverage, places: NDArray) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows (n, 4) of a coverage that a bilinear lookup at uv (n, 2) reads, and their shares (n, 4)."""
    side = coverage.side
    x = places * side - 0.5
    low = np.floor(x).astype(np.int64)
    along = x - low
    rows, mix = np.empty((len(places), 4), np.int64), np.empty((len(places), 4))
    for corner, (i, j) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
        column, row = np.clip(low + (i, j), 0, side - 1).T
        texel = row * side + column
        found = np.minimum(np.searchsorted(coverage.texels, texel), len(coverage.texels) - 1)
        there = coverage.texels[found] == texel
        rows[:, corner] = found
        mix[:, corner] = there * (along[:, 0] if i else 1 - along[:, 0]) * (along[:, 1] if j else 1 - along[:, 1])
    lost = np.flatnonzero(mix.sum(1) <= 0)  # other charts took the texels: what a fill shows there
    rows[lost, 0], mix[lost, 0] = _nearest(coverage, np.clip(np.rint(x[lost]), 0, side - 1).astype(np.int64)), 1
    return rows, mix / mix.sum(1, keepdims=True)


def _nearest(coverage: Coverage, texels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Row of the covered texel that is nearest to each of some columns and rows (n, 2)."""
    rows, columns = np.divmod(coverage.texels, coverage.side)
    return np.array([np.argmin((columns - column) ** 2 + (rows - row) ** 2) for column, row in texels], np.int64)


def _traced(points: TriangleMesh, *, method: str, order: int, scene: Occluders | None, seed: int, threads: int | None,
            rays: int, first: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two traces (n, K) of the same points, with seeds of their own; `first` numbers them."""
    plain = "embree" if scene is not None else method  # a sample has no neighbours to learn from
    one, two = (methods.run(methods.bake(points, plain, order, rays=rays if scene is not None else None, scene=scene,
                                         threads=threads,
                                         seed=int(np.random.SeedSequence([seed, 1, first + n]).generate_state(1)[0])))
                for n in range(2))
    return one.coefficients.astype(np.float64), two.coefficients.astype(np.float64)


def _reached(sides: Sequence[int], errors: Sequence[float], error: float) -> float:
    """The side at which the error is reached, on a line through its last two measurements in logarithms."""
    if len(errors) == 1:
        return sides[0]
    (e0, e1), side = (max(e, 1e-9) for e in errors[-2:]), sides[-1]
    rate = float(np.log2(e0 / e1))
    if e1 > error:
        rate = min(max(rate, _LEAST_RATE), _MOST_RATE)
    return side * 2.0 ** (np.log2(e1 / error) / rate)
