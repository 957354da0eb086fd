# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer textures (PRTT, algorithm 1): a bake of the texels, some rows at a time, that can be resumed."""
from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import methods
from . import spherical_harmonics as sh
from .atlas import Part, place
from .auto_bake import enough_bands
from .bands import all_of
from .bounce import Reflection
from .errors import UserError
from .exchange import atomic, reason
from .geometry import Surface
from .lamps import Lamps
from .progress import scaled
from .raster import Layout
from .raycast import Geometry
from .record import IDENTITY, BakeRecord
from .texels import NormalMap, fill_map, mirrored, scattered, texel_points

CHANNELS = 4             # coefficients that one image holds
_LAYOUT_SHARE = 0.1      # of the progress
_POINTS = 4096           # of the surface, of which some say what order is enough for all tiles
_TILE = 1 << 18          # texels of a tile, covered or not: some seconds of work
_OURS = re.compile(r"\d{4}\.(npy|json)")
_JOB = "job.json"
_SCARCE = 1e-4           # of the energy of transfer: parts of a texture that have no more may have no known error


@dataclass(frozen=True, eq=False)
class FillMap:
    """How the texels of a texture follow from the covered ones."""

    source: NDArray[np.int64]   # (side * side,) the covered texel that each shows,
    outside: NDArray[np.int64]  # (n,) but these show what goes on linearly from there
    inside: NDArray[np.int64]   # (n,) and from their mirror images


@dataclass(frozen=True, eq=False)
class TextureTransfer:
    """Transfer at the covered texels of a texture, and the record that explains it."""

    uv: NDArray[np.float64]                  # (C, 2) of each face corner
    texels: list[NDArray[np.int64]]          # of each tile, (n,) row * side + column
    coefficients: list[NDArray[np.float32]]  # of each tile, (n, K); coloured ones (n, 3K), red, green, blue of each
    inside: list[NDArray[np.bool_]]          # of each tile, (n,) texels whose centre is on the mesh, not beside
    record: BakeRecord
    irradiance: list[NDArray[np.float32]] | None = None  # of each tile, (n, 3 or more) from lamps: see `lamps.Lamps`

    def fill_map(self) -> FillMap:
        """What the texels show that no face covers; see `texels.fill_map` and `texels.mirrored`."""
        side = self.record.side
        covered = np.zeros(side * side, bool)
        for texels in self.texels:
            covered[texels] = True
        source = fill_map(covered.reshape(side, side))
        return FillMap(source, *mirrored(covered.reshape(side, side), source))

    def image(self, index: int, filled: FillMap) -> NDArray[np.float32]:
        """Numbers 4 * index .. 4 * index + 3 of the texels as an image (side * side, 4), row 0 at the bottom.

        After those of the coefficients comes the irradiance, where there is one.
        """
        tiles, first = self.coefficients, CHANNELS * index
        if self.irradiance is not None and index >= image_count(self.record.terms):
            tiles, first = self.irradiance, CHANNELS * (index - image_count(self.record.terms))
        out = np.zeros((self.record.side ** 2, CHANNELS), np.float32)
        for texels, values in zip(self.texels, tiles, strict=True):
            part = values[:, first:first + CHANNELS]
            out[texels, :part.shape[1]] = part
        image = out[filled.source]
        image[filled.outside] = 2 * image[filled.outside] - out[filled.inside]
        return image


