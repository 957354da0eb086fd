# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake and relight without a window, each in a process of its own."""
from __future__ import annotations

import json
import os
import signal
import subprocess

import numpy as np
import pytest

from .conftest import ODD, ROOT, command, ring

bpy = pytest.importorskip("bpy")


def _names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture(scope="module")
def baked(ply, tmp_path_factory):
    """The .npz of the ring and its process."""
    path = tmp_path_factory.mktemp("baked") / "ring.npz"
    done = subprocess.run(command("bake", ply, "--rays", 64, "--order", 4, "--npz", path, "--json"), cwd=ROOT,
                          capture_output=True, text=True, timeout=300)
    return path, done


@pytest.fixture(scope="module")
def baked_blend(blend, tmp_path_factory):
    """The scene with its ring baked, and a picture of that."""
    folder = tmp_path_factory.mktemp("baked")
    done = subprocess.run(command("bake", blend, "--rays", 64, "--out", folder / "out.blend", "--png",
                                  folder / "out.exr"), cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done
    return folder


def test_npz_is_the_library_call(ply, baked):
    from neural_gash_addon.backend import exchange, methods
    from neural_gash_addon.scene.read import read_object
    path, done = baked
    assert done.returncode == 0 and not done.stderr
    arrays, record = exchange.load_npz(path)
    positions, _ = ring()
    np.testing.assert_array_equal(arrays["positions"], positions.astype(np.float32))  # the vertices, in order
    assert str(arrays["domain"]) == "POINT" and arrays["transfer"].shape == (len(positions), 16)

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.ply_import(filepath=str(ply), forward_axis="Y", up_axis="Z")
    obj = bpy.context.object
    obj.data.shade_smooth()
    mesh = read_object(obj, bpy.context.evaluated_depsgraph_get()).mesh
    expected = methods.run(methods.bake(mesh, "embree", 4, rays=64))
    np.testing.assert_array_equal(arrays["transfer"], expected.coefficients)
    np.testing.assert_array_equal(arrays["normals"], mesh.normals.astype(np.float32))
    assert (record.rays, record.order, record.points) == (expected.record.rays, 4, len(positions))
    bpy.ops.wm.read_factory_settings(use_empty=True)


def test_json_is_one_line(baked):
    from neural_gash_addon.backend.exchange import load_npz
    path, done = baked
    assert done.stdout.count("\n") == 1
    printed = json.loads(done.stdout)
    record = json.loads(load_npz(path)[1].to_json())
    assert printed.pop("object") == "ring" and printed == record
    assert _names(path.parent) == ["ring.npz"]


def test_odd_names_everywhere(blend, run, tmp_path):
    from neural_gash_addon.backend.exchange import load_npz
    out, npz = tmp_path / f"{ODD}.blend", tmp_path / f"{ODD}.npz"
    done = run("bake", blend, "--object", ODD, "--occluders", ODD, "--rays", 64, "--out", out, "--npz", npz)
    assert done.returncode == 0 and not done.stderr and done.stdout.startswith(ODD)
    arrays, record = load_npz(npz)
    assert record.occluders == ODD and str(arrays["domain"]) == "POINT"
    assert (arrays["transfer"][:, 0] < 0.1).all()  # under the roof
    assert _names(tmp_path) == sorted([out.name, npz.name])


@pytest.mark.parametrize("degrees, columns", [(0, 0), (90, -4), (-45, 2)])
def test_relight_npz(baked, sky, run, tmp_path, degrees, columns):
    """Radiance is T . L, and turning the light turns the sky: as its image with the columns moved along."""
    from neural_gash_addon.backend.exchange import load_npz
    from neural_gash_addon.backend.light import project_equirect
    out = tmp_path / "lit.npz"
    path, pixels = sky
    done = run("relight", baked[0], "--hdri", path, f"--rotation={degrees}", "--strength", 2, "--npz", out, "--json")
    assert done.returncode == 0 and not done.stderr and done.stdout.count("\n") == 1
    light = 2 * project_equirect(np.roll(pixels, columns, axis=1), 4)
    np.testing.assert_allclose(json.loads(done.stdout)["light"], light, atol=1e-5)
    arrays = load_npz(baked[0])[0]
    with np.load(out, allow_pickle=False) as lit:
        np.testing.assert_allclose(lit["radiance"], arrays["transfer"] @ light, atol=1e-5)
        np.testing.assert_array_equal(lit["positions"], arrays["positions"])
    assert _names(tmp_path) == ["lit.npz"]


def test_relight_blend_doubles_with_the_strength(baked_blend, run, exr, tmp_path):
    assert _names(baked_blend) == ["out.blend", "out.exr"]
    before = (baked_blend / "out.blend").read_bytes()
    done = run("relight", baked_blend / "out.blend", "--strength", 2, "--rotation", 30, "--png", tmp_path / "lit.exr")
    assert done.returncode == 0 and not done.stderr
    first, second = exr(baked_blend / "out.exr"), exr(tmp_path / "lit.exr")
    inside = (first[..., 3] == 1) & (second[..., 3] == 1)
    assert first.shape == (16, 24, 4) and inside.any() and (first[inside][:, :3] > 0).all()
    np.testing.assert_allclose(second[inside][:, :3], 2 * first[inside][:, :3], rtol=1e-2, atol=1e-3)
    np.testing.assert_allclose(first[inside][:, 2], 4 * first[inside][:, 0], rtol=1e-2, atol=1e-3)  # the World's blue
    assert (baked_blend / "out.blend").read_bytes() == before and _names(tmp_path) == ["lit.exr"]


def test_relight_is_lit_whatever_view_the_file_was_saved_in(baked_blend, run, exr, tmp_path):
    import neural_gash_addon
    neural_gash_addon.register()
    try:
        bpy.ops.wm.open_mainfile(filepath=str(baked_blend / "out.blend"), load_ui=False)
        bpy.context.scene.neural_gash.view = "OCCLUSION"
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "view.blend"), copy=True)
    finally:
        neural_gash_addon.unregister()
        bpy.ops.wm.read_factory_settings(use_empty=True)
    done = run("relight", tmp_path / "view.blend", "--png", tmp_path / "lit.exr")
    assert done.returncode == 0 and not done.stderr
    np.testing.assert_allclose(exr(tmp_path / "lit.exr"), exr(baked_blend / "out.exr"), rtol=1e-2, atol=1e-3)


