# SPDX-License-Identifier: GPL-3.0-or-later
"""What methods take on this machine: calibrated once, refreshed where that proves wrong, and what plans make of it."""
import json
import logging
from dataclasses import replace

import numpy as np
import pytest

from neural_gash_addon.backend import costs, methods, metrics, pilot, plan, progress
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.pilot import DENSE, Pilot
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.backend.workers import spread, workers

from .shapes import cube, torus


class Clock:
    """Stands still but for what takes time."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        return self.now


class Machine:
    """Methods that take so many times what is expected of them, and how often each was run."""

    def __init__(self, clock, **slower):
        self.clock, self.slower = clock, slower
        self.runs = dict.fromkeys(slower, 0)

    def candidates(self, dense=()):
        def candidate(name):
            def bake(mesh, order, **how):
                yield 0.5
                self.runs[name] += 1
                self.clock.now += 0.3 * self.slower[name]
                return None

            def ways(found, points, tolerance, said):
                return [] if name in dense and points < 50_000 else [plan.Plan(name, tolerance=tolerance, seconds=0.3)]

            return plan.Candidate(bake, True, ways)
        return {name: candidate(name) for name in self.slower}


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(progress, "time", made)
    return made


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Of a machine that is not known yet."""
    monkeypatch.setattr(costs, "_SMALL", 500)
    monkeypatch.setattr(costs, "_LARGE", 51_000)
    path = tmp_path / "folder" / "costs.json"
    costs.keep_in(path)
    yield path
    costs.keep_in(None)


def factors(names, threads=1, points=0):
    """What is known of some methods."""
    return [costs.factors(threads, points).get(name, 1.0) for name in names]


def calibrated(candidates, threads=1, points=1000):
    return methods.run(costs.ways(candidates, threads, points))


def test_a_machine_is_calibrated_once_and_it_is_kept(file, clock):
    machine = Machine(clock, slow=2.5, quick=0.5)
    calibrated(machine.candidates())
    assert machine.runs == {"slow": costs._RUNS[0], "quick": costs._RUNS[0]}
    assert factors(["slow", "quick", "other"]) == pytest.approx([2.5, 0.5, 1])
    ways = calibrated(machine.candidates())
    told = [way(None, 1000, 0.1, "") for way in ways.values()]
    assert [(each.method, each.tolerance) for each, in told] == [("slow", 0.1), ("quick", 0.1)]
    assert [each.seconds for each, in told] == pytest.approx([costs._USUAL * 0.3 * 2.5, costs._USUAL * 0.3 * 0.5])
    costs.keep_in(file)  # as when Blender starts again
    assert factors(["slow", "quick"]) == pytest.approx([2.5, 0.5])
    calibrated(machine.candidates())
    assert machine.runs == {"slow": costs._RUNS[0], "quick": costs._RUNS[0]}


def test_another_number_of_threads_and_another_machine_are_calibrated_by_themselves(file, clock, monkeypatch):
    machine = Machine(clock, slow=2.5)
    calibrated(machine.candidates())
    assert factors(["slow"], threads=2) == [1]
    machine.slower["slow"] = 4
    calibrated(machine.candidates(), threads=2)
    assert factors(["slow"]) + factors(["slow"], threads=2) == pytest.approx([2.5, 4])
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(costs.platform, "node", lambda: "another")
        costs.keep_in(file)
        assert factors(["slow"]) == [1]
        machine.slower["slow"] = 0.25
        calibrated(machine.candidates())
    costs.keep_in(file)
    assert factors(["slow"]) + factors(["slow"], threads=2) == pytest.approx([2.5, 4])


def test_dense_meshes_have_factors_of_their_own_before_the_first_of_these(file, clock):
    machine = Machine(clock, slow=2.5, dense=0.5)
    calibrated(machine.candidates(["dense"]))
    assert machine.runs == {"slow": costs._RUNS[0], "dense": 0}
    machine.slower["slow"] = 1.5
    for _ in range(2):
        ways = calibrated(machine.candidates(["dense"]), points=DENSE)
    assert machine.runs == {"slow": sum(costs._RUNS), "dense": costs._RUNS[1]}
    assert factors(["slow", "dense"]) == pytest.approx([2.5, 1])
    assert factors(["slow", "dense"], points=DENSE) == pytest.approx([1.5, 0.5])
    assert ways["slow"](None, DENSE, 0.1, "")[0].seconds == pytest.approx(costs._USUAL * 0.3 * 1.5)
    costs.keep_in(file)
    assert factors(["slow", "dense"], points=DENSE) == pytest.approx([1.5, 0.5])


