# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of rooms: their format, that they are made once, and that what they say of the light is true."""
from dataclasses import replace

import numpy as np
import pytest

from neural_gash_addon.backend import irradiance, methods
from neural_gash_addon.backend import spherical_harmonics as sh
from training import floor_plans, room_labels, rooms

SMALL = dict(points=64, queries=48)


def load(path):
    with np.load(path, allow_pickle=False) as found:
        return {key: found[key] for key in found.files}


def test_a_file_holds_what_it_promises(tmp_path):
    jobs = [*room_labels.jobs(2, room_labels.TRAIN, 512, **SMALL),
            *room_labels.jobs(1, room_labels.VALIDATION, 1024, **SMALL)]
    paths, done = room_labels.prepare(jobs, tmp_path, workers=0, quiet=True)
    assert len(paths) == len(done) == 3 and not any(o.problem for o in done)
    for job, path in zip(jobs, paths, strict=True):
        found = load(path)
        assert [found.pop(key).shape for key in room_labels.KEYS] == [
            (64, 12), (64, 3), (room_labels.LOOKS, 64, 3), (room_labels.LOOKS, 64, 25, 3), (48, 9), *[(48, 3)] * 4,
            (48, 25, 3), (48, 5, 3), (), ()]
        assert not found
        found = load(path)
        assert all(found[key].dtype == (np.float16 if key == "point_shape" else np.float32)
                   and np.isfinite(found[key]).all() for key in room_labels.KEYS[:-2])
        for shape, light, close in (("point_shape", "point_indirect", 2e-3), ("shape", "indirect", 1e-5),
                                    ("shape_noise", "indirect_noise", 1e-3)):
            np.testing.assert_allclose(found[shape][..., 0, :], found[light] * sh.normalisation(0, 0), rtol=close,
                                       atol=1e-5)
        assert found["seed"] == job.seed and str(found["split"]) == job.split
        assert found["direct"].max() > 0 and found["indirect"].max() > 0 and (found["indirect_noise"] >= 0).all()
        for points in (found["scene_points"], found["queries"]):
            assert np.linalg.norm(points[:, 3:6], axis=1) == pytest.approx(1, abs=1e-5)
            assert points[:, 6:9].min() >= 0 and points[:, 6:9].max() <= 1
        # a second, independent look with more rays, at both together
        scene = rooms.generate(job.seed)
        asked = found["queries"]
        truth = methods.run(irradiance.irradiance(scene, asked[:, :3], asked[:, 3:6], 4096, seed=77))
        noise = np.sqrt(found["direct_noise"] ** 2 + found["indirect_noise"] ** 2 + truth.error ** 2)
        score = (found["direct"] + found["indirect"] - truth.values) / np.maximum(noise, 1e-6)
        assert np.median(np.abs(score)) < 1.2 and (np.abs(score) < 6).mean() > 0.97
        looks = found["point_indirect"]
        assert np.ptp(looks, axis=0).max() > 0 and np.allclose(looks.mean(1), looks.mean((0, 1)), rtol=2)
    assert load(paths[0])["seed"] != load(paths[2])["seed"]


def test_a_run_goes_on_where_it_was(tmp_path):
    jobs = room_labels.jobs(3, room_labels.TRAIN, 16, **SMALL)
    paths, _ = room_labels.prepare(jobs, tmp_path, workers=0, quiet=True)
    before = [load(path) for path in paths]
    assert room_labels.prepare(jobs, tmp_path, workers=0, quiet=True) == (paths, [])
    paths[0].write_bytes(paths[0].read_bytes()[:-200])
    paths[2].unlink()
    again, done = room_labels.prepare(jobs, tmp_path, workers=1, quiet=True)
    assert again == paths and {o.job for o in done} == {jobs[0], jobs[2]}
    for path, old in zip(paths, before, strict=True):
        new = load(path)
        for key in room_labels.KEYS:
            np.testing.assert_array_equal(new[key], old[key])
    assert not [p for p in tmp_path.iterdir() if p not in paths]


