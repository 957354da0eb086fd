# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer textures (PRTT, algorithm 1): a bake of the texels, some rows at a time, that can be resumed."""
from __future__ import annotations

import re
import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from . import methods
from .bounce import Reflection
from .errors import UserError
from .exchange import atomic, reason
from .geometry import Surface
from .progress import scaled
from .raster import CHECKED_SIDE, Layout
from .raycast import Geometry, Occluders
from .record import BakeRecord
from .texels import NormalMap, fill_map, texel_points
from .unwrap import unwrap

CHANNELS = 4             # coefficients that one image holds
MIN_SIDE, MAX_SIDE = 16, 8192
_ATLAS_SHARE = 0.1       # of the progress
_TILE = 1 << 18          # texels of a tile, covered or not: some seconds of work
_OURS = re.compile(r"\d{4}\.(npy|json)")
_JOB = "job.json"


@dataclass(frozen=True, eq=False)
class TextureTransfer:
    """Transfer at the covered texels of a texture, and the record that explains it."""

    uv: NDArray[np.float64]                  # (C, 2) of each face corner
    texels: list[NDArray[np.int64]]          # of each tile, (n,) row * side + column
    coefficients: list[NDArray[np.float32]]  # of each tile, (n, K); coloured ones (n, 3K), red, green, blue of each
    record: BakeRecord

    def fill_map(self) -> NDArray[np.int64]:
        """Which covered texel each of the side * side shows; see `texels.fill_map`."""
        side = self.record.side
        covered = np.zeros(side * side, bool)
        for texels in self.texels:
            covered[texels] = True
        return fill_map(covered.reshape(side, side))

    def image(self, index: int, filled: NDArray[np.int64]) -> NDArray[np.float32]:
        """Numbers 4 * index .. 4 * index + 3 of the texels as an image (side * side, 4), row 0 at the bottom."""
        out = np.zeros((self.record.side ** 2, CHANNELS), np.float32)
        for texels, coefficients in zip(self.texels, self.coefficients, strict=True):
            part = coefficients[:, CHANNELS * index:CHANNELS * (index + 1)]
            out[texels, :part.shape[1]] = part
        return out[filled]