def test_what_a_method_takes_where_its_constants_are_from_is_no_news(file, clock, monkeypatch):
    monkeypatch.setitem(costs._THERE[0], "slow", 1.25)
    calibrated(Machine(clock, slow=2.5).candidates())
    assert factors(["slow"]) == pytest.approx([2])


def test_other_work_that_meets_some_of_the_runs_is_not_the_machine(file, clock, monkeypatch):
    machine = Machine(clock, slow=2.5, quick=0.5)
    candidates = machine.candidates()
    real = candidates["slow"].bake

    def disturbed(*args, **named):
        clock.now += 0 if named["seed"] in (1, 3) else 7
        return (yield from real(*args, **named))

    monkeypatch.setitem(candidates, "slow", plan.Candidate(disturbed, True, candidates["slow"].ways))
    calibrated(candidates)
    assert factors(["slow", "quick"]) == pytest.approx([2.5, 0.5])


def told(taken, method="slow", threads=1, expected=1.0):
    costs.learn(plan.Plan(method, seconds=expected), threads, taken)


def test_where_it_proves_wrong_the_machine_is_calibrated_again(file, clock):
    """All methods, after five plans in a row that took too long, or too short; then ten, as that was no good."""
    machine = Machine(clock, slow=2.5, quick=0.5)
    calibrated(machine.candidates())
    machine.slower.update(slow=5, quick=0.75)
    for taken in (0.7, 1.4, 2, 2, 2, 2, 1, 2, 2, 2, 2, 0.5, 0.5, 0.5, 0.5, 2, 2, 2, 2):  # as meshes differ
        told(taken)
        calibrated(machine.candidates())
    assert factors(["slow", "quick"]) == pytest.approx([2.5, 0.5])
    costs.keep_in(file)  # what was seen before Blender was closed counts
    told(2, "quick")
    assert factors(["slow", "quick"]) == [1, 1]
    calibrated(machine.candidates())
    assert factors(["slow", "quick"]) == pytest.approx([5, 0.75])
    assert machine.runs == {"slow": 2 * costs._RUNS[0], "quick": 2 * costs._RUNS[0]}
    for _ in range(9):
        told(0.1)
        calibrated(machine.candidates())
    assert machine.runs == {"slow": 2 * costs._RUNS[0], "quick": 2 * costs._RUNS[0]}
    told(0.1)
    costs.keep_in(file)
    calibrated(machine.candidates())
    assert machine.runs == {"slow": 3 * costs._RUNS[0], "quick": 3 * costs._RUNS[0]}


def test_what_is_too_short_or_not_expected_or_of_other_threads_says_nothing(file, clock):
    calibrated(Machine(clock, slow=2.5).candidates())
    for _ in range(20):
        told(1e-2, expected=1e-3)
        told(1.0, "analytic", expected=0.0)
        told(8.0, threads=2)
    assert factors(["slow"]) == pytest.approx([2.5])


def test_without_a_file_nothing_is_calibrated_nor_learned(clock):
    costs.keep_in(None)
    machine = Machine(clock, slow=2.5)
    calibrated(machine.candidates())
    for _ in range(10):
        told(8.0)
    assert machine.runs == {"slow": 0} and factors(["slow"]) == [1]


@pytest.mark.parametrize("content", ["", "{", "[]", '{"version": 4}', '{"version": 4, "machines": 5}',
                                     '{"version": 4, "machines": {"here": 5}}',
                                     '{"version": 4, "machines": {"here": {"1": {"factors": {"slow": 0}}}}}',
                                     '{"version": 4, "machines": {"here": {"1": {"calibrated": null}}}}',
                                     '{"version": 4, "machines": {"here": {"1": {"off": Infinity}}}}',
                                     '{"version": 4, "machines": {"here": {"1": {"off": "0"}}}}',
                                     '{"version": 4, "machines": {"here": {"1": {"again": -1}}}}',
                                     '{"version": 4, "machines": {"here": {"1": {"again": 4000000000}}}}',
                                     '{"version": 4, "machines": {"here": {"one": {}}}}', "[" * 200_000,
                                     '{"version": 4, "machines": {"here": {"1": {"factors": {"slow": "2"}}}}}'])
