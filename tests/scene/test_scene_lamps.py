# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps and emissive materials read as Cycles shows them: units, shapes, instances, what is left out, bad input."""
from __future__ import annotations

import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from neural_gash_addon.backend import irradiance, methods  # noqa: E402
from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.scene.lamps import read_lamps  # noqa: E402

SQUARE = ([(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)], [(0, 1, 2, 3)])


def shader(obj, kind="DIFFUSE", colour=(1, 1, 1), strength=1.0, base=(0, 0, 0)):
    """Give an object a material of plain numbers."""
    material = bpy.data.materials.new(obj.name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    if kind == "DIFFUSE":
        node = tree.nodes.new("ShaderNodeBsdfDiffuse")
        node.inputs["Color"].default_value = (*colour, 1)
    elif kind == "PRINCIPLED":
        node = tree.nodes.new("ShaderNodeBsdfPrincipled")
        node.inputs["Base Color"].default_value, node.inputs["Specular IOR Level"].default_value = (*base, 1), 0
        node.inputs["Emission Color"].default_value = (*colour, 1)
        node.inputs["Emission Strength"].default_value = strength
    else:
        node = tree.nodes.new("ShaderNodeEmission")
        node.inputs["Color"].default_value, node.inputs["Strength"].default_value = (*colour, 1), strength
        if kind == "MIX":
            mix, add = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeAddShader")
            mix.inputs[0].default_value = 0.25
            tree.links.new(node.outputs[0], mix.inputs[2])
            tree.links.new(tree.nodes.new("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[1])
            tree.links.new(mix.outputs[0], add.inputs[0])
            tree.links.new(mix.outputs[0], add.inputs[1])
            node = add
    tree.links.new(node.outputs[0], output.inputs["Surface"])
    obj.data.materials.clear()
    obj.data.materials.append(material)
    return material


def lamp(kind, location=(0, 0, 2), rotation=(0, 0, 0), scale=(1, 1, 1), energy=100.0, spread=math.pi, **more):
    """A lamp object."""
    data = bpy.data.lights.new("Lamp", kind)
    data.energy = energy
    if kind == "AREA":
        data.spread = spread
    for name, value in more.items():
        setattr(data, name, value)
    obj = bpy.data.objects.new("Lamp", data)
    obj.location, obj.rotation_euler, obj.scale = location, rotation, scale
    bpy.context.scene.collection.objects.link(obj)
    return obj


@pytest.fixture
def floor(make):
    """A white square of 10 cm at the origin."""
    obj = make.mesh(0.1 * np.array(SQUARE[0]), SQUARE[1], "Floor")
    shader(obj)
    return obj


@pytest.fixture
def cycles(render, camera):
    """cycles(samples) -> irradiance (3,) at the origin, as Cycles renders a white surface there."""
    def look(samples=1024):
        camera((0, 0, 0.3), (0, 0, -1), width=0.02)
        return np.pi * render(4, 4, samples=samples)[..., :3].mean((0, 1))
    return look


def ours(obj, points=((0, 0, 0),), normals=((0, 0, 1),), rays=16384):
    bpy.context.view_layer.update()
    scene, _, _ = read_lamps(obj, bpy.context.evaluated_depsgraph_get())
    found = methods.run(irradiance.irradiance(scene, np.array(points, float), np.array(normals, float), rays))
    return found.values


@pytest.mark.parametrize("more", [
    {"shape": "SQUARE", "size": 1.0}, {"shape": "RECTANGLE", "size": 0.4, "size_y": 1.5, "scale": (2, 0.5, 1)},
    {"shape": "DISK", "size": 1.2, "rotation": (0.6, 0.3, 0.2)},
    {"shape": "ELLIPSE", "size": 0.5, "size_y": 1.5, "location": (0.7, 0, 1.5), "scale": (1, -1.5, 1)},
    {"shape": "SQUARE", "size": 0.5, "normalize": False}, {"shape": "ELLIPSE", "size": 0.5, "normalize": False},
    {"shape": "SQUARE", "color": (1, 0.5, 0.2), "exposure": 1.5},
    {"shape": "SQUARE", "use_temperature": True, "temperature": 3000}], ids=str)
def test_area_lamps_light_as_in_cycles(floor, cycles, more):
    if any(not hasattr(bpy.types.AreaLight, name) and name not in bpy.types.AreaLight.bl_rna.properties
           for name in more.keys() - {"location", "rotation", "scale"}):
        pytest.skip("this Blender's lamps have no such setting")
    lamp("AREA", **more)
    found, expected = ours(floor)[0], cycles()
    assert expected.min() > 0
    np.testing.assert_allclose(found, expected, rtol=0.01)


@pytest.mark.parametrize("more", [{"shadow_soft_size": 0.0}, {"shadow_soft_size": 0.1},
                                  {"shadow_soft_size": 0.5, "use_soft_falloff": False}, {"scale": (3, 3, 3)},
                                  {"shadow_soft_size": 0.2, "normalize": False}, {"normalize": False}], ids=str)
def test_point_lamps_light_as_in_cycles(floor, cycles, more):
    if any(name not in bpy.types.PointLight.bl_rna.properties for name in more.keys() - {"scale"}):
        pytest.skip("this Blender's lamps have no such setting")
    lamp("POINT", location=(0.5, 0.2, 2), **more)
    np.testing.assert_allclose(ours(floor)[0], cycles(), rtol=0.01)


@pytest.mark.parametrize("kind", ["EMISSION", "PRINCIPLED", "MIX"])
def test_emissive_materials_light_as_in_cycles(floor, make, cycles, kind):
    quad = make.mesh(*SQUARE, "Light")
    quad.location, quad.rotation_euler, quad.scale = (0.3, 0, 0.8), (0.4, 0, 0), (1, 0.7, 1)
    shader(quad, kind, (1, 0.5, 0.1), 3.0)
    np.testing.assert_allclose(ours(floor)[0], cycles(), rtol=0.015)


def test_scene_units_change_nothing(floor, cycles):
    bpy.context.scene.unit_settings.scale_length = 0.01
    lamp("AREA", size=1.0)
    np.testing.assert_allclose(ours(floor)[0], cycles(256), rtol=0.02)


def test_nodes_of_a_lamp_colour_it(floor, cycles):
    obj = lamp("AREA", size=1.0)
    obj.data.use_nodes = True
    emission = next(node for node in obj.data.node_tree.nodes if node.type == "EMISSION")
    emission.inputs["Color"].default_value, emission.inputs["Strength"].default_value = (0.2, 1, 0.5, 1), 3
    np.testing.assert_allclose(ours(floor)[0], cycles(256), rtol=0.02)


def test_an_image_emits_what_is_in_its_triangles(floor, make, cycles):
    quad = make.mesh(*SQUARE, "Light")
    quad.location.z = 1.0
    quad.data.uv_layers.new(name="UV")
    for loop in quad.data.loops:
        x, y, _ = quad.data.vertices[loop.vertex_index].co
        quad.data.uv_layers["UV"].uv[loop.index].vector = (0.5 + x, 0.5 + y)
    image = bpy.data.images.new("even", 8, 8, float_buffer=True, is_data=True)
    image.pixels.foreach_set(np.tile(np.array([0.2, 2.5, 0.4, 1], np.float32), 64))
    material = shader(quad, "EMISSION", (1, 1, 1), 5.0)
    tree = material.node_tree
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    tree.links.new(texture.outputs["Color"], next(n for n in tree.nodes if n.type == "EMISSION").inputs["Color"])
    np.testing.assert_allclose(ours(floor)[0], cycles(256), rtol=0.02)


def test_instances_of_lamps_and_emitters_light_too(floor, make, cycles):
    group = bpy.data.collections.new("Lamps")
    sphere, point = make.sphere("Bulb"), lamp("POINT", location=(0, 0.4, 0.2), energy=30)
    shader(sphere, "EMISSION", (1, 0.8, 0.2), 4.0)
    sphere.scale = (0.1, 0.1, 0.1)
    for obj in (sphere, point):
        bpy.context.scene.collection.objects.unlink(obj)
        group.objects.link(obj)
    for place in ((0.5, 0, 1), (-0.5, 0.3, 0.8)):
        empty = bpy.data.objects.new("Empty", None)
        empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", group, place
        bpy.context.scene.collection.objects.link(empty)
    np.testing.assert_allclose(ours(floor)[0], cycles(4096), rtol=0.02)


def _room(make):
    """The inside of a box of 2 m without its front: a red wall, a blue one, the others white; and a block in it."""
    box = make.cube("Room")
    box.data.flip_normals()
    for number, colour in enumerate([(0.75, 0.75, 0.75), (0.7, 0.05, 0.05), (0.05, 0.05, 0.7)]):
        material = shader(box, "DIFFUSE", colour)
        box.data.materials.clear()
        bpy.data.materials[material.name].name = f"wall {number}"
    for number in range(3):
        box.data.materials.append(bpy.data.materials[f"wall {number}"])
    for face in box.data.polygons:
        face.material_index = 1 if face.center.x < -0.9 else 2 if face.center.x > 0.9 else 0
    block = make.cube("Block")
    block.scale, block.location, block.rotation_euler = (0.25, 0.25, 0.5), (0.35, 0.3, -0.5), (0, 0, 0.4)
    shader(block, "DIFFUSE", (0.8, 0.6, 0.2))
    return box


def test_colours_bleed_as_in_cycles(make, render, camera):
    """The floor of a box with a red and a blue wall, under an area lamp below its ceiling, looked at from above."""
    box = _room(make)
    lamp("AREA", location=(0, 0, 0.95), size=0.6, energy=50)
    bpy.context.scene.cycles.diffuse_bounces = bpy.context.scene.cycles.max_bounces = 4
    camera((0, 0, 0.9), (0, 0, -1), width=1.9)
    shown = render(16, 16, samples=2048)[..., :3]
    line = (np.arange(16) + 0.5) / 16 * 1.9 - 0.95
    x, y = np.meshgrid(line, line)
    hidden = np.hypot(x - 0.35, y - 0.3) < 0.45  # the block
    points = np.stack([x, y, 0 * x - 1], -1)[~hidden]
    found = 0.75 / np.pi * ours(box, points, np.tile([0, 0, 1.0], (len(points), 1)), 4096)
    expected = shown[~hidden]
    assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)
    left, right = found[points[:, 0] < -0.8].mean(0), found[points[:, 0] > 0.8].mean(0)
    assert left[0] > 1.2 * left[2] and right[2] > 1.2 * right[0]


def test_what_is_left_out_is_said(floor):
    lamp("SPOT")
    assert "1 spot lamp is left out." in _notice(floor)
    lamp("SPOT")
    lamp("SUN")
    lamp("AREA", spread=1.0)
    said = _notice(floor)
    assert "2 spot lamps are left out." in said and "Sun lamps" in said and "180 degrees" in said
    material = shader(floor, "EMISSION")
    tree = material.node_tree
    noise = tree.nodes.new("ShaderNodeTexNoise")
    tree.links.new(noise.outputs[0], next(n for n in tree.nodes if n.type == "EMISSION").inputs["Strength"])
    assert f"'{material.name}'" in _notice(floor)


def _notice(obj):
    return read_lamps(obj, bpy.context.evaluated_depsgraph_get())[2]


def test_hidden_lamps_and_portals_do_not_shine(floor):
    for hide in ("hide_render", "hide_viewport", "hide"):
        obj = lamp("POINT")
        obj.hide_set(True) if hide == "hide" else setattr(obj, hide, True)
    lamp("AREA").data.cycles.is_portal = True
    lamp("POINT").visible_diffuse = False
    lamp("AREA", scale=(0, 1, 1))
    assert not ours(floor, rays=64).any()
    lamp("POINT")
    assert ours(floor, rays=64).all()


def test_a_hidden_object_lights_and_shadows_itself_when_it_is_baked(make):
    obj = make.cube()
    shader(obj, "EMISSION", strength=2.0)
    bpy.context.view_layer.update()
    shown, _, _ = read_lamps(obj, bpy.context.evaluated_depsgraph_get())
    obj.hide_set(True)
    bpy.context.view_layer.update()
    hidden, _, _ = read_lamps(obj, bpy.context.evaluated_depsgraph_get())
    assert len(shown.triangles) == len(hidden.triangles) == 12
    np.testing.assert_array_equal(shown.emission, hidden.emission)


def test_what_only_emits_reflects_nothing(make):
    obj = make.cube()
    shader(obj, "EMISSION")
    assert not read_lamps(obj, bpy.context.evaluated_depsgraph_get())[0].albedo.any()
    shader(obj, "PRINCIPLED", base=(0.5, 0.25, 0))
    np.testing.assert_allclose(read_lamps(obj, bpy.context.evaluated_depsgraph_get())[0].albedo[0], (0.5, 0.25, 0))


@pytest.mark.parametrize("energy", [float("nan"), float("inf"), -5.0])
def test_strengths_that_are_none_are_refused(floor, energy):
    lamp("POINT", energy=energy)
    with pytest.raises(UserError, match="The lamp 'Lamp'"):
        read_lamps(floor, bpy.context.evaluated_depsgraph_get())


def test_emission_that_is_none_is_refused(floor):
    shader(floor, "EMISSION", strength=float("nan"))
    with pytest.raises(UserError, match="emission"):
        read_lamps(floor, bpy.context.evaluated_depsgraph_get())


def test_the_key_tells_scenes_apart(floor, make):
    def key():
        bpy.context.view_layer.update()
        return read_lamps(floor, bpy.context.evaluated_depsgraph_get())[1]

    bulb, point = make.sphere("Bulb"), lamp("POINT")
    material = shader(bulb, "EMISSION")
    keys = [key()]
    assert key() == keys[0]
    changes = [lambda: setattr(point.data, "energy", 7), lambda: setattr(point.location, "x", 1),
               lambda: setattr(bulb.location, "x", 1), lambda: setattr(point.data, "color", (1, 0, 0)),
               lambda: setattr(floor, "location", (0.1, 0, 0)), lambda: point.hide_set(True),
               lambda: setattr(next(n for n in material.node_tree.nodes if n.type == "EMISSION").inputs["Strength"],
                               "default_value", 2), lambda: bpy.data.objects.remove(bulb)]
    for change in changes:
        change()
        keys.append(key())
    assert len(set(keys)) == len(changes) + 1
