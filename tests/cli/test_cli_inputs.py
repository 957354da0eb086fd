# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of every kind that the command line takes, whole and broken, and what it says while it works."""
from __future__ import annotations

import json
import os
import subprocess

import numpy as np
import pytest

from .conftest import ROOT, command, ring

bpy = pytest.importorskip("bpy")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A folder with a smooth ring as .obj, .stl and .glb, written by Blender."""
    folder = tmp_path_factory.mktemp("exported")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    data = bpy.data.meshes.new("Ring")
    positions, triangles = ring()
    data.from_pydata(positions.tolist(), [], triangles.tolist())
    data.shade_smooth()
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Ring", data))
    bpy.ops.wm.obj_export(filepath=str(folder / "ring.obj"))
    bpy.ops.wm.stl_export(filepath=str(folder / "ring.stl"))
    bpy.ops.export_scene.gltf(filepath=str(folder / "ring.glb"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return folder


@pytest.mark.parametrize("kind, domain", [(".obj", "POINT"), (".glb", "POINT"), (".stl", "CORNER")])
def test_shading_is_the_files(exported, run, kind, domain, tmp_path):
    """Shaded as the file says; a .stl knows no smooth shading. The normals point outward in Blender's axes."""
    npz = tmp_path / "ring.npz"
    done = run("bake", exported / f"ring{kind}", "--method", "analytic", "--npz", npz, "--json")
    assert done.returncode == 0, done
    report = json.loads(done.stdout)
    assert (report["method"], report["rays"], report["domain"]) == ("analytic", 0, domain)
    with np.load(npz, allow_pickle=False) as data:
        positions, normals = data["positions"], data["normals"]
    assert np.ptp(positions[:, 2]) == pytest.approx(0.9, abs=0.01), "the ring lies in the plane that it lay in"
    round_ = positions * (1, 1, 0)
    outward = positions - round_ / np.linalg.norm(round_, axis=1, keepdims=True)  # from the middle of the tube
    assert (np.einsum("ij,ij->i", outward, normals) > 0).all()


@pytest.mark.parametrize("suffix", ["glb", "ply", "stl", "obj"])
def test_broken_meshes_are_one_sentence(suffix, refused, tmp_path):
    """Importers written in Python answer with a traceback, which is nobody's to read."""
    path = tmp_path / f"broken.{suffix}"
    path.write_bytes(b"glTF\x00garbage")
    assert "Location:" not in refused("bake", path, "--json")


def test_several_meshes_want_a_name(refused, run, tmp_path):
    path = tmp_path / "two.obj"
    path.write_text("o A\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\no B\nv 0 0 1\nv 1 0 1\nv 0 1 1\nf 4 5 6\n")
    assert "A, B" in refused("bake", path, "--json")
    assert json.loads(run("bake", path, "--object", "B", "--rays", 8, "--json").stdout)["object"] == "B"


@pytest.mark.parametrize("option, name", [("--png", "a.jpg"), ("--npz", "a.txt"), ("--out", "a.ply")])
def test_wrong_suffixes_are_said(blend, refused, tmp_path, option, name):
    assert "files, which" in refused("bake", blend, option, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_unwritable_outputs_are_said_before_the_input_is_read(refused, tmp_path):
    (tmp_path / "broken.blend").write_text("no blend")
    assert "cannot be written to" in refused("bake", tmp_path / "broken.blend", "--npz", tmp_path / "none" / "a.npz")


def test_tolerance_is_reached(ply, run):
    report = json.loads(run("bake", ply, "--tolerance", "0.01", "--json").stdout)
    assert report["tolerance"] == pytest.approx(0.01) and 0 < report["error_estimate"] < 0.012


def test_smallest_tolerance_is_taken(ply, run):
    done = run("bake", ply, "--tolerance", "0.0001", "--json")
    assert done.returncode == 0, done.stderr


def test_input_is_overwritten_only_when_named(blend, run, tmp_path):
    path = tmp_path / "own.blend"
    path.write_bytes(blend.read_bytes())
    assert run("bake", path, "--rays", 8, "--json").returncode == 0
    assert path.read_bytes() == blend.read_bytes()
    assert run("bake", path, "--rays", 8, "--out", path).returncode == 0
    bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
    assert "neural_gash" in bpy.data.objects["Ring"].data
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert [p.name for p in tmp_path.iterdir()] == ["own.blend"]  # no drafts, no backups


def test_picture_of_an_object_hidden_from_renders(blend, run, exr, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(blend), load_ui=False)
    bpy.data.objects["Ring"].hide_render = True
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "in.blend"), check_existing=False)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    out = tmp_path / "out.blend"
    assert run("bake", tmp_path / "in.blend", "--rays", 8, "--png", tmp_path / "a.exr", "--out", out).returncode == 0
    picture = exr(tmp_path / "a.exr")
    assert picture.shape == (16, 24, 4) and picture[..., 3].max() == 1
    bpy.ops.wm.open_mainfile(filepath=str(out), load_ui=False)
    assert bpy.data.objects["Ring"].hide_render
    bpy.ops.wm.read_factory_settings(use_empty=True)


def test_bar_reaches_the_end_on_a_terminal(ply):
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    process = subprocess.Popen(command("bake", ply, "--rays", 64, "--json"), cwd=ROOT, stdout=subprocess.PIPE,
                               stderr=theirs)
    os.close(theirs)
    shown = b""
    while True:
        try:
            part = os.read(ours, 1000)
        except OSError:  # how Linux ends a terminal
            break
        if not part:
            break
        shown += part
    out, _ = process.communicate(timeout=60)
    os.close(ours)
    assert process.returncode == 0 and b"100 %" in shown and json.loads(out)["points"]
