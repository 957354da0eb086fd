# SPDX-License-Identifier: GPL-3.0-or-later
"""Many bakes on many machines: each once, the same as by itself, and never again while it is up to date."""
from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from .conftest import ODD, ROOT, command, ring

bpy = pytest.importorskip("bpy")


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """Two .blends of a ring that is flattened from frame 1 to 5, and a box beside it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    data = bpy.data.meshes.new("Ring")
    positions, faces = ring()
    data.from_pydata(positions.tolist(), [], faces.tolist())
    body = bpy.data.objects.new("Ring", data)
    bpy.context.scene.collection.objects.link(body)
    body.shape_key_add(name="Basis")
    flat = body.shape_key_add(name="Flat")
    for point in flat.data:
        point.co.z *= 0.2
    for frame, value in ((1, 0), (5, 1)):
        flat.value = value
        flat.keyframe_insert("value", frame=frame)
    bpy.ops.mesh.primitive_cube_add(location=(4, 0, 0))
    bpy.context.object.name = "Box"
    folder = tmp_path_factory.mktemp("moving")
    for name in ("a", "b"):
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / f"{name}.blend"), check_existing=False)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return folder / "a.blend", folder / "b.blend"


def _many(files, out, *more):
    return ["bake", *files, "--object", "Ring", "--object", "Box", "--frames", "1,5", "--rays", 64, "--npz",
            out / "{file}" / "{object}-{frame}.npz", *more]


def _lines(done):
    return [json.loads(line) for line in done.stdout.splitlines()]


def _names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_two_processes_share_the_work(moving, run, tmp_path):
    """Both at once; together each item once, and every file that of a bake by itself."""
    workers = [subprocess.Popen(command(*_many(moving, tmp_path, "--shard", f"{i}/2")), cwd=ROOT, text=True,
                                stdout=subprocess.PIPE, stderr=subprocess.PIPE) for i in (1, 2)]
    shares = []
    for worker in workers:
        out, err = worker.communicate(timeout=300)
        assert worker.returncode == 0 and not err
        shares.append([json.loads(line) for line in out.splitlines()])
    items = [(e["file"], e["object"], e["frame"]) for share in shares for e in share]
    assert sorted(items) == sorted((str(f), o, n) for f in moving for o in ("Ring", "Box") for n in (1, 5))
    assert [len(share) for share in shares] == [4, 4]
    assert all(e["status"] == "baked" for share in shares for e in share)
    assert all((e["record"]["rays"] > 0) == (e["object"] == "Ring")  # a box is convex: no ray
               for share in shares for e in share)
    kept = [f"{f.stem}/{o}-{n:04d}.npz" for f in moving for o in ("Ring", "Box") for n in (1, 5)]
    assert _names(tmp_path) == sorted(kept + [f"{name}.json" for name in kept])

    alone = tmp_path / "alone.npz"  # of a .blend saved at frame 5
    bpy.ops.wm.open_mainfile(filepath=str(moving[1]))
    bpy.context.scene.frame_set(5)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "at5.blend"), check_existing=False)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert run("bake", tmp_path / "at5.blend", "--object", "Ring", "--rays", 64, "--npz", alone).returncode == 0
    with np.load(alone) as one, np.load(tmp_path / "b" / "Ring-0005.npz") as many, \
            np.load(tmp_path / "b" / "Ring-0001.npz") as other:
        np.testing.assert_array_equal(one["positions"], many["positions"])
        np.testing.assert_array_equal(one["transfer"], many["transfer"])
        assert not np.array_equal(one["transfer"], other["transfer"])


def test_a_worker_that_was_killed_is_gone_on_from(moving, run, tmp_path):
    """Killed in the middle of an item: what was done is up to date, the rest is baked, every file is whole."""
    worker = subprocess.Popen(command(*_many(moving, tmp_path)), cwd=ROOT, text=True, stdout=subprocess.PIPE,
                              stderr=subprocess.DEVNULL)
    done = [json.loads(worker.stdout.readline()) for _ in range(3)]
    worker.kill()
    rest = worker.communicate()[0]
    done += [json.loads(line) for line in rest.splitlines() if line.endswith("}")]
    assert worker.returncode != 0 and 3 <= len(done) < 8
    again = run(*_many(moving, tmp_path))
    assert again.returncode == 0 and not again.stderr
    entries = {(e["file"], e["object"], e["frame"]): e["status"] for e in _lines(again)}
    assert len(entries) == 8
    known = {(e["file"], e["object"], e["frame"]) for e in done}
    assert all(entries[item] == "up to date" for item in known)
    assert sum(status == "baked" for status in entries.values()) in (8 - len(done), 7 - len(done))
    for path in tmp_path.rglob("*.npz"):
        if not path.name.startswith("."):  # a draft of the one that was killed
            with np.load(path) as arrays:
                assert np.isfinite(arrays["transfer"]).all()


def test_what_is_up_to_date_is_left_alone(moving, run, tmp_path):
    """Baked again: another setting, another shape, a file or its state gone or damaged; else not."""
    files, out = [tmp_path / "a.blend"], tmp_path / "out"
    shutil.copy(moving[0], files[0])
    def statuses(*more):
        done = run(*_many(files, out, *more))
        assert done.returncode == 0 and not done.stderr, done
        return [e["status"] for e in _lines(done)]
    assert statuses() == ["baked"] * 4
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    assert statuses() == ["up to date"] * 4
    assert times == {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    (out / "a" / "Ring-0005.npz").unlink()
    (out / "a" / "Box-0001.npz.json").write_text('{"key": 3')
    assert statuses() == ["up to date", "baked", "baked", "up to date"]
    assert statuses("--order", "4") == ["baked"] * 4
    assert statuses("--order", "4") == ["up to date"] * 4
    bpy.ops.wm.open_mainfile(filepath=str(files[0]))
    bpy.data.meshes[bpy.data.objects["Box"].data.name].vertices[0].co.z -= 0.5
    bpy.ops.wm.save_as_mainfile(filepath=str(files[0]), check_existing=False)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert statuses("--order", "4") == ["up to date"] * 2 + ["baked"] * 2


def test_textures_and_blends(moving, run, tmp_path):
    """A .blend holds no other item's bake, and textures that are gone are made again."""
    call = ["bake", moving[0], "--object", "Ring", "--object", "Box", "--shard", "1/1", "--texture", 32, "--rays", 64,
            "--textures", tmp_path / "{object}", "--out", tmp_path / "{object}.blend"]
    assert [e["status"] for e in _lines(run(*call))] == ["baked", "baked"]
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "Box.blend"))
    from neural_gash_addon.scene.attributes import has_bake
    assert has_bake(bpy.data.objects["Box"]) and not has_bake(bpy.data.objects["Ring"])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    next((tmp_path / "Box").glob("*.exr")).unlink()
    assert [e["status"] for e in _lines(run(*call))] == ["up to date", "baked"]


