# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare Methods on This Mesh: what it leaves in the file is what the library measures, and nothing else changes."""
from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from .conftest import WEDGE
from .test_ops_modal import ESC, TIMER, Context, _to_the_end

bpy = pytest.importorskip("bpy")
pytest.importorskip("torch")
trimesh = pytest.importorskip("trimesh")

ERRORS = "neural_gash_error"


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    """A reference of fewer rays: what is tried here is what is made of it."""
    from neural_gash_addon.ops import compare as operator
    plain = operator.compare.reference
    monkeypatch.setattr(operator.compare, "reference", lambda *given: plain(*given, rays=256))


def torus(make, **kinds):
    ring = trimesh.creation.torus(1.0, 0.45, 16, 8)
    return make(ring.vertices, ring.faces, name="Ring", **kinds)


def colours(obj):
    attribute = obj.data.attributes[ERRORS]
    out = np.empty((len(attribute.data), 4), np.float32)
    attribute.data.foreach_get("color", out.ravel())
    return out


def shown(image):
    width, height = image.size
    out = np.empty((height, width, 4), np.float32)
    image.pixels.foreach_get(out.ravel())
    return out


@pytest.mark.parametrize("smooth", (True, False))
def test_what_is_left_is_what_the_library_measures(make, settings, tmp_path, smooth):
    from neural_gash_addon.backend import compare, compare_picture, methods
    from neural_gash_addon.scene.read import read_object
    obj = torus(make, smooth=smooth)
    settings.method, settings.rays, settings.order = "embree", 16, 2
    path = tmp_path / "chart.png"
    assert bpy.ops.neural_gash.compare(filepath=str(path)) == {"FINISHED"}
    mesh = read_object(obj, bpy.context.evaluated_depsgraph_get()).mesh
    truth = methods.run(compare.reference(mesh, 2, np.arange(len(mesh.points)), (), 77))
    found = methods.run(methods.bake(mesh, "embree", 2, rays=16, seed=0)).coefficients
    errors = compare.point_errors(found, truth)
    expected = compare_picture.heat(errors / np.quantile(errors, 0.99))
    linear = np.where(expected <= 0.04045, expected / 12.92, ((expected + 0.055) / 1.055) ** 2.4)
    assert obj.data.attributes[ERRORS].domain == mesh.domain == ("POINT" if smooth else "CORNER")
    np.testing.assert_allclose(colours(obj)[:, :3], linear[mesh.elements], atol=1e-5)
    assert obj.data.attributes.active_color_name == ERRORS and obj.data.attributes.default_color_name == ""
    image = next(i for i in bpy.data.images if i.get("neural_gash_comparison"))
    assert image.packed_file and tuple(image.size) == (compare_picture.WIDTH, compare_picture.HEIGHT)
    pixels = shown(image)[..., :3]
    marks = 0
    for number in range(len(methods.METHODS)):  # in the legend all; in the axes one may hide another
        colour = np.abs(pixels - compare_picture._COLOURS[number % len(compare_picture._COLOURS)]).max(-1) < 0.01
        assert colour[:, compare_picture._RIGHT:].sum() > 30
        marks += colour[:, :compare_picture._RIGHT].sum()
    assert marks > 30 * len(methods.METHODS)
    saved = bpy.data.images.load(str(path))
    np.testing.assert_allclose(shown(saved), shown(image), atol=0.01)


def test_again_draws_over_and_a_bake_beside_stays(make, settings):
    from neural_gash_addon.scene.attributes import read_transfer
    obj = torus(make, smooth=True)
    settings.method = "gnn"
    bpy.ops.neural_gash.bake()
    before = read_transfer(obj)[0]
    for _ in range(2):
        bpy.ops.neural_gash.compare()
    np.testing.assert_array_equal(read_transfer(obj)[0], before)
    assert sum(bool(i.get("neural_gash_comparison")) for i in bpy.data.images) == 1
    assert [a.name for a in obj.data.attributes].count(ERRORS) == 1
    from neural_gash_addon.scene import staleness
    assert staleness.status(obj) != staleness.STALE
    bpy.ops.neural_gash.clear()
    assert ERRORS in obj.data.attributes  # it is no bake


