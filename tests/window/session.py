# SPDX-License-Identifier: GPL-3.0-or-later
"""What only a real window can show: how the modal bake feels, Esc, Ctrl-Z, saving, a deleted object.

    make test-window BLENDER=/path/to/blender

`make` copies the package as an extension into a temporary user folder and starts Blender with this
file. It needs a display (Xvfb will do) and embreex for Blender's Python (on PYTHONPATH, if Blender
has none). Screenshots go to out/window where ImageMagick's `import` exists. The session prints one
JSON line of measured facts; the exit code is 0 where all of them are as they should be. Keep the
mouse away: the session presses keys itself.
"""
from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
from mathutils import Euler

sys.path.insert(0, str(Path(__file__).resolve().parent))
from following import following
from likeness import LARGEST, differences
from moments import moments
from pressing import click, drag

ID = "bl_ext.user_default.neural_gash"
NAME = "Suzanne"
TAB = "Neural GASh"
MANY_RAYS = 16384     # minutes of work: these bakes never end by themselves
ESC_LIMIT = 0.25      # seconds from the key to the end of the operator
GAP_LIMIT = 0.5       # seconds without a turn of the event loop; software GL draws the panel in this time too
TIMEOUT = 560         # seconds for the whole session

facts: dict = {}
failures: list[str] = []
pictures = Path(sys.argv[sys.argv.index("--") + 1]) if "--" in sys.argv else None


class Tee:
    """stderr that remembers: Blender prints an operator's traceback there and goes on."""

    def __init__(self, stream) -> None:
        self.stream, self.text = stream, ""

    def write(self, text: str) -> int:
        self.text += text
        return self.stream.write(text)

    def flush(self) -> None:
        self.stream.flush()


sys.stderr = Tee(sys.stderr)


def expect(holds: bool, name: str) -> None:
    """Note whether a fact is as it should be."""
    facts[name] = bool(holds)
    if not holds:
        failures.append(name)


def here() -> SimpleNamespace:
    """This module, for the others."""
    return SimpleNamespace(**globals())


def state():
    """The extension's ops.state."""
    return sys.modules[f"{ID}.ops.state"]


def view3d():
    """Window, area and main region of the 3D view."""
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width)
    return window, area, next(r for r in area.regions if r.type == "WINDOW")


def in_view():
    """Operators behave as if called from the 3D view."""
    window, area, region = view3d()
    return bpy.context.temp_override(window=window, area=area, region=region)


