# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy interreflection under a fixed light (PRTT, section 4.2, equation 3).

What a point sees of other surfaces is one more environment. Patches (`bounce`) reflect the light by
the triple product of their transfer with it, a dull part and a lobe about the mirrored direction;
points project what their rays meet, times the cosine, to harmonics. Those add to
`gloss.transferred` of the sky, as both are incoming light times cosine: so a shader needs nothing
more for any number of bounces, where PRTT fetches and convolves a texture for each.
"""
from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import gloss, lobes, sampling
from . import spherical_harmonics as sh
from .bounce import Bounces, spread
from .errors import UserError
from .geometry import Surface, TriangleMesh, unit
from .pictures import Picture
from .progress import scaled
from .raster import Layout
from .raycast import Geometry, Occluders
from .record import BakeRecord
from .texels import NormalMap, texel_points
from .texture import TextureTransfer
from .workers import default_threads

RAYS = 256            # of a texel: with 128 a mirroring floor shows grain
_RAYS_AT_ONCE = 1 << 15
_SETS = 16
_TILE = 1 << 18       # texels


@dataclass(frozen=True, eq=False)
class Finish:
    """How triangles reflect, F of them."""

    albedo: NDArray[np.float64]     # (F, 3) diffuse
    specular: NDArray[np.float64]   # (F, 3) of the lobe
    roughness: NDArray[np.float64]  # (F,) Blender's, 0 to 1
    lobe: str = lobes.GGX           # what the roughness means
    pictures: Sequence[Picture] = ()  # that say all of it, in this order, from place to place


class GlossyBounces:
    """The light that leaves each patch, direct and bounced, by direction."""

    def __init__(self, parts: Sequence[Geometry], finish: Finish, scene: Occluders, light: NDArray, seed: int = 0,
                 threads: int | None = None) -> None:
        """Prepare; nothing is traced yet.

        Args:
            parts: positions (V, 3), triangles (F, 3) of everything, in the order that `scene` has them.
            finish: of the triangles of all parts. light: (K, 3) in the bake frame.
        """
        self._order = sh.order_of(len(light))
        self._light = np.asarray(light, np.float64)
        self._threads = threads or default_threads()
        self._seed = seed
        self._bounces = Bounces(parts, finish.albedo, scene, self._order, seed, threads, pictures=finish.pictures)
        patches = self._bounces.patches
        values = patches.mean(np.column_stack([finish.albedo, finish.specular, finish.roughness]), finish.pictures)
        self._specular = values[:, 3:6]
        bands = lobes.attenuation(values[:, 6], self._order, finish.lobe)
        self._damping = np.repeat(bands, 2 * np.arange(self._order) + 1, axis=1)       # (M, K)
        self._normals = unit(patches.mean(patches.normals))                            # (M, 3)
        self._leaving = np.zeros((0, self._order ** 2, 3), np.float32)  # by the direction of the ray that meets it

    def solve(self, bounces: int = 1) -> Generator[float, None, None]:
        """Trace the patches, and reflect the light from patch to patch, so that points see `bounces` of them."""
        yield from scaled(self._bounces.trace(), 0, 0.8)
        now = gloss.transferred(self._bounces.direct, self._light)
        total = now.astype(np.float64)
        for number in range(1, bounces):
            leaving = self._left(now)
            now = np.concatenate([self._projected(self._bounces.directions[s:s + 256], self._bounces.met[s:s + 256],
                                                  leaving) for s in range(0, len(now), 256)])
            total += now
            yield 0.8 + 0.2 * number / bounces
        self._leaving = self._left(total)

    def gather(self, mesh: TriangleMesh, rays: int = RAYS) -> Generator[float, None, NDArray[np.float32]]:
        """Bounced light times cosine at the points of a mesh: (N, K, 3), to be added to `gloss.transferred`.

        Yields:
            Progress, 0 to 1. Closing the generator stops the workers.
        """
        out = np.zeros((len(mesh.points), self._order ** 2, 3), np.float32)
        rng = np.random.default_rng([self._seed, 4])
        sets = sampling.hemisphere_sets(_SETS, rays, int(rng.integers(2**31)))
        which, angles = rng.integers(0, _SETS, len(mesh.points)), rng.uniform(0, 2 * np.pi, len(mesh.points))
        lit = mesh.lit()
        step = max(1, _RAYS_AT_ONCE // rays)

        def part(points: NDArray) -> None:
            frames = sampling.frames(mesh.normals[points], angles[points])
            directions = np.matmul(sets[which[points]], frames.transpose(0, 2, 1)).astype(np.float32)
            met = self._bounces.met_by(mesh, points, directions)
            out[points] = self._projected(directions, met, self._leaving)

        yield from spread(part, [lit[s:s + step] for s in range(0, len(lit), step)], self._threads)
        return out

    def _left(self, lit: NDArray) -> NDArray[np.float32]:
        """(sides, K, 3) that leaves the traced sides, of the light times cosine (sides, K, 3) that reaches them.

        As a function of the direction w of the ray that meets a side: the lobe is seen at w mirrored at its
        normal, I - 2nn' = -(2nn' - I), a half turn about n, and then odd bands change their sign.
        """
        sides = self._bounces.sides
        patch, normals = sides // 2, self._normals[sides // 2]
        out = lit * self._damping[patch][:, :, None] * self._specular[patch][:, None]
        half_turns = 2 * normals[:, :, None] * normals[:, None, :] - np.eye(3)
        bands = np.repeat(np.arange(self._order), 2 * np.arange(self._order) + 1)
        for colour in range(3):
            out[..., colour] = sh.rotate_each(out[..., colour], half_turns) * (-1.0) ** bands
        # dull: the mean of incoming light times cosine over pi, the same in every direction
        out[:, 0] += self._bounces.albedo[patch] * lit[:, 0] / (np.pi * sh.normalisation(0, 0) ** 2)
        return out.astype(np.float32)

    def _projected(self, directions: NDArray[np.float32], met: NDArray[np.int32], leaving: NDArray[np.float32]
                   ) -> NDArray[np.float32]:
        """(n, K, 3) of what cosine-distributed rays (n, R, 3) meet: rows (n, R) of `leaving`, -1 for nothing."""
        hit = np.flatnonzero(met.ravel() >= 0)
        values = np.zeros((met.size, self._order ** 2), np.float32)
        values[hit] = sh.evaluate(directions.reshape(-1, 3)[hit], self._order)
        radiance = np.zeros((met.size, 3), np.float32)
        radiance[hit] = np.einsum("rk,rkc->rc", values[hit], leaving[met.ravel()[hit]])
        count, rays = met.shape
        found: NDArray[np.float32] = np.matmul(values.reshape(count, rays, -1).transpose(0, 2, 1),
                                               radiance.reshape(count, rays, 3))
        return found * np.float32(np.pi / rays)


def bake(surface: Surface, uv: NDArray, record: BakeRecord, light: NDArray, finish: Finish, *, bounces: int = 1,
         occluders: Sequence[Geometry] = (), normal_maps: Sequence[NormalMap] = (), threads: int | None = None,
         ) -> Generator[float, None, TextureTransfer]:
    """Bounced light at the texels of a texture whose transfer is baked.

    Args:
        uv: (C, 2) of each face corner; record: of the bake. light: (K, 3) of its order, in its frame.
        finish: of the triangles of the surface, then of the occluders. bounces: 1 or more.
    Yields:
        Progress, 0 to 1.
    Returns:
        K numbers of each texel, red, green and blue of each, with a record like the bake's.
    Raises:
        UserError: the UVs leave no face any room.
    """
    began = time.perf_counter()
    scene = Occluders([(surface.positions, surface.triangles), *occluders], surface.resolution)
    solution = GlossyBounces([(surface.positions, surface.triangles), *occluders], finish, scene, light, record.seed,
                             threads)
    yield from scaled(solution.solve(bounces), 0, 0.2)
    layout = Layout(uv[surface.corners], surface.triangles, record.side)
    rows = max(1, _TILE // record.side)
    texels, found, inside = [], [], []
    for start in range(0, record.side, rows):
        stop = min(start + rows, record.side)
        coverage = layout.coverage(start, stop)
        mesh = texel_points(surface, coverage, normal_maps)
        if len(coverage.texels):
            gathering = solution.gather(mesh)
            values = yield from scaled(gathering, 0.2 + 0.8 * start / record.side, 0.8 * (stop - start) / record.side)
            texels.append(coverage.texels)
            found.append(values.reshape(len(values), -1))
            inside.append(np.all(coverage.barycentric == coverage.centres, axis=1))
    if not texels:
        raise UserError("The UVs leave no face any room in the texture, so there is nothing to bake.")
    points = sum(map(len, texels))
    return TextureTransfer(uv, texels, found, inside, replace(
        record, colours=3, bounces=bounces, points=points, rays=RAYS * points, probe_rays=0, error_estimate=None,
        tolerance=None, seconds=time.perf_counter() - began))
