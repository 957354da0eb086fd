# SPDX-License-Identifier: GPL-3.0-or-later
"""The shading group equals the NumPy evaluation."""
from ctypes.util import find_library

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from neural_gash_addon.backend.shading import radiance  # noqa: E402
from neural_gash_addon.scene import attributes, nodes, preview  # noqa: E402


def _interpolated(obj, values, size):
    """Per-element values (E, C) of a flat object at the centres of size x size pixels over [-1, 1]^2."""
    data = obj.data
    data.calc_loop_triangles()
    centres = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(centres, centres)
    points = np.stack([x, y], -1)
    out = np.full((size, size, values.shape[1]), np.nan)
    per_vertex = len(values) == len(data.vertices)
    for triangle in data.loop_triangles:
        a, b, c = (np.array(data.vertices[v].co[:2]) for v in triangle.vertices)
        weights = (points - a) @ np.linalg.inv(np.stack([b - a, c - a]))
        inside = (weights >= -1e-9).all(-1) & (weights.sum(-1) <= 1 + 1e-9)
        full = np.concatenate([1 - weights.sum(-1, keepdims=True), weights], -1)
        elements = triangle.vertices if per_vertex else triangle.loops
        out[inside] = full[inside] @ values[list(elements)]
    return out


@pytest.mark.parametrize("order", [2, 3, 4, 5])
@pytest.mark.parametrize("smooth", [True, False])
def test_cycles_equals_numpy(make, render, camera, order, smooth):
    obj = make.grid(2)
    if not smooth:  # normals that differ within a vertex, so that each corner has its own coefficients
        obj.data.vertices[4].co.z = 0.3
        obj.data.shade_flat()
    material = bpy.data.materials.new("Paint")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    albedo = (0.9, 0.5, 0.1)
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*albedo, 1)
    obj.data.materials.append(material)
    mesh, transfer = make.bake(obj, order=order)
    assert mesh.domain == ("POINT" if smooth else "CORNER")
    light = np.random.default_rng(1).normal(0, 1, (order * order, 3))
    preview.preview_on(obj)
    preview.update_light(obj, light)
    camera((0, 0, 5), (0, 0, -1), width=2)
    picture = render(256, 256)[..., :3]
    values, _ = attributes.read_transfer(obj)
    expected = _interpolated(obj, radiance(values, light, np.array(albedo)), 256)
    assert expected.min() < -0.1  # negative values pass, too
    difference = np.abs(picture - expected).max(-1)
    # 0.005 of a pixel is where a sample may lie beside its centre; the corners' values jump at edges
    assert np.quantile(difference, 0.97) < 1e-4 * max(1.0, np.abs(expected).max())
    if smooth:
        assert difference.max() < 5e-4 * np.abs(expected).max()


@pytest.mark.skipif(not find_library("EGL"), reason="EEVEE needs a graphics driver")
def test_eevee_equals_numpy_to_half_precision(make, render, camera):
    obj = make.grid(1)
    make.bake(obj, order=5)  # seven attributes
    light = np.random.default_rng(1).normal(0, 1, (25, 3))
    preview.preview_on(obj)
    preview.update_light(obj, light)
    camera((0, 0, 5), (0, 0, -1), width=2)
    picture = render(64, 64, eevee=True)[..., :3]
    values, _ = attributes.read_transfer(obj)
    expected = np.maximum(_interpolated(obj, radiance(values, light, 0.8), 64), 0)  # it cannot show less
    assert expected.max() > 1
    np.testing.assert_allclose(picture, expected, atol=2e-3 * expected.max())


def test_group_is_small_and_shared(make):
    group = nodes.ensure_group(5)
    assert nodes.ensure_group(5) is group
    assert nodes.ensure_group(3) is not group
    assert group.name == "PRT Shading 5"
    kinds = [node.type for node in group.nodes]
    assert kinds.count("ATTRIBUTE") == 7
    assert kinds.count("VECT_MATH") == 25 + 1
    assert [i.name for i in group.interface.items_tree if i.in_out == "INPUT"] == \
        ["Albedo", "Tint"] + [f"L{k}" for k in range(25)]


def test_a_group_of_another_version_is_left_alone(make):
    group = nodes.ensure_group(3)
    group["neural_gash_version"] = 0
    assert nodes.ensure_group(3) is not group


def test_a_persons_group_of_that_name_is_left_alone(make):
    theirs = bpy.data.node_groups.new("PRT Shading 3", "ShaderNodeTree")
    assert nodes.ensure_group(3) is not theirs
    assert not theirs.nodes