def test_out_holds_the_bake_and_the_rest(baked_blend):
    from neural_gash_addon.scene.attributes import has_bake, read_transfer
    bpy.ops.wm.open_mainfile(filepath=str(baked_blend / "out.blend"), load_ui=False)
    objects = bpy.context.scene.objects
    assert [o.name for o in objects if has_bake(o)] == ["Ring"] and ODD in objects and "Doubled" in objects
    coefficients, record = read_transfer(objects["Ring"])
    assert record.order == 3 and coefficients.shape == (len(ring()[0]), 9) and coefficients.any()
    assert [s.name for s in bpy.data.scenes] == ["Scene"] and [c.name for c in bpy.data.cameras] == ["Eye"]
    bpy.ops.wm.read_factory_settings(use_empty=True)


def test_missing_hdri_of_the_world_warns(blend, run, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(blend), load_ui=False)
    tree = bpy.context.scene.world.node_tree
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = bpy.data.images.new("gone", 4, 2)
    texture.image.source, texture.image.filepath = "FILE", "//gone.hdr"
    tree.links.new(texture.outputs[0], tree.nodes["Background"].inputs["Color"])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "in.blend"), check_existing=False)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    done = run("bake", tmp_path / "in.blend", "--rays", 8, "--json")
    assert done.returncode == 0 and json.loads(done.stdout)["points"]
    assert len(done.stderr.splitlines()) == 1 and "gone" in done.stderr


def test_modifiers_that_change_topology(blend, run, refused, tmp_path):
    from neural_gash_addon.backend.exchange import load_npz
    npz = tmp_path / "copy.npz"
    arguments = ("bake", blend, "--object", "Doubled", "--rays", 8, "--npz", npz)
    assert "copy" in refused(*arguments) and not _names(tmp_path)
    assert run(*arguments, "--applied-copy").returncode == 0
    assert len(load_npz(npz)[0]["positions"]) == 8


KEEP = "--json"