def test_occluders_count_and_convex_things_have_no_error(make, settings):
    make(name="Other", positions=np.array(WEDGE[0]) + (3, 0, 0), faces=WEDGE[1])
    make(name="Cube")
    settings.tolerance, settings.quality = 0.02, "TOLERANCE"
    bpy.ops.neural_gash.compare()
    cube = bpy.data.objects["Cube"]
    assert np.ptp(colours(cube), axis=0).max() < 1e-3  # no shadows, no errors anywhere
    settings.occluders, settings.method = "VISIBLE", "analytic"
    bpy.ops.neural_gash.compare()
    assert np.ptp(colours(cube), axis=0).max() > 0.3   # unshadowed is wrong where the other blocks


def test_bad_input_is_one_sentence_and_changes_nothing(make, settings, refused, snapshot, tmp_path):
    obj = torus(make, smooth=True)
    before = snapshot()
    assert ".png" in refused(lambda: bpy.ops.neural_gash.compare(filepath=str(tmp_path / "chart.jpg")))
    assert "cannot be written" in refused(lambda: bpy.ops.neural_gash.compare(filepath=str(tmp_path / "no" / "c.png")))
    settings.method, settings.order = "mlp", 5
    assert "orders up to 3" in refused(bpy.ops.neural_gash.compare)
    settings.method, settings.order = "analytic", 2
    assert snapshot() == before
    obj.data.attributes.new(ERRORS, "FLOAT", "POINT")
    before = snapshot()
    assert ERRORS in refused(bpy.ops.neural_gash.compare)
    assert snapshot() == before
    bpy.ops.object.mode_set(mode="EDIT")
    assert "Edit Mode" in refused(bpy.ops.neural_gash.compare)
    bpy.ops.object.mode_set(mode="OBJECT")


@pytest.fixture
def operator():
    """The logic of the operator outside Blender's, with its reports."""
    from neural_gash_addon.ops.bake import Baking
    from neural_gash_addon.ops.compare import NEURAL_GASH_OT_compare as Compare
    members = {name: vars(Compare)[name] for name in ("_doing", "_prepare", "_finish")}
    made = type("Operator", (Baking,), {**members, "filepath": "",
                                        "report": lambda self, kind, text: self.reports.append((*kind, text))})()
    made.reports = []
    return made


def test_beside_the_window(make, settings, operator):
    from neural_gash_addon.ops import state
    obj = torus(make, smooth=True)
    context = Context()
    area = SimpleNamespace(type="IMAGE_EDITOR", regions=(), spaces=SimpleNamespace(active=SimpleNamespace(image=None)))
    context.window_manager.windows = [SimpleNamespace(screen=SimpleNamespace(areas=[area]))]
    assert operator.invoke(context, None) == {"RUNNING_MODAL"}
    assert _to_the_end(operator, context) == {"FINISHED"}
    assert area.spaces.active.image.get("neural_gash_comparison") and ERRORS in obj.data.attributes
    (kind, text), = operator.reports
    assert kind == "INFO" and "embree 64" in text and "quickest within 2 %" in text or "none of them" in text
    assert context.idle and not state.running


def test_esc_and_changes_meanwhile_leave_everything(make, settings, operator, snapshot):
    obj = torus(make, smooth=True)
    before = snapshot()
    context = Context()
    operator.invoke(context, None)
    assert context.status == "Neural GASh: comparing methods on Ring, 0 %. Esc cancels"
    assert operator.modal(context, TIMER) == {"RUNNING_MODAL"}
    assert operator.modal(context, ESC) == {"CANCELLED"}
    operator._worker.join(60)
    assert snapshot() == before and context.idle
    operator.invoke(context, None)
    obj.data.vertices[0].co.x += 0.5
    obj.data.update()
    assert _to_the_end(operator, context) == {"CANCELLED"}
    assert "changed" in operator.reports[-1][1] and ERRORS not in obj.data.attributes
