# SPDX-License-Identifier: GPL-3.0-or-later
"""A room with a red and a green wall, lit from inside: an area lamp at its ceiling, a point lamp, and a glowing ball.

Writes out/lamps.png: the previews of its bakes on the left, Cycles' own picture of the room on the right. Prints what
the bakes took and by how much the two pictures differ.
"""
from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

import demo
from neural_gash_addon.ops.job import summary
from neural_gash_addon.scene.attributes import read_record
from neural_gash_addon.scene.preview import preview_off
from neural_gash_addon.scene.render import render_pixels, silent_blender

RESOLUTION = (480, 446)
CELLS = 48  # of a wall of 2 m, along its side
WHITE, RED, GREEN = (0.73, 0.73, 0.73), (0.61, 0.06, 0.06), (0.12, 0.45, 0.1)


def material(name: str, colour: tuple[float, float, float], emission: float = 0.0) -> bpy.types.Material:
    """A dull material, or one that emits."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    node = tree.nodes.new("ShaderNodeEmission" if emission else "ShaderNodeBsdfDiffuse")
    node.inputs["Color"].default_value = (*colour, 1)
    if emission:
        node.inputs["Strength"].default_value = emission
    tree.links.new(node.outputs[0], tree.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return made


def grids(name: str, places: list[Matrix], materials: list[bpy.types.Material], cells: int) -> bpy.types.Object:
    """An object of squares from -1 to 1 of cells x cells faces, each moved by a matrix, each of a material."""
    line = np.linspace(-1, 1, cells + 1)
    x, y = np.meshgrid(line, line)
    flat = np.stack([x, y, 0 * x, 0 * x + 1], -1).reshape(-1, 4)
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1, 1)
    quads = first + [0, 1, cells + 2, cells + 1]
    positions = np.concatenate([flat @ np.array(place).T for place in places])[:, :3]
    faces = np.concatenate([quads + number * len(flat) for number in range(len(places))])
    _, first, joined = np.unique(positions.round(6), axis=0, return_index=True, return_inverse=True)  # along the edges
    positions, faces = positions[first], joined.reshape(-1)[faces]
    data = bpy.data.meshes.new(name)
    data.from_pydata(positions.tolist(), [], faces.tolist())
    kinds = list(dict.fromkeys(materials))
    for made in kinds:
        data.materials.append(made)
    data.polygons.foreach_set("material_index", np.repeat([kinds.index(made) for made in materials], cells * cells))
    obj = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def sides(*, front: bool) -> list[Matrix]:
    """The faces of the cube from -1 to 1, outward: at -Z, Z, Y, -X, X, and at -Y if asked for."""
    turns = [Matrix.Rotation(math.pi, 4, "X"), Matrix.Rotation(0, 4, "X"), Matrix.Rotation(-math.pi / 2, 4, "X"),
             Matrix.Rotation(-math.pi / 2, 4, "Y"), Matrix.Rotation(math.pi / 2, 4, "Y"),
             Matrix.Rotation(math.pi / 2, 4, "X")]
    return [turn @ Matrix.Translation((0, 0, 1)) for turn in turns[:6 if front else 5]]


def build() -> list[bpy.types.Object]:
    """The objects of the room, all selected; a camera, a lamp, and a World without light."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    white = material("White", WHITE)
    walls = [white, white, white, material("Red", RED), material("Green", GREEN)]
    room = grids("Room", sides(front=False), walls, CELLS)
    room.data.flip_normals()
    block = grids("Block", sides(front=True), [white] * 6, CELLS // 2)
    block.matrix_world = (Matrix.Translation((0.38, 0.3, -0.45)) @ Matrix.Rotation(-0.3, 4, "Z")
                          @ Matrix.Diagonal((0.3, 0.3, 0.55, 1)))
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=4, radius=0.13, location=(-0.62, -0.45, -0.87))
    ball = bpy.context.object
    ball.data.materials.append(material("Glow", (0.25, 0.5, 1), 6.0))
    bpy.ops.mesh.primitive_monkey_add(size=0.75, location=(-0.3, -0.05, -0.69), rotation=(-0.6, 0, 0.5))
    head = bpy.context.object
    head.modifiers.new("Subdivision", "SUBSURF").levels = 1
    bpy.ops.object.modifier_apply(modifier="Subdivision")
    head.data.materials.append(material("Head", (0.75, 0.6, 0.4)))
    for obj in (ball, head):
        obj.data.shade_smooth()
    area, point = bpy.data.lights.new("Ceiling", "AREA"), bpy.data.lights.new("Side", "POINT")
    area.size, area.energy, area.spread, area.color = 0.64, 12, math.pi, (1, 0.85, 0.6)
    point.shadow_soft_size, point.energy, point.color = 0.08, 10, (1, 0.5, 0.25)
    lamps = [bpy.data.objects.new(data.name, data) for data in (area, point)]
    for lamp, place in zip(lamps, ((0, 0.1, 0.99), (0.75, -1.2, 0.3)), strict=True):
        lamp.location, lamp.visible_camera = place, False  # previews show no lamps
    eye = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    eye.location, eye.rotation_euler, eye.data.angle = (0, -4.6, 0), (math.pi / 2, 0, 0), 0.62
    for obj in (*lamps, eye):
        scene.collection.objects.link(obj)
    scene.camera = eye
    scene.world = bpy.data.worlds.new("Dark")
    scene.world.color = (0, 0, 0)
    objects = [room, block, ball, head]
    for obj in objects:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = room
    return objects


