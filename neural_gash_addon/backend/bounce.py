# SPDX-License-Identifier: GPL-3.0-or-later
"""Diffuse interreflection as transfer (Sloan 2002, section 5), in colour and valid under every light.

X_0 is direct transfer; X_{b+1}(p) = mean over cosine-distributed rays from p of albedo(q) X_b(q), q
being what the ray meets, zero where it meets nothing. The recursion is solved on patches, whose rays
are traced once and kept as the patches they meet; points to be baked then gather the sum of all
bounces with rays of their own, a chunk at a time.
"""
from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import sampling
from . import spherical_harmonics as sh
from .geometry import INSET, TriangleMesh, unit
from .patches import Patches
from .pictures import Picture
from .raycast import Geometry, Occluders
from .transfer import Transfer
from .workers import default_threads, results, workers

PATCHES = 8192        # about as many; more sharpen the light that bounces near edges and shadows
PATCH_RAYS = 128
MIN_RAYS, MAX_RAYS = 64, 256  # of a point's gathering
MAX_BOUNCES = 64
INVISIBLE = 2e-3      # of all transfer: a bounce that adds less is the last
LEFT_OUT = 0.3        # of a tolerance: what bounces may be that are left out, as 0.95**2 + 0.3**2 is 1
_FALL = 0.5, 0.95     # from one bounce to the next, at least (where but one is known) and at most
BLACK = "Everything is black: no bounce is computed."
_RAYS_AT_ONCE = 1 << 17
_FRONTS = 0.9         # of the progress: each further round of backs has so much of what is left
_SETS = 16


@dataclass(eq=False)
class Reflection:
    """What a bake with bounces wants, and the solution, once it has been made."""

    albedo: NDArray[np.float64]  # (F, 3) of the triangles of what is baked, then of the occluders, in order
    bounces: int                 # at most; fewer where more would not be seen
    pictures: Sequence[Picture] = ()  # that say it from place to place
    seed: int = 0                # one for all tiles of a texture
    solution: Bounces | None = None

    def add(self, transfer: Transfer, mesh: TriangleMesh, occluders: Sequence[Geometry], scene: Occluders,
            threads: int | None) -> Generator[float, None, Transfer]:
        """Direct transfer (N, K) of the points of a mesh with what bounces bring: (N, K, 3).

        Solved once for all tiles of a texture. Where nothing bounces, the transfer as it is.
        """
        began = time.perf_counter()
        order = transfer.record.order
        planned = transfer.record.tolerance if transfer.record.plan else None
        allowed = None if planned is None else LEFT_OUT * planned
        solution = yield from self.solved(mesh, occluders, scene, order, threads, allowed)
        transfer = Transfer(transfer.coefficients, transfer.record.also(self._why()))
        if not solution.used:
            return transfer
        rays = int(np.clip(transfer.record.rays_per_point, MIN_RAYS, MAX_RAYS))
        bounced = yield from solution.gather(mesh, rays)
        record = replace(transfer.record, bounces=solution.used, colours=3,
                         rays=transfer.record.rays + rays * len(mesh.points),
                         seconds=transfer.record.seconds + time.perf_counter() - began)
        return Transfer(transfer.coefficients[:, :, None] + bounced, record)

    def solved(self, mesh: TriangleMesh, occluders: Sequence[Geometry], scene: Occluders, order: int,
               threads: int | None, allowed: float | None = None) -> Generator[float, None, Bounces]:
        """The solution, made the first time; arguments as `add` and `Bounces.solve`. Yields progress."""
        if self.solution is None:
            parts = [(mesh.positions, mesh.triangles), *occluders]
            self.solution = Bounces(parts, self.albedo, scene, order, self.seed, threads, pictures=self.pictures)
            yield from self.solution.solve(self.bounces, allowed=allowed)
        return self.solution

    @property
    def black(self) -> bool:
        """Whether everything is, so that nothing needs to be known of the scene."""
        return not self.albedo.any() and not self.pictures

    def _why(self) -> str:
        """One sentence: how many bounces there are."""
        assert self.solution is not None
        used, left = self.solution.used, f"{100 * self.solution.left_out:.1g} %"
        if self.solution.left_out and not used:
            return f"Light that bounces would add {left}, too little for the tolerance: no bounce is computed."
        if self.solution.left_out:
            return f"Of {self.bounces} bounces asked for, {used} {'is' if used == 1 else 'are'} enough: the others " \
                   f"would add {left}."
        return f"Bounces computed: {used} of the {self.bounces} asked for." if used else BLACK


