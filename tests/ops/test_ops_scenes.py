# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes through bpy.ops of objects as real scenes hold them: parented, turned, huge, with crowded materials."""
from __future__ import annotations

import numpy as np
import pytest

from .conftest import WEDGE

bpy = pytest.importorskip("bpy")


def _baked(obj):
    from neural_gash_addon.scene.attributes import read_transfer
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    return read_transfer(obj)


def test_parented_and_turned(make, settings):
    """Under a turned, scaled and moved parent: what the same shape gives with its world coordinates applied."""
    from mathutils import Matrix
    parent = bpy.data.objects.new("Parent", None)
    bpy.context.scene.collection.objects.link(parent)
    obj = make(*WEDGE)
    parent.location, parent.rotation_euler, parent.scale = (3, -2, 5), (0.3, 1.2, -0.7), (2, 2, 2)
    obj.parent = parent
    obj.matrix_parent_inverse = Matrix.Translation((1, 0, 0))
    obj.rotation_euler, obj.scale = (0.9, -0.2, 2.0), (1, 1, 1)
    bpy.context.view_layer.update()
    settings.rays = 4096
    turned, record = _baked(obj)
    np.testing.assert_allclose(np.reshape(record.frame, (3, 3)), obj.matrix_world.to_quaternion().to_matrix(),
                               atol=1e-6)
    applied = make([obj.matrix_world @ vertex.co for vertex in obj.data.vertices], WEDGE[1])
    flat, _ = _baked(applied)
    np.testing.assert_allclose(turned, flat, atol=0.02)  # two estimates, as the points are not bit for bit the same
    assert np.abs(turned[:, 1:] - flat[:, 1:].mean()).max() > 0.1


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_size_changes_nothing(make, settings, scale):
    settings.rays = 4096
    first, _ = _baked(make(*WEDGE))
    second, _ = _baked(make(np.array(WEDGE[0]) * scale, WEDGE[1]))
    np.testing.assert_allclose(second, first, atol=0.02)


def test_material_that_reads_many_attributes(make, settings):
    """Ten of its own and seven of order 5 are more than EEVEE draws: the bake is kept, the material too."""
    from neural_gash_addon.ops.batch import bake_object
    from neural_gash_addon.scene.attributes import has_bake
    from neural_gash_addon.scene.preview import is_on
    obj = make()
    material = bpy.data.materials.new("Crowded")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    last = None
    for index in range(10):
        obj.data.color_attributes.new(f"Paint {index}", "FLOAT_COLOR", "CORNER")
        read = nodes.new("ShaderNodeAttribute")
        read.attribute_name = f"Paint {index}"
        mix = nodes.new("ShaderNodeMixRGB")
        links.new(read.outputs["Color"], mix.inputs["Color1"])
        if last:
            links.new(last, mix.inputs["Color2"])
        last = mix.outputs["Color"]
    links.new(last, nodes["Principled BSDF"].inputs["Base Color"])
    obj.data.materials.append(material)
    settings.order = 5
    _, warning = bake_object(bpy.context, obj, settings)
    assert "Crowded" in warning and "\n" not in warning
    assert has_bake(obj) and not is_on(obj) and obj.material_slots[0].material == material
    settings.order = 2
    assert bake_object(bpy.context, obj, settings)[1] == "" and is_on(obj)


def test_a_million_vertices(make, settings):
    """A plane of them, none in shadow: exact."""
    from neural_gash_addon.backend import spherical_harmonics as sh
    side = 1000
    x, y = np.meshgrid(np.arange(side, dtype=np.float32), np.arange(side, dtype=np.float32))
    index = np.arange(side * side, dtype=np.int32).reshape(side, side)
    corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).ravel()
    obj = make([], [])
    data = obj.data
    data.vertices.add(side * side)
    data.vertices.foreach_set("co", np.stack([x, y, np.zeros_like(x)], axis=-1).ravel())
    data.loops.add(len(corners))
    data.loops.foreach_set("vertex_index", corners)
    data.polygons.add(len(corners) // 4)
    data.polygons.foreach_set("loop_start", np.arange(0, len(corners), 4, dtype=np.int32))
    data.update(calc_edges=True)
    data.shade_smooth()
    settings.order, settings.rays = 2, 4
    coefficients, record = _baked(obj)
    assert record.points == len(coefficients) == side * side
    np.testing.assert_allclose(coefficients, np.broadcast_to(sh.cosine_lobe(np.array([[0, 0, 1.0]]), 2),
                                                             coefficients.shape), atol=1e-6)


def test_linked_mesh_under_a_local_object(make, settings, refused, tmp_path):
    path = str(tmp_path / "library.blend")
    bpy.data.libraries.write(path, {make(name="Linked").data})
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(path, link=True) as (there, here):
        here.meshes = list(there.meshes)
    obj = make(name="Local")
    obj.data = here.meshes[0]
    assert "linked" in refused(bpy.ops.neural_gash.bake)


def _twins(make):
    """Two objects of one mesh."""
    first = make(*WEDGE)
    second = bpy.data.objects.new("Twin", first.data)
    bpy.context.scene.collection.objects.link(second)
    bpy.context.view_layer.update()
    return first, second


def test_clear_takes_the_previews_of_twins_away(make, settings, snapshot):
    """They share the bake, so none of them shows it any more."""
    from neural_gash_addon.scene.attributes import has_bake
    first, second = _twins(make)
    before = snapshot()
    for obj in (first, second):
        bpy.context.view_layer.objects.active = obj
        _baked(obj)
    bpy.ops.neural_gash.clear()
    assert not has_bake(first) and not has_bake(second)
    bpy.context.view_layer.objects.active = first
    del bpy.context.scene["neural_gash_light"]
    assert snapshot() == before


def test_a_bake_relights_the_other_previews(make, settings):
    """The light is the scene's: another object's preview follows, as does a twin's at another order."""
    from neural_gash_addon.scene.preview import _group_nodes
    world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    colour = world.node_tree.nodes["Background"].inputs["Color"]
    colour.default_value = (1, 1, 1, 1)
    bpy.context.scene.world = world
    other = make()
    _baked(other)
    first, second = _twins(make)
    bpy.context.view_layer.objects.active = first
    _baked(first)
    colour.default_value = (0.5, 0, 0, 1)
    bpy.context.view_layer.objects.active = second
    settings.order = 4
    _baked(second)
    for obj, terms in ((other, 9), (first, 16), (second, 16)):
        node, = _group_nodes(obj)
        assert sum(s.name.startswith("L") for s in node.inputs) == terms, obj.name
        np.testing.assert_allclose(node.inputs["L0"].default_value[:3], (0.5 * np.sqrt(4 * np.pi), 0, 0), atol=1e-5)