def image_count(terms: int) -> int:
    """How many images the numbers of a texel take."""
    return -(-terms // CHANNELS)


def bake(surface: Surface, method: str = "embree", order: int = 5, *, uv: NDArray | None = None,
         side: int | None = None, texels_per_metre: float | None = None, padding: int = 2, rays: int | None = None,
         tolerance: float | None = None, occluders: Sequence[Geometry] = (), normal_maps: Sequence[NormalMap] = (),
         seed: int = 0, threads: int | None = None, folder: Path | None = None, key: str = "",
         reflection: Reflection | None = None) -> Generator[float, None, TextureTransfer]:
    """Bake the transfer of a texture's texels.

    Args:
        uv: (C, 2) of each face corner, 0 to 1, without overlaps; an atlas is made where not given.
        side: texels a side, or, for an atlas, texels_per_metre to have it as large as that takes.
        padding: texels between the charts of an atlas.
        method, order, rays, tolerance, occluders, seed, threads: as `methods.bake`; a tolerance is
            met by every tile.
        folder: where finished tiles are kept, so that a bake that was killed goes on from there and
            gives the same numbers. key: what tells this bake from others in the same folder.
        reflection: light that bounces, if any shall.
    Yields:
        Progress, 0 to 1.
    Raises:
        UserError: arguments out of range, UVs outside the texture, or faces that overlap in it.
    """
    began = time.perf_counter()
    _check_side(side, texels_per_metre)
    start_at = 0.0
    if uv is None:
        start_at = _ATLAS_SHARE
        atlas = yield from scaled(
            unwrap(surface, side=side, texels_per_metre=texels_per_metre, padding=padding), 0, _ATLAS_SHARE)
        uv, side = atlas.uv, atlas.side
        _check_side(side, None)
    elif len(pairs := Layout(uv[surface.corners], surface.triangles, min(side or 0, CHECKED_SIDE)).overlapping()):
        raise UserError(overlap_message(pairs, surface.polygons))
    assert side is not None
    layout = Layout(uv[surface.corners], surface.triangles, side)
    store = _Store(folder, key) if folder is not None else None
    scene: Occluders | None = None
    rows = max(1, _TILE // side)
    texels, coefficients, records = [], [], []
    for number, start in enumerate(range(0, side, rows)):
        stop = min(start + rows, side)
        coverage = layout.coverage(start, stop)
        done, share = start_at + (1 - start_at) * start / side, (1 - start_at) * (stop - start) / side
        yield done
        if not len(coverage.texels):
            continue
        found = store.load(number, len(coverage.texels)) if store else None
        if found is None:
            mesh = texel_points(surface, coverage, normal_maps)
            if scene is None and methods.METHODS[method].traces:
                scene = Occluders([(mesh.positions, mesh.triangles), *occluders], mesh.resolution)
            baking = methods.bake(mesh, method, order, rays=rays, tolerance=tolerance, seed=_tile_seed(seed, number),
                                  occluders=occluders, threads=threads, scene=scene, reflection=reflection)
            transfer = yield from scaled(baking, done, share)
            found = transfer.coefficients.reshape(len(mesh.points), -1), transfer.record
            if store:
                found = store.save(number, *found)
        texels.append(coverage.texels)
        coefficients.append(found[0])
        records.append(found[1])
    if not texels:
        raise UserError("The UVs leave no face any room in the texture, so there is nothing to bake.")
    return TextureTransfer(uv, texels, coefficients, _whole(records, coefficients, seed, side, began))


def _check_side(side: int | None, texels_per_metre: float | None) -> None:
    """UserError unless a texture of this size can be baked."""
    if side is None:
        if not (texels_per_metre is not None and 0 < texels_per_metre < np.inf):
            raise UserError("Give a resolution, or a positive number of texels per metre.")
    elif not MIN_SIDE <= side <= MAX_SIDE:
        raise UserError(f"The resolution must be {MIN_SIDE} to {MAX_SIDE} texels, not {side}.")


def overlap_message(pairs: NDArray, polygons: NDArray) -> str:
    """A sentence that names faces which claim the same texels; pairs: (m, 2) triangles."""
    faces = np.unique(np.sort(polygons[pairs], axis=1), axis=0)
    named = ", ".join(f"{a} and {b}" for a, b in faces[:5])
    more = f" and {len(faces) - 5:,} more pairs" if len(faces) > 5 else ""
    return (f"Faces lie over each other in the UV map ({named}{more}), so they cannot have shadows of their own; "
            "unwrap them apart, or let the bake make its own UV map.")


def _tile_seed(seed: int, number: int) -> int:
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def _whole(records: list[BakeRecord], coefficients: list[NDArray], seed: int, side: int, began: float) -> BakeRecord:
    """One record of all tiles."""
    energy = np.array([np.square(c, dtype=np.float64).sum() for c in coefficients])
    errors = [r.error_estimate for r in records]
    error = None
    if all(e is not None for e in errors):
        error = float((np.square(np.array(errors, float)) * energy).sum() / max(energy.sum(), 1e-300)) ** 0.5
    return replace(records[0], points=sum(r.points for r in records), rays=sum(r.rays for r in records),
                   probe_rays=sum(r.probe_rays for r in records), seconds=time.perf_counter() - began,
                   error_estimate=error, seed=seed, target="texture", side=side)


class _Store:
    """Finished tiles in a folder: NNNN.npy, and then NNNN.json, whose being there says that both are whole."""

    def __init__(self, folder: Path, key: str) -> None:
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            job = folder / _JOB
            if not job.exists() or job.read_text() != key:
                self.clear()
                with atomic(job) as draft:
                    draft.write_text(key)
        except OSError as error:
            raise UserError(f"Tiles cannot be kept in '{folder}' ({reason(error)}).") from error

    def load(self, number: int, points: int) -> tuple[NDArray[np.float32], BakeRecord] | None:
        """A finished tile; None where it is not there."""
        try:
            record = BakeRecord.from_json((self._folder / f"{number:04d}.json").read_text())
            coefficients = np.load(self._folder / f"{number:04d}.npy", mmap_mode="r")
        except (OSError, ValueError, UserError):
            return None
        return (coefficients, record) if coefficients.shape == (points, record.terms) else None

    def save(self, number: int, coefficients: NDArray[np.float32], record: BakeRecord
             ) -> tuple[NDArray[np.float32], BakeRecord]:
        """Keep a tile; the same, its coefficients on disk."""
        values, text = self._folder / f"{number:04d}.npy", self._folder / f"{number:04d}.json"
        try:
            with atomic(values) as draft, draft.open("wb") as file:
                np.save(file, coefficients)
            with atomic(text) as draft:
                draft.write_text(record.to_json())
        except OSError as error:
            raise UserError(f"A tile cannot be written to '{self._folder}' ({reason(error)}).") from error
        return np.load(values, mmap_mode="r"), record

    def clear(self) -> None:
        """Remove the tiles, and nothing else that is there."""
        for path in self._folder.iterdir():
            if _OURS.fullmatch(path.name):
                path.unlink()


def remove_tiles(folder: Path) -> None:
    """Remove the tiles of a bake that is over, and their folder if nothing else is in it."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if _OURS.fullmatch(path.name) or path.name == _JOB:
            path.unlink()
    if not any(folder.iterdir()):
        folder.rmdir()
