# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene points with the light that arrives at them, path traced: what the light-transport embedding reads of a room."""
from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import irradiance
from .lit_scene import LitScene
from .progress import scaled
from .raycast import Occluders
from .scene_points import scene_points

DENSITY = 32       # points to a square metre of surface: about 0.18 m apart
FEWEST, MOST = 4096, 12_288  # of a room
STRAIGHT = 64      # paths for light that comes straight from emitters, of which hardly any noise is left
REFLECTED = 64     # paths for light that was reflected: noisy at one point, and not over a neighbourhood

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class LitPoints:
    """M scene points in farthest-point order."""

    places: Floats    # (M, 3) metres
    normals: Floats   # (M, 3) unit, of the side that is lit
    albedo: Floats    # (M, 3)
    emission: Floats  # (M, 3) radiance, W m^-2 sr^-1
    direct: Floats    # (M, 3) irradiance straight from emitters, W/m^2
    indirect: Floats  # (M, 3) irradiance that was reflected, with the noise of REFLECTED paths
    shape: Floats | None = None  # (M, K, 3) where asked: the same by direction, see `irradiance.Irradiance`


def count_of(scene: LitScene) -> int:
    """How many scene points a scene has: by the area of its surfaces, so that they are as close in large rooms."""
    area = float(scene.areas[:len(scene.areas) - scene.bodiless].sum())
    return round(min(max(DENSITY * area, FEWEST), MOST))


def lit_points(scene: LitScene, occluders: Occluders, count: int | None = None, paths: int = REFLECTED, *,
               seed: int = 0, threads: int | None = None, order: int = 0) -> Generator[float, None, LitPoints]:
    """Points on the surfaces of a scene, lit. Where a front is dark and its back is not, the point is of its back.

    Rooms are often modelled with normals outwards; what is solid is dark inside.

    Args:
        count: of points; `count_of` the scene where it is None. paths: from each, for reflected light. order: bands
            of `shape`; 0 for none.
    Yields:
        Progress, 0 to 1.
    """
    points = scene_points(scene, count or count_of(scene), seed)
    places, normals = points[:, :3], points[:, 3:6].copy()

    def traced(rows: NDArray) -> Generator[float, None, tuple[Floats, Floats, Floats]]:
        found = []
        for part, (rays, straight) in enumerate(((STRAIGHT, True), (paths, False))):
            found.append((yield from scaled(irradiance.irradiance(
                scene, places[rows], normals[rows], rays, depth=1 if straight else irradiance.DEPTH, straight=straight,
                seed=seed, threads=threads, occluders=occluders, order=0 if straight else order), part / 2, 1 / 2)))
        shape = found[1].shape
        return found[0].values, found[1].values, np.zeros((len(rows), 0, 3), np.float32) if shape is None else shape

    direct, indirect, shape = yield from scaled(traced(np.arange(len(points))), 0.0, 0.8)
    dark = np.flatnonzero(~(direct.any(1) | indirect.any(1)))
    normals[dark] *= -1
    direct[dark], indirect[dark], shape[dark] = yield from scaled(traced(dark), 0.8, 0.2)
    normals[dark[~(direct[dark].any(1) | indirect[dark].any(1))]] *= -1
    return LitPoints(places, normals, points[:, 6:9], points[:, 9:], direct, indirect, shape if order else None)