def cycles(samples: int) -> np.ndarray:
    """What Cycles makes of the scene, denoised: linear pixels (H, W, 4), top row first."""
    scene = bpy.context.scene
    scene.render.film_transparent = True
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", samples, True
    scene.cycles.max_bounces = scene.cycles.diffuse_bounces = 4  # as many as the bake follows
    scene.render.resolution_x, scene.render.resolution_y = RESOLUTION
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = str(Path(folder) / "room.exr")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(scene.render.filepath)
        pixels = np.empty((image.size[1], image.size[0], image.channels), np.float32)
        image.pixels.foreach_get(pixels.ravel())
    return pixels[::-1]


def main() -> None:
    """Bake the room, render its previews, then the room itself."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=demo.ROOT / "out", help="folder for the picture")
    parser.add_argument("--samples", type=int, default=128, help="of Cycles (128)")
    parser.add_argument("--tolerance", type=float, default=0.02, help="of the bakes (0.02)")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    objects = build()
    settings = bpy.context.scene.neural_gash
    settings.lamps, settings.occluders, settings.tolerance = True, "VISIBLE", arguments.tolerance
    with silent_blender():
        bpy.ops.neural_gash.bake()
        preview = render_pixels(objects, camera=bpy.context.scene.camera, resolution=RESOLUTION, samples=64)
    for obj in objects:
        print(f"{obj.name:6} {summary(read_record(obj))}.")
        preview_off(obj)
    with silent_blender():
        truth = cycles(arguments.samples)
    dull = (preview[..., 3] > 0.99) & (truth[..., :3].max(-1) < 2)  # all but what glows
    shown, real = preview[dull, :3], truth[dull, :3]
    difference = np.linalg.norm(shown - real) / np.linalg.norm(real)
    middle = np.median(np.abs(shown - real).mean(1) / real.mean(1))
    print(f"Difference of the pictures, but for what glows: {difference:.1%} (relative L2), {middle:.1%} (median of "
          f"pixels), {shown.mean() / real.mean() - 1:+.2%} (means).")
    path = arguments.out / "lamps.png"
    demo.write_png(path, [preview, truth])
    print(f"Picture:\n  {path}")


if __name__ == "__main__":
    demo.run(main)