def test_a_failure_is_named_and_the_rest_done(moving, run, tmp_path):
    missing = tmp_path / "missing.blend"
    done = run("bake", missing, moving[0], "--object", "Nobody", "--object", "Box", "--rays", 64, "--npz",
               tmp_path / "{file}-{object}.npz")
    assert done.returncode == 2
    assert [e["status"] for e in _lines(done)] == ["failed"] * 3 + ["baked"]
    assert [e.get("error", "") for e in _lines(done)] == [f"There is no file '{missing}'."] * 2 + [
        "There is no object named 'Nobody' in the scene.", ""]
    assert len(done.stderr.splitlines()) == 3


def test_more_shards_than_items(moving, run, tmp_path):
    done = run("bake", moving[0], "--object", "Box", "--shard", "2/3", "--npz", tmp_path / "x.npz")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("option, value, part", [
    ("--shard", "0/3", "no shard"), ("--shard", "4/3", "no shard"), ("--shard", "a/b", "no shard"),
    ("--frames", "5-1", "end before they begin"), ("--frames", "one", "no frames"),
    ("--frames", "9999999", "no frames beyond")])
def test_bad_numbers(run, moving, tmp_path, option, value, part):
    done = run("bake", moving[0], option, value, "--npz", tmp_path / "x.npz")
    assert done.returncode == 2 and not done.stdout
    assert part in done.stderr.splitlines()[-1]


