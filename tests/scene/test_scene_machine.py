# SPDX-License-Identifier: GPL-3.0-or-later
"""What is known of this machine is kept in the extension's folder, and only there."""
import bpy

from neural_gash_addon.backend import costs
from neural_gash_addon.scene import machine


def test_an_extension_keeps_what_bakes_take_in_its_own_folder(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(machine, "__package__", "bl_ext.user_default.neural_gash.scene")
    monkeypatch.setattr(bpy.utils, "extension_path_user", lambda package: asked.append(package) or str(tmp_path))
    machine.register()
    assert asked == ["bl_ext.user_default.neural_gash"] and costs._file == tmp_path / "costs.json"
    machine.unregister()
    assert costs._file is None and not list(tmp_path.iterdir())


def test_what_is_no_extension_writes_nowhere():
    machine.register()
    assert costs._file is None
    machine.unregister()
