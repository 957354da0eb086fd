# SPDX-License-Identifier: GPL-3.0-or-later
"""The same transfer by others' ray casters, as their users would write it.

Each peer is a class: building it makes the acceleration structure, `transfer(rays, seed)` gives
coefficients (N, K) of the plain estimator: uniform random directions over the sphere, the mean of
4 V max(n.w, 0) Y_k(w). ImportError where it is not installed.
"""
from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.raycast import Occluders

CHUNK = 1 << 18  # rays at a time of the NumPy estimator


@lru_cache(maxsize=2)
def origins(mesh: TriangleMesh) -> NDArray[np.float64]:
    """Ray origins (N, 3) off the surface, in the mesh's coordinates: ours, so that all see the same surface.

    Kept from the first call, so that no peer's time has ours in it.
    """
    scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    return scene.origins(mesh.points, mesh.clearance) / scene.scale + scene.centre


class _Plain:
    """The estimator in NumPy over a caster's `hits(origins, directions) -> (R,) bool`."""

    def __init__(self, mesh: TriangleMesh, order: int) -> None:
        self.mesh, self.order, self.origins = mesh, order, origins(mesh)

    def hits(self, starts: NDArray, directions: NDArray) -> NDArray[np.bool_]:
        raise NotImplementedError

    def transfer(self, rays: int, seed: int) -> NDArray[np.float64]:
        """Coefficients (N, K)."""
        rng = np.random.default_rng(seed)
        count = len(self.mesh.points)
        out = np.empty((count, self.order ** 2))
        size = max(1, CHUNK // rays)
        for first in range(0, count, size):
            part = slice(first, first + size)
            normals = self.mesh.normals[part]
            n = len(normals)
            z = rng.uniform(-1, 1, n * rays)
            phi = rng.uniform(0, 2 * np.pi, n * rays)
            s = np.sqrt(1 - z * z)
            directions = np.stack([s * np.cos(phi), s * np.sin(phi), z], 1)
            free = ~self.hits(np.repeat(self.origins[part], rays, axis=0), directions)
            cosine = np.einsum("nrd,nd->nr", directions.reshape(n, rays, 3), normals)
            weight = 4 * free.reshape(n, rays) * np.maximum(cosine, 0)
            values = sh.evaluate(directions, self.order).reshape(n, rays, -1)
            out[part] = np.matmul(weight[:, None], values)[:, 0] / rays
        return out


class Trimesh(_Plain):
    """trimesh's ray interface on embreex, `intersects_any`."""

    name = "trimesh + embreex"

    def __init__(self, mesh: TriangleMesh, order: int) -> None:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        super().__init__(mesh, order)
        self.caster = RayMeshIntersector(trimesh.Trimesh(mesh.positions, mesh.triangles, process=False))
        self.caster.intersects_any(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))  # builds

    def hits(self, starts: NDArray, directions: NDArray) -> NDArray[np.bool_]:
        return self.caster.intersects_any(starts, directions)


class Open3D(_Plain):
    """Open3D's RaycastingScene.test_occlusions, all threads."""

    name = "Open3D RaycastingScene"

    def __init__(self, mesh: TriangleMesh, order: int) -> None:
        import open3d

        super().__init__(mesh, order)
        self._tensor = open3d.core.Tensor
        self.caster = open3d.t.geometry.RaycastingScene()
        self.caster.add_triangles(self._tensor(mesh.positions.astype(np.float32)),
                                  self._tensor(mesh.triangles.astype(np.uint32)))
        self.caster.test_occlusions(self._tensor(np.array([[0, 0, 0, 0, 0, 1]], np.float32)))  # builds

    def hits(self, starts: NDArray, directions: NDArray) -> NDArray[np.bool_]:
        rays = np.concatenate([starts, directions], 1).astype(np.float32)
        return self.caster.test_occlusions(self._tensor(rays)).numpy()


