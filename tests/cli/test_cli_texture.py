# SPDX-License-Identifier: GPL-3.0-or-later
"""Texture bakes from the command line; one that is killed goes on where it was."""
from __future__ import annotations

import json
import subprocess
import time

import numpy as np
import OpenImageIO as oiio
import pytest

from .conftest import ROOT, command


def _pixels(folder):
    return [oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT) for path in sorted(folder.glob("*.exr"))]


def test_textures_beside_a_file(run, blend, tmp_path):
    done = run("bake", blend, "--object", "Ring", "--texture", 64, "--rays", 16, "--textures", tmp_path / "maps",
               "--out", tmp_path / "out.blend", "--png", tmp_path / "out.png", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[-1])
    assert (report["target"], report["side"], report["uv_map"], report["order"]) == ("texture", 64, "PRT", 3)
    assert [p.shape for p in _pixels(tmp_path / "maps")] == [(64, 64, 4)] * 3
    assert json.loads((tmp_path / "maps" / "Ring_prt.json").read_text())["rays"] == report["rays"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["maps", "out.blend", "out.png"]
    relit = run("relight", tmp_path / "out.blend", "--object", "Ring", "--png", tmp_path / "relit.png")
    assert relit.returncode == 0, relit.stderr


def test_options_that_do_not_fit_are_refused(refused, blend, tmp_path):
    out = tmp_path / "out.blend"
    assert "--texture" in refused("bake", blend, "--object", "Ring", "--half", "--out", out)
    assert "--npz" in refused("bake", blend, "--object", "Ring", "--texture", 64, "--npz", tmp_path / "a.npz")
    assert "--texture" in refused("bake", blend, "--object", "Ring", "--gloss", "ggx", "--out", out)
    assert "--texture" in refused("bake", blend, "--object", "Ring", "--padding", 4, "--out", out)
    assert "padding" in refused("bake", blend, "--object", "Ring", "--texture", 64, "--padding", 0, "--out", out)
    assert "texels per metre" in refused("bake", blend, "--object", "Ring", "--texture", "0/m", "--out", out)
    assert "resolution" in refused("bake", blend, "--object", "Ring", "--texture", 5, "--out", out)
    assert "no UV map" in refused("bake", blend, "--object", "Ring", "--texture", 64, "--uv-map", "X", "--out", out)
    assert "--uv-map" in refused("bake", blend, "--object", "Ring", "--texture", "9/m", "--uv-map", "X", "--out", out)
    assert not list(tmp_path.iterdir())


def test_the_planner_chooses_the_target(run, refused, blend, tmp_path):
    """A coarse ring wants a texture for what little is inside its faces, and by 0.3 does not."""
    def report(tolerance, *arguments):
        done = run("bake", blend, "--object", "Ring", "--texture", "auto", "--json", "--tolerance", tolerance,
                   *arguments)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1])

    fine, rough = report(0.01, "--half"), report(0.3, "--out", tmp_path / "out.blend", "--textures", tmp_path / "maps")
    assert fine["target"] == "texture" and f"a texture of {fine['side']} has them." in fine["plan"]
    assert rough["target"] == "vertices" and not (tmp_path / "maps").exists()
    assert "--textures" in refused("bake", blend, "--object", "Ring", "--texture", "auto", "--json",
                                   "--textures", tmp_path / "maps")


def test_gloss(run, blend, tmp_path, exr):
    done = run("bake", blend, "--object", "Ring", "--texture", 32, "--rays", 4, "--gloss", "phong",
               "--out", tmp_path / "out.blend", "--png", tmp_path / "baked.exr")
    assert done.returncode == 0, done.stderr
    pictures = {}
    for gloss in ("", "ggx", "phong"):
        to = tmp_path / f"{gloss or 'dull'}.exr"
        done = run("relight", tmp_path / "out.blend", "--object", "Ring", "--png", to,
                   *(("--gloss", gloss) if gloss else ()))
        assert done.returncode == 0, done.stderr
        pictures[gloss] = exr(to)[..., :3]
    baked = exr(tmp_path / "baked.exr")[..., :3]
    np.testing.assert_allclose(pictures["phong"], baked, atol=5e-3)
    added = pictures["phong"] - pictures[""]
    assert added.mean() > 1e-3 and np.abs(pictures["ggx"] - pictures["phong"]).max() > 1e-3


