# SPDX-License-Identifier: GPL-3.0-or-later
"""Labels beside brute force, and files that are made once, made again when cut, and not used when stale."""
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.errors import UserError
from training import data, labels, solids

RAYS = 16


def skewed_frames(normals: np.ndarray) -> np.ndarray:
    """Some frames about the normals, unlike the motors'."""
    axis = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 0, 1.0]])
    first = np.cross(axis, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, normals, np.cross(first, normals)], 2)


def scene() -> solids.Mesh:
    """A ball between a plate and a bar: 100-odd triangles."""
    plate, bar = solids.box((2, 2, 0.2), (0, 0, -0.8)), solids.box((2, 0.2, 0.2), (0, 0.3, 1))
    return solids.merge([solids.ball(0.5, 1), plate, bar])


def blocked(mesh: solids.Mesh, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Whether each ray (D, 3) meets any triangle: Möller and Trumbore 1997, all against all."""
    a, b, c = (mesh[0][mesh[1][:, k]] for k in range(3))
    e, f, s = b - a, c - a, origin - a
    h = np.cross(directions[:, None], f)
    determinant = (e * h).sum(-1)
    determinant = np.where(np.abs(determinant) < 1e-14, np.nan, determinant)
    u = (s * h).sum(-1) / determinant
    q = np.cross(s, e)
    v = directions @ q.T / determinant
    t = (f * q).sum(-1) / determinant
    return ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)).any(1)


def quadrature(side: int) -> np.ndarray:
    """side**2 directions about +z, by strata of the cosine-weighted hemisphere."""
    u, v = ((np.indices((side, side)).reshape(2, -1) + 0.5) / side)
    return np.stack([np.sqrt(u) * np.cos(2 * np.pi * v), np.sqrt(u) * np.sin(2 * np.pi * v), np.sqrt(1 - u)], 1)


@pytest.mark.parametrize("crease", [None, 0.6])
def test_labels_equal_brute_force(crease):
    positions, triangles = scene()
    sample = labels.label(positions, triangles, crease, name="n", category="c", rays=1024, seed=3, frames=skewed_frames)
    mesh = labels.normalised(positions), triangles
    assert np.array_equal(sample.positions[sample.triangles], mesh[0][triangles].astype(np.float32))
    assert np.ptp(sample.positions, axis=0).max() == pytest.approx(1, abs=1e-6)
    some = np.arange(0, len(sample.positions), 3 if crease is None else 5)
    frames = skewed_frames(sample.normals[some].astype(float))
    local, seen = quadrature(48), []
    for k, frame in zip(some, frames, strict=True):
        # a small step out, and into the point's own faces, whose corners may lie in other planes
        own = sample.positions[sample.triangles[(sample.triangles == k).any(1)]].mean((0, 1))
        origin = sample.positions[k] + 3e-6 * sample.normals[k]
        if crease is not None:
            origin = origin + 3e-5 * (own - sample.positions[k])
        seen.append(~blocked(mesh, origin, sample.directions @ frame.T))
        world = local[:, [0, 2, 1]] @ frame.T  # about e_y
        free = ~blocked(mesh, origin, world)
        twin = (free[:, None] * sh.evaluate(world, labels.ORDER)).mean(0)
        assert sample.coefficients[k] == pytest.approx(twin, abs=0.015)
    # rays that graze the rim of a triangle may go either way in float32
    assert (np.array(seen) == sample.visibility[some]).mean() > 0.995
    assert 0.1 < 1 - sample.visibility.mean() < 0.6  # there is something to see
    assert np.abs(sample.unshadowed - sample.coefficients).max() > 0.2


def test_creases_split_what_is_sharp_only():
    box = solids.refine(solids.box(), 0.3)
    inner = len(box[0])
    assert len(labels.shaded(*box, None).points) == inner
    creased = labels.shaded(*box, 0.5)
    assert np.unique(np.abs(creased.normals).max(1)) == pytest.approx(1)  # flat sides
    on_edges = (np.abs(np.abs(box[0]) - 0.5) < 1e-9).sum(1)  # of how many sides each vertex is part
    assert len(creased.points) == on_edges.sum()
    assert len(labels.shaded(*solids.ball(1, 3), 0.5).points) == len(solids.ball(1, 3)[0])


def test_a_run_goes_on_where_it_was(tmp_path):
    jobs = data.generated(3, 5, RAYS)
    paths, done = data.prepare(jobs, tmp_path, workers=0, quiet=True)
    assert len(done) == len(paths) == 3 and not any(o.problem for o in done)
    before = [labels.load(p) for p in paths]
    assert data.prepare(jobs, tmp_path, workers=0, quiet=True) == (paths, [])
    cut, gone = paths[0], paths[2]
    cut.write_bytes(cut.read_bytes()[:-200])
    gone.unlink()
    again, done = data.prepare(jobs, tmp_path, workers=0, quiet=True)
    assert again == paths and [o.job for o in done] == [jobs[0], jobs[2]]
    for path, old in zip(paths, before, strict=True):
        new = labels.load(path)
        for key in labels.ARRAYS:
            assert np.array_equal(getattr(new, key), getattr(old, key)), key
        assert new.coefficients.shape == (len(new.positions), 25) and new.coefficients.dtype == np.float32
        assert new.visibility.shape == (len(new.positions), 25) and new.visibility.dtype == bool
        assert new.name.startswith(new.category)
    assert not [p for p in tmp_path.iterdir() if p not in paths]  # no drafts are left


def test_other_settings_are_another_file(monkeypatch):
    job = data.generated(1, 0, RAYS)[0]
    names = {job.file_name(), replace(job, rays=48).file_name(), replace(job, frames="a:b").file_name()}
    for module in (data.meshes, data.labels):
        monkeypatch.setattr(module, "VERSION", module.VERSION + 1)
        names.add(job.file_name())
    assert len(names) == 5


def test_a_folder_of_meshes_in_processes(tmp_path):
    folder, cache = tmp_path / "meshes", tmp_path / "cache"
    folder.mkdir()
    solid = trimesh.Trimesh(*solids.torus(1, 0.3, 16, 8), process=False)
    for suffix in data.SUFFIXES:
        solid.export(folder / f"ring{suffix}")
    (folder / "broken.ply").write_text("ply\nno more")
    (folder / "notes.txt").write_text("not a mesh")
    made = data.Job("scatter", 50_000, 16)  # of parts by Blender, whose order may hang on addresses in memory
    jobs = [*data.of_folder(folder, RAYS, "tests.training.test_data:skewed_frames"), made]
    paths, done = data.prepare(jobs, cache, workers=1, quiet=True)
    assert len(jobs) == 5 and len(paths) == 4
    here = data.meshes.generate(made.seed)
    there = labels.load(paths.pop())
    assert there.category == here.category and np.array_equal(there.positions, labels.shaded(
        labels.normalised(here.positions), here.triangles, here.crease).points.astype(np.float32))
    assert [o.job.name for o in done if o.problem] == ["broken"]
    assert {len(labels.load(p).positions) for p in paths} == {len(solid.vertices)}  # .stl welded too
    assert labels.load(paths[0]).category == "file"
    with pytest.raises(UserError, match="There is no"):
        data.of_folder(cache, RAYS)


def test_the_split_is_by_mesh_and_does_not_move(tmp_path):
    paths = [tmp_path / job.file_name() for job in data.generated(400, 0, RAYS)]
    train, held = data.split(paths, 0.2, seed=1)
    assert sorted(train + held) == sorted(paths) and len(held) == pytest.approx(80, abs=25)
    relabelled = [tmp_path / job.file_name() for job in data.generated(200, 0, 2 * RAYS)]
    again = data.split(relabelled, 0.2, seed=1)[1]
    assert [p.name[:-17] for p in again] == [p.name[:-17] for p in paths[:200] if p in held]
    assert data.split(paths, 0.2, seed=2)[1] != held


def test_the_command(tmp_path, capsys):
    assert data.main(["--count", "1", "--seed", "3", "--rays", "16", "--cache", str(tmp_path), "--workers", "0"]) == 0
    assert "1 of 1" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        data.main(["--folder", str(tmp_path / "none")])
