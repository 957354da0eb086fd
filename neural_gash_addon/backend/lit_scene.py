# SPDX-License-Identifier: GPL-3.0-or-later
"""Everything in a scene that reflects and emits, as one set of triangles."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .geometry import NO_FACES, NOT_FINITE, unit
from .pictures import Picture
from .raycast import Occluders


@dataclass(frozen=True, eq=False)
class LitScene:
    """Triangles, dull on both sides, some of which emit. Metres, linear RGB.

    Raises:
        UserError: no triangles, or numbers that are not finite or out of range.
    """

    positions: NDArray[np.float64]    # (V, 3)
    triangles: NDArray[np.int32]      # (F, 3) counter-clockwise from their front
    albedo: NDArray[np.float64]       # (F, 3) mean of each triangle, 0 to 1
    emission: NDArray[np.float64]     # (F, 3) radiance, W m^-2 sr^-1, 0 or more, the same in all directions
    pictures: Sequence[Picture] = ()  # that say the albedo (columns 0 to 2) from place to place
    front_only: NDArray[np.bool_] | None = None  # (F,) which emit from their front alone, as area lights; else both
    bodiless: int = 0  # so many at the end emit, but no ray meets them: lamps, which block and reflect nothing

    def __post_init__(self) -> None:
        if not len(self.triangles) - self.bodiless:
            raise UserError(NO_FACES)
        if not np.isfinite(self.positions).all():
            raise UserError(NOT_FINITE)
        with np.errstate(over="ignore"):
            sends = np.asarray(self.emission, np.float32)  # as it is traced
        if not (np.isfinite(sends).all() and np.min(sends) >= 0):
            raise UserError("The scene has emission that is negative, infinite or not a number.")
        if not (np.isfinite(self.albedo).all() and np.min(self.albedo) >= 0 and np.max(self.albedo) <= 1):
            raise UserError("The scene has colours that are not between 0 and 1.")

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """(F, 3, 3) positions of the corners of each triangle."""
        return np.asarray(self.positions, np.float64)[self.triangles]

    @cached_property
    def _double(self) -> NDArray[np.float64]:
        """(F, 3) normals as long as twice the area."""
        edges = self.corners[:, 1:] - self.corners[:, :1]
        found: NDArray[np.float64] = np.cross(edges[:, 0], edges[:, 1])
        return found

    @cached_property
    def areas(self) -> NDArray[np.float64]:
        """(F,) square metres; 0 of degenerate ones."""
        found: NDArray[np.float64] = 0.5 * np.linalg.norm(self._double, axis=1)
        return found

    @cached_property
    def normals(self) -> NDArray[np.float64]:
        """(F, 3) unit normals of the fronts; 0 of degenerate triangles."""
        return unit(self._double)

    @cached_property
    def emitters(self) -> NDArray[np.int64]:
        """(E,) triangles that emit."""
        return np.flatnonzero((self.emission > 0).any(1) & (self.areas > 0))

    @cached_property
    def _coloured(self) -> tuple[list[tuple[Picture, NDArray[np.int64]]], NDArray[np.int16], NDArray[np.int64]]:
        """Pictures of albedo and their columns that say it; each triangle's picture, -1: none, and row in it (F,)."""
        found = [(picture, np.flatnonzero(picture.columns < 3)) for picture in self.pictures]
        found = [(picture, columns) for picture, columns in found if len(columns)]
        number, row = np.full(len(self.triangles), -1, np.int16), np.zeros(len(self.triangles), np.int64)
        for index, (picture, _) in enumerate(found):
            number[picture.triangles] = index
            row[picture.triangles] = np.arange(len(picture.triangles))
        return found, number, row

    def albedo_at(self, faces: NDArray[np.int64], u: NDArray, v: NDArray) -> NDArray[np.float32]:
        """(n, 3) at barycentric coordinates u, v (n,) of some triangles (n,), as `raycast.Hits` has them."""
        out = self._albedo32.take(faces, 0)
        pictures, number, row = self._coloured
        if not pictures:
            return out
        numbers = number.take(faces)
        order = np.argsort(numbers, kind="stable")  # NumPy sorts 16 bits by radix
        ends = np.searchsorted(numbers.take(order), np.arange(len(pictures) + 1))
        for (picture, columns), start, stop in zip(pictures, ends[:-1], ends[1:], strict=True):
            here = order[start:stop]
            if len(here):
                places = np.stack([1 - u[here] - v[here], u[here], v[here]], 1)
                out[here[:, None], picture.columns[columns]] = picture.at(row[faces[here]], places)[:, columns]
        return out

    @cached_property
    def _albedo32(self) -> NDArray[np.float32]:
        return np.asarray(self.albedo, np.float32)

    def occluders(self) -> Occluders:
        """For rays; triangles are numbered alike, the bodiless ones left out."""
        resolution = float(np.spacing(np.float32(np.abs(self.positions).max())))
        return Occluders([(self.positions, self.triangles[:len(self.triangles) - self.bodiless])], resolution)
