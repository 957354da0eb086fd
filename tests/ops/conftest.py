# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on registered in an empty file for each test; unregistered after, as 4.5 would hang at exit."""
from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture(autouse=True)
def addon():
    """Registered on an empty scene."""
    bpy = pytest.importorskip("bpy")
    import neural_gash_addon
    bpy.ops.wm.read_factory_settings(use_empty=True)
    neural_gash_addon.register()
    yield neural_gash_addon
    neural_gash_addon.unregister()
    bpy.ops.wm.read_factory_settings(use_empty=True)


CUBE = ([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)],
        [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
# Two squares at a right angle, smooth: points on each see the other.
WEDGE = ([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (0, 1, 1)], [(0, 1, 2, 3), (0, 3, 5, 4)])


@pytest.fixture
def make():
    """make(positions, faces, name, smooth): a mesh object, active and selected."""
    def build(positions=CUBE[0], faces=CUBE[1], name="Thing", smooth=False):
        import bpy
        data = bpy.data.meshes.new(name)
        data.from_pydata([tuple(map(float, p)) for p in positions], [], [tuple(map(int, f)) for f in faces])
        if smooth:
            data.shade_smooth()
        obj = bpy.data.objects.new(name, data)
        bpy.context.scene.collection.objects.link(obj)
        for other in bpy.context.selected_objects:
            other.select_set(False)
        bpy.context.view_layer.objects.active = obj
        obj.select_set(True)
        bpy.context.view_layer.update()
        return obj
    return build


@pytest.fixture
def settings():
    """The scene's settings, made quick."""
    import bpy
    chosen = bpy.context.scene.neural_gash
    chosen.method, chosen.quality, chosen.rays = "embree", "RAYS", 64
    return chosen


@pytest.fixture
def refused():
    """refused(operator) -> the one sentence of an operator that must not work."""
    def call(operator, *arguments):
        with pytest.raises(RuntimeError) as caught:
            operator(*arguments)
        lines = [line for line in str(caught.value).strip().splitlines() if line]
        assert len(lines) == 1 and "Traceback" not in lines[0]
        sentence = lines[0].split("poll() ")[-1].removeprefix("Error: ")
        assert sentence.endswith(".") and len(sentence) < 250
        return sentence
    return call


@pytest.fixture
def snapshot():
    """snapshot() -> everything of the file that a failed bake must leave alone, to compare."""
    def take():
        import bpy
        meshes = {}
        for mesh in bpy.data.meshes:
            positions = np.empty(3 * len(mesh.vertices), np.float32)
            if len(positions):
                mesh.vertices.foreach_get("co", positions)
            meshes[mesh.name] = (positions.tobytes(), tuple(sorted(a.name for a in mesh.attributes)),
                                 str(mesh.get("neural_gash")), tuple(m and m.name for m in mesh.materials))
        objects = {o.name: (o.data.name if o.data else "", tuple(tuple(row) for row in o.matrix_world), o.mode,
                            o.select_get(), tuple((s.link, s.material and s.material.name)
                                                  for s in o.material_slots)) for o in bpy.context.scene.objects}
        active = bpy.context.view_layer.objects.active
        names = {kind: sorted(i.name for i in getattr(bpy.data, kind))
                 for kind in ("objects", "meshes", "materials", "node_groups", "scenes", "images", "collections")}
        return repr((meshes, objects, active and active.name, names, "neural_gash_light" in bpy.context.scene))
    return take


def folding(make, name, cells, last):
    """A smooth sheet of cells x cells that folds up by a shape key, from frame 1 to the last."""
    line, side = np.linspace(-1, 1, cells + 1), cells + 1
    positions = [(x, y, 0.0) for y in line for x in line]
    faces = [(j * side + i, j * side + i + 1, (j + 1) * side + i + 1, (j + 1) * side + i)
             for j in range(cells) for i in range(cells)]
    obj = make(positions, faces, name, smooth=True)
    obj.shape_key_add(name="Basis")
    key = obj.shape_key_add(name="Up")
    for point, (x, y, _) in zip(key.data, positions, strict=True):
        point.co = (0.35 * x, y, 0.9 * x) if x > 0 else (x, y, 0)
    for frame, value in ((1, 0.0), (last, 1.0)):
        key.value = value
        key.keyframe_insert("value", frame=frame)
    return obj


@pytest.fixture
def wing(make, settings):
    """A sheet that folds up from frame 1 to frame 10; baked, at frame 1."""
    import bpy
    obj = folding(make, "Wing", 24, 10)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 4
    bpy.context.scene.frame_set(1)
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}
    return obj


@pytest.fixture
def sheet(make, settings):
    """sheet(name): one that folds up from frame 1 to frame 3; not baked."""
    import bpy
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, 3
    scene.frame_set(1)
    return lambda name="Sheet": folding(make, name, 8, 3)


@pytest.fixture
def floor(make, settings):
    """A white floor; bakes are quick, with lamps."""
    from .lit import FLOOR, paint
    obj = make(*FLOOR, "Floor", smooth=True)
    paint(obj)
    settings.lamps, settings.method, settings.quality, settings.tolerance = True, "analytic", "TOLERANCE", 0.02
    settings.light_source, settings.sky = "SKY", (0, 0, 0)
    return obj
