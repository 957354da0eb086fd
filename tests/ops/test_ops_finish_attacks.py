# SPDX-License-Identifier: GPL-3.0-or-later
"""What materials of others may be made of, and what a bake with bounces reads of them."""
from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

FLOOR = ([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [(0, 1, 2, 3)])
LID = ([(-1, -1, 0.5), (1, -1, 0.5), (1, 1, 0.5), (-1, 1, 0.5)], [(0, 1, 2, 3)])
SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))


def _unwrap(obj, uv=SQUARE):
    obj.data.uv_layers.new(name="Mine").uv.foreach_set("vector", np.array(uv, np.float32).ravel())


def _image(colour, side=4):
    image = bpy.data.images.new("colours", side, side, alpha=True, float_buffer=True, is_data=True)
    image.pixels.foreach_set(np.tile(np.array(colour, np.float32), side * side))
    return image


def _paint(obj, image, output="Color", socket="Base Color"):
    """A dull grey material whose socket has an image; the image's node."""
    material = bpy.data.materials.new(obj.name)
    material.use_nodes = True
    tree = material.node_tree
    shader = tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (0.3, 0.3, 0.3, 1)
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    tree.links.new(node.outputs[output], shader.inputs[socket])
    obj.data.materials.append(material)
    return node


def _finish(obj, mode="VISIBLE"):
    from neural_gash_addon.scene.read import read_finish
    bpy.context.view_layer.update()
    return read_finish(obj, mode, bpy.context.evaluated_depsgraph_get())


def test_an_image_of_many_objects_is_read_once(make):
    floor = make(*FLOOR, "Floor")
    _unwrap(floor)
    _paint(floor, _image((0.9, 0.1, 0.1, 1)))
    for number in range(3):
        lid = make(*LID, f"Lid {number}")
        _unwrap(lid)
        lid.data.materials.append(floor.data.materials[0])
    finish, pictures = _finish(floor)
    np.testing.assert_allclose(finish[:, :3], np.tile([0.9, 0.1, 0.1], (8, 1)), atol=1e-6)
    assert len(pictures) == 4 and len({id(picture.pixels) for picture in pictures}) == 1


def test_reroutes_lead_to_the_image(make):
    floor = make(*FLOOR)
    _unwrap(floor)
    node = _paint(floor, _image((0.9, 0.1, 0.2, 1)))
    tree = floor.data.materials[0].node_tree
    reroute, socket = tree.nodes.new("NodeReroute"), tree.nodes["Principled BSDF"].inputs["Base Color"]
    tree.links.new(node.outputs["Color"], reroute.inputs[0])
    tree.links.new(reroute.outputs[0], socket)
    np.testing.assert_allclose(_finish(floor)[0][:, :3], [(0.9, 0.1, 0.2)] * 2, atol=1e-6)
    node.mute = True
    np.testing.assert_allclose(_finish(floor)[0][:, :3], 0.3, atol=1e-6)


def test_the_alpha_of_an_image_is_not_its_colour(make):
    floor = make(*FLOOR)
    _unwrap(floor)
    _paint(floor, _image((0.1, 0.1, 0.1, 0.9)), "Alpha", "Roughness")
    assert _finish(floor)[0][:, 6] == pytest.approx(0.5)  # the socket's own, as of all that is not read


def test_images_that_are_projected_otherwise_are_not_read_by_uv(make):
    floor = make(*FLOOR)
    _unwrap(floor)
    node = _paint(floor, _image((0.9, 0.1, 0.2, 1)))
    node.projection = "BOX"
    np.testing.assert_allclose(_finish(floor)[0][:, :3], 0.3, atol=1e-6)


def test_materials_that_geometry_nodes_set_count_on_what_is_baked(make):
    floor, donor = make(*FLOOR), make(*LID, "Donor")
    _paint(donor, None)
    tree = bpy.data.node_groups.new("Painter", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    first, last = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    painter = tree.nodes.new("GeometryNodeSetMaterial")
    painter.inputs["Material"].default_value = donor.data.materials[0]
    tree.links.new(first.outputs[0], painter.inputs["Geometry"])
    tree.links.new(painter.outputs[0], last.inputs[0])
    floor.modifiers.new("Painter", "NODES").node_group = tree
    np.testing.assert_allclose(_finish(floor, "SELF")[0][:, :3], 0.3, atol=1e-6)


@pytest.mark.parametrize("metallic", [np.nan, np.inf, -3])
def test_metal_that_is_no_part_of_1_gives_numbers(make, metallic):
    floor = make(*FLOOR)
    _unwrap(floor)
    _paint(floor, _image((0.9, 0.1, 0.2, 1)))
    shader = floor.data.materials[0].node_tree.nodes["Principled BSDF"]
    shader.inputs["Metallic"].default_value = metallic
    finish, (picture,) = _finish(floor)
    for values in (finish, picture.lookups()):
        assert np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1


def test_the_uv_map_of_the_bake_is_not_what_images_lie_on(make, settings):
    """A mesh without UVs shows no image by UV, and the bake's own map must not change that, or its age."""
    from neural_gash_addon.scene import staleness
    settings.target, settings.side, settings.bounces, settings.occluders = "TEXTURE", 32, 2, "VISIBLE"
    _paint(make(*LID, "Lid"), None)
    floor = make(*FLOOR)
    _paint(floor, _image((0.9, 0.1, 0.2, 1)))
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    assert [layer.name for layer in floor.data.uv_layers] == ["PRT"] and staleness.check(floor)
    np.testing.assert_allclose(_finish(floor)[0][:2, :3], 0.3, atol=1e-6)
