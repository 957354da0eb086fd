# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects become the right arrays, and what cannot be baked is refused in one sentence."""
import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from mathutils import Euler, Matrix  # noqa: E402

from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.scene import read  # noqa: E402

SHEAR = Matrix(((1, 0.7, 0, 2), (0, 1.5, 0.2, -1), (0, 0, 0.5, 3), (0, 0, 0, 1)))


def _face_normals(mesh):
    corners = mesh.positions[mesh.triangles]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _sentence(error):
    text = str(error.value)
    assert text.endswith(".") and text.count(". ") == 0 and "\n" not in text
    return text


@pytest.mark.parametrize("matrix", [
    Matrix.Identity(4), Matrix.Scale(-1, 4, (1, 0, 0)), Matrix.Diagonal((2, 0.5, -3, 1)),
    Euler((1, 2, 3)).to_matrix().to_4x4() @ Matrix.Diagonal((-2, -1, -0.5, 1)), SHEAR,
], ids=["as it is", "mirrored", "mirrored, stretched", "inverted, turned", "sheared"])
def test_sphere_normals_are_those_of_the_ellipsoid(make, matrix):
    obj = make.sphere(detail=5)
    obj.matrix_world = matrix
    if matrix == SHEAR:  # a location, rotation and scale hold no shear, a parent's matrix does
        obj.matrix_world = Matrix.Identity(4)
        obj.parent = bpy.data.objects.new("Parent", None)
        bpy.context.scene.collection.objects.link(obj.parent)
        obj.matrix_parent_inverse = SHEAR
    scene_mesh = read.read_object(obj, make.depsgraph())
    mesh, full = scene_mesh.mesh, np.array(matrix, dtype=float)
    assert mesh.domain == "POINT"
    local = np.array([v.co for v in obj.data.vertices], dtype=float)
    np.testing.assert_allclose(mesh.positions, local @ full[:3, :3].T + full[:3, 3], atol=1e-6)
    # the ellipsoid |A^-1 (x - t)| = 1 has the gradient A^-T A^-1 (x - t)
    inverse = np.linalg.inv(full[:3, :3])
    gradient = (mesh.positions - full[:3, 3]) @ inverse.T @ inverse
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    assert (gradient * mesh.normals).sum(1).min() > 0.999
    outward = mesh.positions[mesh.triangles].mean(1) - full[:3, 3]
    assert (_face_normals(mesh) * outward).sum(1).min() > 0


def test_flat_cube_has_a_point_per_corner(make):
    obj = make.cube()
    mesh = read.read_object(obj, make.depsgraph()).mesh
    assert mesh.domain == "CORNER" and len(mesh.points) == 24 and len(mesh.elements) == 24
    vertices = [loop.vertex_index for loop in obj.data.loops]
    np.testing.assert_allclose(mesh.points[mesh.elements], mesh.positions[vertices])
    faces = [p.normal for p in obj.data.polygons for _ in p.loop_indices]
    np.testing.assert_allclose(mesh.normals[mesh.elements], faces, atol=1e-6)


def test_smooth_cube_has_a_point_per_vertex(make):
    obj = make.cube(smooth=True)
    mesh = read.read_object(obj, make.depsgraph()).mesh
    assert mesh.domain == "POINT" and len(mesh.points) == 8
    np.testing.assert_allclose(mesh.normals, mesh.positions / math.sqrt(3), atol=1e-6)


def test_sharp_edge_splits_only_its_own_corners(make):
    obj = make.cube(smooth=True)
    obj.data.edges[0].use_edge_sharp = True
    obj.data.edges[1].use_edge_sharp = True
    mesh = read.read_object(obj, make.depsgraph()).mesh
    assert mesh.domain == "CORNER" and 8 < len(mesh.points) < 24


def test_custom_normals(make):
    obj = make.grid(1)
    obj.data.normals_split_custom_set([(0.6, 0, 0.8)] * 4)
    mesh = read.read_object(obj, make.depsgraph()).mesh
    np.testing.assert_allclose(mesh.normals, [(0.6, 0, 0.8)] * 4, atol=1e-3)


def test_far_away_object_keeps_its_precision(make):
    obj = make.sphere()
    obj.location = (1e4, -1e4, 0)
    mesh = read.read_object(obj, make.depsgraph()).mesh
    assert mesh.resolution < 2e-7
    radius = np.linalg.norm(mesh.positions - (1e4, -1e4, 0), axis=1)
    np.testing.assert_allclose(radius, 1, atol=1e-6)