def test_other_settings_are_another_file(monkeypatch):
    job = room_labels.jobs(1, room_labels.TRAIN, 16)[0]
    names = {job.file_name(), replace(job, rays=32).file_name(), replace(job, points=5).file_name(),
             replace(job, queries=5).file_name(), replace(job, split=room_labels.VALIDATION).file_name()}
    for module in (room_labels, rooms):
        monkeypatch.setattr(module, "VERSION", module.VERSION + 1)
        names.add(job.file_name())
    assert len(names) == 7
    seeds = [{job.seed for job in room_labels.jobs(5000, split, 16)} for split in (room_labels.TRAIN,
                                                                                  room_labels.VALIDATION)]
    assert not seeds[0] & seeds[1]


def test_points_that_nobody_sees_are_not_asked():
    """A block sunk into the floor, and one on it with a slit of a millimetre below."""
    room = rooms.Part((rooms.box((4, 4, 3), (0, 0, 1.5))[0], rooms.box((4, 4, 3))[1][:, ::-1]), np.full(3, 0.5))
    sunk = rooms.Part(rooms.box((1, 1, 1), (1, 1, 0.2)), np.full(3, 0.5))
    standing = rooms.Part(rooms.box((1, 1, 1), (-1, -1, 0.501)), np.full(3, 0.5), 1.0)
    scene = rooms.assembled([room, sunk, standing])
    asked = room_labels.visible_points(scene, 4000, 0, scene.occluders())
    x, y, z = asked[:, :3].T
    under_one, under_other = ((np.abs(x - c) < 0.45) & (np.abs(y - c) < 0.45) & (z < 0.002) for c in (1, -1))
    assert len(asked) == 4000 and not under_one.any() and under_other.sum() <= 2
    assert not (z < 0).any()                                       # within the floor
    floor = asked[:, 2] < 1e-6
    assert floor.mean() == pytest.approx(14 / (14 + 16 + 48 + 4 * 0.7 + 1 + 4 + 1), abs=0.02)  # by area


def test_the_command(tmp_path, capsys):
    assert room_labels.main(["--rooms", "1", "--validation", "1", "--rays", "16", "--validation-rays", "16", "--points",
                             "32", "--queries", "16", "--evaluation", "1", "--cache", str(tmp_path), "--workers", "0"
                             ]) == 0
    assert "4 of 4" in capsys.readouterr().out
    found = [load(path) for path in sorted(tmp_path.glob("*.npz"))]
    assert sorted(str(each["split"]) for each in found) == ["evaluation", "evaluation", "train", "validation"]


def test_scenes_of_files_are_labelled(meshes):
    jobs = room_labels.evaluation(0, meshes / "scenes", 64, 512, 256)
    assert len(jobs) == 4
    for job in jobs:
        scene = room_labels.scene_of(job)
        assert np.ptp(scene.positions, axis=0).max() < floor_plans.LARGEST
        found = room_labels.label(scene, seed=job.seed, split=job.split, rays=job.rays, points=job.points,
                                  queries=job.queries)
        assert found["queries"].shape == (256, 9) and np.isfinite(found["indirect"]).all()
        lit = (found["direct"] + found["indirect"]).max(1) > 0
        assert lit.mean() > 0.5, job  # asked on the sides that light reaches
    ours, theirs = (room_labels.scene_of(job) for job in jobs[:2])
    points = np.array([[0.45, 0.3, 0], [0.1, 0.2, 0], [0.001, 0.3, 0.2], [0.28, 0.5592, 0.5]])
    normals = np.array([[0, 0, 1], [0, 0, 1], [1, 0, 0], [0, -1, 0]])
    low = theirs.positions.min(0)
    one, other = (methods.run(irradiance.irradiance(scene, points + shift, normals, 8192)).values
                  for scene, shift in ((ours, 0), (theirs, low)))
    assert one == pytest.approx(other, rel=0.04)   # its light hangs half a millimetre lower
