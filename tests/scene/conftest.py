# SPDX-License-Identifier: GPL-3.0-or-later
"""An empty Blender scene for each test, and what the tests build in it."""
from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture(autouse=True)
def empty_file():
    """Every test starts from an empty file; skips where there is no bpy."""
    bpy = pytest.importorskip("bpy")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    yield
    bpy.ops.wm.read_factory_settings(use_empty=True)


class Maker:
    """Short ways to put things into the current scene."""

    @staticmethod
    def mesh(positions, faces, name="Thing", smooth=False):
        """A mesh object."""
        import bpy
        data = bpy.data.meshes.new(name)
        data.from_pydata([tuple(map(float, p)) for p in positions], [], [tuple(map(int, f)) for f in faces])
        if smooth:
            data.shade_smooth()
        obj = bpy.data.objects.new(name, data)
        bpy.context.scene.collection.objects.link(obj)
        return obj

    @classmethod
    def grid(cls, cells=2, name="Grid", smooth=True):
        """A square from -1 to 1 in the plane z = 0."""
        n = cells + 1
        line = np.linspace(-1, 1, n)
        positions = [(x, y, 0) for y in line for x in line]
        faces = [(j * n + i, j * n + i + 1, (j + 1) * n + i + 1, (j + 1) * n + i)
                 for j in range(cells) for i in range(cells)]
        return cls.mesh(positions, faces, name, smooth)

    @classmethod
    def cube(cls, name="Cube", smooth=False):
        """The cube from -1 to 1."""
        positions = [(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
        faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
        return cls.mesh(positions, faces, name, smooth)

    @classmethod
    def sphere(cls, name="Sphere", smooth=True, detail=2):
        """An icosphere of radius 1."""
        import bmesh
        obj = cls.mesh([], [], name)
        edit = bmesh.new()
        bmesh.ops.create_icosphere(edit, subdivisions=detail, radius=1.0)
        edit.to_mesh(obj.data)
        edit.free()
        if smooth:
            obj.data.shade_smooth()
        else:
            obj.data.shade_flat()
        return obj

    @staticmethod
    def depsgraph():
        """The current evaluated state."""
        import bpy
        return bpy.context.evaluated_depsgraph_get()

    @classmethod
    def bake(cls, obj, order=3, seed=0, occluders="SELF"):
        """Store made-up coefficients on `obj`, of both signs; gives the mesh and the transfer."""
        from neural_gash_addon.backend.record import BakeRecord
        from neural_gash_addon.backend.transfer import Transfer
        from neural_gash_addon.scene import attributes, read
        scene_mesh = read.read_object(obj, cls.depsgraph())
        count = len(scene_mesh.mesh.points)
        values = np.random.default_rng(seed).normal(0, 0.5, (count, order * order)).astype(np.float32)
        record = BakeRecord(
            method="made up", order=order, points=count, domain=scene_mesh.mesh.domain, rays=0, seed=seed,
            seconds=0.0, error_estimate=None, occluders=occluders, frame=scene_mesh.frame,
            fingerprint=read.fingerprint(obj, cls.depsgraph(), occluders))
        transfer = Transfer(values, record)
        attributes.write_transfer(obj, scene_mesh.mesh.elements, transfer)
        return scene_mesh.mesh, transfer


@pytest.fixture
def make() -> type[Maker]:
    """Builders of test objects."""
    return Maker


@pytest.fixture
def render(tmp_path):
    """render(width, height) -> (H, W, 4) float32 as Cycles (or EEVEE) shows it, row 0 at the bottom."""
    def shoot(width, height, samples=1, eevee=False):
        import bpy
        scene = bpy.context.scene
        if eevee:
            scene.render.engine = "BLENDER_EEVEE" if bpy.app.version >= (5, 0, 0) else "BLENDER_EEVEE_NEXT"
            scene.eevee.taa_render_samples = samples
            scene.render.filter_size = 0.01
        else:
            scene.render.engine = "CYCLES"
        scene.cycles.device = "CPU"
        scene.cycles.samples = samples
        scene.cycles.use_adaptive_sampling = False
        scene.cycles.use_denoising = False
        scene.cycles.pixel_filter_type = "BOX"
        scene.cycles.filter_width = 0.01  # samples at the pixels' centres
        scene.render.resolution_x, scene.render.resolution_y = width, height
        scene.render.resolution_percentage = 100
        if bpy.app.version >= (5, 0, 0):
            scene.render.image_settings.media_type = "IMAGE"
        scene.render.image_settings.file_format = "OPEN_EXR"
        scene.render.image_settings.color_depth = "32"
        scene.render.filepath = str(tmp_path / "render.exr")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(scene.render.filepath)
        image.colorspace_settings.name = "Non-Color"
        pixels = np.empty((height, width, image.channels), np.float32)
        image.pixels.foreach_get(pixels.ravel())
        bpy.data.images.remove(image)
        return pixels
    return shoot


@pytest.fixture
def camera():
    """camera(position, towards, width) or with an angle instead of a width: the scene's camera."""
    def place(position, towards, width=None, angle=None):
        import bpy
        from mathutils import Vector
        data = bpy.data.cameras.new("Camera")
        if width is not None:
            data.type, data.ortho_scale = "ORTHO", width
        else:
            data.angle = angle
        obj = bpy.data.objects.new("Camera", data)
        bpy.context.scene.collection.objects.link(obj)
        obj.location = position
        obj.rotation_mode = "QUATERNION"
        obj.rotation_quaternion = Vector(towards).to_track_quat("-Z", "Y")
        bpy.context.scene.camera = obj
        return obj
    return place
