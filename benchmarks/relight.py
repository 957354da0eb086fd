# SPDX-License-Identifier: GPL-3.0-or-later
"""How quickly previews follow the light: `python benchmarks/relight.py [--vertices 100000]`.

Each line is one change, with all that Blender and the add-on do until the light constants of the preview are the new
ones: the dependency graph's update, the projection where one is needed, and the writing of the constants. Drawing the
frame is Blender's, and not in it. Three runs, their median; beside it, baking the mesh unshadowed again, which is the
least that a method without transfer would have to do.
"""
from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import bpy  # before bmesh, which it brings

import bmesh  # isort: skip
import numpy as np

import neural_gash_addon

REPEATS = 200


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vertices", type=int, default=100_000)
    vertices = parser.parse_args().vertices
    bpy.ops.wm.read_factory_settings(use_empty=True)
    neural_gash_addon.register()
    try:
        _measure(vertices)
    finally:
        neural_gash_addon.unregister()
    return 0


def _measure(vertices: int) -> None:
    """Every change, in turn, three times."""
    background, mapping, texture, lamp = _world()
    obj = _grid(vertices)
    settings = bpy.context.scene.neural_gash
    settings.method = "analytic"
    bpy.context.view_layer.objects.active = obj
    bpy.ops.neural_gash.bake()
    images = [texture.image, _image(1024, 1)]

    def strength(step: int) -> None:
        background.inputs["Strength"].default_value = 1 + step / REPEATS

    def turn(step: int) -> None:
        mapping.inputs["Rotation"].default_value[2] = step / REPEATS

    def slide(step: int) -> None:
        settings.light_rotation = step / REPEATS

    def sun(step: int) -> None:
        lamp.rotation_euler[0] = step / REPEATS

    def other(step: int) -> None:
        texture.image = images[step % 2]

    changes: dict[str, tuple[Callable[[int], None], int]] = {
        "rotation slider": (slide, REPEATS), "strength of the World": (strength, REPEATS),
        "mapping of the World": (turn, REPEATS), "sun lamp turned": (sun, REPEATS),
        "another image of 1024 x 512": (other, 10)}
    print(f"{len(obj.data.vertices):,} vertices")
    seen: dict[str, list[float]] = {name: [] for name in changes}
    again = []
    for _ in range(3):
        for name, (change, repeats) in changes.items():
            began = time.perf_counter()
            for step in range(repeats):
                change(step + 1)
                bpy.context.view_layer.update()
            seen[name].append((time.perf_counter() - began) / repeats)
        began = time.perf_counter()
        bpy.ops.neural_gash.bake()
        again.append(time.perf_counter() - began)
    for name, seconds in seen.items():
        median = float(np.median(seconds))
        print(f"{name:28} {1e3 * median:8.2f} ms  {1 / median:7.0f} a second, "
              f"{float(np.median(again)) / median:7.0f} times as quick as an unshadowed bake")


def _world() -> tuple[bpy.types.Node, bpy.types.Node, bpy.types.Node, bpy.types.Object]:
    """A World with a mapped image and a sun lamp."""
    world = bpy.data.worlds.new("World")
    if bpy.app.version < (5, 0, 0):
        world.use_nodes = True
    bpy.context.scene.world = world
    tree = world.node_tree
    texture, mapping, coordinates = (tree.nodes.new(f"ShaderNode{kind}") for kind in
                                     ("TexEnvironment", "Mapping", "TexCoord"))
    texture.image = _image(1024, 0)
    tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    background = tree.nodes["Background"]
    tree.links.new(texture.outputs["Color"], background.inputs["Color"])
    lamp = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    bpy.context.scene.collection.objects.link(lamp)
    return background, mapping, texture, lamp


def _image(width: int, seed: int) -> bpy.types.Image:
    """Noise, in floating point."""
    image = bpy.data.images.new("Sky", width, width // 2, float_buffer=True, is_data=True)
    pixels = np.random.default_rng(seed).uniform(0, 2, width * width // 2 * 4)
    image.pixels.foreach_set(pixels.astype(np.float32))
    return image


def _grid(vertices: int) -> bpy.types.Object:
    """A plane of so many vertices."""
    side = round(vertices ** 0.5) - 1
    edit = bmesh.new()
    bmesh.ops.create_grid(edit, x_segments=side, y_segments=side, size=1)
    mesh = bpy.data.meshes.new("Grid")
    edit.to_mesh(mesh)
    edit.free()
    obj = bpy.data.objects.new("Grid", mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


if __name__ == "__main__":
    sys.exit(main())
