# SPDX-License-Identifier: GPL-3.0-or-later
"""What blocks, and the fingerprint that notices changes."""
import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from mathutils import Euler, Matrix  # noqa: E402

from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.scene import read  # noqa: E402


def _centres(occluders):
    return sorted(tuple(np.round((p.min(0) + p.max(0)) / 2, 4).tolist()) for p, _ in occluders)


def _collection(name, *objects):
    collection = bpy.data.collections.new(name)
    bpy.context.scene.collection.children.link(collection)
    for obj in objects:
        collection.objects.link(obj)
        bpy.context.scene.collection.objects.unlink(obj)
    return collection


def test_visible_objects_but_the_baked_one(make):
    baked, other, hidden, unrendered = (make.cube(n) for n in "abcd")
    other.location = (5, 0, 0)
    hidden.hide_set(True)
    unrendered.hide_render = True
    assert read.read_occluders(baked, "SELF", make.depsgraph()) == []
    found = read.read_occluders(baked, "VISIBLE", make.depsgraph())
    assert _centres(found) == [(5, 0, 0)]
    positions, triangles = found[0]
    assert positions.dtype == np.float64 and triangles.dtype == np.int32 and triangles.shape == (12, 3)


def test_modifiers_parents_and_mirrors_of_occluders(make):
    baked, other = make.cube(), make.sphere("Other")
    other.parent = baked
    baked.location = (0, 0, 2)
    other.location, other.scale = (3, 0, 0), (-1, 1, 1)
    other.modifiers.new("Finer", "SUBSURF")
    positions, triangles = read.read_occluders(baked, "VISIBLE", make.depsgraph())[0]
    assert len(positions) > len(other.data.vertices)
    np.testing.assert_allclose(positions.mean(0), (3, 0, 2), atol=1e-4)
    corners = positions[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals * (corners.mean(1) - (3, 0, 2))).sum(1).min() > 0


def test_collection_instances_and_linked_duplicates(make):
    baked, source = make.cube(), make.cube("Source")
    collection = _collection("Things", source)
    bpy.context.view_layer.layer_collection.children["Things"].exclude = True
    for x in (4, 8):
        instancer = bpy.data.objects.new("Instancer", None)
        instancer.instance_type, instancer.instance_collection = "COLLECTION", collection
        instancer.location.x = x
        bpy.context.scene.collection.objects.link(instancer)
    twin = bpy.data.objects.new("Twin", baked.data)
    twin.location.y = 6
    bpy.context.scene.collection.objects.link(twin)
    found = read.read_occluders(baked, "VISIBLE", make.depsgraph())
    assert _centres(found) == [(0, 6, 0), (4, 0, 0), (8, 0, 0)]


def test_instances_of_the_baked_object_block_it(make):
    baked = make.cube()
    collection = _collection("Things", baked)
    instancer = bpy.data.objects.new("Instancer", None)
    instancer.instance_type, instancer.instance_collection = "COLLECTION", collection
    instancer.location.x = 4
    bpy.context.scene.collection.objects.link(instancer)
    assert _centres(read.read_occluders(baked, "VISIBLE", make.depsgraph())) == [(4, 0, 0)]


