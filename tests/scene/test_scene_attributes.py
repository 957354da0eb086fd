# SPDX-License-Identifier: GPL-3.0-or-later
"""A bake on a mesh keeps every bit, and touches nothing of the person's."""
import json
import struct

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.scene import attributes  # noqa: E402


def _names(obj):
    return sorted(a.name for a in obj.data.attributes if a.name.startswith("_prt_"))


def _chosen(obj):
    a = obj.data.attributes
    return a.active_color_name, a.default_color_name, a.active.name if a.active else None


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("smooth", [True, False])
def test_round_trip_is_exact(make, order, smooth):
    obj = make.cube(smooth=smooth)
    mesh, transfer = make.bake(obj, order=order)
    values, record = attributes.read_transfer(obj)
    assert values.dtype == np.float32
    np.testing.assert_array_equal(values, transfer.coefficients[mesh.elements])
    assert record == transfer.record
    assert len(_names(obj)) == attributes.attribute_count(order ** 2) == -(-order ** 2 // 4)
    assert {obj.data.attributes[n].domain for n in _names(obj)} == {mesh.domain}
    assert json.loads(obj.data["neural_gash"])["order"] == order


def test_an_earlier_bake_goes_whatever_its_order_and_domain(make):
    obj = make.cube()
    make.bake(obj, order=5)
    obj.data.shade_smooth()
    mesh, transfer = make.bake(obj, order=2)
    assert _names(obj) == ["_prt_0"] and obj.data.attributes["_prt_0"].domain == "POINT"
    np.testing.assert_array_equal(attributes.read_transfer(obj)[0], transfer.coefficients[mesh.elements])


@pytest.mark.parametrize("own", [False, True])
def test_active_and_rendered_colours_stay(make, own):
    obj = make.cube()
    if own:
        for name in ("Paint", "Other"):
            obj.data.attributes.new(name, "BYTE_COLOR", "CORNER")
        obj.data.attributes.active_color_name = "Other"
        obj.data.attributes.default_color_name = "Paint"
        obj.data.attributes.active = obj.data.attributes["Paint"]
    before, names = _chosen(obj), sorted(a.name for a in obj.data.attributes)
    make.bake(obj, order=5)
    make.bake(obj, order=3)
    assert _chosen(obj)[:2] == before[:2]
    if own:
        assert _chosen(obj) == before
    attributes.clear(obj)
    assert sorted(a.name for a in obj.data.attributes) == names
    assert _chosen(obj)[:2] == before[:2] and "neural_gash" not in obj.data
    attributes.clear(obj)  # again: nothing to do


def test_attributes_of_that_name_that_no_bake_made(make):
    obj = make.cube()
    theirs = obj.data.attributes.new("_prt_1", "FLOAT", "POINT")
    theirs.data[0].value = 3
    with pytest.raises(UserError, match="_prt_1"):
        make.bake(obj)
    attributes.clear(obj)
    assert _names(obj) == ["_prt_1"] and not attributes.has_bake(obj)


def test_a_changed_mesh_is_noticed(make):
    from neural_gash_addon.scene import read
    obj, other = make.cube(), make.grid()
    _, transfer = make.bake(other)
    with pytest.raises(UserError, match="changed"):
        attributes.write_transfer(obj, read.read_object(other, make.depsgraph()).mesh.elements, transfer)
    assert not _names(obj)


def test_damage_is_told(make):
    obj = make.cube()
    with pytest.raises(UserError, match="not been baked"):
        attributes.read_transfer(obj)
    make.bake(obj)
    obj.data.attributes.remove(obj.data.attributes["_prt_1"])
    with pytest.raises(UserError, match="_prt_1"):
        attributes.read_transfer(obj)
    obj.data["neural_gash"] = "not JSON"
    with pytest.raises(UserError):
        attributes.read_transfer(obj)
    attributes.clear(obj)
    assert not _names(obj)


def test_save_and_load(make, tmp_path):
    obj = make.sphere()
    mesh, transfer = make.bake(obj, order=5)
    path = str(tmp_path / "baked.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    values, record = attributes.read_transfer(bpy.data.objects["Sphere"])
    np.testing.assert_array_equal(values, transfer.coefficients[mesh.elements])
    assert record == transfer.record


def test_duplicate(make):
    obj = make.cube()
    mesh, transfer = make.bake(obj)
    twin = obj.copy()
    twin.data = obj.data.copy()
    attributes.clear(obj)
    values, record = attributes.read_transfer(twin)
    np.testing.assert_array_equal(values, transfer.coefficients[mesh.elements])
    assert record == transfer.record


def test_join(make):
    first, second = make.cube("First"), make.cube("Second")
    second.location.x = 3
    a = make.bake(first, seed=1)[1].coefficients
    b = make.bake(second, seed=2)[1].coefficients
    with bpy.context.temp_override(active_object=first, selected_editable_objects=[first, second],
                                   object=first, selected_objects=[first, second]):
        bpy.ops.object.join()
    values, _ = attributes.read_transfer(first)
    assert len(values) == 48
    corners = {tuple(row) for row in values}
    assert corners == {tuple(row) for row in np.concatenate([a, b])}


def test_undo(make):
    obj = make.cube()
    bpy.context.view_layer.objects.active = obj
    bpy.ops.ed.undo_push(message="start")
    mesh, transfer = make.bake(obj)
    bpy.ops.ed.undo_push(message="bake")
    attributes.clear(obj)
    bpy.ops.ed.undo_push(message="clear")
    bpy.ops.ed.undo()
    values, _ = attributes.read_transfer(bpy.data.objects["Cube"])
    np.testing.assert_array_equal(values, transfer.coefficients[mesh.elements])
    bpy.ops.ed.undo()
    assert not attributes.has_bake(bpy.data.objects["Cube"])


def _accessor(blob, scene, index):
    """An accessor's values, and its component type."""
    accessor = scene["accessors"][index]
    view = scene["bufferViews"][accessor["bufferView"]]
    width = {"VEC3": 3, "VEC4": 4}[accessor["type"]]
    kind = {5121: np.uint8, 5123: np.uint16, 5126: np.float32}[accessor["componentType"]]
    length, = struct.unpack("<I", blob[12:16])
    start = 20 + length + 8 + view.get("byteOffset", 0)
    return np.frombuffer(blob, kind, accessor["count"] * width, start).reshape(-1, width)


@pytest.mark.parametrize("paint", [False, True])
def test_gltf_carries_the_attributes(make, tmp_path, paint):
    obj = make.cube(smooth=True)
    if paint:
        obj.data.materials.append(bpy.data.materials.new("Paint"))
    make.bake(obj)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    path = tmp_path / "baked.glb"
    # a mesh without material gets every colour attribute as COLOR_n, too, unless told not to
    bpy.ops.export_scene.gltf(filepath=str(path), export_attributes=True, export_format="GLB",
                              export_all_vertex_colors=paint)
    blob = path.read_bytes()
    length, = struct.unpack("<I", blob[12:16])
    scene = json.loads(blob[20:20 + length])
    primitive = scene["meshes"][0]["primitives"][0]["attributes"]
    carried = {name.lower(): index for name, index in primitive.items()}
    values, _ = attributes.read_transfer(obj)
    for index in range(3):
        stored = _accessor(blob, scene, carried[f"_prt_{index}"])
        part = values[:, 4 * index:4 * index + stored.shape[1]]
        assert stored.dtype == np.float32
        assert {tuple(row[:part.shape[1]]) for row in stored} == {tuple(row) for row in part}
    if "color_0" in carried:  # viewers multiply by it, so the bake must not pass for a vertex colour
        colour = _accessor(blob, scene, carried["color_0"])
        assert (colour == colour.max()).all() and colour.max() > 0
