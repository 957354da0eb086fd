# SPDX-License-Identifier: GPL-3.0-or-later
"""Images on triangles, which say how they reflect from place to place."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .texels import REPEAT, bilinear

# where in a triangle an image is looked up: its centre and half-way to its corners
PLACES = np.array([[4, 4, 4], [8, 2, 2], [2, 8, 2], [2, 2, 8]]) / 12
_LOOKUPS = 4096  # at least, of an image on few triangles


@dataclass(frozen=True, eq=False)
class Picture:
    """An image on some triangles, and which of their numbers it gives: offset + gain * channel."""

    triangles: NDArray[np.int64]  # (f,) ascending
    uv: NDArray[np.float64]       # (f, 3, 2) of their corners
    pixels: NDArray[np.float32]   # (H, W, 3)
    columns: NDArray[np.int64]    # (c,) of the numbers (F, C) of all triangles
    channels: NDArray[np.int64]   # (c,) of the image
    gain: NDArray[np.float64]     # (c,)
    offset: NDArray[np.float64]   # (c,)
    extension: str = REPEAT       # see `texels.bilinear`

    def at(self, rows: NDArray[np.int64], barycentric: NDArray) -> NDArray[np.float64]:
        """Its numbers (n, c) at barycentric coordinates (n, 3) of some of its triangles, rows (n,) of `triangles`."""
        found = bilinear(self.pixels, np.einsum("nc,ncx->nx", barycentric, self.uv[rows]), self.extension)
        return np.clip(found[:, self.channels] * self.gain + self.offset, 0, 1)

    def lookups(self) -> NDArray[np.float64]:
        """(f, n, c) its numbers at n places of each of its triangles, evenly spread; many where there are few."""
        cuts = int(np.ceil(np.sqrt(_LOOKUPS / max(4 * len(self.triangles), 1))))
        i, j = np.divmod(np.arange(cuts * cuts), cuts)
        a, b = (i + 0.5) / cuts, (j + 0.5) / cuts      # of the unit square, folded onto the triangle
        u, v = np.where(a + b > 1, [1 - a, 1 - b], [a, b])
        places = np.concatenate([PLACES, np.stack([1 - u - v, u, v], 1)] if cuts > 1 else [PLACES])
        count = len(self.triangles)
        found = self.at(np.repeat(np.arange(count), len(places)), np.tile(places, (count, 1)))
        return found.reshape(count, len(places), len(self.columns))

    def only(self, kept: NDArray[np.bool_]) -> Picture:
        """The part of it on those of all triangles (F,) that are kept, which are numbered anew."""
        here = kept[self.triangles]
        return replace(self, triangles=(np.cumsum(kept) - 1)[self.triangles[here]], uv=self.uv[here])