def test_what_could_not_be_kept(refused, moving, tmp_path):
    a, b = moving
    assert "{file}" in refused("bake", a, b, "--object", "Box", "--npz", tmp_path / "x.npz")
    assert "{object}" in refused("bake", *moving, "--object", "Box", "--object", "Ring", "--npz",
                                 tmp_path / "{file}.npz")
    assert "{frame}" in refused("bake", a, "--object", "Box", "--frames", "1-2", "--npz", tmp_path / "x.npz")
    assert "--frames" in refused("bake", a, "--shard", "1/2", "--npz", tmp_path / "{frame}.npz")
    assert "folders" in refused("bake", a, tmp_path / "a.blend", "--npz", tmp_path / "{file}.npz")
    assert "Nothing" in refused("bake", a, b, "--json")
    assert "--share" in refused("bake", a, b, "--texture", 32, "--share", "--textures", tmp_path / "{file}")
    (tmp_path / "file").write_text("")
    assert "is a file" in refused("bake", a, b, "--npz", tmp_path / "file" / "{file}.npz")
    assert _names(tmp_path) == ["file"]


@pytest.mark.skipif(shutil.which("node") is None, reason="Flamenco's job type is JavaScript; there is no node here")
@pytest.mark.parametrize("frames", ["", "1-3,-7"])
def test_flamenco_tasks(frames):
    """What the job type asks the workers to run is understood as it was meant."""
    from neural_gash_addon.cli import _parser
    settings = {"blendfile": "/farm/a b.blend", "objects": f"-Ring|{ODD}", "frames": frames, "output": "/farm/out/",
                "tolerance": 0.05, "order": 4, "occluders": "visible", "tasks": 3}
    script = (ROOT / "farm" / "neural_gash_bake.js").read_text() + """
        const tasks = [];
        const job = { settings: JSON.parse(process.argv[1]), addTask: (task) => tasks.push(task) };
        const author = {
            Task: (name, type) => ({ name, type, commands: [], addCommand(command) { this.commands.push(command); } }),
            Command: (name, parameters) => ({ name, parameters }),
        };
        compileJob(job);
        console.log(JSON.stringify({ tasks, keys: JOB_TYPE.settings.map((setting) => setting.key) }));"""
    done = subprocess.run(["node", "-e", script, json.dumps(settings)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    made = json.loads(done.stdout)
    assert sorted(made["keys"]) == sorted(settings)
    assert [task["type"] for task in made["tasks"]] == ["blender"] * 3
    for number, task in enumerate(made["tasks"], 1):
        (asked,) = task["commands"]
        assert asked["name"] == "exec" and asked["parameters"]["exe"] == "{blender}"
        assert asked["parameters"]["args"][:2] == ["--command", "neural_gash"]
        found = _parser().parse_args(asked["parameters"]["args"][2:])
        assert found.inputs == ["/farm/a b.blend"] and found.objects == ["-Ring", ODD]
        assert found.shard == (number, 3) and found.frames == ([-7, 1, 2, 3] if frames else None)
        assert (found.tolerance, found.order, found.occluders) == (0.05, 4, "visible")
        assert found.npz == Path("/farm/out/{file}-{object}-{frame}.npz" if frames else "/farm/out/{file}-{object}.npz")


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written(refused, moving, tmp_path):
    tmp_path.chmod(0o500)
    assert "cannot be written" in refused("bake", *moving, "--object", "Box", "--npz", tmp_path / "{file}.npz")