def test_instances_made_by_geometry_nodes(make):
    baked, carrier, source = make.cube(), make.grid(1, "Carrier"), make.cube("Source")
    source.location.z, source.hide_render = 50, True
    carrier.location.z = 10
    group = bpy.data.node_groups.new("Scatter", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, end = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    scatter, info = group.nodes.new("GeometryNodeInstanceOnPoints"), group.nodes.new("GeometryNodeObjectInfo")
    cone = group.nodes.new("GeometryNodeMeshCone")
    info.inputs["Object"].default_value = source
    group.links.new(start.outputs[0], scatter.inputs["Points"])
    group.links.new(cone.outputs["Mesh"], scatter.inputs["Instance"])
    group.links.new(scatter.outputs[0], end.inputs[0])
    carrier.modifiers.new("Scatter", "NODES").node_group = group
    found = read.read_occluders(baked, "VISIBLE", make.depsgraph())
    centres = sorted(tuple(np.round(p.mean(0)[:2], 3)) for p, _ in found)
    assert centres == [(-1, -1), (-1, 1), (1, -1), (1, 1)]


def test_curves_texts_and_balls_block_once(make):
    baked = make.cube()
    text = bpy.data.curves.new("Text", "FONT")
    text.body, text.extrude = "H", 0.1
    curve = bpy.data.curves.new("Curve", "CURVE")
    curve.dimensions, curve.bevel_depth = "3D", 0.1
    spline = curve.splines.new("POLY")
    spline.points.add(1)
    spline.points[1].co = (1, 0, 0, 1)
    ball = bpy.data.metaballs.new("Ball")
    ball.elements.new()
    for data in (text, curve, ball):
        bpy.context.scene.collection.objects.link(bpy.data.objects.new(data.name, data))
    bare = bpy.data.curves.new("Bare", "CURVE")  # a curve without thickness blocks nothing
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Bare", bare))
    assert len(read.read_occluders(baked, "VISIBLE", make.depsgraph())) == 3


def test_a_collection_counts_whole_and_hidden(make):
    baked, inside, hidden, off, outside = (make.cube(n) for n in "abcde")
    for x, obj in enumerate((baked, inside, hidden, off, outside)):
        obj.location.x = 10 * x
    collection = _collection("Blockers", baked, inside, hidden)
    inner = bpy.data.collections.new("Inner")
    collection.children.link(inner)
    inner.objects.link(off)
    hidden.hide_set(True)
    off.hide_viewport = True
    found = read.read_occluders(baked, "Blockers", make.depsgraph())
    assert _centres(found) == [(10, 0, 0), (20, 0, 0), (30, 0, 0)]
    assert len(bpy.data.objects) == 5 and hidden.hide_get() and off.hide_viewport
    with pytest.raises(UserError, match="Nowhere"):
        read.read_occluders(baked, "Nowhere", make.depsgraph())


def test_occluder_with_bad_coordinates_is_kept_out_of_the_way(make):
    baked, other = make.cube(), make.cube("Other")
    other.data.vertices[0].co.x = float("nan")
    positions, triangles = read.read_occluders(baked, "VISIBLE", make.depsgraph())[0]
    assert np.isfinite(positions).all() and 0 < len(triangles) < 12


def _print(obj, make, mode="SELF"):
    bpy.context.view_layer.update()
    return read.fingerprint(obj, make.depsgraph(), mode)


def test_fingerprint_ignores_place_turn_and_even_scale(make):
    obj = make.sphere()
    obj.scale = (1.234567, 0.876543, 2.345678)
    first = _print(obj, make)
    for i in range(40):
        obj.location = (i, -i, 100 * i)
        obj.rotation_euler = (i * 1.1, i * 0.7, i * 2.3)
        assert read.same_fingerprint(_print(obj, make), first)
    obj.scale = [3 * s for s in obj.scale]
    assert read.same_fingerprint(_print(obj, make), first)


@pytest.mark.parametrize("change", ["scale", "mirror", "shape", "shading", "sharp edge", "topology",
                                    "modifier"])
def test_fingerprint_notices(make, change):
    obj = make.cube(smooth=True)
    first = _print(obj, make)
    if change == "scale":
        obj.scale.x = 1.01
    elif change == "mirror":
        obj.scale.x = -1
    elif change == "shape":
        obj.data.vertices[0].co.x += 1e-4
        obj.data.update()
    elif change == "shading":
        obj.data.shade_flat()
    elif change == "sharp edge":
        obj.data.edges[0].use_edge_sharp = True
    elif change == "topology":
        obj.data.polygons[0].flip()
        obj.data.update()
    else:
        obj.modifiers.new("Grow", "DISPLACE").strength = 0.5
    assert not read.same_fingerprint(_print(obj, make), first)


def test_fingerprint_with_occluders_is_of_where_they_stand(make):
    obj, other = make.cube(), make.cube("Other")
    other.location.x = 4
    first = _print(obj, make, "VISIBLE")
    assert not read.same_fingerprint(first, _print(obj, make))
    both = bpy.data.objects.new("Parent", None)
    bpy.context.scene.collection.objects.link(both)
    obj.parent = other.parent = both
    both.matrix_world = Matrix.Translation((3, 2, 1)) @ Euler((1, 2, 3)).to_matrix().to_4x4()
    assert read.same_fingerprint(_print(obj, make, "VISIBLE"), first)
    other.location.x = 4.01
    moved = _print(obj, make, "VISIBLE")
    assert not read.same_fingerprint(moved, first)
    other.location.x = 4
    other.data.vertices[0].co.x -= 0.1
    other.data.update()
    assert not read.same_fingerprint(_print(obj, make, "VISIBLE"), first)
    assert read.same_fingerprint(_print(obj, make), _print(obj, make))


def test_frames_of_a_turned_object_differ_by_the_turn(make):
    obj = make.cube()
    turn = Euler((0.3, 1.2, -2)).to_matrix().to_4x4()
    for start in (Matrix.Diagonal((1, 2, 3, 1)), Matrix.Diagonal((-1, 2, 3, 1)),
                  Euler((1, 1, 1)).to_matrix().to_4x4() @ Matrix.Diagonal((-1, -2, -3, 1))):
        obj.matrix_world = start
        before = read.bake_frame(obj)
        obj.matrix_world = turn @ start
        after = read.bake_frame(obj)
        assert np.linalg.det(before) == pytest.approx(1)
        np.testing.assert_allclose(after @ before.T, np.array(turn)[:3, :3], atol=1e-6)
