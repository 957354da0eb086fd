# SPDX-License-Identifier: GPL-3.0-or-later
"""What lamps add to a bake: irradiance at its points, to the same tolerance."""
from __future__ import annotations

import math
import time
from collections.abc import Generator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from . import embedding_bake
from .geometry import TriangleMesh
from .irradiance import BATCHES, Irradiance, irradiance
from .lit_scene import LitScene
from .progress import scaled
from .raycast import Occluders
from .record import LAMPS_BASIS
from .transfer import Transfer

_PILOT = 0.1    # of the progress
_SAFELY = 1.05  # times the paths that the error asks for, which is an estimate
FEWEST, MOST = 32, 4096  # paths from a point, to begin with and where the tolerance is not met before


@dataclass(eq=False)
class Lamps:
    """What a bake with lamps wants."""

    scene: LitScene           # in the frame of the bake, metres
    key: str                  # what tells it from others
    notice: str = ""          # what of the lamps is not in it
    rays: int | None = None   # paths from every point, or
    tolerance: float | None = None  # relative L2 error to reach
    learned: bool = False     # what surfaces reflect is the network's, of which direct light is traced; needs torch
    _room: Any = None         # embedding_bake.Room, once it has been encoded

    @cached_property
    def _occluders(self) -> Occluders:
        return self.scene.occluders()

    def add(self, transfer: Transfer, mesh: TriangleMesh, seed: int, threads: int | None
            ) -> Generator[float, None, Transfer]:
        """The transfer of a mesh's points with the irradiance at them."""
        began = time.perf_counter()
        found, rays = yield from (self._predicted if self.learned else self._traced)(mesh, seed, threads)
        record = replace(transfer.record, lamps=self.key, lamps_rays=rays * len(mesh.points),
                         lamps_error=relative(found),
                         lamps_notice=" ".join(filter(None, (found.notice, self.notice))),
                         basis=transfer.record.basis + LAMPS_BASIS,
                         seconds=transfer.record.seconds + time.perf_counter() - began)
        return replace(transfer, irradiance=found.values, record=record)

    def _predicted(self, mesh: TriangleMesh, seed: int, threads: int | None
                   ) -> Generator[float, None, tuple[Irradiance, int]]:
        """Irradiance by the light-transport embedding, and the paths of its direct light. As good as it gets: the
        error is measured, and not brought to a tolerance.
        """
        start = 0.0
        if self._room is None and len(self.scene.emitters):
            start = 0.4
            self._room = yield from scaled(embedding_bake.encoded(
                self.scene, seed=seed, threads=threads, occluders=self._occluders), 0.0, start)
        found = yield from scaled(embedding_bake.irradiance(
            self.scene, mesh.points, mesh.normals, seed=seed, threads=threads, occluders=self._occluders,
            clearance=mesh.clearance, room=self._room), start, 1 - start)
        if self.tolerance is not None and relative(found) > self.tolerance:
            found = replace(found, notice="The network's error is above the tolerance; by paths it would be met.")
        return found, embedding_bake.STRAIGHT

    def _traced(self, mesh: TriangleMesh, seed: int, threads: int | None
                ) -> Generator[float, None, tuple[Irradiance, int]]:
        """Irradiance, and its paths from each point.

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
                occluders=self._occluders, clearance=mesh.clearance), start, share)
            found = more if found is None else _mean(found, done, more, rays)
            done, start = done + rays, start + share
            error = relative(found)
            if error <= tolerance or done >= MOST:
                break
            missing = min(MOST, _SAFELY * done * (error / tolerance) ** 2) - done
            rays = _whole_batches(min(done, missing))
            share = (1 - start) * min(1.0, rays / missing)
        assert found is not None
        return found, done


def relative(found: Irradiance) -> float:
    """Relative L2 error, by the standard errors of all points and channels; 0 where it is dark."""
    energy = float(np.square(found.values, dtype=np.float64).sum())
    return float(np.square(found.error, dtype=np.float64).sum() / energy) ** 0.5 if energy else 0.0


def _mean(first: Irradiance, rays: int, second: Irradiance, more: int) -> Irradiance:
    """Of two with these numbers of paths."""
    a, b = np.float32(rays / (rays + more)), np.float32(more / (rays + more))
    return Irradiance(a * first.values + b * second.values, np.hypot(a * first.error, b * second.error), first.notice)


def _whole_batches(rays: float) -> int:
    """So many paths or a few more, which the tracer can deal out evenly."""
    return max(1, math.ceil(rays / BATCHES)) * BATCHES


def _seed(seed: int, number: int) -> int:
    return int(np.random.SeedSequence([seed, 7, number]).generate_state(1)[0])
