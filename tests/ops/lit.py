# SPDX-License-Identifier: GPL-3.0-or-later
"""A floor under lamps, for the tests of lamps. Blender is imported within: a module of a test that another one imports
keeps bpy from being freed at exit, which then hangs in 4.5."""
from __future__ import annotations

import math

import numpy as np

GRID = 16
FLOOR = ([(x / GRID * 2 - 1, y / GRID * 2 - 1, 0) for y in range(GRID + 1) for x in range(GRID + 1)],
         [(i + j * (GRID + 1), i + 1 + j * (GRID + 1), i + 1 + (j + 1) * (GRID + 1), i + (j + 1) * (GRID + 1))
          for j in range(GRID) for i in range(GRID)])
PANEL = ([(-0.4, -0.4, 1), (-0.4, 0.4, 1), (0.4, 0.4, 1), (0.4, -0.4, 1)], [(0, 1, 2, 3)])


def paint(obj, colour=(0.8, 0.8, 0.8), emission=(0, 0, 0), strength=0.0):
    """A dull material for a mesh; its shader."""
    import bpy
    material = bpy.data.materials.new(obj.name)
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Specular IOR Level"].default_value = 0
    shader.inputs["Base Color"].default_value = (*colour, 1)
    shader.inputs["Emission Color"].default_value = (*emission, 1)
    shader.inputs["Emission Strength"].default_value = strength
    obj.data.materials.append(material)
    return shader


def area(energy=20.0, location=(0, 0, 1), size=0.8):
    """A square area lamp that shines down."""
    import bpy
    data = bpy.data.lights.new("Lamp", "AREA")
    data.energy, data.size, data.spread = energy, size, math.pi
    obj = bpy.data.objects.new("Lamp", data)
    obj.location = location
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.update()
    return obj


def bake():
    """As the button does."""
    import bpy
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def attribute(obj, name="_prt_lamps"):
    """(E, 3) of an attribute."""
    values = np.empty((len(obj.data.attributes[name].data), 4), np.float32)
    obj.data.attributes[name].data.foreach_get("color", values.ravel())
    return values[:, :3]


def record(obj):
    """Of its bake."""
    from neural_gash_addon.scene.attributes import read_record
    return read_record(obj)
