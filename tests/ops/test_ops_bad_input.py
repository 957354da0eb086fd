# SPDX-License-Identifier: GPL-3.0-or-later
"""Each bad input gets a right bake or one clear sentence, and nothing of the scene changes."""
from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as sampling
from hypothesis import strategies as st

from .conftest import CUBE, WEDGE

bpy = pytest.importorskip("bpy")


def _nothing(make):
    bpy.context.view_layer.objects.active = None


def _camera(make):
    obj = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.objects.active = obj


def _no_vertices(make):
    make([], [])


def _loose_only(make):
    obj = make([(0, 0, 0), (1, 0, 0)], [])
    obj.data.edges.add(1)


def _not_a_number(make):
    make([(math.nan, 0, 0), *CUBE[0][1:]], CUBE[1])


def _infinite(make):
    make([(math.inf, 0, 0), *CUBE[0][1:]], CUBE[1])


def _zero_scale(make):
    make().scale = (1, 1, 0)


def _edit_mode(make):
    make()
    bpy.ops.object.mode_set(mode="EDIT")


def _in_the_way(make):
    make().data.attributes.new("_prt_0", "FLOAT", "POINT")


def _topology(make):
    make().modifiers.new("Mirror", "ARRAY")


REFUSED = {
    "active": _nothing, "not a mesh": _camera, "no faces": _no_vertices, "faces": _loose_only,
    "not numbers": _not_a_number, "infinite": _infinite, "zero": _zero_scale, "Edit Mode": _edit_mode,
    "_prt_0": _in_the_way, "copy": _topology,
}


@pytest.mark.parametrize("word", REFUSED)
def test_one_sentence_and_nothing_changed(word, make, settings, refused, snapshot):
    REFUSED[word](make)
    bpy.context.view_layer.update()
    before = snapshot()
    assert word in refused(bpy.ops.neural_gash.bake)
    assert snapshot() == before
    if bpy.context.object and bpy.context.object.mode == "EDIT":
        bpy.ops.object.mode_set(mode="OBJECT")


def test_no_collection_chosen(make, settings, refused):
    make()
    settings.occluders = "COLLECTION"
    assert "collection" in refused(bpy.ops.neural_gash.bake)
    settings.collection = bpy.data.collections.new("SELF")
    assert "rename" in refused(bpy.ops.neural_gash.bake)


def test_linked_data(make, settings, refused, tmp_path):
    path = str(tmp_path / "library.blend")
    bpy.data.libraries.write(path, {make(name="Linked")})
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(path, link=True) as (there, here):
        here.objects = list(there.objects)
    obj = here.objects[0]
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.objects.active = obj
    assert "linked" in refused(bpy.ops.neural_gash.bake)
    assert refused(bpy.ops.neural_gash.clear) and refused(bpy.ops.neural_gash.preview)


def _baked(obj):
    """The bake's coefficients, which must be there and finite."""
    from neural_gash_addon.scene.attributes import read_transfer
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    coefficients, _ = read_transfer(obj)
    assert np.isfinite(coefficients).all()
    return coefficients


def test_loose_zero_area_flipped_and_duplicate_parts_bake(make, settings):
    """Two walls, with one of each kind of rubbish beside them."""
    positions = [*WEDGE[0], (5, 5, 5), (6, 5, 5), (7, 5, 5)]
    faces = [*WEDGE[1], (6, 7, 8), (3, 2, 1, 0), (0, 1, 2)]
    coefficients = _baked(make(positions, faces))
    assert coefficients.any()


def test_hidden_objects_bake(make, settings):
    shown = _baked(make(*WEDGE))
    for hide in (lambda o: setattr(o, "hide_viewport", True), lambda o: o.hide_set(True)):
        obj = make(*WEDGE)
        hide(obj)
        np.testing.assert_allclose(_baked(obj), shown, atol=1e-6)


def test_odd_names_bake(make, settings):
    _baked(make(name="a/b\\c:*?\"<>|\n\t'%s {0} \U0001f600"))


def test_many_colour_attributes_bake_or_say_so(make, settings, refused, snapshot):
    """Order 5 takes 7 attributes; a mesh with twenty of its own still bakes, as its material reads none."""
    obj = make()
    for index in range(20):
        obj.data.color_attributes.new(f"Paint {index}", "FLOAT_COLOR", "CORNER")
    settings.order = 5
    _baked(obj)
    assert len([a for a in obj.data.attributes if a.name.startswith("Paint")]) == 20


def test_damaged_records_do_not_stop_anything(make, settings, refused):
    from neural_gash_addon.scene.preview import is_on
    obj = make()
    bpy.ops.neural_gash.bake()
    for text in ("", "{", "[]", '{"schema": 99}', '{"schema": 1}'):
        obj.data["neural_gash"] = text
        settings.light_rotation += 0.1
        if is_on(obj):
            bpy.ops.neural_gash.preview()
        assert refused(bpy.ops.neural_gash.preview)
    _baked(obj)


_coordinate = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 1e-30, 1e30, 3e38, math.nan, math.inf, -math.inf]),
    st.floats(-2, 2, width=32), st.floats(width=32))
_benign = st.one_of(st.integers(-2, 2).map(float), st.floats(-2, 2, width=32))


@st.composite
def _meshes(draw):
    """Positions, faces (also repeated and folded ones), scale and smoothness."""
    coordinate = draw(st.sampled_from([_benign, _benign, _coordinate]))
    positions = draw(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=3, max_size=9))
    corner = st.integers(0, len(positions) - 1)
    faces = draw(st.lists(st.lists(corner, min_size=3, max_size=5, unique=True), max_size=8))
    if faces and draw(st.booleans()):
        faces += [faces[0], faces[0][::-1]]
    scale = draw(st.tuples(*[st.sampled_from([1.0, -1.0, 1e-6, 1e6, 0.0, 1e-20])] * 3))
    return positions, faces, scale, draw(st.booleans())


@sampling(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(case=_meshes(), method=st.sampled_from(["embree", "analytic", "hybrid", "gnn"]),
       order=st.sampled_from([2, 3, 5]))
def test_random_broken_meshes(case, method, order, make, settings, refused, snapshot):
    """Finite coefficients or one sentence, and after a refusal the scene is what it was."""
    positions, faces, scale, smooth = case
    obj = make(positions, faces, "Broken", smooth)
    obj.scale = scale
    bpy.context.view_layer.update()
    settings.method, settings.order, settings.rays = method, order, 16
    before = snapshot()
    try:
        bpy.ops.neural_gash.bake()
    except RuntimeError:
        refused(bpy.ops.neural_gash.bake)
        assert snapshot() == before
    else:
        from neural_gash_addon.scene.attributes import read_transfer
        coefficients, _ = read_transfer(obj)
        assert np.isfinite(coefficients).all()
        # No band can hold more than an open hemisphere's light: |T|^2 <= 1/pi^2 int max(cos, 0)^2 = 2/(3 pi).
        assert (np.square(coefficients, dtype=np.float64).sum(axis=1) < 0.4).all()
        bpy.ops.neural_gash.clear()
    finally:
        data = obj.data
        bpy.data.objects.remove(obj)
        bpy.data.meshes.remove(data)
