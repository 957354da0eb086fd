# SPDX-License-Identifier: GPL-3.0-or-later
"""The same glossy picture twice: from transfer, in NumPy, and path traced, by Mitsuba 3.

Both see facets through a pinhole, and average over the same square pixels. The BRDF is Phong's,
(n+1)/(2 pi) max(r.w, 0)**n, so that B = int L V max(n.w, 0) lobe(w) dw with a lobe that integrates
to 1: the one whose zonal coefficients `lobes` has. (With n+2 for n+1 it would reflect all of a
white sky at normal incidence; this is a factor of both pictures.)
"""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neural_gash_addon.backend import gloss, lobes
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import POINT, TriangleMesh, unit
from neural_gash_addon.backend.raycast import Geometry, Occluders

_SKY = 512  # rows of the environment map: bilinear lookups err by 1e-5 of a light of 5 bands


@dataclass(frozen=True)
class Camera:
    """A pinhole; Z is up."""

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    degrees: float  # across the width
    width: int
    height: int

    def rays(self, per_side: int, seed: int) -> NDArray[np.float64]:
        """Directions (H, W, per_side**2, 3), somewhere in each cell of a grid over each pixel; row 0 is on top."""
        jitter = np.random.default_rng([seed, 7]).random((2, self.height, self.width, per_side, per_side))
        cell = np.arange(per_side)
        x = (np.arange(self.width)[:, None, None] + (cell[:, None] + jitter[0]) / per_side) / self.width
        y = (np.arange(self.height)[:, None, None, None] + (cell + jitter[1]) / per_side) / self.height
        ahead = unit(np.subtract(self.target, self.origin)[None].astype(float))[0]
        right = unit(np.cross(ahead, [0, 0, 1])[None])[0]
        half = np.tan(np.radians(self.degrees) / 2)
        across, up = half * (2 * x - 1), half * self.height / self.width * (1 - 2 * y)
        found = ahead + across[..., None] * right + up[..., None] * np.cross(right, ahead)
        return unit(found.reshape(-1, 3)).reshape(self.height, self.width, per_side ** 2, 3)


class Seen:
    """The points of a surface that a camera sees, some in each pixel, and pictures of them."""

    def __init__(self, geometry: Geometry, camera: Camera, per_side: int, seed: int) -> None:
        positions, triangles = geometry
        directions = camera.rays(per_side, seed)
        flat = directions.reshape(-1, 3)
        scene = Occluders([geometry])
        start = np.ascontiguousarray(np.broadcast_to(scene.normalise(np.array([camera.origin])), flat.shape))
        hits = scene.hits(start, flat.astype(np.float32))
        rays, faces = hits.rays[hits.front], hits.faces[hits.front]
        a, b, c = positions[triangles[faces]].transpose(1, 0, 2)
        normals = unit(np.cross(b - a, c - a))
        reach = np.einsum("nd,nd->n", a - camera.origin, normals) / np.einsum("nd,nd->n", flat[rays], normals)
        points = camera.origin + reach[:, None] * flat[rays]
        self.view = -flat[rays]                              # (N, 3)
        self.mesh = TriangleMesh(positions, triangles, points, normals, normals,
                                 np.arange(len(points), dtype=np.int32), POINT, 0.0)
        self._pixel = rays // per_side ** 2                  # (N,)
        self._shape = (camera.height, camera.width)
        self._per_pixel = per_side ** 2
        self.covered = np.bincount(self._pixel, minlength=camera.height * camera.width).reshape(self._shape) \
            == self._per_pixel                               # (H, W), from edge to edge, and from in front

    def picture(self, product: NDArray, exponent: float) -> NDArray[np.float64]:
        """(H, W, 3) radiance, 0 beside the surface, of the points' `gloss.transferred` (N, K, 3)."""
        bands = lobes.phong_attenuation(exponent, sh.order_of(product.shape[1]))
        radiance = gloss.reflected_radiance(product, self.view, self.mesh.normals, bands)
        size = self._shape[0] * self._shape[1]
        sums = [np.bincount(self._pixel, channel, size) for channel in radiance.T]
        return np.stack(sums, -1).reshape(*self._shape, 3) / self._per_pixel


