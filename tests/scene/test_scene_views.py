# SPDX-License-Identifier: GPL-3.0-or-later
"""What a view shows, in Cycles' pixels, is what the bake holds, whatever the material's colour and the light."""
from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from neural_gash_addon.scene import preview  # noqa: E402
from neural_gash_addon.scene.attributes import read_transfer  # noqa: E402
from neural_gash_addon.scene.lighting import light_object  # noqa: E402


@pytest.fixture
def settings(empty_file):
    """The settings of the scene, with the add-on registered."""
    import neural_gash_addon
    neural_gash_addon.register()
    yield bpy.context.scene.neural_gash
    neural_gash_addon.unregister()


def _textured():
    """A material whose colour is a node's, not a value."""
    material = bpy.data.materials.new("Paint")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    tree = material.node_tree
    colour = tree.nodes.new("ShaderNodeRGB")
    colour.outputs[0].default_value = (0.9, 0.2, 0.1, 1)
    tree.links.new(colour.outputs[0], tree.nodes["Principled BSDF"].inputs["Base Color"])
    return material


def _even(obj, row):
    """Make every vertex of a bake hold the same numbers, so that every pixel must show them."""
    from neural_gash_addon.backend.transfer import Transfer
    from neural_gash_addon.scene import attributes, read
    values, record = read_transfer(obj)
    mesh = read.read_object(obj, bpy.context.evaluated_depsgraph_get()).mesh
    attributes.write_transfer(obj, mesh.elements, Transfer(np.tile(np.float32(row), (len(values), 1)), record))


ROW = np.array([0.2, -0.11, 0.07, 0.3, -0.05, 0.02, 0.13, -0.2, 0.09])
SCALE = np.sqrt(4 * np.pi)


@pytest.mark.parametrize("turned", [False, True])
def test_pixels_are_what_the_bake_holds(make, render, camera, settings, turned):
    obj = make.grid(2)
    obj.data.materials.append(_textured())
    make.bake(obj)
    _even(obj, ROW)
    preview.preview_on(obj)
    settings.light_strength, settings.light_rotation, settings.soften = 3.0, 0.5, True  # none of it counts
    if turned:
        obj.rotation_euler = (0, 0, 0.7)  # the numbers are of the bake's own axes, and stay
        bpy.context.view_layer.update()
        light_object(bpy.context.scene, obj)
    camera((0, 0, 5), (0, 0, -1), width=0.5)
    settings.view = "OCCLUSION"
    np.testing.assert_allclose(render(8, 8)[..., :3], SCALE * ROW[0], rtol=1e-4)
    settings.view = "COEFFICIENT"
    for k in (0, 3, 7):
        settings.coefficient = k
        expected = np.broadcast_to(SCALE * ROW[k] * np.array([1, 0, -1]), (8, 8, 3))
        np.testing.assert_allclose(render(8, 8)[..., :3], expected, atol=1e-4)
    settings.coefficient = 9  # of a higher order than the bake's
    assert not render(8, 8)[..., :3].any()


def test_leaving_a_view_is_as_if_it_had_never_been(make, settings):
    obj = make.grid(2)
    obj.data.materials.append(_textured())
    make.bake(obj)
    preview.preview_on(obj)
    light_object(bpy.context.scene, obj)

    def sockets():
        node, = (n for n in obj.material_slots[0].material.node_tree.nodes if n.type == "GROUP")
        return [tuple(s.default_value) if hasattr(s.default_value, "__len__") else s.default_value for s in node.inputs]

    lit = sockets()
    material = obj.material_slots[0].material
    settings.view = "OCCLUSION"
    assert sockets() != lit
    settings.view = "LIT"
    assert sockets() == lit and obj.material_slots[0].material == material  # no shader was made anew


def test_an_unshadowed_flat_mesh_is_white(make, render, camera, settings):
    """Ambient occlusion is 1 where the whole sky is seen: a bake by the real thing, not made-up numbers."""
    obj = make.grid(2)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    settings.method = "analytic"
    bpy.ops.neural_gash.bake()
    settings.view = "OCCLUSION"
    camera((0, 0, 5), (0, 0, -1), width=0.5)
    np.testing.assert_allclose(render(8, 8)[..., :3], 1.0, rtol=1e-4)