def image_count(terms: int) -> int:
    """How many images the numbers of a texel take."""
    return -(-terms // CHANNELS)


def bake(surface: Surface, method: str = "embree", order: int = 5, *, uv: NDArray | None = None,
         side: int | None = None, texels_per_metre: float | None = None, padding: int = 2, rays: int | None = None,
         tolerance: float | None = None, occluders: Sequence[Geometry] = (),
         normal_maps: Sequence[NormalMap] = (), seed: int = 0, threads: int | None = None, folder: Path | None = None,
         key: str = "", reflection: Reflection | None = None, lamps: Lamps | None = None, whole: bool = False
         ) -> Generator[float, None, TextureTransfer]:
    """Bake the transfer of a texture's texels.

    Args:
        uv: (C, 2) of each face corner, 0 to 1, without overlaps; an atlas is made where not given.
        side: texels a side, or, for an atlas, texels_per_metre to have it as large as that takes.
        padding: texels between the charts of an atlas.
        method, order, rays, tolerance, occluders, seed, threads, whole: as `methods.bake`; a tolerance is
            met by every tile. Where a plan leaves bands out, it does in all tiles alike, as their borders would be
            seen, and the tolerance is met by the whole.
        folder: where finished tiles are kept, so that a bake that was killed goes on from there and
            gives the same numbers. key: what tells this bake from others in the same folder.
        reflection: light that bounces, if any shall. lamps: what lights the texels besides.
    Yields:
        Progress, 0 to 1.
    Raises:
        UserError: arguments out of range, UVs outside the texture, or faces that overlap in it.
    """
    methods.check(method, order, rays, tolerance)
    began = time.perf_counter()
    placing = place([Part(surface, uv)], side=side, texels_per_metre=texels_per_metre, padding=padding)
    (placed,), side = yield from scaled(placing, 0, _LAYOUT_SHARE)
    uv = placed.uv
    layout = Layout(uv[surface.corners], surface.triangles, side)
    digest = hashlib.blake2b(uv.tobytes(), digest_size=16).hexdigest()
    store = _Store(folder, f"{key} {side} {digest}") if folder is not None else None
    scene: Any = None
    bands = all_of(order, tolerance)
    sees = methods.METHODS[method].sees
    if methods.METHODS[method].plans and tolerance is not None and not whole and sees:
        some = texel_points(surface, scattered(surface, _POINTS, np.random.default_rng([seed, 7])), normal_maps)
        scene = sees(some, occluders)
        looking = enough_bands(some, order, tolerance, occluders, seed, threads, scene,
                               methods.candidates())
        bands = yield from scaled(looking, _LAYOUT_SHARE, 0)
    left = tolerance if bands.order == order else max(bands.left, methods.MIN_TOLERANCE)
    rows = max(1, _TILE // side)
    texels, values, inside, records = [], [], [], []
    for number, start in enumerate(range(0, side, rows)):
        stop = min(start + rows, side)
        coverage = layout.coverage(start, stop)
        done, share = _LAYOUT_SHARE + (1 - _LAYOUT_SHARE) * start / side, (1 - _LAYOUT_SHARE) * (stop - start) / side
        yield done
        if not len(coverage.texels):
            continue
        found = store.load(number, len(coverage.texels), bands.order) if store else None
        if found is None:
            mesh = texel_points(surface, coverage, normal_maps)
            if scene is None and sees:
                scene = sees(mesh, occluders)
            baking = methods.bake(mesh, method, bands.order, rays=rays, tolerance=left, whole=True,
                                  seed=_tile_seed(seed, number), occluders=occluders, threads=threads, scene=scene,
                                  reflection=reflection, lamps=lamps)
            transfer = yield from scaled(baking, done, share)
            found = transfer.coefficients.reshape(len(mesh.points), -1), transfer.record
            if transfer.irradiance is not None:
                found = np.concatenate([found[0], transfer.irradiance], axis=1), found[1]
            if store:
                found = store.save(number, *found)
        texels.append(coverage.texels)
        values.append(found[0])
        inside.append(np.all(coverage.barycentric == coverage.centres, axis=1))
        records.append(found[1])
    if not texels:
        raise UserError("The UVs leave no face any room in the texture, so there is nothing to bake.")
    terms = records[0].terms
    coefficients = [v[:, :terms] for v in values]
    irradiance = None if lamps is None else [v[:, terms:] for v in values]
    record = _whole(records, map(_energy, coefficients), map(_lamps_energy, irradiance or ())).also(bands.reason)
    if tolerance is not None and records[0].tolerance is not None:
        record = replace(record, tolerance=tolerance, error_estimate=bands.whole(record.error_estimate))
    record = replace(record, seed=seed, seconds=time.perf_counter() - began, target="texture", side=side,
                     single_faces=placed.single_faces)
    return TextureTransfer(uv, texels, coefficients, inside, record, irradiance)


def alike(transfers: Sequence[TextureTransfer]) -> list[TextureTransfer]:
    """The same, all of them coloured if one is, and of the highest order, so that one texture can hold them.

    Bands that a plan left out are zero.
    """
    colours = max(t.record.colours for t in transfers)
    order = max(t.record.order for t in transfers)

    def like(values: NDArray[np.float32], own: int) -> NDArray[np.float32]:
        values = values if own == colours else np.repeat(values, colours, axis=1)
        return sh.padded(values, colours * order * order)

    return [t if (t.record.colours, t.record.order) == (colours, order) else
            replace(t, coefficients=[like(c, t.record.colours) for c in t.coefficients],
                    record=replace(t.record, colours=colours, order=order)) for t in transfers]


def merged(transfers: Sequence[TextureTransfer]) -> TextureTransfer:
    """The texels of several meshes that share a texture, and a record of all.

    A texel beside one mesh may be inside another, whose it is. The UVs are the first mesh's.
    Fingerprint and frame are each mesh's own, and not in the record.
    """
    first = transfers[0]
    owner = np.full(first.record.side ** 2, -1)
    for number, transfer in enumerate(transfers):
        for texels, inside in zip(transfer.texels, transfer.inside, strict=True):
            owner[texels[inside]] = number
    kept = [(texels[keep], coefficients[keep], inside[keep], irradiance[keep])
            for number, t in enumerate(transfers)
            for texels, coefficients, inside, irradiance in zip(t.texels, t.coefficients, t.inside,
                                                                t.irradiance or t.coefficients, strict=True)
            for keep in [(owner[texels] == number) | (owner[texels] < 0)]]
    lit = first.irradiance is not None
    record = _whole([t.record for t in transfers], [sum(map(_energy, t.coefficients)) for t in transfers],
                    [sum(map(_lamps_energy, t.irradiance or ())) for t in transfers])
    record = replace(record, seconds=sum(t.record.seconds for t in transfers), fingerprint="", uv_map="",
                     single_faces=sum(t.record.single_faces for t in transfers), frame=IDENTITY,
                     bounces=max(t.record.bounces for t in transfers))
    return TextureTransfer(first.uv, [k[0] for k in kept], [k[1] for k in kept], [k[2] for k in kept], record,
                           [k[3] for k in kept] if lit else None)


def _tile_seed(seed: int, number: int) -> int:
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def _energy(values: NDArray) -> float:
    """Sum of squares."""
    return float(np.square(values, dtype=np.float64).sum())


def _lamps_energy(values: NDArray) -> float:
    """Likewise, of irradiance, whatever else there is of the lamps."""
    return _energy(values[:, :3])


def _whole(records: Sequence[BakeRecord], energies: Iterable[float], lamps: Iterable[float]) -> BakeRecord:
    """One record of all parts of a texture, whose coefficients have these energies, and whose irradiance those."""
    return replace(records[0], points=sum(r.points for r in records), rays=sum(r.rays for r in records),
                   probe_rays=sum(r.probe_rays for r in records), lamps_rays=sum(r.lamps_rays for r in records),
                   error_estimate=_joint([r.error_estimate for r in records], energies),
                   lamps_error=_joint([r.lamps_error for r in records], lamps))


def _joint(errors: Sequence[float | None], energies: Iterable[float]) -> float | None:
    """The relative L2 error of parts together; None where parts that have none are more than _SCARCE of the energy.

    Those count as wholly wrong.
    """
    if all(error is None for error in errors):
        return None
    energy = np.array(list(energies))
    whole, unknown = max(float(energy.sum()), 1e-300), np.array([error is None for error in errors])
    if energy[unknown].sum() > _SCARCE * whole:
        return None
    squares = np.array([1.0 if error is None else error ** 2 for error in errors])
    return float((squares * energy).sum() / whole) ** 0.5


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

    def load(self, number: int, points: int, order: int) -> tuple[NDArray[np.float32], BakeRecord] | None:
        """A finished tile; None where it is not there, or of another order."""
        try:
            record = BakeRecord.from_json((self._folder / f"{number:04d}.json").read_text())
            coefficients = np.load(self._folder / f"{number:04d}.npy", mmap_mode="r")
        except (OSError, ValueError, UserError):
            return None
        whole = coefficients.shape == (points, record.numbers)
        return (coefficients, record) if whole and record.order == order else None

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
