# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance from emitters, colour bleeding included, by path tracing (Kajiya 1986).

From each point paths go on in cosine-distributed directions. At every vertex light is gathered twice, from a
point on an emitter chosen by power, and from the emitter that the path's own next ray meets; the balance heuristic
joins both (Veach and Guibas 1995), so a wall beside a lamp is as quiet as one far off. Paths end by Russian roulette
in proportion to what they still carry. At the points themselves, directions and emitters are scrambled nets.

Beside irradiance, where asked, the same paths tell the light by direction: what each brings, times the harmonics of the
direction in which it left the point, is an estimate of radiance times cosine, as `gloss.transferred` has it of the sky.
Without the cosine its variance would be infinite, as few of the paths graze.

Computed in Occluders' coordinates, where irradiance is the same; arrays are (3, n), which NumPy goes through faster,
and tables that are looked up at random have rows.
"""
from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import sampling
from . import spherical_harmonics as sh
from .bounce import spread
from .errors import UserError
from .geometry import NOT_FINITE
from .lit_scene import LitScene
from .raycast import Occluders
from .workers import default_threads

DEPTH = 5      # segments of the longest path from a point to an emitter: what four surfaces have reflected is the last
RAYS = 1024    # paths from a point
BATCHES = 8    # of paths, each with nets of its own: what they differ by tells the standard error
DARK = "Nothing in the scene emits light, so the irradiance is zero."
_PATHS_AT_ONCE = 1 << 15  # so that a wave's arrays stay in the cache
_SETS = 16
_BELOW_ONE = np.float32(1 - 2.0 ** -24)

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Irradiance:
    """At N points."""

    values: Floats    # (N, 3) W/m^2
    error: Floats     # (N, 3) standard error of each
    notice: str = ""  # what a person should know, if there is anything
    shape: Floats | None = None  # (N, K, 3) where asked: integral of radiance, cosine and Y_k; [:, 0] / Y_0 is values
    shape_error: Floats | None = None  # (N, K, 3) standard error of each


def irradiance(scene: LitScene, points: NDArray, normals: NDArray, rays: int = RAYS, *, depth: int = DEPTH,
               straight: bool = True, seed: int = 0, threads: int | None = None, occluders: Occluders | None = None,
               clearance: NDArray | None = None, order: int = 0) -> Generator[float, None, Irradiance]:
    """Light that arrives at points from all emitters, direct and reflected up to depth - 1 times.

    Args:
        points: (N, 3) metres. normals: (N, 3) unit; where it is zero, the irradiance is.
        rays: paths from each point, at least BATCHES; made a multiple of it.
        straight: whether what comes straight from emitters counts, or only what was reflected.
        occluders: `scene.occluders()`, if it is there already.
        clearance: (N, 3) from points to where their rays start (see TriangleMesh); along the normals where not given.
        order: bands of `shape`, world axes; 0 for none.
    Yields:
        Progress, 0 to 1. Closing the generator stops the workers.
    Raises:
        UserError: too few rays, no depth, or points that are not finite.
    """
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    clearance = normals if clearance is None else clearance
    if rays < BATCHES or depth < 1:
        raise UserError(f"Irradiance wants at least {BATCHES} rays a point and a depth of at least 1.")
    if not (np.isfinite(points).all() and np.isfinite(normals).all()):
        raise UserError(NOT_FINITE)
    values, error = np.zeros((2, len(points), 3), np.float32)
    shapes = np.zeros((2, len(points), order * order, 3), np.float32) if order else (None, None)
    if not len(scene.emitters):
        return Irradiance(values, error, DARK, *shapes)
    tracer = _Tracer(scene, occluders or scene.occluders(), -(-rays // BATCHES), depth, straight, seed, order)
    lit = np.flatnonzero(np.any(normals != 0, axis=1))
    step = max(1, _PATHS_AT_ONCE // (BATCHES * tracer.paths))
    jobs = [lit[start:start + step] for start in range(0, len(lit), step)]
    seeds = np.random.SeedSequence([seed, 5]).spawn(len(jobs))

    def part(job: tuple[NDArray, np.random.SeedSequence]) -> None:
        rows, own = job
        found = tracer.trace(points[rows], normals[rows], clearance[rows], np.random.default_rng(own))
        # (n, BATCHES, ...)
        for (mean, deviation), batches in zip(((values, error), shapes), found, strict=True):
            if mean is not None and deviation is not None:
                mean[rows] = batches.mean(1)
                deviation[rows] = batches.std(1, ddof=1) / BATCHES ** 0.5

    yield from spread(part, list(zip(jobs, seeds, strict=True)), threads or default_threads())
    return Irradiance(values, error, "", *shapes)


class _Tracer:
    """The scene as tables of float32 that waves of paths look up."""

    def __init__(self, scene: LitScene, occluders: Occluders, paths: int, depth: int, straight: bool, seed: int,
                 order: int) -> None:
        """paths: of a batch, from each point. order: bands of light by direction, 0 for none."""
        self.paths, self._depth, self._straight, self._order = paths, depth, straight, order
        self._scene, self._occluders = scene, occluders
        self._offset = np.float32(occluders.offset)
        corners = ((scene.corners - occluders.centre) * occluders.scale).transpose(1, 2, 0)  # (corner, axis, F)
        frames = sampling.frames(scene.normals, np.zeros(len(scene.normals)))                # (F, 3, 3)
        # first corner, edges from it, tangent, bitangent and normal, three rows each
        table = np.concatenate([corners[0], corners[1] - corners[0], corners[2] - corners[0],
                                *frames.transpose(2, 1, 0)])
        self._faces = np.ascontiguousarray(table.T, np.float32)                              # (F, 18)
        self._emission = np.asarray(scene.emission, np.float32)                              # (F, 3)
        self._albedo = np.asarray(scene.albedo.max(1), np.float32)                           # (F,) brightest channel
        # emitters are chosen by power: their density per area is in proportion to their mean radiance
        brightness = scene.emission.mean(1)
        power = (brightness * scene.areas)[scene.emitters] * occluders.scale ** 2
        self._emitters = scene.emitters
        self._cumulative = np.cumsum(power).astype(np.float32)
        self._density = (brightness / power.sum()).astype(np.float32)                        # (F,)
        self._behind = np.ones(len(brightness), bool) if scene.front_only is None else ~np.asarray(scene.front_only)
        # what rays may meet, too, is gathered twice
        self._meeting = (np.arange(len(brightness)) < len(brightness) - scene.bodiless).astype(np.float32)   # (F,)
        bits = np.random.default_rng([seed, 6]).integers(0, 2**32, (_SETS, 1, 2), dtype=np.uint32)
        nets = sampling.owen_scramble(sampling.sobol2(paths)[None], bits)
        self._nets = ((nets.transpose(2, 0, 1) + 0.5) / 2.0 ** 32).astype(np.float32)        # (2, sets, paths)

    def trace(self, points: NDArray, normals: NDArray, clearance: NDArray, rng: np.random.Generator
              ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Irradiance at points (n, 3) by each batch of paths (n, BATCHES, 3), by direction (n, BATCHES, K, 3)."""
        each = BATCHES * self.paths
        count = len(points) * each
        gathered = np.zeros((3, count), np.float32)  # by each path, over pi
        origins = self._occluders.origins(points, clearance).T.repeat(each, axis=1)
        frames = sampling.frames(normals, np.zeros(len(normals))).astype(np.float32)
        tangents, bitangents, up = (frames[:, :, k].T.repeat(each, axis=1) for k in range(3))
        carried = np.ones((3, count), np.float32)
        straight: Floats | None = None  # as gathered, what is in `shape` already
        path = np.arange(count)
        shape: NDArray[np.float64] | float = 0.0
        for vertex in range(self._depth):
            n = len(path)
            if not n:
                break
            towards, around = ((self._net(rng, n // self.paths) for _ in range(2)) if vertex == 0
                               else rng.random((2, 2, n), np.float32))
            counts = vertex > 0 or self._straight
            if counts:
                ways = self._gather_emitters(gathered, path, carried, origins, up, towards)
                if vertex == 0 and self._order:
                    shape = self._shape(gathered, ways, len(points))
                    straight, gathered = gathered, np.zeros_like(gathered)
            radius, angle = np.sqrt(around[0]), around[1] * np.float32(2 * np.pi)
            cosine = np.sqrt(1 - around[0])
            directions = tangents * (radius * np.cos(angle)) + bitangents * (radius * np.sin(angle)) + up * cosine
            faces, u, v, _ = self._occluders.first(_rows(origins), _rows(directions))
            if vertex == 0:
                first = directions
            if counts:
                self._gather_met(gathered, path, carried, origins, directions, cosine, faces, u, v)
            if vertex == self._depth - 1:
                break
            # roulette by what is carried on the average of the triangle, so that few textures are looked up
            chance = np.minimum(carried.max(0) * self._albedo[faces], 1)
            on = np.flatnonzero((rng.random(n, np.float32) < chance) & (faces >= 0))
            faces, u, v, directions = faces[on], u[on], v[on], directions.take(on, 1)
            carried = carried.take(on, 1) * (self._scene.albedo_at(faces, u, v).T / chance[on])
            path = path[on]
            found = self._faces.take(faces, 0).T
            tangents, bitangents, up = found[9:12], found[12:15], found[15:18]
            up = up * -np.sign(_dot(up, directions))  # of the side that was met
            origins = found[:3] + u * found[3:6] + v * found[6:9] + self._offset * up
        if self._order:
            shape = shape + self._shape(gathered, first, len(points))
            gathered = gathered if straight is None else gathered + straight
        sums = gathered.reshape(3, len(points), BATCHES, self.paths).sum(3, dtype=np.float64)
        return np.pi / self.paths * sums.transpose(1, 2, 0), np.asarray(shape)

    def _shape(self, gathered: Floats, ways: Floats, points: int) -> NDArray[np.float64]:
        """(points, BATCHES, K, 3) of what paths brought (3, count) from ways (3, count) of any length."""
        length = np.sqrt(np.maximum(_dot(ways, ways), 1e-30))
        harmonics = sh.evaluate((ways / length).T, self._order).reshape(points, BATCHES, self.paths, -1)
        brought = gathered.T.reshape(points, BATCHES, self.paths, 3)
        found: NDArray[np.float64] = np.pi / self.paths * (harmonics.transpose(0, 1, 3, 2) @ brought)
        return found

    def _net(self, rng: np.random.Generator, batches: int) -> Floats:
        """(2, batches * paths): of each batch one of the nets, shifted at random."""
        shifts = rng.random((2, batches, 1), np.float32)
        shifted = self._nets[:, rng.integers(0, _SETS, batches)] + shifts
        return np.minimum(shifted - np.floor(shifted), _BELOW_ONE).reshape(2, -1)

    def _gather_emitters(self, gathered: Floats, path: NDArray, carried: Floats, origins: Floats, up: Floats,
                         pairs: Floats) -> Floats:
        """Add what comes from a point on an emitter, chosen by pairs (2, n), unless something is between.

        Returns the ways to it (3, n).
        """
        chosen, u, v = sampling.on_triangles(self._cumulative, pairs)
        faces = self._emitters[chosen]
        found = self._faces.take(faces, 0).T
        there = found[15:18]
        towards = ways = found[:3] + u * found[3:6] + v * found[6:9] - origins
        above, facing = _dot(ways, up), -_dot(ways, there)
        good = np.flatnonzero((above > 0) & ((facing > 0) | self._behind[faces] & (facing < 0)))
        faces, facing, ways = faces[good], facing[good], ways.take(good, 1)
        square = _dot(ways, ways)
        ways += self._offset * np.sign(facing) * there.take(good, 1)  # a little off the emitter
        free = self._occluders.blocked(_rows(origins.take(good, 1)), _rows(ways), np.ones(len(good), np.float32)) != 0
        good, faces = good[free], faces[free]
        form = above[good] * np.abs(facing[free]) / (np.float32(np.pi) * square[free] ** 2)
        self._add(gathered, path, carried, good, faces, form / (self._density[faces] + self._meeting[faces] * form))
        return towards

    def _gather_met(self, gathered: Floats, path: NDArray, carried: Floats, origins: Floats, directions: Floats,
                    cosine: Floats, faces: NDArray, u: Floats, v: Floats) -> None:
        """Add what comes from the emitters that the paths' rays meet; faces (n,) are -1 where they meet nothing."""
        good = np.flatnonzero((faces >= 0) & (self._density[faces] > 0))
        faces, u, v = faces[good], u[good], v[good]
        found = self._faces.take(faces, 0).T
        facing = -_dot(directions.take(good, 1), found[15:18])
        ways = found[:3] + u * found[3:6] + v * found[6:9] - origins.take(good, 1)
        form = cosine[good] * np.abs(facing) / (np.float32(np.pi) * np.maximum(_dot(ways, ways), 1e-30))
        share = form / (self._density[faces] + form)
        share[(facing < 0) & ~self._behind[faces]] = 0
        self._add(gathered, path, carried, good, faces, share)

    def _add(self, gathered: Floats, path: NDArray, carried: Floats, good: NDArray, faces: NDArray, share: Floats
             ) -> None:
        """Add to the paths of some rows (g,) a share (g,) of what their emitters (g,) send."""
        emission, path = self._emission.take(faces, 0).T, path[good]
        for channel in range(3):
            gathered[channel][path] += carried[channel][good] * emission[channel] * share


def _dot(a: Floats, b: Floats) -> Floats:
    """(n,) of (3, n) each."""
    found: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return found


def _rows(a: Floats) -> Floats:
    """(n, 3), contiguous, of (3, n)."""
    return np.stack([a[0], a[1], a[2]], 1)
