# SPDX-License-Identifier: GPL-3.0-or-later
"""The bake by the light-transport embedding (`embedding`): scene points are traced, all else is asked. Needs torch.

Transfer has no size, so, unlike lengths in rooms, those of scenes are not read: they are brought to one size.
"""
from __future__ import annotations

import logging
import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import embedding, sampling, weights
from . import spherical_harmonics as sh
from .bounce import Bounces, Reflection
from .estimator import BlockedEstimator, morton_order
from .geometry import CORNER, TEXEL, TriangleMesh
from .hybrid import FULL, levelled
from .nearest import nearest_to
from .paper_bake import import_torch
from .progress import run, scaled
from .raycast import Geometry, Occluders
from .record import BakeRecord
from .scene_points import CANDIDATES, TURN, farthest
from .transfer import Transfer
from .workers import default_threads, workers

POINTS, RAYS = 4096, 64        # scene points at least, and rays from each: noisy at one, and not over a neighbourhood
MOST, DENSITY = 16_384, 2500   # and at most; so many to a square as wide as the scene is long
BOUNCE_RAYS = 64               # from each scene point, for what bounces bring
CHECKED, CHECKS = 128, 64      # points that are traced twice to know the error; rays of each
QUERIES_AT_ONCE = 4096         # decoded together, so that memory does not grow with their number
_ENCODING, _REFLECTING = 0.3, 0.3  # of the progress
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ScenePoints:
    """M points of a surface in farthest-point order, and what blocks the sky there."""

    places: NDArray[np.float32]   # (M, 3), the scene's longest side embedding.EXTENT
    normals: NDArray[np.float32]  # (M, 3) unit, of faces
    blocked: NDArray[np.float32]  # (M, K), traced: see `split`
    rays: int                     # from each
    surface: TriangleMesh | None = None  # they, in the axes of the bake: for what bounces


def split(blocked: NDArray, normals: NDArray) -> NDArray[np.float32]:
    """A blocked part (N, K) as the share of the sky that is blocked, and how it differs from an even sky of it."""
    return _levelled(blocked, normals, -1)


def joined(found: NDArray, normals: NDArray) -> NDArray[np.float32]:
    """The inverse of `split`."""
    return _levelled(found, normals, 1)


def _levelled(values: NDArray, normals: NDArray, sign: int) -> NDArray[np.float32]:
    return levelled(values, sh.cosine_lobe(normals, sh.order_of(values.shape[1])), sign)


def on_surface(mesh: TriangleMesh, count: int, seed: int) -> TriangleMesh:
    """Points of a mesh by area, `count` in farthest-point order, each of its face; none where it has no area.

    They face to the side that is shaded, where the mesh says which that is (`TEXEL` does not).
    """
    corners, double = _faces(mesh)
    sizes = np.linalg.norm(double, axis=1)
    places = normals = np.zeros((0, 3))
    if sizes.sum() > 0:
        rng = np.random.default_rng([seed, 14])
        bits = sampling.owen_scramble(sampling.sobol2(CANDIDATES * count), rng.integers(0, 2**32, 2, dtype=np.uint32))
        faces, u, v = sampling.on_triangles(np.cumsum(sizes), (bits.T + rng.random((2, len(bits)))) / 2.0 ** 32)
        here = corners[faces]
        candidates = here[:, 0] + u[:, None] * (here[:, 1] - here[:, 0]) + v[:, None] * (here[:, 2] - here[:, 0])
        facing = double[faces] / sizes[faces, None]
        of_corner = mesh.corners if mesh.domain == CORNER else mesh.triangles
        if mesh.domain != TEXEL and of_corner is not None:
            shading = mesh.normals[mesh.elements[of_corner[faces]]].sum(1)
            facing *= np.where((shading * facing).sum(1) < 0, -1, 1)[:, None]
        spacing = float(np.sqrt(sizes.sum() / 2 / count))
        scale = 1 / float(np.ptp(candidates, axis=0).max() or 1.0)  # what is compared are squares
        kept = farthest(scale * np.concatenate([candidates, TURN * spacing * facing], 1), count)
        places, normals = candidates[kept], facing[kept]
    return TriangleMesh(mesh.positions, mesh.triangles, places, normals, normals,
                        np.arange(len(places), dtype=np.int32), TEXEL, mesh.resolution)


