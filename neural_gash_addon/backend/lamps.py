# SPDX-License-Identifier: GPL-3.0-or-later
"""What lamps add to a bake: irradiance at its points, to the same tolerance, by paths or by the embedding's network."""
from __future__ import annotations

import logging
import math
import time
from collections.abc import Generator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import embedding_bake
from .errors import UserError
from .geometry import TriangleMesh
from .irradiance import BATCHES, Irradiance, irradiance
from .lit_points import count_of
from .lit_scene import LitScene
from .progress import scaled
from .raycast import Occluders
from .record import LAMPS_BASIS
from .transfer import Transfer

_PILOT = 0.1    # of the progress
_SAFELY = 1.05  # times the paths that the error asks for, which is an estimate
FEWEST, MOST = 32, 4096  # paths from a point, to begin with and where the tolerance is not met before
# What the network takes, in paths: for measuring its error, at each scene point, and at each point (docs/embedding.md).
_MEASURED, _SCENE_POINT, _POINT = 130_000, 100, 80
_WORTH = 2      # times what it takes have to be saved, as it may turn out to be no good
_BEST = 0.04    # relative error below which it has been in no room
_TRIAL = 512    # points at which it is tried


_LOGGER = logging.getLogger(__name__)
Found = tuple[Irradiance, int, str]  # with its paths from each point, and a sentence of why