def test_a_damaged_file_is_replaced(file, clock, caplog, monkeypatch, content):
    monkeypatch.setattr(costs, "_machine", lambda: "here")
    file.parent.mkdir()
    file.write_text(content)
    with caplog.at_level(logging.WARNING):
        costs.keep_in(file)
    assert "calibrated anew" in caplog.text and factors(["slow"]) == [1]
    calibrated(Machine(clock, slow=2.5).candidates())
    costs.keep_in(file)
    assert factors(["slow"]) == pytest.approx([2.5])


def test_a_file_of_another_version_is_not_read(file, clock):
    calibrated(Machine(clock, slow=2.5).candidates())
    file.write_text(json.dumps({**json.loads(file.read_text()), "version": 0}))
    costs.keep_in(file)
    assert factors(["slow"]) == [1]


def test_where_nothing_can_be_written_it_is_known_all_the_same(file, clock, caplog):
    file.parent.write_text("a file where a folder should be")
    with caplog.at_level(logging.WARNING):
        calibrated(Machine(clock, slow=2.5).candidates())
    assert "cannot be kept" in caplog.text and factors(["slow"]) == pytest.approx([2.5])


def test_the_methods_of_the_table_are_calibrated_by_the_first_plan(file):
    mesh = TriangleMesh.from_triangles(*torus(sections=64))
    reference = methods.run(methods.bake(mesh, "embree", rays=2048, seed=9)).coefficients
    shares: list[float] = []
    found = methods.run(methods.bake(mesh, "auto", tolerance=0.05, threads=1), shares.append)
    assert shares.count(0.0) > 10 and shares == sorted(shares)
    known = json.loads(file.read_text())["machines"][costs._machine()]["1"]
    assert known["calibrated"] == [500]
    traced = {name for name, entry in methods.METHODS.items() if entry.traces and entry.ways}
    assert set(known["factors"]) == traced - {"sparse", "hybrid"}  # for which so few points are too few
    assert metrics.rel_l2(found.coefficients, reference) <= 0.0625


def test_dense_meshes_are_calibrated_by_the_methods_of_the_table(file, monkeypatch):
    """Sparse is expected to take something there, or it would keep a factor of 1 beside others that are measured."""
    monkeypatch.setattr(costs, "_LARGE", 67_000)
    methods.run(costs.ways(methods.candidates(), 1, DENSE))
    known = json.loads(file.read_text())["machines"][costs._machine()]["1"]
    traced = {name for name, entry in methods.METHODS.items() if entry.traces and entry.ways}
    assert set(known["dense"]) == traced - set(costs._ALIKE) and set(costs._ALIKE) < traced


def test_plans_follow_what_is_known_of_the_machine(file):
    """The dearest method is not taken, whichever it is."""
    mesh = TriangleMesh.from_triangles(*torus(sections=120))
    first = methods.run(methods.bake(mesh, "auto", tolerance=0.05, threads=1)).record.method
    for method in ("embree", "hybrid"):
        costs._known[1].factors = {"embree": 1.0, "hybrid": 1.0, method: 8.0}
        found = methods.run(methods.bake(mesh, "auto", tolerance=0.05, threads=1)).record
        assert found.method == ("hybrid" if method == "embree" else "embree")
    assert first in ("embree", "hybrid")


def test_calibrating_can_be_cancelled_and_is_not_half_kept(file, clock):
    machine = Machine(clock, slow=2.5, quick=0.5)
    work = costs.ways(machine.candidates(), 1, 1000)
    while machine.runs["slow"] < 1:
        next(work)
    work.close()
    assert not file.exists()
    calibrated(machine.candidates())
    assert factors(["slow", "quick"]) == pytest.approx([2.5, 0.5])


