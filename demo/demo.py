# SPDX-License-Identifier: GPL-3.0-or-later
"""`make demo`: bake a mesh with overhangs, light it with one of Blender's HDRIs, render it through the node group.

Writes out/unshadowed_beside_shadowed.png and out/three_light_rotations.png.
"""
from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import neural_gash_addon  # noqa: E402
from neural_gash_addon.ops.job import summary  # noqa: E402
from neural_gash_addon.scene.attributes import read_record  # noqa: E402
from neural_gash_addon.scene.render import render_pixels, silent_blender  # noqa: E402

HDRI = "courtyard.exr"
VIEW = {"direction": (0.55, -1.0, 0.5), "resolution": (640, 520), "samples": 16}
BACKGROUND = 0.05  # grey behind the pictures, linear


def build_mesh() -> bpy.types.Object:
    """Suzanne, with brow and ears that overhang, on a finely tessellated round floor: one smooth mesh."""
    bpy.ops.mesh.primitive_monkey_add(location=(0, 0, 0.585), rotation=(math.radians(-30), 0, math.radians(20)))
    monkey = bpy.context.object
    monkey.modifiers.new("Subdivision", "SUBSURF").levels = 2
    bpy.ops.object.modifier_apply(modifier="Subdivision")
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=140, y_subdivisions=140, size=3.0)
    floor = bpy.context.object
    positions = np.empty(3 * len(floor.data.vertices), np.float32)
    floor.data.vertices.foreach_get("co", positions)
    xy = positions.reshape(-1, 3)[:, :2]
    longest = np.abs(xy).max(1, keepdims=True)  # squares about the centre become circles
    xy *= np.divide(longest, np.linalg.norm(xy, axis=1, keepdims=True), out=np.ones_like(longest), where=longest > 0)
    floor.data.vertices.foreach_set("co", positions)
    monkey.select_set(True)
    bpy.context.view_layer.objects.active = monkey
    bpy.ops.object.join()
    bpy.ops.object.shade_smooth()
    return monkey


def light_by_hdri() -> None:
    """One of the HDRIs that ship with Blender as the World."""
    world = bpy.data.worlds.new("HDRI")
    world.use_nodes = True
    texture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    folder = Path(bpy.utils.system_resource("DATAFILES")) / "studiolights" / "world"
    texture.image = bpy.data.images.load(str(folder / HDRI))
    world.node_tree.links.new(texture.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])
    bpy.context.scene.world = world


def write_png(path: Path, pictures: list[np.ndarray]) -> None:
    """Linear pictures (H, W, 4) side by side, as an sRGB PNG."""
    row = np.concatenate(pictures, axis=1)
    row = row[..., :3] + (1 - row[..., 3:]) * BACKGROUND
    row = np.clip(row, 0, 1)
    srgb = np.where(row <= 0.0031308, 12.92 * row, 1.055 * row ** (1 / 2.4) - 0.055)
    height, width = row.shape[:2]
    image = bpy.data.images.new(path.stem, width, height)
    image.pixels.foreach_set(np.dstack([srgb, np.ones((height, width))])[::-1].astype(np.float32).ravel())
    image.filepath_raw, image.file_format = str(path), "PNG"
    image.save()
    bpy.data.images.remove(image)


def main() -> None:
    """Build, bake twice, render five times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "out", help="folder for the pictures")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    obj = build_mesh()
    light_by_hdri()
    settings = bpy.context.scene.neural_gash
    settings.order = 5
    settings.soften = True  # a low sun rings

    def bake(method: str) -> None:
        settings.method = method
        with silent_blender():
            bpy.ops.neural_gash.bake()
        print(f"{method:9} {summary(read_record(obj))}.")

    def picture(rotation: float = 0.0) -> np.ndarray:
        settings.light_rotation = math.radians(rotation)
        with silent_blender():
            return render_pixels([obj], **VIEW)

    bake("analytic")
    first = picture()
    settings.light_strength = 0.8 / float(np.percentile(first[first[..., 3] > 0.9][:, :3], 97))
    unshadowed = picture()
    bake("embree")
    shadowed = picture()
    pictures = {"unshadowed_beside_shadowed.png": [unshadowed, shadowed],
                "three_light_rotations.png": [shadowed, picture(120), picture(240)]}
    print("Pictures:")
    for name, parts in pictures.items():
        write_png(out / name, parts)
        print(f"  {out / name}")


def run(main: Callable[[], None]) -> None:
    """Run a demo with the add-on registered."""
    neural_gash_addon.register()
    try:
        main()
    finally:
        neural_gash_addon.unregister()


if __name__ == "__main__":
    run(main)
