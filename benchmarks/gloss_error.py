# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy radiance from five bands beside brute force, by Phong exponent: `python benchmarks/gloss_error.py`.

Both see the same SH light. The reference samples the lobe itself and traces those rays; nothing of
it but the light is band-limited. So the table shows what cutting off costs: the transfer before the
product, and the product after it. Bakes take 4096 rays, so that noise is no part of it.
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import trimesh
from meshes import knot
from numpy.typing import NDArray

from neural_gash_addon.backend import gloss, light, lobes, methods, sampling
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import POINT, TriangleMesh
from neural_gash_addon.backend.raycast import Geometry, Occluders

ORDER, EXPONENTS = 5, (1, 5, 10, 20, 50, 100)
_PRODUCT = 2 * ORDER - 1  # bands of the transfer that reach ORDER bands of its product with ORDER bands of light
_RAYS = 4096              # of a point, for its transfer

# (centre, radii) of a skull, muzzle, brow, nose and ears
_HEAD = (((0, 0, 0), (1.0, 0.9, 0.95)), ((0, -0.75, -0.4), (0.6, 0.45, 0.4)), ((0, -0.85, 0.25), (0.75, 0.2, 0.12)),
         ((0, -1.15, -0.2), (0.2, 0.18, 0.14)),
         ((1.25, 0, 0.1), (0.45, 0.08, 0.5)), ((-1.25, 0, 0.1), (0.45, 0.08, 0.5)))


def torus() -> Geometry:
    """Radii 1 and 0.45."""
    ring = trimesh.creation.torus(1.0, 0.45, 128, 64)
    return np.array(ring.vertices), np.array(ring.faces, dtype=np.int32)


def head() -> Geometry:
    """Ellipsoids that run into each other: overhanging brow, muzzle and ears."""
    ball = trimesh.creation.icosphere(4)
    return (np.concatenate([ball.vertices * radii + centre for centre, radii in _HEAD]),
            np.concatenate([ball.faces + n * len(ball.vertices) for n in range(len(_HEAD))]).astype(np.int32))


def outward(geometry: Geometry) -> Geometry:
    """The closed surface with its facets wound so that their normals point out."""
    positions, triangles = geometry
    a, b, c = positions[triangles].transpose(1, 0, 2)
    volume = np.einsum("ni,ni->", a, np.cross(b, c))
    return positions, triangles if volume > 0 else triangles[:, ::-1]


def outside_head(points: NDArray) -> NDArray[np.bool_]:
    """Which points (N, 3) lie in no ellipsoid of the head (those on its facets lie a little inside their own)."""
    inside = [np.square((points - centre) / radii).sum(1) < 0.99 for centre, radii in _HEAD]
    return ~np.any(inside, axis=0)


