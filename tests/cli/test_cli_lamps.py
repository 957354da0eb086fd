# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps on the command line."""
from __future__ import annotations

import json
import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    """A .blend of a floor under a small lamp of 30 W, 2 m above it, and a spot; the World is black."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    data = bpy.data.meshes.new("Floor")
    data.from_pydata([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (0, 0, 0)], [],
                     [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)])
    data.shade_smooth()
    scene = bpy.context.scene
    scene.collection.objects.link(bpy.data.objects.new("Floor", data))
    for kind in ("AREA", "SPOT"):
        lamp = bpy.data.lights.new(kind, kind)
        lamp.energy = 30
        if kind == "AREA":
            lamp.size, lamp.spread = 0.01, math.pi
        obj = bpy.data.objects.new(kind, lamp)
        obj.location.z = 2
        scene.collection.objects.link(obj)
    scene.world = bpy.data.worlds.new("Black")
    scene.world.color = (0, 0, 0)
    eye = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    eye.data.type, eye.data.ortho_scale, eye.location.z = "ORTHO", 0.02, 1
    scene.collection.objects.link(eye)
    scene.camera = eye
    scene.render.resolution_x = scene.render.resolution_y = 4
    path = tmp_path_factory.mktemp("lit") / "lit.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), check_existing=False)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return path


def test_irradiance_is_in_the_npz_the_picture_and_what_is_relit(lit, run, exr, sky, tmp_path):
    from neural_gash_addon.backend.exchange import load_npz
    npz, png, blend = tmp_path / "a.npz", tmp_path / "a.exr", tmp_path / "a.blend"
    done = run("bake", lit, "--lamps", "--method", "analytic", "--npz", npz, "--png", png, "--out", blend, "--json")
    assert done.returncode == 0, done
    arrays, record = load_npz(npz)
    printed = json.loads(done.stdout.splitlines()[-1])
    assert printed["lamps"] == record.lamps != "" and printed["lamps_notice"] == "1 spot lamp is left out."
    distances = np.linalg.norm(arrays["positions"] - (0, 0, 2), axis=1)
    expected = 30 / np.pi * 4 / distances ** 4  # I cos^2 / d^2, with both cosines 2 / d
    np.testing.assert_allclose(arrays["irradiance"], np.repeat(expected[:, None], 3, 1), rtol=0.03)
    np.testing.assert_allclose(exr(png)[..., :3], 0.8 * 30 / np.pi / 4 / np.pi, rtol=0.03)
    light, _ = sky(0) if callable(sky) else sky
    assert run("relight", npz, "--hdri", light, "--npz", tmp_path / "b.npz").returncode == 0
    with np.load(tmp_path / "b.npz", allow_pickle=False) as relit:
        from neural_gash_addon.backend.shading import radiance
        lit_by_sky = radiance(arrays["transfer"], relit["light"])
        np.testing.assert_allclose(relit["radiance"], lit_by_sky + arrays["irradiance"] / np.pi, rtol=1e-5)
    again = tmp_path / "c.exr"
    assert run("relight", blend, "--png", again).returncode == 0
    np.testing.assert_allclose(exr(again), exr(png), rtol=1e-4)


def test_without_the_flag_there_is_none(lit, run, tmp_path):
    npz = tmp_path / "a.npz"
    assert run("bake", lit, "--method", "analytic", "--npz", npz).returncode == 0
    with np.load(npz, allow_pickle=False) as data:
        assert "irradiance" not in data.files


def test_the_network_is_asked_for_by_a_flag(lit, run):
    pytest.importorskip("torch", reason="the network needs torch")
    done = run("bake", lit, "--lamps-network", "--method", "analytic", "--json")
    assert done.returncode == 0, done
    printed = json.loads(done.stdout.splitlines()[-1])
    assert printed["lamps_error"] > 0 and printed["lamps_rays"] == 128 * printed["points"]


def test_textures_have_one_more(lit, run, tmp_path):
    done = run("bake", lit, "--lamps", "--rays", 8, "--texture", 16, "--textures", tmp_path)
    assert done.returncode == 0 and "lamps with 8 paths a point" in done.stdout, done
    assert (tmp_path / "Floor_prt_lamps.exr").exists()


def test_a_second_farm_run_is_up_to_date_until_a_lamp_changes(lit, run, tmp_path):
    arguments = ("bake", lit, "--frames", "1", "--method", "analytic", "--npz", tmp_path / "a.npz")

    def status(*more):
        return json.loads(run(*arguments, *more).stdout.splitlines()[-1])["status"]

    assert [status("--lamps"), status("--lamps"), status(), status("--lamps")] == [
        "baked", "up to date", "baked", "baked"]


def test_gloss_shows_lamps_if_it_is_asked_for_when_they_are_baked(lit, run, refused, tmp_path):
    for name, more in (("dull", ()), ("glossy", ("--gloss", "ggx"))):
        run("bake", lit, "--lamps", "--texture", 16, "--rays", 32, *more, "--out", tmp_path / f"{name}.blend")
    said = refused("relight", tmp_path / "dull.blend", "--gloss", "ggx", "--png", tmp_path / "a.png")
    assert "baked with --gloss" in said
    run("relight", tmp_path / "glossy.blend", "--gloss", "ggx", "--png", tmp_path / "a.png")