@pytest.mark.parametrize("kills", [2])
def test_a_killed_bake_goes_on_and_gives_the_same_bytes(run, ply, tmp_path, kills):
    def arguments(folder):
        return ("bake", ply, "--texture", 1024, "--order", 2, "--rays", 64, "--textures", folder / "maps", "--json")

    whole, torn = tmp_path / "whole", tmp_path / "torn"
    whole.mkdir()
    torn.mkdir()
    assert run(*arguments(whole)).returncode == 0
    tiles = torn / ".maps-ring.tiles"
    for count in range(1, kills + 1):
        process = subprocess.Popen(command(*arguments(torn)), cwd=ROOT, stdout=subprocess.DEVNULL,
                                   stderr=subprocess.DEVNULL)
        try:
            while len(list(tiles.glob("0*.json"))) < count:
                assert process.poll() is None
                time.sleep(0.02)
        finally:
            process.kill()
            process.wait()
    done = {path: path.stat().st_mtime_ns for path in tiles.glob("0*.json")}
    assert 1 < len(done) < 4 and not (torn / "maps").exists()
    again = run(*arguments(torn))
    assert again.returncode == 0, again.stderr
    for a, b in zip(_pixels(whole / "maps"), _pixels(torn / "maps"), strict=True):
        assert np.array_equal(a, b)
    assert [p.name for p in torn.iterdir()] == ["maps"]


def test_several_objects_share_a_texture_as_large_as_they_need(run, blend, tmp_path):
    done = run("bake", blend, "--object", "Ring", "--object", "Roof", "--object", "No faces", "--texture", "fit",
               "--share", "--order", "2", "--tolerance", "0.1", "--textures", tmp_path / "maps", "--json")
    records = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 2 and "no faces" in done.stderr   # one is named, the others are done
    baked = {r["object"]: r for r in records if "error" not in r}
    assert set(baked) == {"Ring", "Roof"} and baked["Ring"]["side"] == baked["Roof"]["side"]
    assert len(list((tmp_path / "maps").glob("*.exr"))) == 1


def test_density_and_padding(run, blend):
    sides = {}
    for density, padding in ((20, 2), (40, 2), (40, 8)):
        done = run("bake", blend, "--object", "Ring", "--texture", f"{density}/m", "--padding", padding, "--order", 2,
                   "--method", "analytic", "--json")
        sides[density, padding] = json.loads(done.stdout)["side"]
    assert 1.3 * sides[20, 2] < sides[40, 2] < 2.1 * sides[20, 2] and sides[40, 8] > sides[40, 2] + 12


def test_a_tolerance_that_the_file_holds_does_not_count(run, blend, tmp_path):
    out = tmp_path / "a.blend"
    assert run("bake", blend, "--object", "Ring", "--tolerance", 0.3, "--out", out).returncode == 0
    done = run("bake", out, "--object", "Ring", "--texture", 32, "--order", 2, "--json")
    assert json.loads(done.stdout)["tolerance"] == pytest.approx(0.02)


def test_sizes_folders_and_strengths_that_cannot_be_are_said(run, refused, blend, tmp_path):
    out = tmp_path / "out.blend"
    assert "like '50/m', nor 'fit'" in run("bake", blend, "--texture", "big", "--out", out).stderr
    assert "is a file" in refused("bake", blend, "--object", "Ring", "--texture", 64, "--textures", blend, "--out", out)
    assert not list(tmp_path.iterdir())   # no tiles: it was said before the bake
    assert run("bake", blend, "--object", "Ring", "--texture", 64, "--rays", 16, "--out", out).returncode == 0
    assert "strength" in refused("relight", out, "--strength", 1e30, "--png", tmp_path / "a.png")


def test_tiles_of_names_that_differ_only_in_signs_are_kept_apart(tmp_path):
    from types import SimpleNamespace

    from neural_gash_addon.cli_bake import _tiles
    arguments = SimpleNamespace(textures=None, out=tmp_path / "a.blend", npz=None, png=None, texture=64)
    assert len({_tiles(arguments, SimpleNamespace(name=name)) for name in ("a b", "a_b", "a/b")}) == 3
