# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on in a real Blender without a window: `blender -b --python tests/window/background.py`.

Bakes a head that is twisted from frame to frame, saves it, opens it again, and renders it with Live: each frame must
be that of a bake made there. Handlers and timers are counted before and after.
"""
from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np

ID = "bl_ext.user_default.neural_gash"
FRAMES = (1, 12)


def ours() -> int:
    """How many handlers the add-on has."""
    kinds = [getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers)]
    return sum(getattr(h, "__module__", "").startswith(ID) for kind in kinds if isinstance(kind, list) for h in kind)


def build() -> None:
    """A head, twisted by a modifier that is keyed."""
    for obj in list(bpy.data.objects):
        if obj.type == "MESH":
            bpy.data.objects.remove(obj)
    bpy.ops.mesh.primitive_monkey_add()
    bpy.ops.object.shade_smooth()
    twist = bpy.context.object.modifiers.new("Twist", "SIMPLE_DEFORM")
    twist.deform_method = "TWIST"
    for frame, angle in zip(FRAMES, (0.0, 2.0), strict=True):
        twist.angle = angle
        twist.keyframe_insert("angle", frame=frame)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.frame_step = *FRAMES, FRAMES[1] - FRAMES[0]
    scene.frame_set(1)
    scene.render.engine, scene.cycles.samples = "CYCLES", 4
    scene.render.resolution_x = scene.render.resolution_y = 48
    scene.render.image_settings.file_format = "OPEN_EXR"
    settings = scene.neural_gash
    settings.method, settings.quality, settings.rays, settings.light_source = "embree", "RAYS", 256, "SKY"
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def pixels(path: Path) -> np.ndarray:
    """(48 * 48 * 4,) of a picture."""
    image = bpy.data.images.load(str(path))
    values = np.empty(48 * 48 * 4, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return values


def main() -> dict:
    """The session; what it found."""
    none = ours()
    assert none == 0, none
    bpy.ops.preferences.addon_enable(module=ID)
    some = ours()
    build()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / "head.blend"))
        bpy.ops.wm.open_mainfile(filepath=str(folder / "head.blend"))
        scene = bpy.context.scene
        assert ours() == some
        scene.neural_gash.live = True
        scene.render.filepath = str(folder / "moving")
        bpy.ops.render.render(animation=True)
        scene.neural_gash.live = False
        worst = []
        for frame in FRAMES:
            scene.frame_set(frame)
            assert bpy.ops.neural_gash.bake() == {"FINISHED"}
            scene.render.filepath = str(folder / "still.exr")
            bpy.ops.render.render(write_still=True)
            worst.append(float(np.abs(pixels(folder / "still.exr") - pixels(folder / f"moving{frame:04}.exr")).max()))
            (folder / "still.exr").unlink()
        change = float(np.abs(pixels(folder / "moving0001.exr") - pixels(folder / "moving0012.exr")).max())
    assert max(worst) < 0.01 < 0.1 < change, (worst, change)
    bpy.ops.preferences.addon_disable(module=ID)
    assert ours() == 0
    return {"blender": bpy.app.version_string, "differences": worst, "change": change, "handlers": some}


try:
    print(json.dumps(main()), flush=True)
except Exception as error:
    raise SystemExit(f"{type(error).__name__}: {error}") from error  # which --python-exit-code sees
sys.exit(0)
