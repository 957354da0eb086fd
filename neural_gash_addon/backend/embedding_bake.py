# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance in a room by the light-transport embedding: encode the room once, then ask for any points. Needs torch."""
from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import embedding, weights
from .errors import UserError
from .nearest import nearest_to
from .paper_bake import import_torch

QUERIES_AT_ONCE = 4096  # decoded together, so that memory does not grow with their number


def network() -> Any:
    """The trained network: networks.embedding.Embedding, on the GPU where there is one, in `eval` mode.

    None ships yet (docs/embedding.md says why); `python -m training.embedding` writes one.

    Raises:
        UserError: no torch, or no weights, or not those that were trained.
    """
    torch = import_torch("embedding")
    from .networks.embedding import SMALL, Embedding

    model = Embedding(SMALL)
    arrays = weights.load(weights.FOLDER / weights.EMBEDDING)
    model.load_state_dict({key: torch.from_numpy(array.copy()) for key, array in arrays.items()})
    return model.to("cuda" if torch.cuda.is_available() else "cpu").eval()


class Room:
    """A room's codes, which answer for any point."""

    def __init__(self, model: Any, points: NDArray) -> None:
        """Encode scene points.

        Args:
            model: networks.embedding.Embedding, on its device, in `eval` mode.
            points: (M, 12) position (metres), unit normal, albedo, emitted radiance (linear RGB), in farthest-point
                order.
        Raises:
            UserError: there are no points, or the room is larger than any that the network knows.
        """
        import torch

        from .networks.embedding import Layout, level, shining

        if not len(points):
            raise UserError("There is no surface in the room; add one, or choose another method.")
        size = float(np.ptp(points[:, :3], axis=0).max())
        if size > embedding.EXTENT:
            raise UserError(f"The room is {size:.1f} m long, and the network knows rooms of up to "
                            f"{embedding.EXTENT:.0f} m; bake it in parts, or choose another method.")
        self.model, self.positions = model, np.asarray(points[:, :3], np.float64)
        sizes, self._where = model.settings, next(model.parameters()).device
        stages = len(sizes.depths)
        albedo, emission = self._tensor(points[:, 6:9].T), self._tensor(points[:, 9:12].T)
        areas = self._tensor(embedding.areas(self.positions))
        self.level = level(albedo, emission, areas)  # (3,); zero where nothing shines, and all is dark
        places = embedding.normalised(self.positions, self.positions)
        known = Layout.of(embedding.layout(self.positions, stages, sizes.gathered, sizes.around), self._where)
        orders = [torch.from_numpy(order).to(self._where) for order in embedding.orders(places, stages)]
        emission = emission / self.level.clamp_min(1e-30)[:, None]
        normals = self._tensor(points[:, 3:6])
        rows, lamp_areas = shining(emission, areas)
        self.lamps = (self._tensor(places)[rows] * embedding.EXTENT, normals[rows], lamp_areas, emission[:, rows])
        with torch.no_grad():
            self.codes = model.encoder(self._tensor(places), normals, areas, albedo, emission,
                                       self._direct(places, points[:, 3:6]), known, orders)
        self.places = self._tensor(places[:self.codes.shape[1]])

    def irradiance(self, queries: NDArray) -> Generator[float, None, NDArray[np.float32]]:
        """(N, 3) irradiance, linear RGB, of queries (N, 9): position, unit normal, albedo. Yields progress."""
        import torch

        out = np.empty((len(queries), 3), np.float32)
        count = self.codes.shape[1]
        for start in range(0, len(queries), QUERIES_AT_ONCE):
            part = queries[start:start + QUERIES_AT_ONCE]
            near = nearest_to(part[:, :3], self.positions[:count], self.model.settings.neighbours)
            places = embedding.normalised(part[:, :3], self.positions)
            with torch.no_grad():
                found = self.model.decoder(self.codes, self.places, self._tensor(places), self._tensor(part[:, 3:6]),
                                           self._tensor(part[:, 6:9].T), self._direct(places, part[:, 3:6]),
                                           torch.from_numpy(near).to(self._where))
                out[start:start + len(part)] = (found.expm1() * self.level[:, None]).T.cpu().numpy()
            yield min((start + len(part)) / len(queries), 1.0)
        return out

    def _direct(self, places: NDArray, normals: NDArray) -> Any:
        """(3, n) unshadowed light of the lamps at normalised places, in units of the level."""
        import torch

        from .networks.embedding import direct

        return torch.cat([direct(self._tensor(places[at:at + QUERIES_AT_ONCE]) * embedding.EXTENT,
                                 self._tensor(normals[at:at + QUERIES_AT_ONCE]), *self.lamps)
                          for at in range(0, len(places), QUERIES_AT_ONCE)], 1)

    def _tensor(self, array: NDArray) -> Any:
        import torch

        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(self._where)
