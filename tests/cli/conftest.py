# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line in processes of its own, and files for it to work on."""
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

ROOT = Path(__file__).resolve().parents[2]
ODD = "a 'b' \"c\" ü 屋根 %s {0}"


def command(*arguments):
    """`python -m neural_gash_addon …` as a list."""
    return [sys.executable, "-m", "neural_gash_addon", *map(str, arguments)]


def ring():
    """A torus, whose inner side shadows itself: positions (V, 3) and triangles."""
    made = trimesh.creation.torus(1.0, 0.45, 24, 12)
    return np.array(made.vertices), np.array(made.faces)


def _add(name, positions, faces, smooth=False):
    import bpy
    data = bpy.data.meshes.new(name)
    data.from_pydata(np.asarray(positions).tolist(), [], np.asarray(faces).tolist())
    if smooth:
        data.shade_smooth()
    obj = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(obj)
    return obj


@pytest.fixture(scope="session")
def ply(tmp_path_factory):
    """A smooth .ply."""
    pytest.importorskip("bpy")
    path = tmp_path_factory.mktemp("input") / "ring.ply"
    trimesh.Trimesh(*ring(), process=False).export(path)
    return path


@pytest.fixture(scope="session")
def blend(tmp_path_factory):
    """A .blend of a ring (active), an oddly named floor under a roof, and objects that cannot be baked."""
    bpy = pytest.importorskip("bpy")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    body = _add("Ring", *ring(), smooth=True)
    square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    _add(ODD, square + (9, 0, 0), [(0, 1, 2, 3)])
    roof = _add("Roof", square * 9 + (9, 0, 1), [(0, 1, 2, 3)])
    roofs = bpy.data.collections.new(ODD)
    scene.collection.children.link(roofs)
    roofs.objects.link(roof)
    _add("No faces", [(0, 0, 0)], [])
    _add("Doubled", square, [(0, 1, 2, 3)]).modifiers.new("Array", "ARRAY")
    eye = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    scene.collection.objects.link(eye)
    eye.location = (0, 0, 6)
    scene.camera = eye
    scene.render.resolution_x, scene.render.resolution_y = 24, 16
    scene.world = bpy.data.worlds.new("Sky")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.2, 0.4, 0.8, 1)
    bpy.context.view_layer.objects.active = body
    path = tmp_path_factory.mktemp("input") / "scene.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), check_existing=False)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return path


@pytest.fixture(scope="session")
def sky(tmp_path_factory):
    """sky(columns turned) -> an .exr of 16 x 8 random texels, and those, row 0 at the bottom."""
    bpy = pytest.importorskip("bpy")
    folder = tmp_path_factory.mktemp("sky")
    pixels = np.ones((8, 16, 4), np.float32)
    pixels[..., :3] = np.random.default_rng(5).uniform(0, 3, (8, 16, 3))
    path = folder / f"{ODD.replace('/', '')}.exr"
    image = bpy.data.images.new("sky", 16, 8, float_buffer=True)
    image.pixels.foreach_set(pixels.ravel())
    image.file_format = "OPEN_EXR"
    image.filepath_raw = str(path)
    image.save()
    bpy.data.images.remove(image)
    image = bpy.data.images.load(str(path))
    image.pixels.foreach_get(pixels.ravel())  # as written: rounded to half floats
    bpy.data.images.remove(image)
    return path, pixels


@pytest.fixture
def run():
    """run(*arguments) -> the finished process, which never shows a traceback."""
    def call(*arguments):
        done = subprocess.run(command(*arguments), cwd=ROOT, capture_output=True, text=True, timeout=300)
        assert "Traceback" not in done.stderr and "Traceback" not in done.stdout, done.stderr
        return done
    return call


@pytest.fixture
def refused(run):
    """refused(*arguments) -> the one sentence of a command that must not work."""
    def call(*arguments):
        done = run(*arguments)
        lines = [line for line in done.stderr.splitlines() if not line.startswith("IMB_")]  # Blender's own
        assert done.returncode == 2 and not done.stdout, done
        assert len(lines) == 1 and lines[0].startswith("neural_gash: ") and lines[0].endswith("."), lines
        return lines[0]
    return call


@pytest.fixture
def exr():
    """exr(path) -> its pixels (H, W, 4)."""
    def read(path):
        import bpy
        image = bpy.data.images.load(str(path))
        pixels = np.empty((image.size[1], image.size[0], 4), np.float32)
        image.pixels.foreach_get(pixels.ravel())
        bpy.data.images.remove(image)
        return pixels
    return read