def test_resolution_follows_coordinates_and_scale(make):
    obj = make.cube()
    obj.scale = (1, 100, 1)
    near = read.read_object(obj, make.depsgraph()).mesh.resolution
    assert near == pytest.approx(100 * 2.0 ** -23)
    obj.data.transform(Matrix.Translation((1e4, 0, 0)))
    assert read.read_object(obj, make.depsgraph()).mesh.resolution == pytest.approx(100 * 2.0 ** -10)


def test_modifiers_and_shape_keys_that_keep_the_vertices(make):
    obj = make.grid()
    obj.shape_key_add(name="Basis")
    key = obj.shape_key_add(name="Up")
    for point in key.data:
        point.co.z = 2
    key.value = 0.5
    modifier = obj.modifiers.new("Move", "DISPLACE")
    modifier.direction, modifier.strength, modifier.mid_level = "X", 4, 0
    mesh = read.read_object(obj, make.depsgraph()).mesh
    np.testing.assert_allclose(mesh.positions.mean(0), (4, 0, 1), atol=1e-6)


def test_modifier_that_changes_the_topology_is_refused_and_can_be_applied(make):
    obj = make.cube()
    obj.location, obj.scale = (1, 2, 3), (1, 2, 1)
    material = bpy.data.materials.new("Paint")
    obj.data.materials.append(material)
    obj.modifiers.new("Finer", "SUBSURF")
    other = bpy.data.collections.new("Other")
    bpy.context.scene.collection.children.link(other)
    other.objects.link(obj)
    with pytest.raises(UserError) as error:
        read.read_object(obj, make.depsgraph())
    assert "Cube" in _sentence(error) and "applied copy" in str(error.value)
    copy = read.make_applied_copy(obj, make.depsgraph())
    assert copy.name == "Cube (applied)" and not copy.modifiers and len(copy.data.vertices) == 26
    assert set(copy.users_collection) == set(obj.users_collection)
    assert list(copy.data.materials) == [material] and list(copy.location) == [1, 2, 3]
    bpy.context.view_layer.update()
    assert copy.matrix_world == obj.matrix_world
    mesh = read.read_object(copy, make.depsgraph()).mesh
    assert len(mesh.positions) == 26
    assert len(obj.modifiers) == 1 and len(obj.data.vertices) == 8


def test_applied_copy_of_a_previewed_bake_is_clean(make):
    from neural_gash_addon.scene import attributes, preview
    obj = make.cube()
    material = bpy.data.materials.new("Paint")
    obj.data.materials.append(material)
    make.bake(obj)
    preview.preview_on(obj)
    obj.modifiers.new("Finer", "SUBSURF")
    copy = read.make_applied_copy(obj, make.depsgraph())
    assert not attributes.has_bake(copy) and not preview.is_on(copy) and preview.is_on(obj)
    assert not [a.name for a in copy.data.attributes if a.name.startswith("_prt_")]
    assert copy.material_slots[0].material == material and copy.material_slots[0].link == "DATA"