def press(key: str, **modifiers: bool) -> None:
    """A real key press, with the mouse in the 3D view."""
    window, _, region = view3d()
    where = {"x": region.x + region.width // 4, "y": region.y + region.height // 4}
    window.event_simulate("MOUSEMOVE", "NOTHING", **where)
    window.event_simulate(key, "PRESS", **where, **modifiers)
    window.event_simulate(key, "RELEASE", **where, **modifiers)


def bake() -> None:
    """As the button does."""
    with in_view():
        began = time.perf_counter()
        assert bpy.ops.neural_gash.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
        facts["invoke_s"] = round(time.perf_counter() - began, 3)


def settings():
    """Of the scene that is open now."""
    return bpy.context.scene.neural_gash


def suzanne() -> bpy.types.Object | None:
    """Found anew each time: undo and loading replace it."""
    return bpy.data.objects.get(NAME)


def snapshot() -> dict:
    """All that a bake may touch."""
    obj = suzanne()
    return {"attributes": sorted(a.name for a in obj.data.attributes), "colour": obj.data.attributes.active_color_name,
            "mesh": sorted(obj.data.keys()), "object": sorted(obj.keys()),
            "slots": [(s.link, s.material and s.material.name) for s in obj.material_slots],
            "materials": sorted(m.name for m in bpy.data.materials),
            "groups": sorted(g.name for g in bpy.data.node_groups)}


def coefficients() -> np.ndarray:
    """What is baked on Suzanne."""
    return sys.modules[f"{ID}.scene.attributes"].read_transfer(suzanne())[0]


def light() -> list[float]:
    """All socket values of the preview's shading group."""
    values: list[float] = []
    for slot in suzanne().material_slots:
        for node in slot.material.node_tree.nodes:
            if node.type == "GROUP":
                for socket in node.inputs:
                    value = getattr(socket, "default_value", 0.0)
                    values += [value] if isinstance(value, float) else list(value)
    return values


def reports() -> list[str]:
    """The lines of the Info editor."""
    window, _, _ = view3d()
    area = min((a for a in window.screen.areas if a.type != "VIEW_3D"), key=lambda a: a.height)
    kind, area.ui_type = area.ui_type, "INFO"
    try:
        with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
            bpy.ops.info.select_all(action="SELECT")
            bpy.ops.info.report_copy()
            bpy.ops.info.select_all(action="DESELECT")
        return window.id_data.clipboard.splitlines()
    finally:
        area.ui_type = kind


def picture(name: str):
    """A screenshot, once what is due has been drawn."""
    if pictures is None or not shutil.which("import"):
        return
    for _ in range(3):
        view3d()[1].tag_redraw()
        yield 0.3
    subprocess.run(["import", "-window", "root", str(pictures / f"{name}.png")], check=False)


def until_idle(limit: float, gaps: list[float] | None = None):
    """Wait for the bake's end, noting the times between turns of the event loop."""
    last = began = time.perf_counter()
    while state().running and last - began < limit:
        yield 0.005
        now = time.perf_counter()
        if gaps is not None:
            gaps.append(now - last)
        last = now
    expect(not state().running, "bake_ended")


def session():
    """The whole of it, one pause a yield."""
    bpy.ops.preferences.addon_enable(module=ID)
    expect(ID in bpy.context.preferences.addons, "enabled")
    facts["blender"] = bpy.app.version_string
    yield 0.5
    yield from build()
    yield from cancelled()
    yield from baked()
    yield from following(here())
    yield from reopened()
    yield from textured()
    yield from deleted()
    yield from moments(here())
    if pictures is not None and shutil.which("import"):
        facts["differences"] = {name: round(much, 3) for name, much in differences(pictures).items()}
        expect(max(facts["differences"].values()) < LARGEST, "pictures_are_like_the_references")


def build():
    """A dense smooth Suzanne under a sun, the panel open."""
    for obj in [o for o in bpy.data.objects if o.type in ("MESH", "LIGHT")]:
        bpy.data.objects.remove(obj)
    bpy.data.orphans_purge(do_recursive=True)  # what has no user is not saved
    with in_view():
        bpy.ops.object.light_add(type="SUN", rotation=(0.6, 0.5, 0.4))
        bpy.context.object.data.energy = 3.0
        bpy.ops.mesh.primitive_monkey_add()
        bpy.context.object.name = NAME
        bpy.context.object.modifiers.new("Subdivision", "SUBSURF").levels = 3
        bpy.ops.object.modifier_apply(modifier="Subdivision")
        bpy.ops.object.shade_smooth()
    facts["vertices"] = len(suzanne().data.vertices)
    expect(facts["vertices"] > 30_000, "dense")
    _, area, _ = view3d()
    area.spaces.active.show_region_ui = True
    yield 0.5
    region = next(r for r in area.regions if r.type == "UI")
    region.active_panel_category = TAB
    area.spaces.active.region_3d.view_distance = 5
    area.spaces.active.region_3d.view_location = (0.55, 0, 0)  # the panel is on the right
    area.spaces.active.region_3d.view_rotation = Euler((1.3, 0, 0.45)).to_quaternion()
    yield 0.5
    expect(region.active_panel_category == TAB, "panel_open")
    yield from picture("1_before")
    with in_view():
        bpy.ops.ed.undo_push(message="Session begins")


def cancelled():
    """A bake of many rays, stopped by Esc."""
    before = snapshot()
    settings().quality, settings().rays = "RAYS", MANY_RAYS
    idle: list[float] = []
    last = time.perf_counter()
    for _ in range(60):
        next(r for r in view3d()[1].regions if r.type == "UI").tag_redraw()  # as a bake does
        yield 0.005
        idle.append(time.perf_counter() - last)
        last = time.perf_counter()
    facts["idle_largest_gap_s"], facts["idle_mean_gap_s"] = round(max(idle), 3), round(float(np.mean(idle)), 4)
    bake()
    expect(state().running, "running")
    gaps: list[float] = []
    last = began = time.perf_counter()
    while last - began < 8:
        yield 0.005
        gaps.append(time.perf_counter() - last)
        last = time.perf_counter()
    facts["bake_largest_gap_s"], facts["bake_mean_gap_s"] = round(max(gaps), 3), round(float(np.mean(gaps)), 4)
    expect(max(gaps) < max(GAP_LIMIT, 2 * max(idle)), "stays_responsive")  # also on a machine that is busy otherwise
    facts["progress_after_8_s"] = round(state().progress, 4)
    expect(state().running and 0 < state().progress < 1, "progress_moves")
    yield from picture("2_baking")
    began = time.perf_counter()
    press("ESC")
    yield from until_idle(10)
    facts["esc_s"] = round(time.perf_counter() - began, 3)
    expect(facts["esc_s"] < max(ESC_LIMIT, 3 * float(np.mean(idle))), "esc_in_time")
    while any(t.name.startswith("neural_gash") for t in threading.enumerate()) and time.perf_counter() - began < 20:
        yield 0.005
    facts["threads_gone_s"] = round(time.perf_counter() - began, 3)
    expect(facts["threads_gone_s"] < 2, "threads_end")
    expect(snapshot() == before, "esc_leaves_no_trace")
    yield from picture("3_cancelled")


def baked():
    """A bake to its end, Ctrl-Z, a second one, the light turned."""
    before = snapshot()
    settings().quality, settings().tolerance = "TOLERANCE", 0.02
    for turn in ("first", "second"):
        gaps: list[float] = []
        began = time.perf_counter()
        if turn == "first":
            bake()
        else:
            yield from click(here(), "neural_gash.preset(")
            yield from click(here(), "neural_gash.bake()")
            settings().tolerance = 0.02
        expect(state().running, f"{turn}_bake_begins")
        yield from until_idle(120, gaps)
        facts[f"{turn}_bake_s"] = round(time.perf_counter() - began, 2)
        facts[f"{turn}_bake_largest_gap_s"] = round(max(gaps[:-1]), 3)
        facts[f"{turn}_bake_last_gap_s"] = round(gaps[-1], 3)  # writing the bake, drawing it
        after = snapshot()
        names = [n for n in after["attributes"] if n.startswith("_prt_")]
        expect(names == ["_prt_0", "_prt_1", "_prt_2"] and np.isfinite(coefficients()).all(), f"{turn}_attributes")
        expect(any("PRT preview" in (name or "") for _, name in after["slots"]), f"{turn}_preview_on")
        if turn == "first":
            press("Z", ctrl=True)
            yield 1.0
            expect(snapshot() == before, "one_undo_removes_all")
            press("Z", ctrl=True, shift=True)
            yield 1.0
            expect(snapshot() == after, "one_redo_brings_all_back")
            press("Z", ctrl=True)
            yield 1.0
            expect(snapshot() == before, "undo_again")
    yield from picture("4_solid")
    view3d()[1].spaces.active.shading.type = "MATERIAL"
    yield 5
    while bpy.app.is_job_running("SHADER_COMPILATION"):
        yield 0.5
    yield 2
    yield from picture("5_material_preview")
    materials = len(bpy.data.materials)
    unturned = light()
    seen = set()
    yield from drag(here(), "light_rotation", 60, lambda: seen.add(tuple(light())))
    facts["light_while_dragged"], facts["dragged_to"] = len(seen), round(settings().light_rotation, 3)
    expect(len(seen) > 5 and settings().light_rotation > 0.1, "the_light_follows_the_slider_as_it_is_dragged")
    expect(not np.allclose(light(), unturned), "slider_turns_the_light")
    expect(len(bpy.data.materials) == materials, "slider_makes_no_materials")
    yield 2
    yield from picture("6_turned")
    settings().light_rotation = 0.0


def reopened():
    """Saved, opened again."""
    before, values, lit = snapshot(), coefficients(), light()
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "session.blend")
        bpy.ops.wm.save_as_mainfile(filepath=path)
        bpy.ops.wm.read_homefile(use_factory_startup=True)
        yield 0.5
        expect(suzanne() is None, "file_left")
        bpy.ops.wm.open_mainfile(filepath=path)
        yield 1.5
    expect(snapshot() == before, "reopened_same")
    if snapshot() != before:
        facts["reopened_before_and_after"] = [before, snapshot()]
    expect(np.array_equal(coefficients(), values), "reopened_same_numbers")
    expect(np.allclose(light(), lit), "reopened_same_light")
    staleness = sys.modules[f"{ID}.scene.staleness"]
    expect(staleness.status(suzanne()) == staleness.CURRENT, "reopened_up_to_date")
    yield from picture("7_reopened")
    suzanne().data.vertices[0].co.z += 0.1
    suzanne().data.update()
    yield 2
    expect(staleness.status(suzanne()) == staleness.STALE, "changed_is_seen")
    yield from picture("8_changed")


