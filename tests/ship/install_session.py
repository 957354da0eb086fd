# SPDX-License-Identifier: GPL-3.0-or-later
"""Run by test_ship.py alone: install the zip, bake with the wheels in it, disable. Argument: the zip."""
import importlib.util
import json
import sys
from pathlib import Path

import bpy

ID = "bl_ext.user_default.neural_gash"


def registered() -> set[str]:
    """Everything of ours that Blender knows."""
    found = {name for name in dir(bpy.types) if name.startswith("NEURAL_GASH_") or name == "NeuralGashSettings"}
    found |= {"Scene.neural_gash"} if hasattr(bpy.types.Scene, "neural_gash") else set()
    found |= {f"op {name}" for name in dir(bpy.ops.neural_gash)}
    for name in dir(bpy.app.handlers):
        handlers = getattr(bpy.app.handlers, name)
        if isinstance(handlers, list):
            found |= {f"{name} {h}" for h in handlers if "neural_gash" in getattr(h, "__module__", "")}
    return found


commands: list[object] = []  # Blender cannot list its commands: count ours as they come and go
real_register, real_unregister = bpy.utils.register_cli_command, bpy.utils.unregister_cli_command


def register_command(name, run):
    commands.append(real_register(name, run))
    return commands[-1]


def unregister_command(handle):
    real_unregister(handle)
    commands[:] = [c for c in commands if c is not handle]  # Blender's own, registered before, go through here too


bpy.utils.register_cli_command, bpy.utils.unregister_cli_command = register_command, unregister_command
assert not registered(), registered()
assert importlib.util.find_spec("embreex") is None
bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo="user_default", enable_on_install=True)
assert ID in bpy.context.preferences.addons
assert len(commands) == 1
for name in ("embreex", "xatlas"):
    bundled = importlib.import_module(name).__file__
    assert bundled and ".local" in bundled, bundled

bpy.ops.wm.read_homefile(use_factory_startup=True)
bpy.ops.object.select_all(action="SELECT")
bpy.ops.object.delete()
bpy.ops.mesh.primitive_torus_add()
bpy.ops.object.shade_smooth()
bpy.context.scene.neural_gash.order = 4
assert bpy.ops.neural_gash.bake() == {"FINISHED"}
attributes = [name for name, _ in bpy.context.object.data.attributes.items() if name.startswith("_prt_")]
assert attributes == [f"_prt_{i}" for i in range(4)], attributes
assert json.loads(bpy.context.object.data["neural_gash"])["rays"] > 0  # whichever method was planned
kept, = Path(bpy.utils.extension_path_user(ID)).glob("*.json")  # the first plan has calibrated this machine
machine, = json.loads(kept.read_text())["machines"].values()
assert all("embree" in known["factors"] for known in machine.values()), machine
settings = bpy.context.scene.neural_gash
settings.target, settings.side, settings.order, settings.bounces = "TEXTURE", 64, 3, 2
assert bpy.ops.neural_gash.bake() == {"FINISHED"}   # with xatlas, and embreex's hits
images = bpy.context.object.data["neural_gash_images"]
assert len(images.keys()) == 7 and all(image.packed_file for image in images.values()), images
assert not [name for name, _ in bpy.context.object.data.attributes.items() if name.startswith("_prt_")]
assert bpy.ops.neural_gash.clear() == {"FINISHED"}
assert not [image.name for image in bpy.data.images if "PRT" in image.name]
assert "PRT" not in bpy.context.object.data.uv_layers
assert registered()

bpy.ops.preferences.addon_disable(module=ID)
assert not registered() and not commands, (registered(), commands)
timers = [name for name in sys.modules if name.startswith(ID) and hasattr(sys.modules[name], "_compare_changed")
          and bpy.app.timers.is_registered(sys.modules[name]._compare_changed)]
assert not timers, timers
print("installed, baked, disabled")