class MitsubaArrays(_Plain):
    """Mitsuba 3's ray_test on arrays, all threads."""

    name = "Mitsuba 3 LLVM ray_test, NumPy"

    def __init__(self, mesh: TriangleMesh, order: int) -> None:
        super().__init__(mesh, order)
        self.mi, self.scene = _mitsuba_scene(mesh)

    def hits(self, starts: NDArray, directions: NDArray) -> NDArray[np.bool_]:
        point, vector = (a.astype(np.float32).T for a in (starts, directions))
        return self.scene.ray_test(self.mi.Ray3f(self.mi.Point3f(point), self.mi.Vector3f(vector))).numpy()


def _mitsuba_scene(mesh: TriangleMesh) -> tuple[Any, Any]:
    """The module with its variant set, and a scene of the mesh."""
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    shape = mitsuba.Mesh("mesh", len(mesh.positions), len(mesh.triangles))
    parameters = mitsuba.traverse(shape)
    parameters["vertex_positions"] = mitsuba.Float(mesh.positions.astype(np.float32).ravel())
    parameters["faces"] = mitsuba.UInt32(mesh.triangles.astype(np.uint32).ravel())
    parameters.update()
    return mitsuba, mitsuba.load_dict({"type": "scene", "mesh": shape})


class Mitsuba:
    """Mitsuba 3, LLVM: directions, ray_test, harmonics and sums in one compiled kernel, all threads."""

    name = "Mitsuba 3 LLVM, one kernel"
    LANES = 16  # parts of a point's rays that run side by side, so that small meshes fill the threads

    def __init__(self, mesh: TriangleMesh, order: int) -> None:
        self.mi, self.scene = _mitsuba_scene(mesh)
        self.order, self.count = order, len(mesh.points)
        self.origins = self.mi.Point3f(origins(mesh).astype(np.float32).T)
        self.normals = self.mi.Normal3f(mesh.normals.astype(np.float32).T)

    def transfer(self, rays: int, seed: int) -> NDArray[np.float64]:
        """Coefficients (N, K) from uniform random directions."""
        import drjit as dr

        mi = self.mi
        lane = dr.arange(mi.UInt32, self.count * self.LANES)
        point = lane // self.LANES
        origin = dr.gather(mi.Point3f, self.origins, point)
        normal = dr.gather(mi.Normal3f, self.normals, point)
        random = mi.PCG32(size=self.count * self.LANES, initstate=seed)
        sums = [mi.Float(0) for _ in range(self.order ** 2)]
        steps = mi.UInt32(max(1, rays // self.LANES))

        def step(i, random, sums):
            # no dr.maximum and no warp that uses it: LLVM before 17 aborts the process at its fmaximum
            u = random.next_float32()
            z = 1 - 2 * u
            s = 2 * dr.sqrt(u * (1 - u))
            sine, cos = dr.sincos(2 * dr.pi * random.next_float32())
            direction = mi.Vector3f(s * cos, s * sine, z)
            weight = dr.dot(direction, normal)
            weight = dr.select(weight > 0, 4 * weight, 0)
            weight = dr.select(self.scene.ray_test(mi.Ray3f(origin, direction)), 0, weight)
            values = dr.sh_eval(direction, self.order - 1)
            return i + 1, random, [a + weight * y for a, y in zip(sums, values, strict=True)]

        _, _, sums = dr.while_loop((mi.UInt32(0), random, sums), lambda i, *_: i < steps, step)
        dr.eval(sums)  # all at once: each block_sum alone would run the loop again
        totals = [dr.block_sum(s, self.LANES) for s in sums]
        dr.eval(totals)
        out = np.stack([t.numpy() for t in totals], 1).astype(np.float64)
        return out * self._signs() / (max(1, rays // self.LANES) * self.LANES)

    def _signs(self) -> NDArray[np.float64]:
        """Dr.Jit's harmonics have the Condon-Shortley phase, ours have not: (-1)^m."""
        m = np.concatenate([np.arange(-band, band + 1) for band in range(self.order)])
        return (-1.0) ** m