def test_modifier_that_only_reorders_is_refused(make):
    obj = make.mesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2), (0, 2, 3)])
    group = bpy.data.node_groups.new("Sort", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, end = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    sort, index = group.nodes.new("GeometryNodeSortElements"), group.nodes.new("GeometryNodeInputIndex")
    backwards = group.nodes.new("ShaderNodeMath")
    backwards.operation, backwards.inputs[1].default_value = "MULTIPLY", -1
    sort.domain = "FACE"
    group.links.new(start.outputs[0], sort.inputs["Geometry"])
    group.links.new(index.outputs[0], backwards.inputs[0])
    group.links.new(backwards.outputs[0], sort.inputs["Sort Weight"])
    group.links.new(sort.outputs[0], end.inputs[0])
    obj.modifiers.new("Sort", "NODES").node_group = group
    with pytest.raises(UserError, match="applied copy"):
        read.read_object(obj, make.depsgraph())


@pytest.mark.parametrize("how", ["eye", "viewport", "render", "excluded"])
def test_hidden_object_is_read_as_evaluated(make, how):
    obj = make.grid()
    modifier = obj.modifiers.new("Move", "DISPLACE")
    modifier.direction, modifier.strength, modifier.mid_level = "X", 4, 0
    parent = bpy.data.objects.new("Parent", None)
    bpy.context.scene.collection.objects.link(parent)
    obj.parent = parent
    if how == "eye":
        obj.hide_set(True)
    elif how == "viewport":
        obj.hide_viewport = True
    elif how == "render":
        obj.hide_render = True
    else:
        away = bpy.data.collections.new("Away")
        bpy.context.scene.collection.children.link(away)
        away.objects.link(obj)
        bpy.context.scene.collection.objects.unlink(obj)
        bpy.context.view_layer.layer_collection.children["Away"].exclude = True
    parent.location.z = 7
    before = (len(bpy.data.objects), len(bpy.data.scenes), len(bpy.data.meshes))
    mesh = read.read_object(obj, make.depsgraph()).mesh
    np.testing.assert_allclose(mesh.positions.mean(0), (4, 0, 7), atol=1e-6)
    assert (len(bpy.data.objects), len(bpy.data.scenes), len(bpy.data.meshes)) == before


def test_loose_parts_and_broken_faces_are_read(make):
    positions = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (5, 5, 5), (6, 6, 6), (2, 2, 2)]
    faces = [(0, 1, 2, 3), (0, 1, 2, 3), (3, 2, 1, 0), (6, 6, 6), (0, 1, 6)]
    data = bpy.data.meshes.new("Broken")
    data.from_pydata(positions, [(4, 5)], faces)
    obj = bpy.data.objects.new("Broken", data)
    bpy.context.scene.collection.objects.link(obj)
    mesh = read.read_object(obj, make.depsgraph()).mesh
    assert len(mesh.positions) == 7 and np.isfinite(mesh.normals).all()
    assert len(mesh.elements) == (len(data.vertices) if mesh.domain == "POINT" else len(data.loops))


def test_odd_names(make):
    obj = make.cube(name="Größe \"x\" {0} %s / ☃ 'q'")
    assert read.read_object(obj, make.depsgraph()).mesh.domain == "CORNER"


def _no_object(make):
    return None


def _empty(make):
    obj = bpy.data.objects.new("Nothing", None)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def _no_faces(make):
    return make.mesh([(0, 0, 0), (1, 0, 0)], [], "Nothing")


def _not_finite(make, value=math.nan):
    obj = make.cube("Nothing")
    positions = np.zeros(24, np.float32)
    obj.data.vertices.foreach_get("co", positions)
    positions[9] = value
    obj.data.vertices.foreach_set("co", positions)  # setting .co would limit it to the largest float
    return obj


def _infinite(make):
    return _not_finite(make, math.inf)


def _too_large(make):
    return _not_finite(make, 3e38)


def _no_scale(make):
    obj = make.cube("Nothing")
    obj.scale.z = 0
    return obj


def _bad_place(make):
    obj = make.cube("Nothing")
    obj.location.x = math.nan
    return obj


def _edit_mode(make):
    obj = make.cube("Nothing")
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode="EDIT")
    return obj


@pytest.mark.parametrize("build", [_no_object, _empty, _no_faces, _not_finite, _infinite, _too_large,
                                   _no_scale, _bad_place, _edit_mode])
def test_bad_input_gets_one_sentence(make, build):
    obj = build(make)
    with pytest.raises(UserError) as error:
        read.read_object(obj, make.depsgraph())
    assert obj is None or "'Nothing'" in _sentence(error)
    with pytest.raises(UserError):
        read.fingerprint(obj, make.depsgraph())


def test_linked_library_data_is_refused(make, tmp_path):
    make.cube("Linked")
    path = str(tmp_path / "library.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(path, link=True) as (_, wanted):
        wanted.objects = ["Linked"]
    linked = wanted.objects[0]
    bpy.context.scene.collection.objects.link(linked)
    with pytest.raises(UserError) as error:
        read.read_object(linked, make.depsgraph())
    assert "linked" in _sentence(error)
    local = bpy.data.objects.new("Local", linked.data)  # its mesh is still the library's
    bpy.context.scene.collection.objects.link(local)
    with pytest.raises(UserError):
        read.read_object(local, make.depsgraph())
    override = linked.override_create()
    assert "linked" in read.refusal(override)
    # as something that blocks, it is welcome
    own = make.cube("Own")
    assert len(read.read_occluders(own, "VISIBLE", make.depsgraph())) >= 2
