# SPDX-License-Identifier: GPL-3.0-or-later
"""Registering twice leaves nothing behind, and everything that can be pressed says what it does."""
from __future__ import annotations

import pytest

bpy = pytest.importorskip("bpy")


def _registered():
    """Whatever an add-on can leave behind."""
    handlers = bpy.app.handlers
    return {
        "handlers": {name: len(getattr(handlers, name)) for name in dir(handlers)
                     if isinstance(getattr(handlers, name), list)},
        "classes": sorted(name for name in dir(bpy.types) if "gash" in name.lower()),
        "operators": [name for name in dir(bpy.ops.neural_gash) if name != "__doc__"],
        "scene": hasattr(bpy.types.Scene, "neural_gash"),
    }


def test_twice_leaves_nothing(addon):
    addon.unregister()
    before = _registered()
    assert not before["scene"] and not before["classes"] and not before["operators"]
    for _ in range(2):
        addon.register()
        assert hasattr(bpy.types.Scene, "neural_gash")
        addon.unregister()
        assert _registered() == before
    from neural_gash_addon.scene import staleness
    assert not bpy.app.timers.is_registered(staleness._compare_changed)
    addon.register()


def _check_described(rna):
    """Every property of a type, and every item of its menus, says what it does."""
    for prop in rna.properties:
        if prop.identifier in ("rna_type", "name"):
            continue
        where = f"{rna.identifier}.{prop.identifier}"
        assert len(prop.description) > 15 and not prop.description.endswith("."), where
        for item in getattr(prop, "enum_items", ()):
            assert item.description and not item.description.endswith("."), f"{where}: {item.identifier}"


def test_everything_with_a_hover_text_has_one(addon):
    from neural_gash_addon import ops
    _check_described(bpy.context.scene.neural_gash.bl_rna)
    names = {name for name in dir(bpy.ops.neural_gash) if not name.startswith("_")}
    assert names == {cls.bl_idname.partition(".")[2] for cls in ops.CLASSES}
    for name in names:
        kind = getattr(bpy.ops.neural_gash, name).get_rna_type()
        assert len(kind.description) > 15 and not kind.description.endswith("."), name
        assert "UNDO" in getattr(bpy.types, f"NEURAL_GASH_OT_{name}").bl_options
        _check_described(kind)


def test_the_menu_is_the_table(settings):
    from neural_gash_addon.backend.methods import METHODS
    items = settings.bl_rna.properties["method"].enum_items
    assert [(i.identifier, i.name, i.description) for i in items] == [
        (m.name, m.label, m.description) for m in METHODS.values()]


class Layout:
    """Takes every layout call and notes the operators, properties and labels shown."""

    def __init__(self):
        self.shown = []

    def _inner(self, *_, **__):
        return self

    row = column = box = split = _inner

    def operator(self, name, **_):
        self.shown.append(name)
        return self

    def prop(self, owner, name, **_):
        assert name in owner.bl_rna.properties
        self.shown.append(name)

    def prop_search(self, owner, name, _places, _list):
        self.prop(owner, name)

    def label(self, text="", **_):
        self.shown.append(text)

    def progress(self, factor=0.0, text="", **_):
        self.shown.append(text)


def _draw(name):
    """What a panel shows now."""
    from types import SimpleNamespace

    from neural_gash_addon import panels
    cls = getattr(panels, f"NEURAL_GASH_PT_{name}")
    layout = Layout()
    stand_in = SimpleNamespace(layout=layout)
    for helper in ("_readout", "_texture"):
        if hasattr(cls, helper):
            setattr(stand_in, helper, getattr(cls, helper).__get__(stand_in))
    cls.draw(stand_in, bpy.context)
    return layout.shown


def test_panels_draw_in_every_state(make, settings, monkeypatch):
    from neural_gash_addon.ops import state
    bpy.context.view_layer.objects.active = None
    assert _draw("main")[:4] == ["neural_gash.bake"] + 3 * ["neural_gash.preset"]
    assert "view" in _draw("view")
    obj = make()
    assert "neural_gash.bake_applied_copy" not in _draw("main")
    bpy.ops.neural_gash.bake()
    shown = " | ".join(_draw("main"))
    assert "Up to date" in shown and "Time:" in shown and "Rays:" in shown and "Estimated error:" in shown
    obj.data.vertices[0].co.x += 0.3
    obj.data.update()
    bpy.context.view_layer.update()
    assert "Changed since the bake" in _draw("main")
    whole = obj.data["neural_gash"]
    obj.data["neural_gash"] = "{"
    assert "bake again" in " ".join(_draw("main"))
    assert {"light_rotation", "light_strength"} <= set(_draw("light"))
    obj.data["neural_gash"] = whole
    assert {"view", "neural_gash.show_errors"} <= set(_draw("view")) and "coefficient" not in _draw("view")
    settings.view, settings.coefficient = "COEFFICIENT", 5
    assert {"coefficient", "l = 2, m = -1"} <= set(_draw("view"))
    settings.coefficient = 9
    assert "The bake has coefficients 0 to 8" in _draw("view")
    for occluders in ("SELF", "COLLECTION"):
        settings.occluders = occluders
        assert ("collection" in _draw("settings")) == (occluders == "COLLECTION")
    assert "neural_gash.compare" in _draw("compare")
    monkeypatch.setattr(state, "running", True)
    assert not _draw("compare")
    shown = _draw("main")
    assert "neural_gash.bake" not in shown and any("Esc" in text for text in shown)
