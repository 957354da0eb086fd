# SPDX-License-Identifier: GPL-3.0-or-later
"""Comparing methods on one mesh: what is measured is what the bakes give, and a reference knows its own noise."""
from dataclasses import replace

import numpy as np
import pytest

from neural_gash_addon.backend import compare, light, methods, metrics
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.compare import Setting
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.geometry import TriangleMesh

from . import shapes

ORDER = 3


@pytest.fixture(scope="module")
def torus():
    return TriangleMesh.from_triangles(*shapes.torus(sections=16))


@pytest.fixture(scope="module")
def truth(torus):
    rows = compare.sample(len(torus.points), 100, 7)
    assert len(rows) == 100 and (np.diff(rows) > 0).all()
    return methods.run(compare.reference(torus, ORDER, rows, seed=7))


def sky():
    return light.sun(np.array([0.6, 0, 0.8]), np.array([3.0, 2, 1]), 5) + light.constant(np.ones(3), 5)


def test_every_method_of_the_table_appears(monkeypatch):
    monkeypatch.setitem(methods.METHODS, "later", replace(methods.METHODS["embree"], name="later"))
    found = compare.settings_of(ORDER, (2, 4), tolerances=(0.1,))
    assert {s.method for s in found} == set(methods.METHODS)
    assert [s.rays for s in found if s.method == "later"] == [2, 4]
    assert [s.rays for s in found if s.method == "gnn"] == [None]
    assert [(s.rays, s.tolerance) for s in found if s.method == "auto"] == [(None, 0.1)]  # what it plans by


def test_measured_is_what_the_bakes_give(torus, truth):
    lamps = [sky(), light.constant(np.ones(3), 5)]
    chosen = [Setting("analytic", ORDER), Setting("embree", ORDER, 16, threads=1), compare.baseline(ORDER, 1)]
    found = methods.run(compare.compare(compare.vertex_bake(torus), chosen, truth, lamps, rounds=3, seed=20))
    assert [m.setting for m in found] == chosen
    plain = [methods.run(methods.bake(torus, "embree", ORDER, rays=16, seed=20 + n)) for n in range(3)]
    own = [p.coefficients[truth.rows] for p in plain]
    assert found[1].srr == pytest.approx(np.median([metrics.srr(t, truth.transfer, truth.unshadowed) for t in own]))
    assert found[1].rel_l2 == pytest.approx(np.median([metrics.rel_l2(t, truth.transfer) for t in own]))
    relit = [[metrics.relit_error(t, truth.transfer, lamp[:9]) for lamp in lamps] for t in own]
    assert found[1].relit_worst == pytest.approx(np.median(np.max(relit, axis=1)))
    assert found[1].relit_mean == pytest.approx(np.median(np.mean(relit, axis=1)))
    assert found[1].claimed == pytest.approx(np.median([p.record.error_estimate for p in plain]))
    assert found[0].srr == pytest.approx(1) and found[0].claimed is None
    assert found[2].ratio == 1 and len(found[1].seconds) == 3 and min(found[1].seconds) > 0
    rms = np.sqrt(np.square(found[1].errors).mean())  # errors of points are parts of the same whole
    assert rms == pytest.approx(metrics.rel_l2(own[0], truth.transfer))


def test_a_reference_knows_its_noise(torus, truth):
    """Against a trace with 16 times its rays, whose own noise is far below."""
    better = methods.run(compare.reference(torus, ORDER, truth.rows, seed=99, rays=16 * 4096)).transfer
    floor = truth.floor([sky()])
    assert metrics.rel_l2(truth.transfer, better) == pytest.approx(floor["rel_l2"], rel=0.5)
    assert metrics.srr(truth.transfer, better, truth.unshadowed) == pytest.approx(floor["srr"], rel=0.8)
    assert metrics.relit_error(truth.transfer, better, sky()[:9]) == pytest.approx(floor["relit_mean"], rel=0.8)
    assert 0 < floor["rel_l2"] < 0.003


def test_what_is_refused_says_so_and_the_others_go_on(torus, truth):
    chosen = [Setting("mlp", 5), Setting("embree", ORDER, 0), compare.baseline(ORDER)]
    found = methods.run(compare.compare(compare.vertex_bake(torus), chosen, truth, [], rounds=1))
    assert "orders up to 3" in found[0].refused and "1 to" in found[1].refused and not found[2].refused
    assert np.isnan(found[0].median) and found[0].errors is None and found[2].srr < 0.1


def test_openness_alone_is_measured_as_that(torus, truth):
    def bake(setting, seed):
        yield 0.5
        if setting.method == "one":
            return sh.cosine_lobe(torus.normals, ORDER)[:, :1], None
        raise UserError("Not this one.")

    one, other = methods.run(compare.compare(bake, [Setting("one", ORDER), Setting("other", ORDER)], truth, [sky()], 1))
    assert one.openness == pytest.approx(metrics.rel_l2(truth.unshadowed[:, :1], truth.transfer[:, :1]))
    assert np.isnan(one.srr) and np.isnan(one.relit_mean) and other.refused == "Not this one."


def test_closing_it_closes_the_bake(truth):
    closed = []

    def bake(setting, seed):
        try:
            while True:
                yield 0.5
        finally:
            closed.append(setting)

    work = compare.compare(bake, [Setting("analytic", ORDER)], truth, [], 1)
    shares = [next(work) for _ in range(4)]
    assert shares == sorted(shares) and 0 <= shares[-1] < 1
    work.close()
    assert closed == [Setting("analytic", ORDER)]


def test_front_is_what_nothing_beats():
    rng = np.random.default_rng(3)
    times, errors = rng.random(60).round(1) + 0.1, rng.random(60).round(1)
    errors[5] = np.nan
    found = compare.front([*map(float, times)], [*map(float, errors)])

    def beaten(i):
        return any((times[j] <= times[i] and errors[j] <= errors[i]) and (times[j] < times[i] or errors[j] < errors[i])
                   for j in range(60))

    plain = {(times[i], errors[i]) for i in range(60) if not np.isnan(errors[i]) and not beaten(i)}
    assert {(times[i], errors[i]) for i in found} == plain and len(found) == len(plain)
    assert [times[i] for i in found] == sorted(times[i] for i in found)
