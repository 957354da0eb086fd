# SPDX-License-Identifier: GPL-3.0-or-later
"""A golden head on a metallic floor before a red wall, all baked together to textures: gloss, and its bounces.

Writes out/glossy_bounces.png: without glossy bounces on the left, with two of them on the right.
"""
from __future__ import annotations

import argparse
import math
from pathlib import Path

import bpy

import demo
from neural_gash_addon.scene.render import render_pixels, silent_blender

VIEW = {"direction": (0.5, -1.0, 0.5), "resolution": (520, 420), "samples": 16}


def material(obj: bpy.types.Object, colour: tuple[float, float, float], roughness: float, metallic: float) -> None:
    """Give an object a Principled material."""
    made = bpy.data.materials.new(obj.name)
    made.use_nodes = True
    shader = made.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1)
    shader.inputs["Roughness"].default_value, shader.inputs["Metallic"].default_value = roughness, metallic
    obj.data.materials.append(made)


def build() -> list[bpy.types.Object]:
    """The objects of the scene, all selected."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_monkey_add(location=(0, 0, 0.78), rotation=(math.radians(-30), 0, math.radians(20)))
    head = bpy.context.object
    head.modifiers.new("Subdivision", "SUBSURF").levels = 2
    bpy.ops.object.modifier_apply(modifier="Subdivision")
    bpy.ops.object.shade_smooth()
    material(head, (1.0, 0.72, 0.3), 0.35, 1.0)
    bpy.ops.mesh.primitive_plane_add(size=4)
    material(bpy.context.object, (0.6, 0.6, 0.65), 0.3, 1.0)
    bpy.ops.mesh.primitive_plane_add(size=4, location=(0, 1.5, 1.2), rotation=(math.pi / 2, 0, 0))
    wall = bpy.context.object
    wall.scale.y = 0.6
    material(wall, (0.8, 0.05, 0.05), 0.9, 0.0)
    objects = list(bpy.context.scene.objects)
    for obj in objects:
        obj.select_set(True)
    demo.light_by_hdri()
    return objects


def main() -> None:
    """Bake the set, render, bake the bounces, render again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=demo.ROOT / "out", help="folder for the picture")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    objects = build()
    settings = bpy.context.scene.neural_gash
    settings.target, settings.side, settings.order, settings.gloss, settings.soften = "TEXTURE", 512, 5, True, True
    with silent_blender():
        bpy.ops.neural_gash.bake()
        first = render_pixels(objects, **VIEW)
        for obj in objects:
            bpy.context.view_layer.objects.active = obj
            bpy.ops.neural_gash.bake_gloss(bounces=2)
        second = render_pixels(objects, **VIEW)
    path = out / "glossy_bounces.png"
    demo.write_png(path, [first, second])
    print(f"Picture:\n  {path}")


if __name__ == "__main__":
    demo.run(main)