def test_the_mesh_that_is_baked_has_about_the_points_and_shadows():
    for size in (costs._SMALL, 1000):
        mesh = costs._bumpy(size)
        assert 0.95 * size <= len(mesh.points) <= size
    found, open_sky = (methods.run(methods.bake(mesh, name, rays=256)).coefficients for name in ("embree", "analytic"))
    assert 0.2 < np.linalg.norm(open_sky - found) / np.linalg.norm(found) < 0.4
    edges = np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # closed


def test_a_name_that_no_file_can_have_is_met_as_any_that_cannot_be_written(clock, caplog, tmp_path):
    with caplog.at_level(logging.WARNING):
        costs.keep_in(tmp_path / ("long" * 100) / "costs.json")
        calibrated(Machine(clock, slow=2.5).candidates())
    assert "cannot be kept" in caplog.text and factors(["slow"]) == pytest.approx([2.5])
    costs.keep_in(None)


def test_what_is_planned_in_parts_is_not_learned_from(file, monkeypatch):
    told = []
    monkeypatch.setattr(costs, "learn", lambda plan, threads, taken: told.append((plan.method, threads, taken)))
    mesh = TriangleMesh.from_triangles(*torus(sections=64))
    methods.run(methods.bake(mesh, "auto", tolerance=0.05, threads=1, whole=True))
    assert not told
    found = methods.run(methods.bake(mesh, "auto", tolerance=0.05, threads=1)).record
    (method, threads, taken), = told
    assert (method, threads) == (found.method, 1) and 0 < taken < found.seconds


def test_where_nothing_blocks_or_rays_are_given_nothing_is_calibrated(file):
    methods.run(methods.bake(TriangleMesh.from_triangles(*cube(), smooth=False), "auto", tolerance=0.05))
    methods.run(methods.bake(TriangleMesh.from_triangles(*torus()), "auto", rays=8))
    assert not file.exists()


def test_time_between_the_steps_of_a_bake_does_not_count(clock):
    def work():
        for _ in range(5):
            clock.now += 1
            yield 0.5
        return "done"

    stepped = progress.clocked(work())
    for _ in range(5):
        next(stepped)
        clock.now += 10
    with pytest.raises(StopIteration) as end:
        next(stepped)
    assert end.value.value == ("done", 5)


def test_rays_are_expected_to_be_shared_among_threads_where_they_are():
    found = Pilot(0.3, 0.4, 0.03, rays=64, scale=1.0, ray=1e-7, traced=1, sample=(), varies=0.3, turns=1.0, threads=4)
    assert not spread(4, 100 * 10) and found.seconds(100, 10) == pytest.approx(1e-4)
    assert spread(4, 100_000 * 10) and found.seconds(100_000, 10) == pytest.approx(0.025)
    many = replace(found, threads=64)  # of which few have any work
    assert spread(64, 2 ** 15) and many.seconds(2 ** 15, 1) == pytest.approx(1e-7 * 2 ** 14)


@pytest.mark.parametrize("threads, rays, among", [(1, 1e9, 1), (2, 1, 1), (2, 1e9, 2), (64, 1e9, "jobs")],
                         ids=["one", "few rays", "two", "more than there is work for"])
def test_a_pilot_says_what_a_ray_costs_on_one_thread(monkeypatch, threads, rays, among):
    mesh = TriangleMesh.from_triangles(*torus(sections=200))
    scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    jobs = []
    real = pilot.BlockedEstimator.jobs
    monkeypatch.setattr(pilot.BlockedEstimator, "jobs", lambda *of: jobs.append(real(*of)) or jobs[-1])
    monkeypatch.setattr(pilot, "clocked", lambda work: ((yield from work), 1.0))
    with workers(threads, rays) as pool:
        found = methods.run(pilot.look(mesh, scene, 3, 0.01, 0, pool, threads))
    each = pilot.sample_size(len(mesh.points)) * 2 * (pilot.pilot_rays(0.01) + pilot._BESIDES)
    assert 2 < jobs[0] < 64
    assert found.ray * each == pytest.approx(jobs[0] if among == "jobs" else among)
    assert found.threads == found.to_order(2).threads == threads