def points_on(geometry: Geometry, count: int) -> TriangleMesh:
    """`count` points in the facets, even by area, with the facets' normals."""
    positions, triangles = geometry
    corners = positions[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    rng = np.random.default_rng(0)
    faces = rng.choice(len(triangles), count, p=area / area.sum())
    points = (corners[faces] * rng.dirichlet(np.ones(3), count)[:, :, None]).sum(1)
    unit = normals[faces] / area[faces, None]
    return TriangleMesh(positions, triangles, points, unit, unit, np.arange(count, dtype=np.int32), POINT, 0.0)


def kept(mesh: TriangleMesh, which: NDArray) -> TriangleMesh:
    """The mesh with some of its points."""
    return TriangleMesh(mesh.positions, mesh.triangles, mesh.points[which], mesh.normals[which],
                        mesh.clearance[which], mesh.elements[:which.sum()], POINT, mesh.resolution)


def sky() -> NDArray[np.float64]:
    """(K, 3): a blue gradient, a warm window, and a small bright one."""
    image = np.zeros((64, 128, 3))
    image[:] = np.linspace(0.1, 1, 64)[:, None, None] * np.array([0.5, 0.7, 1.0])
    image[34:46, 20:40] += np.array([8.0, 5.0, 2.0])
    image[50:54, 90:95] += 40
    return light.project_equirect(image, ORDER)


class Truth:
    """Rays from a mesh's points, and what is made of them."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        self.scene = Occluders([(mesh.positions, mesh.triangles)])
        self.origins = self.scene.origins(mesh.points, mesh.clearance)
        rng = np.random.default_rng(1)
        self.angles = rng.uniform(0, 2 * np.pi, len(mesh.points))
        view = rng.normal(size=(len(mesh.points), 3))  # anywhere in front
        view *= np.sign((view * mesh.normals).sum(1, keepdims=True))
        self.view = view / np.linalg.norm(view, axis=1, keepdims=True)

    def blocked(self, rows: slice, directions: NDArray) -> NDArray[np.bool_]:
        """(n, R) for directions (n, R, 3) at these points."""
        rays = np.ascontiguousarray(directions.reshape(-1, 3), dtype=np.float32)
        hit = self.scene.blocked(np.repeat(self.origins[rows], directions.shape[1], axis=0), rays)
        return (hit == 0).reshape(directions.shape[:2])

    def radiance(self, lights: list[NDArray], exponent: float, samples: int, seed: int) -> NDArray[np.float64]:
        """B (lights, N, 3) = int L(w) V(w) max(n.w, 0) lobe(w) dw, directions drawn from the lobe."""
        seeds = np.random.default_rng(seed).integers(0, 2**32, (1, 2), dtype=np.uint32)
        u = (sampling.owen_scramble(sampling.sobol2(samples), seeds) + 0.5) / 2**32
        z = u[:, 0] ** (1 / (exponent + 1))
        r, phi = np.sqrt(1 - z * z), 2 * np.pi * u[:, 1]
        local = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
        frames = sampling.frames(gloss.mirrored(self.view, self.mesh.normals), self.angles)
        out = np.empty((len(lights), len(self.view), 3))
        for start in range(0, len(self.view), 64):
            rows = slice(start, start + 64)
            w = np.einsum("nij,rj->nri", frames[rows], local)
            cosine = np.maximum(np.einsum("nri,ni->nr", w, self.mesh.normals[rows]), 0)
            weight = np.where(self.blocked(rows, w), 0, cosine) / samples
            seen = np.einsum("nr,nrk->nk", weight, sh.evaluate(w.reshape(-1, 3), ORDER).reshape(*w.shape[:2], -1))
            for one, lamp in zip(out, lights, strict=True):
                one[rows] = seen @ lamp
        return out

    def transfer(self, order: int) -> NDArray[np.float64]:
        """(N, K) of any order, by the plain definition."""
        local = sampling.hemisphere_sets(1, _RAYS, 3)[0]
        out = sh.cosine_lobe(self.mesh.normals, order)
        frames = sampling.frames(self.mesh.normals, self.angles)
        for start in range(0, len(out), 16):
            rows = slice(start, start + 16)
            w = np.einsum("nij,rj->nri", frames[rows], local)
            values = sh.evaluate(w.reshape(-1, 3), order).reshape(*w.shape[:2], -1)
            out[rows] -= np.einsum("nr,nrk->nk", self.blocked(rows, w) / _RAYS, values)
        return out


def measure(points: int, samples: int) -> None:
    """Print the tables."""
    lamp = sky()
    lights = {"as projected": lamp, "windowed (Hann)": light.window(lamp, ORDER)}
    rows: dict[str, list[str]] = {label: [] for label in lights}
    for name, geometry in (("torus", torus()), ("knot", knot(8800)), ("head", head())):
        mesh = points_on(outward(geometry), points)
        if name == "head":
            mesh = kept(mesh, outside_head(mesh.points))
        truth = Truth(mesh)
        baked = methods.run(methods.bake(mesh, order=ORDER, rays=_RAYS)).coefficients
        wide = truth.transfer(_PRODUCT)
        candidates: dict[str, NDArray] = {
            **{f"order {order}": baked[:, :order * order] for order in (3, 4, ORDER)},
            "exact product": wide, "unshadowed": sh.cosine_lobe(mesh.normals, ORDER)}
        products = {(label, how): gloss.transferred(transfer, one)[:, :ORDER * ORDER]
                    for label, one in lights.items() for how, transfer in candidates.items()}
        for exponent in EXPONENTS:
            references = [truth.radiance(list(lights.values()), exponent, samples, seed) for seed in (1, 2)]
            for n, label in enumerate(lights):
                reference = 0.5 * (references[0][n] + references[1][n])
                scale = float(np.sqrt(np.square(reference).mean()))
                cells = []
                for how in candidates:
                    coefficients = products[label, how]
                    bands = lobes.phong_attenuation(exponent, sh.order_of(coefficients.shape[1]))
                    found = gloss.reflected_radiance(coefficients, truth.view, mesh.normals, bands)
                    cells.append(f"{np.sqrt(np.square(found - reference).mean()) / scale:.1%}")
                noise = np.sqrt(np.square(references[0][n] - references[1][n]).mean()) / 2 / scale
                rows[label].append(f"| {name}, {len(mesh.points)} points | {exponent} | " + " | ".join(cells)
                                   + f" | {noise:.2%} |")
    for label in lights:
        print(f"\n### Gloss, {ORDER} bands of light {label}\n\nRelative RMSE of radiance against {2 * samples} rays in "
              "the lobe of each point, views at random in front. 'exact product': the transfer has all the bands that "
              f"reach {ORDER} of the product, so what is left is the lobe's cut-off. 'no shadows': {ORDER} bands of "
              "unshadowed transfer. 'noise': of the reference, one standard error.\n")
        print("| shape | Phong exponent | order 3 | order 4 | order 5 | exact product | no shadows | noise |")
        print("|---|---|---|---|---|---|---|---|")
        print("\n".join(rows[label]), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--samples", type=int, default=1024, help="rays of a point in each half of the reference")
    args = parser.parse_args()
    measure(args.points, args.samples)
