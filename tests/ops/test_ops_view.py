# SPDX-License-Identifier: GPL-3.0-or-later
"""Presets set a tolerance; views and errors are one press each, and leaving them gives back what was there."""
from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

ERRORS = "neural_gash_error"


def _pressed(settings):
    from neural_gash_addon.ops.preset import preset_in_force
    return preset_in_force(settings)


def test_presets_are_tolerances(settings, refused):
    settings.quality = "RAYS"
    assert _pressed(settings) == ""
    found = []
    for preset in ("DRAFT", "GOOD", "FINAL"):
        settings.quality = "RAYS"
        bpy.ops.neural_gash.preset(preset=preset)
        assert settings.quality == "TOLERANCE" and _pressed(settings) == preset
        found.append(settings.tolerance)
    np.testing.assert_allclose(found, (0.1, 0.02, 0.005), rtol=1e-6)
    settings.tolerance = 0.03
    assert _pressed(settings) == ""
    settings.tolerance, settings.method = 0.02, "analytic"
    assert _pressed(settings) == "" and "no rays" in refused(bpy.ops.neural_gash.preset)


def test_a_new_scene_is_good(addon):
    assert _pressed(bpy.context.scene.neural_gash) == "GOOD"


def test_each_preset_has_a_hover_text_of_its_own(settings):
    from types import SimpleNamespace

    from neural_gash_addon.ops.preset import NEURAL_GASH_OT_preset as Preset
    texts = {Preset.description(bpy.context, SimpleNamespace(preset=name)) for name in ("DRAFT", "GOOD", "FINAL")}
    assert len(texts) == 3 and all(texts)


def _viewport():
    """Window, area and what else of a 3D Viewport."""
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    return {"window": window, "screen": window.screen, "area": area, "space_data": area.spaces.active}


def _shading(place):
    shading = place["space_data"].shading
    return shading.type, shading.color_type


def _colours(obj, name):
    obj.data.color_attributes.new(name, "FLOAT_COLOR", "POINT")


@pytest.mark.parametrize("before", [("MATERIAL", "RANDOM"), ("SOLID", "MATERIAL"), ("WIREFRAME", "SINGLE")])
def test_errors_are_shown_and_left_again(make, before):
    from neural_gash_addon.scene.views import shows_errors
    obj = make()
    for name in ("Mine", ERRORS):
        _colours(obj, name)
    obj.data.color_attributes.active_color_name = "Mine"
    place = _viewport()
    place["space_data"].shading.type, place["space_data"].shading.color_type = before
    screen, keys = place["screen"], sorted(obj.data.keys())
    kept = sorted(screen.keys())
    with bpy.context.temp_override(**place):
        bpy.ops.neural_gash.show_errors()
        assert shows_errors(obj, place["space_data"]) and _shading(place) == ("SOLID", "VERTEX")
        bpy.ops.neural_gash.show_errors()
    assert _shading(place) == before and obj.data.color_attributes.active_color_name == "Mine"
    assert sorted(screen.keys()) == kept and sorted(obj.data.keys()) == keys


def test_errors_of_a_second_object_keep_what_was_before_the_first(make):
    place = _viewport()
    place["space_data"].shading.type = "MATERIAL"
    for name in ("First", "Second"):
        obj = make(name=name)
        _colours(obj, "Mine")
        _colours(obj, ERRORS)
        obj.data.color_attributes.active_color_name = "Mine"
        with bpy.context.temp_override(**place):
            bpy.ops.neural_gash.show_errors()
    with bpy.context.temp_override(**place):
        bpy.ops.neural_gash.show_errors()
    assert _shading(place)[0] == "MATERIAL"


def test_without_errors_or_viewport_it_says_so(make, refused):
    obj = make()
    place = _viewport()
    with bpy.context.temp_override(**place):
        assert "No comparison" in refused(bpy.ops.neural_gash.show_errors)
    _colours(obj, ERRORS)
    with bpy.context.temp_override(area=None):
        assert "3D Viewport" in refused(bpy.ops.neural_gash.show_errors)


def test_glossy_previews_are_dull_in_a_view(make, settings):
    from neural_gash_addon.scene.preview import is_glossy, is_on
    obj = make()
    settings.target, settings.side, settings.method, settings.gloss = "TEXTURE", 32, "analytic", True
    bpy.ops.neural_gash.bake()
    assert is_glossy(obj)
    for view in ("OCCLUSION", "COEFFICIENT"):
        settings.view = view
        assert is_on(obj) and not is_glossy(obj)
    settings.view = "LIT"
    assert is_glossy(obj)


def test_numbers_have_units(settings):
    kinds = {p.identifier: p.subtype for p in settings.bl_rna.properties if p.type in ("INT", "FLOAT")}
    # counts, factors without a bound, and texels a metre, for which Blender has no unit: their names say what they are
    plain = {"order", "rays", "bounces", "coefficient", "light_strength", "lamps_strength", "texels_per_metre"}
    assert {name for name, kind in kinds.items() if kind == "NONE"} == plain
    assert (kinds["side"], kinds["light_rotation"], kinds["tolerance"]) == ("PIXEL", "ANGLE", "FACTOR")


def _point_colours(obj):
    """(E, 3) of the attribute of errors."""
    data = obj.data.attributes[ERRORS].data
    values = np.empty((len(data), 4), np.float32)
    data.foreach_get("color", values.ravel())
    return values[:, :3]


def test_confidence_is_shown_in_one_press(make, settings):
    from .conftest import WEDGE
    obj = make(*WEDGE, smooth=True)
    settings.rays = 16
    bpy.ops.neural_gash.bake()
    obj.rotation_euler = (0.3, 1.0, -0.4)  # which changes nothing of it
    bpy.context.view_layer.update()
    place = _viewport()
    with bpy.context.temp_override(**place):
        assert bpy.ops.neural_gash.show_confidence() == {"FINISHED"}
    assert _shading(place) == ("SOLID", "VERTEX")
    first = _point_colours(obj)
    assert np.ptp(first.sum(1)) > 0.1
    obj.rotation_euler = (0, 0, 0)
    bpy.context.view_layer.update()
    bpy.ops.neural_gash.show_confidence()
    np.testing.assert_allclose(_point_colours(obj).sum(1).argsort()[-1], first.sum(1).argsort()[-1])


def test_confidence_wants_a_bake_to_vertices_that_fits(make, settings, refused):
    obj = make()
    assert "has not been baked" in refused(bpy.ops.neural_gash.show_confidence)
    bpy.ops.neural_gash.bake()
    obj.data.vertices[0].co.z += 0.5
    obj.data.update()
    bpy.context.view_layer.update()
    assert "has changed since the bake" in refused(bpy.ops.neural_gash.show_confidence)
    settings.target, settings.side = "TEXTURE", 32
    bpy.ops.neural_gash.bake()
    assert "bakes to vertices" in refused(bpy.ops.neural_gash.show_confidence)
    assert ERRORS not in obj.data.attributes