def textured():
    """A floor baked to a texture with a bounce, stopped once by Esc; shown glossy; the tiles on disk are gone after."""
    with in_view():
        bpy.ops.mesh.primitive_plane_add(size=4, location=(0, 0, -1))
    floor = bpy.context.object
    settings().target, settings().uv_map, settings().side = "TEXTURE", floor.data.uv_layers[0].name, 512
    settings().occluders, settings().quality, settings().rays = "VISIBLE", "RAYS", 4096
    settings().order, settings().method = 5, "embree"
    tiles = Path(bpy.utils.extension_path_user(ID)) / "tiles"
    bake()
    yield 1.5
    press("ESC")
    yield from until_idle(10)
    expect("neural_gash" not in floor.data, "texture_esc_leaves_no_trace")
    settings().rays = 64
    bake()
    yield from until_idle(120)
    expect(len(floor.data.get("neural_gash_images", {}).keys()) == 7, "texture_baked")
    expect(not [p for folder in tiles.iterdir() for p in folder.iterdir()] if tiles.is_dir() else True, "tiles_removed")
    settings().gloss = True
    yield 0.5
    group = next(n.node_tree.name for n in floor.material_slots[0].material.node_tree.nodes if n.type == "GROUP")
    expect(group.startswith("PRT Gloss"), "gloss_shown")
    view3d()[1].spaces.active.shading.type = "MATERIAL"
    yield 8
    yield from picture("8b_texture_gloss")
    view3d()[1].spaces.active.shading.type = "SOLID"
    settings().target, settings().gloss, settings().occluders = "VERTICES", False, "SELF"
    settings().quality = "TOLERANCE"