class Bounces:
    """The light that leaves each patch after its bounces, for points to gather."""

    def __init__(self, parts: Sequence[Geometry], albedo: NDArray, scene: Occluders, order: int, seed: int = 0,
                 threads: int | None = None, budget: int = PATCHES, pictures: Sequence[Picture] = ()) -> None:
        """Prepare; nothing is traced yet.

        Args:
            parts: positions (V, 3), triangles (F, 3) of everything, in the order that `scene` has them.
            albedo: (F, 3) of the triangles of all parts, 0 to 1. pictures: that say it from place to place.
        """
        self.patches = Patches(parts, budget)
        self.albedo = np.clip(self.patches.mean(albedo, pictures), 0, 1)  # (M, 3)
        self.added: list[float] = []  # transfer of constant light that each bounce added, of all of it
        self.left_out = 0.0           # relative L2 of the bounces that were not needed, about
        self._scene, self._order, self._seed = scene, order, seed
        self._threads = threads or default_threads()
        self.sides = np.zeros(0, np.int64)               # traced sides: 2 * patch, plus 1 for its back
        self.met = np.zeros((0, PATCH_RAYS), np.int32)   # (sides, rays) which traced side, -1: none
        self.directions = np.zeros((0, PATCH_RAYS, 3), np.float32)  # (sides, rays, 3)
        self._row = np.full(2 * self.patches.count, -1)   # row of each side that was traced
        self.direct = np.zeros((0, order * order))
        self._leaving = np.zeros((0, 3 * order * order), np.float32)  # albedo times the sum of bounces

    @property
    def used(self) -> int:
        """How many bounces were computed."""
        return len(self.added)

    def solve(self, bounces: int = MAX_BOUNCES, tolerance: float = INVISIBLE, allowed: float | None = None
              ) -> Generator[float, None, None]:
        """Trace the patches once, and bounce until `bounces` are done, or one adds less than `tolerance`.

        allowed: relative L2 of all transfer. Where a bounce and all that follow it (a geometric series) come to no
            more, they are left out.
        Yields:
            Progress, 0 to 1.
        """
        if bounces == 0 or not self.albedo.any():
            return
        yield from self.trace()
        reflectance = self.albedo[self.sides // 2]                        # (sides, 3)
        now = np.repeat(self.direct[:, :, None], 3, axis=2)              # (sides, K, 3)
        total, everything = np.zeros_like(now), now.copy()
        areas = self._areas()
        whole = float(areas @ now[:, 0].mean(1))
        for number in range(bounces):
            leaving = (now * reflectance[:, None]).reshape(len(now), -1).astype(np.float32)
            size = _size(now, areas)
            now = self.gathered(leaving).reshape(now.shape)
            everything += now
            if allowed is not None:
                falls = _size(now, areas) / size if size > 0 else 0.0
                rest = _size(now, areas) / (1 - min(max(falls, 0.0 if number else _FALL[0]), _FALL[1]))
                if rest <= allowed * _size(everything, areas):
                    self.left_out = rest / _size(everything, areas) if rest > 0 else 0.0
                    break
            total += leaving.reshape(total.shape)
            added = float(areas @ now[:, 0].mean(1))
            whole += added
            self.added.append(added / whole if whole > 0 else 0.0)
            yield 0.5 + 0.5 * (number + 1) / bounces
            if self.added[-1] < tolerance:
                break
        self._leaving = total.reshape(len(total), -1).astype(np.float32)

    def gathered(self, leaving: NDArray[np.float32]) -> NDArray[np.float64]:
        """(sides, C) that the rays of each traced side bring, of what leaves them (sides, C)."""
        out = np.empty(leaving.shape)
        padded = np.concatenate([leaving, np.zeros((1, leaving.shape[1]), np.float32)])  # what -1 brings
        step = max(1, _RAYS_AT_ONCE // PATCH_RAYS)

        def part(start: int) -> None:
            met = self.met[start:start + step]
            out[start:start + step] = padded[met.ravel()].reshape(*met.shape, -1).mean(1, dtype=np.float64)

        with workers(self._threads) as pool:
            list(pool.map(part, range(0, len(self.met), step)))
        return out

    def gather(self, mesh: TriangleMesh, rays: int, seed: int = 0) -> Generator[float, None, NDArray[np.float32]]:
        """What bounces bring to the points of a mesh: (N, K, 3), to be added to their direct transfer.

        seed: of the points' rays, beside that of the patches.
        Yields:
            Progress, 0 to 1. Closing the generator stops the workers.
        """
        terms = self._order ** 2
        out = np.zeros((len(mesh.points), terms, 3), np.float32)
        if not self.used or not self._leaving.any():
            return out
        rng = np.random.default_rng([self._seed, 3, *([seed] if seed else [])])
        sets = sampling.hemisphere_sets(_SETS, rays, int(rng.integers(2**31)))
        which, angles = rng.integers(0, _SETS, len(mesh.points)), rng.uniform(0, 2 * np.pi, len(mesh.points))
        padded = np.concatenate([self._leaving, np.zeros((1, 3 * terms), np.float32)])
        lit = mesh.lit()
        step = max(1, _RAYS_AT_ONCE // rays)

        def part(points: NDArray) -> None:
            frames = sampling.frames(mesh.normals[points], angles[points])
            directions = np.einsum("nij,nrj->nri", frames, sets[which[points]]).astype(np.float32)
            met = self.met_by(mesh, points, directions)
            out[points] = padded[met.ravel()].reshape(len(points), rays, -1).mean(1).reshape(-1, terms, 3)

        yield from spread(part, [lit[s:s + step] for s in range(0, len(lit), step)], self._threads)
        return out

    def trace(self) -> Generator[float, None, None]:
        """Trace all fronts, and then the backs that were met, until no new ones are."""
        fresh, done = 2 * np.arange(self.patches.count), 0.0
        while len(fresh):
            self._row[fresh] = len(self.direct) + np.arange(len(fresh))
            sides = np.full((len(fresh), PATCH_RAYS), -1, np.int64)
            direct = np.zeros((len(fresh), self._order ** 2))
            ways = np.zeros((len(fresh), PATCH_RAYS, 3), np.float32)
            step = max(1, _RAYS_AT_ONCE // PATCH_RAYS)
            parts = [np.arange(s, min(s + step, len(fresh))) for s in range(0, len(fresh), step)]
            seeds = np.random.SeedSequence([self._seed, 2, len(self.direct)]).spawn(len(parts))

            def part(job: tuple[NDArray, np.random.SeedSequence], fresh: NDArray = fresh, sides: NDArray = sides,
                     direct: NDArray = direct, ways: NDArray = ways) -> None:
                rows, seed = job
                sides[rows], direct[rows], ways[rows] = self._traced(fresh[rows], np.random.default_rng(seed))

            for share in spread(part, list(zip(parts, seeds, strict=True)), self._threads):
                yield 0.5 * (done + _FRONTS * (1 - done) * share)
            done += _FRONTS * (1 - done)
            self.met = np.concatenate([self.met, sides.astype(np.int32)])
            self.direct = np.concatenate([self.direct, direct])
            self.directions = np.concatenate([self.directions, ways])
            self.sides = np.concatenate([self.sides, fresh])
            found = np.unique(sides[sides >= 0])
            fresh = found[self._row[found] < 0]
        self.met = np.where(self.met >= 0, self._row[self.met], -1).astype(np.int32)

    def _traced(self, sides: NDArray, rng: np.random.Generator) -> tuple[NDArray, NDArray, NDArray]:
        """Sides that the rays of some sides (n,) meet (n, rays), their direct transfer (n, K), and the rays."""
        points, normals, inwards = self.patches.sample(sides, PATCH_RAYS, rng)
        local = sampling.hemisphere_sets(1, PATCH_RAYS, int(rng.integers(2**31)))[0]
        flat = normals.reshape(-1, 3)
        # one turn for each patch keeps its rays a net; which point has which ray is chance
        turns = np.repeat(rng.uniform(0, 2 * np.pi, len(sides)), PATCH_RAYS)
        chosen = rng.permuted(np.tile(np.arange(PATCH_RAYS), (len(sides), 1)), axis=1).ravel()
        directions = np.einsum("nij,nj->ni", sampling.frames(flat, turns), local[chosen])
        clearance = flat + INSET * unit(inwards.reshape(-1, 3))
        origins = self._scene.origins(points.reshape(-1, 3), clearance)
        rays = np.ascontiguousarray(directions, dtype=np.float32)
        hits = self._scene.hits(origins, rays)
        met = np.full(len(rays), -1, np.int64)
        met[hits.rays] = self.patches.of_hits(hits)
        seen = sh.evaluate(directions, self._order) * (met < 0)[:, None]
        shape = len(sides), PATCH_RAYS, -1
        return met.reshape(len(sides), -1), seen.reshape(shape).mean(1), rays.reshape(shape)

    def met_by(self, mesh: TriangleMesh, points: NDArray[np.int64], directions: NDArray[np.float32]
               ) -> NDArray[np.int32]:
        """(n, R) row of the traced side that rays (n, R, 3) from some points (n,) meet, -1 where they meet none."""
        count, rays = directions.shape[:2]
        origins = self._scene.origins(mesh.points[points], mesh.clearance[points]).repeat(rays, axis=0)
        hits = self._scene.hits(origins, directions.reshape(-1, 3))
        met = np.full(count * rays, -1, np.int32)
        met[hits.rays] = self._row[self.patches.of_hits(hits)]
        return met.reshape(count, rays)

    def _areas(self) -> NDArray[np.float64]:
        """(sides,) area of each traced side."""
        return self.patches.patch_areas[self.sides // 2]


def _size(values: NDArray, areas: NDArray) -> float:
    """L2 norm over the surface of values (sides, K, 3)."""
    return float(areas @ np.square(values).sum((1, 2))) ** 0.5


def spread(work: Callable, jobs: list, threads: int) -> Generator[float, None, None]:
    """Do the jobs on some threads, a few at a time, yielding the share that is done."""
    with workers(threads) as pool:
        for number, _ in enumerate(results(pool, threads, ((job,) for job in jobs), work)):
            yield (number + 1) / len(jobs)
