# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance in a room by the light-transport embedding: encode the room once, then ask for any points. Needs torch.

Light straight from emitters is path traced at each point, where it has little noise. What was reflected is traced at
scene points alone, with few paths, and the network says from them what it is anywhere; where asked, by direction, too.
But in gaps between things that are narrower than its codes are apart, it is traced as well.
"""
from __future__ import annotations

import logging
from collections.abc import Generator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import embedding, weights
from . import irradiance as tracing
from . import spherical_harmonics as sh
from .enclosed import NEAR, enclosed
from .errors import UserError
from .geometry import NOT_FINITE
from .irradiance import Irradiance
from .lit_points import LitPoints, lit_points
from .lit_scene import LitScene
from .nearest import nearest_to
from .paper_bake import import_torch
from .progress import scaled
from .raycast import Occluders

STRAIGHT = 128                  # paths for light straight from emitters: what they cost is about what decoding does
QUERIES_AT_ONCE = 4096          # decoded together, so that memory does not grow with their number
CHECKED, CHECKS = 128, 1024     # points whose reflected light is traced as well, to know the error; paths of each
ENCLOSED = 512                  # paths for reflected light at points in gaps, where the network is not asked
_LOGGER = logging.getLogger(__name__)


def network() -> Any:
    """The trained network: networks.embedding.Embedding of the configuration that was trained, in `eval` mode.

    Raises:
        UserError: no torch, or no weights, or not those that were trained.
    """
    import_torch("embedding")
    from .networks.embedding import FULL, SMALL, Embedding

    arrays = weights.load(weights.FOLDER / weights.EMBEDDING)
    width = len(arrays["encoder.transform.leave.weight"])
    return weights.filled(Embedding(FULL if width == FULL.widths[-1] else SMALL), arrays)


def radiance_network(model: Any) -> Any:
    """The trained radiance decoder, for the codes of `network()`, the model: networks.radiance.Radiance, likewise.

    Raises:
        UserError: no weights, or not those that were trained.
    """
    from .networks.radiance import Radiance

    return weights.filled(Radiance(model.settings), weights.load(weights.FOLDER / weights.RADIANCE))


def encoded(scene: LitScene, *, seed: int = 0, threads: int | None = None, occluders: Occluders | None = None,
            directions: bool = False) -> Generator[float, None, Room | None]:
    """A scene's room, to be asked by `irradiance` any number of times; None where no surface has an area.

    On the GPU, where there is one with enough memory.

    Args:
        directions: it can be asked for light by direction, too.
    Raises:
        UserError: no torch or weights, or a room larger than the network knows.
    """
    refuse_larger(scene.corners[:len(scene.corners) - scene.bodiless])
    model = network()
    decoder = radiance_network(model) if directions else None
    lit = yield from lit_points(scene, occluders or scene.occluders(), seed=seed, threads=threads,
                                order=0 if decoder is None else decoder.order)
    if not len(lit.places):
        return None
    torch = import_torch("embedding")
    if torch.cuda.is_available():
        try:
            return Room(model, lit, decoder, "cuda")
        except torch.cuda.OutOfMemoryError:
            _LOGGER.warning("The GPU has too little memory for this room; its processor does the work.")
            torch.cuda.empty_cache()
    return Room(model, lit, decoder)


def irradiance(scene: LitScene, points: NDArray, normals: NDArray, *, seed: int = 0, threads: int | None = None,
               occluders: Occluders | None = None, clearance: NDArray | None = None, room: Room | None = None,
               order: int = 0) -> Generator[float, None, Irradiance]:
    """Light that arrives at points, as `irradiance.irradiance` gives it: direct light traced, reflected light learned.

    Args:
        points: (N, 3) metres. normals: (N, 3) unit; where it is zero, the irradiance is.
        occluders: `scene.occluders()`, if it is there already. clearance: (N, 3), as `irradiance.irradiance`.
        room: of the scene, if it is there already; encoded with `directions` where there is an order.
        order: bands of light by direction, at most those of the network, 5; 0 for none. It has no `shape_error`.
    Returns:
        `error` is that of direct light, by its paths, and of reflected light, by how far off the network is at CHECKED
        of the points: one share of all values; at those in gaps (`enclosed`), by their paths.
    Raises:
        UserError: no torch or weights, points that are not finite, or a room larger than the network knows.
        ValueError: a higher order than the network's, or any of a room that was encoded without directions.
    """
    if order > sh.MAX_ORDER:
        raise ValueError(f"order {order} is above {sh.MAX_ORDER}, which the network was trained with")
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    if not (np.isfinite(points).all() and np.isfinite(normals).all()):
        raise UserError(NOT_FINITE)
    if not len(scene.emitters):
        values, error = np.zeros((2, len(points), 3), np.float32)
        return Irradiance(values, error, tracing.DARK,
                          np.zeros((len(points), order * order, 3), np.float32) if order else None)
    occluders = occluders or scene.occluders()
    clearance = normals if clearance is None else clearance

    def traced(rows: NDArray, rays: int, straight: bool, start: float, share: float, bands: int
               ) -> Generator[float, None, Irradiance]:
        return (yield from scaled(tracing.irradiance(
            scene, points[rows], normals[rows], rays, depth=1 if straight else tracing.DEPTH, straight=straight,
            seed=seed + 1, threads=threads, occluders=occluders, clearance=clearance[rows],
            order=bands), start, share))

    if room is None:
        room = yield from scaled(encoded(scene, seed=seed, threads=threads, occluders=occluders,
                                         directions=bool(order)), 0.0, 0.3)
    direct = yield from traced(np.arange(len(points)), STRAIGHT, True, 0.3, 0.3, order)
    if room is None:
        return direct
    found, shape = yield from scaled(room.reflected_from(points, normals, direct.values, order), 0.6, 0.2)
    within = enclosed(points, normals, clearance, NEAR * room.spacing(points), occluders, seed)
    gaps, others = np.flatnonzero(within), np.flatnonzero(~within & normals.any(1))
    paths = yield from traced(gaps, ENCLOSED, False, 0.8, 0.1, order)
    checked = np.random.default_rng([seed, 11]).permutation(others)[:CHECKED]
    truth = yield from traced(checked, CHECKS, False, 0.9, 0.1, 0)
    error = _share_off(found[checked], truth) * found
    found[gaps], error[gaps] = paths.values, paths.error
    if paths.shape is not None:
        shape[gaps] = paths.shape
    return Irradiance(direct.values + found, np.hypot(direct.error, error).astype(np.float32), "",
                      None if direct.shape is None else direct.shape + shape)


def _share_off(found: NDArray, truth: Irradiance) -> float:
    """Relative error of values (n, 3) by a noisy truth: what its noise does not explain, and a standard error more."""
    found, values, noise = (np.asarray(each, np.float64) for each in (found, truth.values, truth.error))
    energy = float(np.square(found).sum())
    if not energy or not len(found):
        return 0.0
    beyond = (np.square(found - values) - np.square(noise)).sum(1)
    return float(max(beyond.sum(), 0.0) + len(beyond) ** 0.5 * beyond.std()) ** 0.5 / energy ** 0.5


def refuse_larger(places: NDArray) -> None:
    """Raises UserError where a room of places (..., 3) is larger than any that the network knows."""
    size = float(np.ptp(places.reshape(-1, 3), axis=0).max())
    if size > embedding.LARGEST:
        raise UserError(f"The room is {size:.1f} m long, and the network knows rooms of up to "
                        f"{embedding.LARGEST:.0f} m; bake it in parts, or choose another method.")


class Room:
    """A room's codes, which answer for any point."""

    def __init__(self, model: Any, points: LitPoints, radiance: Any = None, device: str = "cpu") -> None:
        """Encode at least one point.

        Args:
            model: networks.embedding.Embedding in `eval` mode, moved to the device.
            radiance: networks.radiance.Radiance, likewise, where light by direction is asked; of its order are the
                points' shapes.
        """
        import torch

        from .networks.embedding import Frame, level

        self.model, self._where = model.to(device), device
        self.radiance: Any = None if radiance is None else radiance.to(device)
        sizes = model.settings
        self._surface = np.concatenate([points.places, points.normals, points.albedo], 1)
        self._centre = np.mean(points.places, axis=0, dtype=np.float64)
        self._layout = embedding.layout(points.places, sizes.halvings, sizes.gathered, sizes.around)
        self._frame = Frame.of(self._tensor(points.places - self._centre), self._tensor(points.normals), self._layout)
        self._anchors = points.places[:len(self._layout.around)]
        albedo, emission, direct, indirect = (self._tensor(each.T) for each in (
            points.albedo, np.pi * points.emission, points.direct, points.indirect))
        self.level = level(indirect, self._frame.areas)  # (3,); zero where nothing was reflected
        unit = self.level.clamp_min(1e-30)[:, None]
        with torch.no_grad():
            self.codes = model.encoder(self._frame, albedo, emission / unit, direct / unit, indirect / unit)
            if radiance is not None:
                assert points.shape is not None
                self._beyond = radiance.encode(
                    self.codes, self._frame, indirect / unit, self._tensor(points.shape.transpose(2, 0, 1)) /
                    unit[..., None], self._tensor(sh.cosine_lobe(points.normals, radiance.order)))

    def reflected(self, points: NDArray, normals: NDArray, direct: NDArray
                  ) -> Generator[float, None, NDArray[np.float32]]:
        """(N, 3) reflected light at points; see `reflected_from`."""
        found, _ = yield from self.reflected_from(points, normals, direct, 0)
        return found

    def reflected_from(self, points: NDArray, normals: NDArray, direct: NDArray, order: int
                       ) -> Generator[float, None, tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """(N, 3) reflected light at points, and the same by direction (N, K, 3), as `irradiance.Irradiance` has it.

        Args:
            points: (N, 3) metres. normals: (N, 3) unit; where it is zero, so is the light.
            direct: (N, 3) light straight from emitters.
            order: bands, at most those of `radiance`; 0 for none.
        Raises:
            ValueError: an order, where it was encoded without `radiance`.
        """
        import torch

        if order and self.radiance is None:
            raise ValueError("this room was encoded without directions, so it has no light by direction")
        out, unit = np.zeros((len(points), 3), np.float32), self.level[:, None]
        shape, terms = np.zeros((len(points), order * order, 3), np.float32), order * order
        for start in range(0, len(points), QUERIES_AT_ONCE):
            rows = slice(start, start + QUERIES_AT_ONCE)
            anchors = nearest_to(points[rows], self._anchors, self.model.settings.neighbours)
            near = torch.from_numpy(anchors).to(self._where)
            places, facing = self._tensor(points[rows] - self._centre), self._tensor(normals[rows])
            straight = self._tensor(direct[rows].T) / unit.clamp_min(1e-30)
            albedo = self._tensor(embedding.colours(points[rows], normals[rows], anchors[:, 0], self._layout.gathered,
                                                    self._surface).T)
            with torch.no_grad():
                found = self.model.decoder(self.codes, self._frame, places, facing, albedo, straight, near)
                out[rows] = (found * unit).T.cpu().numpy()
                if order:
                    lobes = self._tensor(sh.cosine_lobe(normals[rows], self.radiance.order))
                    by_way = self.radiance(self.codes, self._beyond, self._frame, places, facing, lobes, straight,
                                           found, near)[..., :terms]
                    shape[rows] = (by_way * unit[..., None]).permute(1, 2, 0).cpu().numpy()
            yield min(rows.stop / len(points), 1.0)
        dark = ~np.any(normals, axis=1)
        out[dark], shape[dark] = 0, 0
        return out, shape

    def spacing(self, points: NDArray) -> NDArray[np.float32]:
        """(N,) metres between codes, about, at points (N, 3)."""
        return self._frame.spacing.cpu().numpy()[nearest_to(points, self._anchors, 1)[:, 0]]

    def _tensor(self, array: NDArray) -> Any:
        import torch

        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(self._where)
