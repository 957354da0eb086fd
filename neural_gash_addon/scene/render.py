# SPDX-License-Identifier: GPL-3.0-or-later
"""A picture of one object's preview, without a window: Cycles on the CPU, in a scene of its own."""
from __future__ import annotations

import ctypes
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ..backend.exchange import atomic

_LENS_ANGLE = 0.6  # radians, about a 58 mm lens


def render_preview(objects: Sequence[bpy.types.Object], path: Path, *, camera: bpy.types.Object | None = None,
                   direction: Sequence[float] = (0.6, -1.0, 0.45), resolution: tuple[int, int] | None = None,
                   samples: int = 16) -> None:
    """Render objects alone, as they are shaded now, to a .png (sRGB, transparent around) or a 32-bit .exr.

    Args:
        camera: the view; one that frames the first object from `direction` (from the object
            towards the camera, world axes) where not given.
        resolution: pixels (width, height); with a `camera`, those of the open scene where not
            given, else 800 x 800.
    """
    if resolution is None:
        resolution = (800, 800) if camera is None else _resolution(bpy.context.scene.render)
    hidden = [obj for obj in objects if obj.hide_render]
    scene = bpy.data.scenes.new("Neural GASh render")
    made: list[bpy.types.ID] = []
    try:
        for obj in objects:
            obj.hide_render = False
            scene.collection.objects.link(obj)
        if camera is None:
            data = bpy.data.cameras.new("Neural GASh camera")
            camera = bpy.data.objects.new("Neural GASh camera", data)
            made += [camera, data]
            scene.collection.objects.link(camera)
            _frame(camera, objects[0], Vector(direction).normalized())
        elif camera.name not in scene.collection.objects:
            scene.collection.objects.link(camera)
        scene.camera = camera
        render = scene.render
        render.engine = "CYCLES"
        scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", samples, False
        render.resolution_x, render.resolution_y, render.resolution_percentage = *resolution, 100
        render.film_transparent = True
        exr = path.suffix.lower() == ".exr"
        image = render.image_settings
        image.file_format, image.color_mode, image.color_depth = ("OPEN_EXR" if exr else "PNG", "RGBA",
                                                                  "32" if exr else "8")
        scene.view_settings.view_transform = "Standard"
        render.use_file_extension = False
        with tempfile.TemporaryDirectory(prefix="neural_gash-") as folder, atomic(path) as draft:
            # written elsewhere first: Blender does not say when a disk is full, copying does
            render.filepath = str(Path(folder) / f"render{path.suffix}")
            bpy.ops.render.render(scene=scene.name, write_still=True)
            shutil.copyfile(render.filepath, draft)
    finally:
        for obj in hidden:
            obj.hide_render = True
        bpy.data.scenes.remove(scene)
        for item in made:
            (bpy.data.objects if isinstance(item, bpy.types.Object) else bpy.data.cameras).remove(item)


def render_pixels(objects: Sequence[bpy.types.Object], **view) -> NDArray[np.float32]:
    """`render_preview` as linear pixels (H, W, 4), top row first."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "preview.exr"
        render_preview(objects, path, **view)
        image = bpy.data.images.load(str(path))
        try:
            pixels = np.empty((image.size[1], image.size[0], 4), np.float32)
            image.pixels.foreach_get(pixels.ravel())
        finally:
            bpy.data.images.remove(image)
    return pixels[::-1]


def _resolution(render: bpy.types.RenderSettings) -> tuple[int, int]:
    """Pixels (width, height) of a scene's renders."""
    part = render.resolution_percentage / 100
    return max(1, round(render.resolution_x * part)), max(1, round(render.resolution_y * part))


def _frame(camera: bpy.types.Object, obj: bpy.types.Object, direction: Vector) -> None:
    """Place the camera so that the bounding sphere of the object fills the view."""
    corners = [obj.matrix_world @ Vector(corner) for corner in obj.bound_box]
    centre = sum(corners, Vector()) / len(corners)
    radius = max((corner - centre).length for corner in corners) or 1.0
    camera.data.angle = _LENS_ANGLE
    distance = radius / np.sin(_LENS_ANGLE / 2)
    camera.location = centre + direction * distance
    camera.rotation_euler = direction.to_track_quat("Z", "Y").to_euler()
    camera.data.clip_start, camera.data.clip_end = distance / 1000, distance * 10


@contextmanager
def silent_blender() -> Iterator[None]:
    """Keep what Blender itself writes to standard output off it: that is for the report."""
    _flush()
    saved, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        _flush()
        os.dup2(saved, 1)
        os.close(saved)
        os.close(nowhere)


def _flush() -> None:
    """Let out what Python and C hold back for standard output, while it still goes where it should."""
    sys.stdout.flush()
    ctypes.CDLL("ucrtbase" if sys.platform == "win32" else None).fflush(None)