def count_of(mesh: TriangleMesh, occluders: Occluders) -> int:
    """Scene points that a mesh wants, by its surface beside its extent, however it is cut into faces."""
    area = float(np.linalg.norm(_faces(mesh)[1], axis=1).sum()) / 2
    return int(np.clip(DENSITY * area * occluders.scale ** 2, POINTS, MOST))


def _faces(mesh: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (F, 3, 3), and normals (F, 3) twice as long as faces are large."""
    corners = mesh.positions[mesh.triangles]
    return corners, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def traced(points: TriangleMesh, occluders: Occluders, order: int, rays: int, seed: int, threads: int
           ) -> Generator[float, None, NDArray[np.float64]]:
    """Blocked part (N, K) at points, in the axes of the bake. Yields progress."""
    if not len(points.points):
        return np.zeros((0, order * order))
    rows = morton_order(points.points)
    estimator = BlockedEstimator(points, occluders, order, seed, rays)
    sums, out = np.zeros((len(rows), order * order)), np.zeros((len(rows), order * order))
    with workers(threads, len(rows) * rays) as pool:
        yield from estimator.trace(pool, threads, rows, 0, rays, sums)
        out[rows] = estimator.blocked(pool, rows, sums, rays)
    return out


def scene_points(mesh: TriangleMesh, occluders: Occluders, count: int = POINTS, rays: int = RAYS, *, seed: int = 0,
                 threads: int | None = None) -> Generator[float, None, ScenePoints]:
    """What the network reads of a mesh; what else blocks its light is in what its points see. Yields progress."""
    points = on_surface(mesh, count, seed)
    blocked = yield from traced(points, occluders, sh.MAX_ORDER, rays, seed, threads or default_threads())
    return ScenePoints(in_scale(points.points, occluders), points.normals.astype(np.float32),
                       split(blocked, points.normals), rays, points)


def in_scale(places: NDArray, occluders: Occluders) -> NDArray[np.float32]:
    """Places (N, 3) as the network knows them."""
    return np.float32(embedding.EXTENT) * occluders.normalise(places)


def network() -> Any:
    """The trained network: networks.sky.SkyEmbedding, in `eval` mode. Raises UserError: no torch or weights."""
    import_torch("embedding")
    from .networks.sky import SKY, SkyEmbedding

    return weights.filled(SkyEmbedding(SKY), weights.load(weights.FOLDER / weights.SKY))


def reflecting() -> Any:
    """The trained decoder of what bounces: networks.reflected.Reflected, in `eval` mode. Raises as `network`."""
    import_torch("embedding")
    from .networks.reflected import Reflected
    from .networks.sky import SKY

    return weights.filled(Reflected(SKY), weights.load(weights.FOLDER / weights.BOUNCES))


class Sky:
    """A scene's codes, which answer for any point."""

    def __init__(self, model: Any, occluders: Occluders, points: ScenePoints, device: str = "cpu") -> None:
        """Encode at least one point. model: networks.sky.SkyEmbedding in `eval` mode, moved to the device."""
        import torch

        from .networks.embedding import Frame

        self.occluders, self._rays = occluders, points.rays * len(points.places)
        self._model, self._device = model.to(device), device
        sizes = model.settings
        layout = embedding.layout(points.places, sizes.halvings, sizes.gathered, sizes.around)
        self._places, self._surface = points.places, points.surface
        parents = nearest_to(points.places, points.places[:len(layout.around)], 1)[:, 0]
        self._frame = Frame.of(self._tensor(points.places), self._tensor(points.normals), layout)
        with torch.no_grad():
            self._parents = torch.from_numpy(parents).to(device)
            self._codes = model.encoder(self._frame, self._tensor(points.blocked), self._parents)
        self._bounced: tuple[Bounces, Any, Any] | None = None  # the solution, the decoder, and its codes

    def spent(self) -> int:
        """Rays that the scene points took, the first time that it is asked: several bakes may share them."""
        rays, self._rays = self._rays, 0
        return rays

    def blocked(self, points: NDArray, normals: NDArray, order: int) -> NDArray[np.float32]:
        """Blocked part (n, K) at points (n, 3) with unit normals."""
        return self._blocked(self._asked(points, normals), normals, order)

    def transfer(self, points: NDArray, normals: NDArray, order: int, solution: Bounces | None
                 ) -> NDArray[np.float32]:
        """Transfer (n, K) at points (n, 3) with unit normals; (n, K, 3) with the bounces of a solution `seen`."""
        asked = self._asked(points, normals)
        direct = (sh.cosine_lobe(normals, order) - self._blocked(asked, normals, order)).astype(np.float32)
        return direct if solution is None else direct[:, :, None] + self._brought(asked, solution)

    def seen(self, solution: Bounces) -> Generator[float, None, None]:
        """Trace what the bounces of a solution bring to the scene points, the first time. Yields progress.

        Raises:
            UserError: weights that are not those that were shipped.
        """
        import torch

        if self._bounced is not None and self._bounced[0] is solution:
            return
        assert self._surface is not None, "scene points that are traced know where they are"
        model = reflecting().to(self._device)
        bounced = yield from solution.gather(self._surface, BOUNCE_RAYS)
        with torch.no_grad():
            codes = model.encode(self._codes, self._frame, self._tensor(bounced), self._parents)
        self._bounced = solution, model, codes
        self._rays += BOUNCE_RAYS * len(self._places)

    def _brought(self, asked: tuple[Any, Any, Any], solution: Bounces) -> NDArray[np.float32]:
        """What bounces bring (n, K, 3)."""
        import torch

        assert self._bounced is not None and self._bounced[0] is solution
        with torch.no_grad():
            found: NDArray[np.float32] = self._bounced[1](self._bounced[2], self._frame, *asked).cpu().numpy()
        return found

    def _asked(self, points: NDArray, normals: NDArray) -> tuple[Any, Any, Any]:
        """What decoders want to know of points: places, normals, and the scene points near them."""
        import torch

        places = in_scale(points, self.occluders)
        near = torch.from_numpy(nearest_to(places, self._places, self._model.settings.neighbours)).to(self._device)
        return self._tensor(places), self._tensor(normals), near

    def _blocked(self, asked: tuple[Any, Any, Any], normals: NDArray, order: int) -> NDArray[np.float32]:
        import torch

        from .networks.sky import Codes

        codes = Codes(self._codes.values[:, :order * order], self._codes.key, self._codes.value)
        with torch.no_grad():
            found = self._model.decoder(codes, self._frame, *asked).cpu().numpy()
        found[:, 0] = np.clip(found[:, 0], 0, FULL)
        return joined(found, normals)

    def _tensor(self, array: NDArray) -> Any:
        import torch

        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(self._device)


def encoded(mesh: TriangleMesh, occluders: Sequence[Geometry]) -> Sky | None:
    """What the method sees of a mesh and of what else blocks its light; None where it has no area.

    Raises:
        UserError: no torch, or weights that are not those that were shipped.
    """
    import_torch("embedding")
    scene = Occluders([(mesh.positions, mesh.triangles), *occluders], mesh.resolution)
    return run(_encode(scene, mesh, 0, default_threads()))


def _encode(scene: Occluders, mesh: TriangleMesh, seed: int, threads: int) -> Generator[float, None, Sky | None]:
    model = network()
    points = yield from scene_points(mesh, scene, count_of(mesh, scene), seed=seed, threads=threads)
    if not len(points.places):
        return None
    torch = import_torch("embedding")
    if torch.cuda.is_available():
        try:
            return Sky(model, scene, points, "cuda")
        except torch.cuda.OutOfMemoryError:
            _LOGGER.warning("The GPU has too little memory for this mesh; its processor does the work.")
            torch.cuda.empty_cache()
    return Sky(model, scene, points)


def bake(mesh: TriangleMesh, order: int, *, rays: int | None, tolerance: float | None, occluders: Sequence[Geometry],
         seed: int, threads: int | None, scene: Sky | None = None, reflection: Reflection | None = None
         ) -> Generator[float, None, Transfer]:
    """Ask the embedding at every point; arguments as `methods.bake`. Rays and tolerance do not matter.

    With a reflection, bounces are solved once (`bounce`), traced at the scene points, and asked for like the rest.

    Raises:
        UserError: no torch, or weights that are not those that were shipped.
    """
    began = time.perf_counter()
    torch = import_torch("embedding")
    threads = threads or default_threads()
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        sky = scene
        if sky is None:
            built = Occluders([(mesh.positions, mesh.triangles), *occluders], mesh.resolution)
            sky = yield from scaled(_encode(built, mesh, seed, threads), 0.0, _ENCODING)
        ready, solution = _ENCODING, None
        if reflection is not None and sky is not None:
            ready = _ENCODING + _REFLECTING
            solving = reflection.solved(mesh, occluders, sky.occluders, order, threads)
            solution = yield from scaled(solving, _ENCODING, 0.8 * _REFLECTING)
            if solution.used:
                yield from scaled(sky.seen(solution), ready - 0.2 * _REFLECTING, 0.2 * _REFLECTING)
            else:
                solution = None
        colours = () if solution is None else (3,)
        coefficients = np.zeros((len(mesh.points), sh.coefficient_count(order), *colours), np.float32)
        lit = mesh.lit()
        lit = lit[morton_order(mesh.points[lit])] if len(lit) else lit
        for start in range(0, len(lit), QUERIES_AT_ONCE):
            rows = lit[start:start + QUERIES_AT_ONCE]
            points, normals = mesh.points[rows], mesh.normals[rows]
            coefficients[rows] = (sh.cosine_lobe(normals, order) if sky is None
                                  else sky.transfer(points, normals, order, solution))
            yield ready + (1 - ready) * (start + len(rows)) / len(lit)
        error, checked = None, np.random.default_rng([seed, 15]).permutation(lit)[:CHECKED]
        if sky is not None:
            checking = _error(mesh, sky.occluders, checked, coefficients, seed, threads, solution)
            error = yield from scaled(checking, 1, 0)
    finally:
        torch.set_num_threads(before)
    return Transfer(coefficients, BakeRecord(
        method="embedding", order=order, points=len(mesh.points), domain=mesh.domain,
        rays=sky.spent() if sky is not None else 0, bounces=solution.used if solution is not None else 0,
        colours=3 if solution is not None else 1,
        probe_rays=2 * CHECKS * len(checked) if sky is not None else 0, seed=seed, seconds=time.perf_counter() - began,
        error_estimate=error))


def _error(mesh: TriangleMesh, occluders: Occluders, rows: NDArray, coefficients: NDArray, seed: int, threads: int,
           solution: Bounces | None) -> Generator[float, None, float | None]:
    """Relative L2 error at some points, by two independent traces, whose noise cancels in the product.

    It counts what bounces, too, as that is learned; but for the error of its solution, which is the same in both.
    """
    order, few = sh.order_of(coefficients.shape[1]), replace(
        mesh, points=mesh.points[rows], normals=mesh.normals[rows], clearance=mesh.clearance[rows])
    truth = []
    for number in range(2):
        own = int(np.random.SeedSequence([seed, 16, number]).generate_state(1)[0])
        blocked = yield from scaled(traced(few, occluders, order, CHECKS, own, threads), number / 2, 1 / 2)
        direct = sh.cosine_lobe(few.normals, order) - blocked
        if solution is None:
            truth.append(direct)
            continue
        bounced = yield from scaled(solution.gather(few, CHECKS, own), (number + 1) / 2, 0)
        truth.append(direct[:, :, None] + bounced)
    squared = float(((coefficients[rows] - truth[0]) * (coefficients[rows] - truth[1])).sum())
    energy = float((truth[0] * truth[1]).sum())
    return float(max(squared, 0.0) / energy) ** 0.5 if energy > 0 else None
