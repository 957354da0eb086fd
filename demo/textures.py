# SPDX-License-Identifier: GPL-3.0-or-later
"""A floor of two triangles under a head: baked to its vertices, to a texture, and finely tessellated (PRTT, figure 4).

Writes out/floor_vertices_texture_tessellated.png and prints the errors and the memory.
"""
from __future__ import annotations

import argparse
import math
from pathlib import Path

import bpy
import numpy as np

import demo
from neural_gash_addon.ops.job import summary
from neural_gash_addon.scene.attributes import read_record
from neural_gash_addon.scene.render import render_pixels, silent_blender

VIEW = {"direction": (0.35, -1.0, 0.75), "resolution": (420, 420), "samples": 16}
SIDE, CELLS = 512, 256


def build(cells: int) -> tuple[bpy.types.Object, bpy.types.Object]:
    """A square floor of cells x cells quads, and a smooth head above it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_monkey_add(location=(0, 0, 0.7), rotation=(math.radians(-30), 0, math.radians(20)))
    head = bpy.context.object
    head.modifiers.new("Subdivision", "SUBSURF").levels = 2
    bpy.ops.object.modifier_apply(modifier="Subdivision")
    bpy.ops.object.shade_smooth()
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=cells, y_subdivisions=cells, size=3.6)
    demo.light_by_hdri()
    return head, bpy.context.object


def picture(target: str, cells: int, strength: float) -> tuple[np.ndarray, np.ndarray, str]:
    """Both objects, and the floor alone, as linear pixels; and the report on the floor's bake."""
    head, floor = build(cells)
    settings = bpy.context.scene.neural_gash
    settings.order, settings.tolerance, settings.occluders, settings.soften = 5, 0.01, "VISIBLE", True
    settings.light_strength = strength
    for obj, wanted in ((head, "VERTICES"), (floor, target)):
        settings.target, settings.side = wanted, SIDE
        bpy.context.view_layer.objects.active = obj
        with silent_blender():
            bpy.ops.neural_gash.bake()
    record = read_record(floor)
    with silent_blender():
        return render_pixels([floor, head], **VIEW), render_pixels([floor], **VIEW), summary(record)


def main() -> None:
    """Bake three times, render, compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=demo.ROOT / "out", help="folder for the picture")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    first, _, _ = picture("VERTICES", 1, 1.0)
    strength = 0.8 / float(np.percentile(first[first[..., 3] > 0.9][:, :3], 97))
    cases = {"vertices": ("VERTICES", 1), "texture": ("TEXTURE", 1), "tessellated": ("VERTICES", CELLS)}
    found = {name: picture(*case, strength) for name, case in cases.items()}
    truth = found["tessellated"][1]
    inside = truth[..., 3] > 0.99
    points = {"vertices": 4, "texture": SIDE * SIDE, "tessellated": (CELLS + 1) ** 2}
    print("| floor | points | coefficients | error of its radiance | report |\n|---|---|---|---|---|")
    for name, (_, floor, report) in found.items():
        error = np.linalg.norm((floor - truth)[inside, :3]) / np.linalg.norm(truth[inside, :3])
        print(f"| {name} | {points[name]:,} | {points[name] * 100 / 1e6:.4g} MB | {error:.1%} | {report} |")
    path = out / "floor_vertices_texture_tessellated.png"
    demo.write_png(path, [both for both, _, _ in found.values()])
    print(f"Picture:\n  {path}")


if __name__ == "__main__":
    demo.run(main)