@pytest.mark.parametrize("word, arguments", [
    ("no file", ("{folder}/missing.blend", KEEP)),
    ("none of", ("{folder}/notes.txt", KEEP)),
    ("cannot be read", ("{folder}/broken.blend", KEEP)),
    ("no object named", ("{blend}", "--object", "Nobody", KEEP)),
    ("not a mesh", ("{blend}", "--object", "Eye", KEEP)),
    ("no faces", ("{blend}", "--object", "No faces", KEEP)),
    ("no collection named", ("{blend}", "--occluders", "Nothing", KEEP)),
    ("would be kept", ("{blend}",)),
    ("tolerance must be", ("{blend}", "--tolerance", "0", KEEP)),
    ("tolerance must be", ("{blend}", "--tolerance", "nan", KEEP)),
    ("rays per point must be", ("{blend}", "--rays", "0", KEEP)),
    ("rays per point must be", ("{blend}", "--rays", "99999999999", KEEP)),
    ("order must be", ("{blend}", "--order", "6", KEEP)),
    ("leave out --bounces", ("{blend}", "--method", "analytic", "--bounces", "2", KEEP)),
    ("leave out --rays", ("{blend}", "--method", "gnn", "--rays", "8", KEEP)),
    ("leave out --rays", ("{blend}", "--method", "embedding", "--rays", "8", KEEP)),
    ("cannot be written to", ("{blend}", "--npz", "{folder}/missing/a.npz")),
    ("cannot be written to", ("{blend}", "--out", "{folder}/notes.txt/a.blend")),
    ("is a folder", ("{blend}", "--png", "{folder}/folder.png")),
    ("writes .blend", ("{blend}", "--out", "{folder}/a.npz")),
])
def test_bad_bakes(word, arguments, blend, refused, tmp_path):
    (tmp_path / "notes.txt").write_text("notes")
    (tmp_path / "broken.blend").write_text("no blend")
    (tmp_path / "folder.png").mkdir()
    before = _names(tmp_path)
    places = {"folder": str(tmp_path), "blend": str(blend)}
    filled = [a.replace("{folder}", places["folder"]).replace("{blend}", places["blend"]) for a in arguments]
    assert word in refused("bake", *filled)
    assert _names(tmp_path) == before


@pytest.mark.parametrize("word, arguments", [
    ("no HDRI file", ("{npz}", "--hdri", "{folder}/missing.hdr", KEEP)),
    ("no bake", ("{folder}/missing.npz", "--hdri", "{sky}", KEEP)),
    ("--hdri", ("{npz}", KEEP)),
    ("no baked object", ("{blend}", KEEP)),
    ("rotation", ("{npz}", "--hdri", "{sky}", "--rotation", "inf", KEEP)),
    ("cannot be", ("{npz}", "--hdri", "{npz}", "--npz", "{folder}/a.npz")),
])
def test_bad_relights(word, arguments, blend, baked, sky, refused, tmp_path):
    places = {"folder": tmp_path, "blend": blend, "npz": baked[0], "sky": sky[0]}
    filled = list(arguments)
    for key, value in places.items():
        filled = [argument.replace(f"{{{key}}}", str(value)) for argument in filled]
    assert word in refused("relight", *filled)
    assert not _names(tmp_path)


def test_usage(run):
    for arguments in ((), ("bake", "a.ply", "--rays", "1", "--tolerance", "0.1")):
        done = run(*arguments)
        assert done.returncode == 2 and "usage" in done.stderr


def _heed_interrupts():
    """In the child: a shell that runs the tests in the background has children ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _half_way(path):
    """A bake of `path` onto itself that takes minutes, begun: on a terminal, which shows its bar."""
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    process = subprocess.Popen(command("bake", path, "--out", path, "--rays", 60000), cwd=ROOT,
                               stdout=subprocess.DEVNULL, stderr=theirs, preexec_fn=_heed_interrupts)
    os.close(theirs)
    shown = b""
    try:
        while b"%" not in shown:
            part = os.read(ours, 1000)
            assert part, shown
            shown += part
    except BaseException:
        process.kill()
        process.wait()
        raise
    assert b"baking [" in shown
    return process, ours


@pytest.mark.parametrize("end, code", [(signal.SIGKILL, -9), (signal.SIGINT, 130)])
def test_stopped_half_way_leaves_the_file(blend, tmp_path, end, code):
    path = tmp_path / "scene.blend"
    before = blend.read_bytes()
    path.write_bytes(before)
    process, terminal = _half_way(path)
    try:
        assert process.poll() is None
        process.send_signal(end)
        assert process.wait(timeout=60) == code
    finally:
        process.kill()
        process.wait()
        os.close(terminal)
    assert path.read_bytes() == before and _names(tmp_path) == ["scene.blend"]
