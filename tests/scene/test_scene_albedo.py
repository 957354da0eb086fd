# SPDX-License-Identifier: GPL-3.0-or-later
"""Where images lie on a mesh: the same as Cycles shows."""
from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from neural_gash_addon.backend.texels import bilinear  # noqa: E402
from neural_gash_addon.scene.albedo import image_uv  # noqa: E402

SIDE = 32


def _square(make, mapping):
    """A square that shines with an image by UV, through a Mapping node of this type; its Image Texture node."""
    obj = make.grid(1)
    obj.data.uv_layers.new(name="Mine").uv.foreach_set(
        "vector", np.array([(-0.7, -0.6), (1.5, -0.6), (1.5, 1.7), (-0.7, 1.7)], np.float32).ravel())
    material = bpy.data.materials.new("Shining")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    texture, shine, output = map(tree.nodes.new, ("ShaderNodeTexImage", "ShaderNodeEmission",
                                                  "ShaderNodeOutputMaterial"))
    texture.image = bpy.data.images.new("Noise", 8, 4, float_buffer=True, is_data=True)
    texture.image.pixels.foreach_set(np.random.default_rng(0).uniform(size=128).astype(np.float32))
    texture.image.alpha_mode = "CHANNEL_PACKED"
    texture.image.update()
    tree.links.new(texture.outputs["Color"], shine.inputs["Color"])
    tree.links.new(shine.outputs[0], output.inputs["Surface"])
    if mapping:
        node, place = tree.nodes.new("ShaderNodeMapping"), tree.nodes.new("ShaderNodeTexCoord")
        node.vector_type = mapping
        node.inputs["Location"].default_value = (0.3, -0.2, 0)
        node.inputs["Rotation"].default_value = (0, 0, 0.7)
        node.inputs["Scale"].default_value = (1.5, -0.6, 1)
        tree.links.new(place.outputs["UV"], node.inputs["Vector"])
        tree.links.new(node.outputs["Vector"], texture.inputs["Vector"])
    obj.data.materials.append(material)
    return obj, texture


@pytest.mark.parametrize(("mapping", "extension"), [
    ("", "REPEAT"), ("", "EXTEND"), ("", "CLIP"), ("", "MIRROR"), ("POINT", "REPEAT"), ("TEXTURE", "MIRROR")])
def test_images_lie_where_cycles_shows_them(make, render, camera, mapping, extension):
    obj, texture = _square(make, mapping)
    texture.extension = extension
    camera((0, 0, 2), (0, 0, -1), width=2)
    shown = render(SIDE, SIDE)[..., :3].reshape(-1, 3)
    corners = image_uv(texture, obj.data)
    u, v = np.meshgrid(*[(np.arange(SIDE) + 0.5) / SIDE] * 2)
    at = (corners[0] + u.reshape(-1, 1) * (corners[1] - corners[0]) + v.reshape(-1, 1) * (corners[3] - corners[0]))
    pixels = np.empty((4, 8, 4), np.float32)
    texture.image.pixels.foreach_get(pixels.ravel())
    wrong = np.abs(bilinear(pixels[..., :3], at, extension) - shown).max(1)
    assert shown.std() > 0.1
    assert (wrong > 1e-3).mean() < 0.01, np.sort(wrong)[-50:]


@pytest.mark.parametrize("spoil", ["projection", "normal", "linked", "flat", "generated", "unlinked", "no number"])
def test_what_is_placed_otherwise_is_not_by_uv(make, spoil):
    obj, texture = _square(make, "TEXTURE" if spoil == "flat" else "POINT")
    tree = texture.id_data
    mapping, place = texture.inputs["Vector"].links[0].from_node, tree.nodes["Texture Coordinate"]
    assert image_uv(texture, obj.data).shape == (4, 2)
    if spoil == "projection":
        texture.projection = "BOX"
    elif spoil == "normal":
        mapping.vector_type = "NORMAL"
    elif spoil == "linked":
        tree.links.new(place.outputs["Generated"], mapping.inputs["Scale"])
    elif spoil == "flat":
        mapping.inputs["Scale"].default_value = (0, 1, 1)
    elif spoil == "generated":
        tree.links.new(place.outputs["Generated"], mapping.inputs["Vector"])
    elif spoil == "unlinked":
        tree.nodes.remove(place)
    else:
        mapping.inputs["Location"].default_value = (np.nan, 0, 0)
    assert image_uv(texture, obj.data) is None
