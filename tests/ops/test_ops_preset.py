# SPDX-License-Identifier: GPL-3.0-or-later
"""Presets are tolerances."""
import pytest

from .conftest import WEDGE

bpy = pytest.importorskip("bpy")


def test_presets_are_tolerances(settings):
    from neural_gash_addon.ops.preset import PRESETS, in_force
    settings.property_unset("quality")
    settings.property_unset("tolerance")
    assert in_force(settings) == "GOOD"  # what a new scene has
    reached = []
    for name in PRESETS:
        settings.quality, settings.rays = "RAYS", 77
        assert in_force(settings) == ""
        assert bpy.ops.neural_gash.preset(preset=name) == {"FINISHED"}
        assert in_force(settings) == name and settings.quality == "TOLERANCE" and settings.rays == 77
        reached.append(settings.tolerance)
    assert reached == sorted(reached, reverse=True) and reached[0] >= 4 * reached[1] >= 16 * reached[2]
    settings.tolerance = 0.03
    assert in_force(settings) == ""


def test_a_better_preset_has_a_smaller_error(make, settings):
    from neural_gash_addon.scene.attributes import read_record
    obj = make(*WEDGE)
    errors = []
    for name in ("DRAFT", "FINAL"):
        bpy.ops.neural_gash.preset(preset=name)
        bpy.ops.neural_gash.bake()
        errors.append(read_record(obj).error_estimate)
    assert errors[0] <= 0.1 and errors[1] < errors[0] / 2


def test_nothing_to_set_for_what_traces_nothing(settings):
    settings.method = "analytic"
    assert not bpy.ops.neural_gash.preset.poll()
    settings.method = "embree"
    assert bpy.ops.neural_gash.preset.poll()


def test_everything_has_a_hover_text(settings):
    """Operators, settings and their choices: each says what it does."""
    silent = []
    for kind in (bpy.types.Operator, bpy.types.PropertyGroup):
        for cls in kind.__subclasses__():
            if not cls.__name__.startswith(("NEURAL_GASH", "NeuralGash")):
                continue
            if kind is bpy.types.Operator:
                name = cls.bl_idname.removeprefix("neural_gash.")
                if not getattr(bpy.ops.neural_gash, name).get_rna_type().description:
                    silent.append(name)
            for prop in cls.bl_rna.properties:
                if prop.identifier in ("rna_type", "name") or prop.identifier.startswith("bl_") or prop.is_readonly:
                    continue
                if not prop.description:
                    silent.append(f"{cls.__name__}.{prop.identifier}")
                if prop.type == "ENUM":
                    silent += [f"{cls.__name__}.{prop.identifier}.{item.identifier}" for item in prop.enum_items
                               if not item.description]
    assert silent == []
    assert len(type(settings).bl_rna.properties) > 20