def _phong(mi: Any) -> type:
    """The lobe as a class of BSDF of the variant of Mitsuba that is set; front sides only."""
    import drjit as dr

    class Phong(mi.BSDF):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.exponent = properties["exponent"]
            self.m_components = [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def _lobe(self, si: Any, wo: Any) -> Any:
            cosine = dr.maximum(wo.z * si.wi.z - wo.x * si.wi.x - wo.y * si.wi.y, 0)
            return (self.exponent + 1) * dr.inv_two_pi * cosine ** self.exponent

        def sample(self, _context: Any, si: Any, _one: Any, two: Any, active: Any = True) -> Any:
            z = two.x ** (1 / (self.exponent + 1))
            radius, phi = dr.sqrt(dr.maximum(1 - z * z, 0)), 2 * dr.pi * two.y
            frame = mi.Frame3f(mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z))
            found = mi.BSDFSample3f()
            found.wo = frame.to_world(mi.Vector3f(radius * dr.cos(phi), radius * dr.sin(phi), z))
            found.pdf, found.eta = self._lobe(si, found.wo), 1.0
            found.sampled_type, found.sampled_component = mi.UInt32(int(self.m_flags)), mi.UInt32(0)
            lit = active & (si.wi.z > 0) & (found.wo.z > 0)
            return found, dr.select(lit, mi.Color3f(found.wo.z), mi.Color3f(0.0))

        def eval(self, _context: Any, si: Any, wo: Any, active: Any = True) -> Any:
            lit = active & (si.wi.z > 0) & (wo.z > 0)
            return dr.select(lit, mi.Color3f(self._lobe(si, wo) * wo.z), mi.Color3f(0.0))

        def pdf(self, _context: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return dr.select(active, self._lobe(si, wo), 0.0)

        def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval(context, si, wo, active), self.pdf(context, si, wo, active)

    return Phong


class PathTraced:
    """Pictures of the same surface by Mitsuba, whose variant is set: light straight from the sky, nothing bounced."""

    def __init__(self, mi: Any, geometry: Geometry, camera: Camera, light: NDArray, folder: Path) -> None:
        """light: (K, 3), in world axes. folder: for the mesh's file."""
        import trimesh

        self._mi, self._file = mi, str(folder / "surface.ply")
        trimesh.Trimesh(*geometry, process=False).export(self._file)
        mi.register_bsdf("neural_gash_phong", _phong(mi))
        self._sensor = {
            "type": "perspective", "fov": camera.degrees, "fov_axis": "x", "sampler": {"type": "multijitter"},
            "to_world": mi.ScalarTransform4f().look_at(list(camera.origin), list(camera.target), [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "rgba",
                     "rfilter": {"type": "box"}}}
        theta = (np.arange(_SKY) + 0.5) / _SKY * np.pi        # Mitsuba's own frame of the map
        u = (np.arange(2 * _SKY) + 0.5) / _SKY * np.pi
        s = np.sin(theta)[:, None]
        d = np.stack([s * np.sin(u), np.repeat(np.cos(theta)[:, None], 2 * _SKY, 1), -s * np.cos(u)], -1)
        sky = sh.evaluate(d.reshape(-1, 3), sh.order_of(len(light))) @ light
        self._sky = sky.reshape(_SKY, 2 * _SKY, 3).astype(np.float32)

    def picture(self, exponent: float, samples: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(H, W, 3) radiance, 0 beside the surface, and where it covers a pixel from edge to edge (H, W).

        Mitsuba takes no negative light: the same paths see what of the light is positive, then what is negative.
        """
        parts = []
        for sign in (1, -1):
            sky = self._mi.Bitmap(np.maximum(sign * self._sky, 0))
            scene = self._mi.load_dict({
                "type": "scene", "sensor": self._sensor, "sky": {"type": "envmap", "bitmap": sky},
                "integrator": {"type": "direct", "bsdf_samples": 1, "emitter_samples": 0, "hide_emitters": True},
                "surface": {"type": "ply", "filename": self._file, "face_normals": True,
                            "bsdf": {"type": "neural_gash_phong", "exponent": float(exponent)}}})
            parts.append(np.array(self._mi.render(scene, spp=samples, seed=seed), dtype=np.float64))
        return parts[0][..., :3] - parts[1][..., :3], parts[0][..., 3] > 1 - 1e-6


def compare(found: NDArray, truth: NDArray, where: NDArray) -> tuple[float, float, float]:
    """How two pairs of pictures (2, H, W, 3) of independent noise differ where (H, W): parts of the RMS of the truth.

    Returns:
        The relative RMSE of the pairs' means, what of it is no noise, and its noise: the first
        squared is the sum of the others squared. What is no noise comes of the product of two
        differences that have no noise in common, so it is as good as without any.
    """
    first, second = (found[n][where] - truth[n][where] for n in (0, 1))
    scale = np.sqrt(np.square(0.5 * (truth[0] + truth[1])[where]).mean())
    error, noise = np.sqrt(np.square(0.5 * (first + second)).mean()), 0.5 * np.sqrt(np.square(first - second).mean())
    shared = np.sqrt(max(float((first * second).mean()), 0.0))
    return float(error / scale), float(shared / scale), float(noise / scale)