def deleted():
    """The object goes while it is baked: by the Delete key, as the views stay usable."""
    with in_view():
        bpy.ops.object.select_all(action="DESELECT")
    suzanne().select_set(True)
    bpy.context.view_layer.objects.active = suzanne()
    settings().order = 4  # not the bake that is there already
    settings().tolerance = 0.01
    seen = len(reports())
    bake()
    yield 0.3
    press("DEL")
    yield 0.3
    expect(suzanne() is None and state().running, "deleted_during_the_bake")
    yield from picture("9_deleted")
    yield from until_idle(180)
    yield 0.5
    new = reports()[seen:]
    facts["reports"] = new
    expect(sum("was deleted while it was being baked" in line for line in new) == 1, "one_error")
    expect(not any("Traceback" in line for line in new), "no_traceback_reported")
    yield from picture("10_error")


def finish(code: int) -> None:
    """Print the facts and leave at once: quitting would ask whether to save."""
    facts["failures"] = failures
    print(json.dumps(facts), flush=True)
    sys.stderr.flush()
    os._exit(code)


steps = session()
ends = time.perf_counter() + TIMEOUT


def step() -> float | None:
    """One step of the session, by Blender's timer."""
    try:
        if time.perf_counter() > ends:
            raise TimeoutError("the session took too long")
        return next(steps)
    except StopIteration:
        pass
    except Exception:  # noqa: BLE001  whatever it is, Blender must not be left open
        failures.append(traceback.format_exc())
    expect("Traceback" not in sys.stderr.text, "no_traceback")
    finish(1 if failures else 0)
    return None


if pictures is not None:
    pictures.mkdir(parents=True, exist_ok=True)
bpy.context.preferences.view.show_splash = False
bpy.app.timers.register(step, first_interval=1.0, persistent=True)