@dataclass(eq=False)
class Lamps:
    """What a bake with lamps wants."""

    scene: LitScene           # in the frame of the bake, metres
    key: str                  # what tells it from others
    notice: str = ""          # what of the lamps is not in it
    rays: int | None = None   # paths from every point, or
    tolerance: float | None = None  # relative L2 error to reach
    # Whether what surfaces reflect is the network's, and direct light alone is traced; needs torch. None: where that
    # keeps to the tolerance and is quicker.
    learned: bool | None = False
    # Bands of light by direction, for gloss: with more than one, transfer gets (N, 3 order²) numbers instead of (N, 3):
    # irradiance, and then the other harmonics of radiance times cosine (`irradiance.Irradiance.shape`), in RGB.
    order: int = 1
    _room: Any = None         # embedding_bake.Room, once it has been encoded

    @cached_property
    def _occluders(self) -> Occluders:
        return self.scene.occluders()

    def add(self, transfer: Transfer, mesh: TriangleMesh, seed: int, threads: int | None
            ) -> Generator[float, None, Transfer]:
        """The transfer of a mesh's points with the irradiance at them."""
        began = time.perf_counter()
        found, rays, why = yield from (self._predicted if self.learned else self._traced)(mesh, seed, threads)
        light = found.values
        if found.shape is not None:
            light = np.concatenate([light, found.shape[:, 1:].reshape(len(light), -1)], 1)
        plan = f"{transfer.record.plan} {why}".strip()
        record = replace(transfer.record, plan=plan, lamps=self.key, lamps_order=self.order,
                         lamps_rays=rays * len(mesh.points), lamps_error=relative(found),
                         lamps_notice=" ".join(filter(None, (found.notice, self.notice))),
                         basis=transfer.record.basis + LAMPS_BASIS,
                         seconds=transfer.record.seconds + time.perf_counter() - began)
        return replace(transfer, irradiance=light, record=record)

    @property
    def _bands(self) -> int:
        """That are asked of the tracer and of the network."""
        return self.order if self.order > 1 else 0

    def _predicted(self, mesh: TriangleMesh, seed: int, threads: int | None) -> Generator[float, None, Found]:
        """By the light-transport embedding; the paths are those of direct light. As good as it gets: the error is
        measured, and not brought to a tolerance.
        """
        yield from scaled(self._encode(threads), 0.0, 0.4)
        found = yield from scaled(self._asked(mesh, np.arange(len(mesh.points)), seed, threads), 0.4, 0.6)
        if self.tolerance is not None and not relative(found) <= self.tolerance:
            found = replace(found, notice="The network's error is above the tolerance; by paths it would be met.")
        return found, embedding_bake.STRAIGHT, ""

    def _encode(self, threads: int | None) -> Generator[float, None, None]:
        """Make the room of the scene, if it is not there: the same whichever mesh or tile is the first to ask."""
        if self._room is None and len(self.scene.emitters):
            self._room = yield from embedding_bake.encoded(self.scene, threads=threads,
                                                           occluders=self._occluders, directions=self.order > 1)

    def _asked(self, mesh: TriangleMesh, rows: NDArray, seed: int, threads: int | None
               ) -> Generator[float, None, Irradiance]:
        """What the network says at some points."""
        return (yield from embedding_bake.irradiance(
            self.scene, mesh.points[rows], mesh.normals[rows], seed=seed, threads=threads, occluders=self._occluders,
            clearance=mesh.clearance[rows], room=self._room, order=self._bands))

    def _learned(self, mesh: TriangleMesh, paths: float, seed: int, threads: int | None
                 ) -> Generator[float, None, Found | None]:
        """As `_predicted`, if that keeps to the tolerance at some points; `paths` from each are what it would save."""
        assert self.tolerance is not None
        facing = np.flatnonzero(mesh.normals.any(1))
        rows = np.random.default_rng([seed, 12]).permutation(facing)[:_TRIAL]
        try:
            yield from scaled(self._encode(threads), 0.0, 0.4)
            tried = yield from scaled(self._asked(mesh, rows, seed, threads), 0.4, 0.1)
            if not relative(tried) <= self.tolerance:
                return None
            found = yield from scaled(self._asked(mesh, np.arange(len(mesh.points)), seed, threads), 0.5, 0.5)
        except UserError:  # no torch, or a larger room than it knows: paths need neither
            return None
        except (RuntimeError, AttributeError, ImportError):  # a torch that is broken, or its GPU full: nor that
            _LOGGER.warning("PyTorch failed, so paths find the light of lamps.", exc_info=True)
            return None
        if not relative(found) <= self.tolerance:
            return None
        return found, embedding_bake.STRAIGHT, (f"Lamps by the network, which is {100 * relative(found):.2g} % off: "
                                                f"quicker than {paths:.0f} paths a point.")

    def _worth(self, paths: float, points: int) -> bool:
        """Whether to try the network, if so many paths from each of so many points are still missing."""
        assert self.tolerance is not None
        # the room counts even where it is there: what a tile is baked by shall not hang on those before it
        room = _MEASURED + _SCENE_POINT * count_of(self.scene)
        return self.tolerance >= _BEST and points > _TRIAL and paths * points > _WORTH * (room + _POINT * points)

    def _traced(self, mesh: TriangleMesh, seed: int, threads: int | None) -> Generator[float, None, Found]:
        """By paths.

        To a tolerance, as many paths again as there are, or the fewer that the error so far asks for, until it is met.
        """
        rays = _whole_batches(self.rays or FEWEST)
        tolerance = np.inf if self.tolerance is None else self.tolerance
        found: Irradiance | None = None
        done = 0
        start, share = 0.0, 1.0 if self.tolerance is None else _PILOT  # of the progress
        for number in range(MOST):
            more = yield from scaled(irradiance(
                self.scene, mesh.points, mesh.normals, rays, seed=_seed(seed, number), threads=threads,
                occluders=self._occluders, clearance=mesh.clearance, order=self._bands), start, share)
            found = more if found is None else _mean(found, done, more, rays)
            done, start = done + rays, start + share
            error = relative(found)
            if error <= tolerance or done >= MOST:
                break
            missing = min(MOST, _SAFELY * done * (error / tolerance) ** 2) - done
            if number == 0 and self.learned is None and self._worth(missing, len(mesh.points)):
                learned = yield from scaled(self._learned(mesh, missing, seed, threads), start, 0.5 * (1 - start))
                if learned is not None:
                    return learned
                start += 0.5 * (1 - start)
            rays = _whole_batches(min(done, missing))
            share = (1 - start) * min(1.0, rays / missing)
        assert found is not None
        return found, done, ""


def relative(found: Irradiance) -> float:
    """Relative L2 error, by the standard errors of all points and channels; 0 where it is dark."""
    energy = float(np.square(found.values, dtype=np.float64).sum())
    return float(np.square(found.error, dtype=np.float64).sum() / energy) ** 0.5 if energy else 0.0


def _mean(first: Irradiance, rays: int, second: Irradiance, more: int) -> Irradiance:
    """Of two with these numbers of paths."""
    a, b = np.float32(rays / (rays + more)), np.float32(more / (rays + more))
    shape = None if first.shape is None or second.shape is None else a * first.shape + b * second.shape
    return Irradiance(a * first.values + b * second.values, np.hypot(a * first.error, b * second.error), first.notice,
                      shape)


def _whole_batches(rays: float) -> int:
    """So many paths or a few more, which the tracer can deal out evenly."""
    return max(1, math.ceil(rays / BATCHES)) * BATCHES


def _seed(seed: int, number: int) -> int:
    return int(np.random.SeedSequence([seed, 7, number]).generate_state(1)[0])
