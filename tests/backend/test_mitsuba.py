# SPDX-License-Identifier: GPL-3.0-or-later
"""Radiance under an HDRI against Mitsuba 3's direct integrator, diffuse BSDF, SH-projected map as environment."""
import numpy as np
import pytest

from neural_gash_addon.backend import light, methods, shading
from neural_gash_addon.backend import spherical_harmonics as sh

from . import shapes

mi = pytest.importorskip("mitsuba", reason="needs mitsuba, a development dependency, as an independent renderer")
trimesh = pytest.importorskip("trimesh")

ALBEDO = 0.6
SAMPLES = 256
REPEATS = 4
POINTS = 200


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("scalar_rgb")  # the LLVM one wants a system libLLVM


@pytest.fixture(scope="module")
def hdri():
    """(H, W, 3), bottom row first: one of Blender's own HDRIs."""
    bpy = pytest.importorskip("bpy", reason="needs the HDRIs that Blender ships")
    from pathlib import Path
    path = Path(bpy.utils.system_resource("DATAFILES")) / "studiolights" / "world" / "city.exr"
    pixels = np.array(mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32))
    return pixels[::-1]


def _environment(coefficients: np.ndarray, sign: float) -> dict:
    """The positive (or negated negative) part of the SH map as a Mitsuba environment."""
    height, width = 512, 1024
    theta = (np.arange(height) + 0.5) / height * np.pi
    u = (np.arange(width) + 0.5) / width * 2 * np.pi
    s = np.sin(theta)[:, None]
    d = np.stack([s * np.sin(u), np.repeat(np.cos(theta)[:, None], width, 1), -s * np.cos(u)], -1)  # its own frame
    values = sh.evaluate(d.reshape(-1, 3), sh.order_of(len(coefficients))) @ coefficients
    values = np.maximum(sign * values, 0).reshape(height, width, 3).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(values)}


def _mitsuba_radiance(mesh, coefficients: np.ndarray, folder) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (N, 3) at the mesh's points and its standard error, from a radiance meter looking down at each."""
    ply = trimesh.Trimesh(mesh.positions, mesh.triangles, vertex_normals=mesh.vertex_normals, process=False)
    ply.export(folder / "mesh.ply", vertex_normal=True)
    shape = {"type": "ply", "filename": str(folder / "mesh.ply"),
             "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [ALBEDO] * 3}}}
    lift = 1e-3
    meters = [mi.load_dict({
        "type": "radiancemeter", "origin": list(p + lift * n), "direction": list(-n),
        "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}})
        for p, n in zip(mesh.points, mesh.facets, strict=True)]
    total, variance = np.zeros((POINTS, 3)), np.zeros((POINTS, 3))
    for sign in (1.0, -1.0):
        scene = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, "mesh": shape,
                              "sky": _environment(coefficients, sign)})
        repeats = np.array([[np.array(mi.render(scene, sensor=m, spp=SAMPLES, seed=1000 * r + i)).reshape(3)
                             for i, m in enumerate(meters)] for r in range(REPEATS)])
        total += sign * repeats.mean(0)
        variance += repeats.var(0, ddof=1) / REPEATS
    return total, np.sqrt(variance)


class _Sampled:
    """A mesh with points inside faces, where both renderers see exactly the same surface."""

    def __init__(self, path):
        ply = trimesh.load(path, process=False)
        ply.apply_scale(10 / ply.extents.max())  # Mitsuba's ray epsilon is absolute
        self.positions, self.triangles = np.asarray(ply.vertices), np.asarray(ply.faces)
        self.vertex_normals = np.asarray(ply.vertex_normals)
        rng = np.random.default_rng(0)
        faces = rng.choice(len(self.triangles), POINTS, p=ply.area_faces / ply.area_faces.sum())
        weights = rng.dirichlet(np.full(3, 4.0), POINTS)[:, :, None]
        self.points = (self.positions[self.triangles[faces]] * weights).sum(1)
        normals = (self.vertex_normals[self.triangles[faces]] * weights).sum(1)
        self.normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        self.facets = np.asarray(ply.face_normals)[faces]
        # Mitsuba lights only what is above the facet, too: compare where shading and facet agree
        self.smooth = (self.normals * self.facets).sum(1) > 0.995


@pytest.mark.parametrize("name", ["train/armadillo", "validation/bunny", "train/lungs"])
def test_radiance_agrees_with_mitsuba(meshes, hdri, name, tmp_path):
    order = 4
    sky = light.project_equirect(hdri, order)
    mesh = _Sampled(meshes / f"{name}.ply")
    expected, noise = _mitsuba_radiance(mesh, sky, tmp_path)
    points = shapes.at_points((mesh.positions, mesh.triangles), mesh.points, mesh.normals)
    found = shading.radiance(methods.run(methods.bake(points, order=order, rays=4096)).coefficients, sky, ALBEDO)
    difference = (found - expected)[mesh.smooth]
    sigma = noise[mesh.smooth]
    scale = np.abs(expected).mean()
    # as unbiased as the noise can tell, and point by point within it (a fixed part for the facet's edge)
    assert np.abs(difference.mean(0)).max() < 4 * sigma.mean() / np.sqrt(mesh.smooth.sum()) + 0.004 * scale
    within = np.abs(difference) < 4 * sigma + 0.02 * scale
    assert within.mean() > 0.98
    unshadowed = shading.radiance(sh.cosine_lobe(mesh.normals, order), sky, ALBEDO)
    shadows = np.sqrt(np.mean((unshadowed - expected)[mesh.smooth] ** 2))
    assert np.sqrt(np.mean(difference ** 2)) < 0.15 * shadows  # and the agreement is about shadows
