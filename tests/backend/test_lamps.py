# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance beside transfer: closed forms, to a tolerance, at vertices and texels, and through files."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from neural_gash_addon.backend import exchange, methods
from neural_gash_addon.backend import irradiance as paths
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.geometry import Surface, TriangleMesh
from neural_gash_addon.backend.lamps import MOST, Lamps, relative
from neural_gash_addon.backend.lit_scene import LitScene
from neural_gash_addon.backend.texture import bake as bake_texture
from neural_gash_addon.backend.texture import merged

from .test_irradiance import ceiling, corner_factor, quad, run, scene_of, textured_box

FLOOR = quad((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0))


def lit_floor(bodiless, albedo=0.0):
    """A floor under a square of 1 m, 1 m above it, that sends 2, 4 and 8 W/(m^2 sr) down."""
    scene = scene_of((*FLOOR, albedo, 0), (*ceiling(0.5, 1.0), 0.5, (2, 4, 8)), front_only=np.ones(4, bool))
    return replace(scene, bodiless=2 if bodiless else 0)


def floor_mesh():
    return TriangleMesh.from_triangles(*FLOOR)


def surface():
    corners = np.arange(6, dtype=np.int32).reshape(2, 3)
    return Surface(FLOOR[0], FLOOR[1].ravel().astype(np.int32), np.tile([0, 0, 1.0], (6, 1)).astype(np.float32),
                   np.repeat(np.arange(2, dtype=np.int32), 3), corners, 1e-7)


@pytest.mark.parametrize("bodiless", [False, True])
def test_below_a_square_lamp_is_the_form_factor(bodiless):
    found = run(lit_floor(bodiless), [[0, 0, 0], [0.5, 0.5, 0]], [[0, 0, 1], [0, 0, 1]], 4096)
    factors = 4 * corner_factor(0.5, 0.5), corner_factor(1, 1)
    np.testing.assert_allclose(found.values, np.pi * np.outer(factors, [2, 4, 8]), rtol=5e-3)


def test_what_has_no_body_blocks_and_reflects_nothing():
    """A lamp on the floor lights a ceiling through another that is between."""
    up = [[0, 0, 0.0]], [[0, 0, 1.0]]
    emitter = (*ceiling(0.5, 2.0), 0.0, 1)
    between = (*ceiling(2.0, 1.0), 0.9, 1e-9)
    scene = scene_of((*FLOOR, 0.9, 0), emitter, between, front_only=np.ones(6, bool))
    free = run(replace(scene, bodiless=2), *up, 4096)
    assert not run(scene, *up, 512).values.max() > 1e-6
    assert free.values == pytest.approx(np.pi * 4 * corner_factor(0.25, 0.25), rel=5e-3)
    with pytest.raises(UserError, match="no faces"):
        replace(scene, bodiless=6)


def test_a_room_with_a_lamp_without_a_body_is_that_with_one_where_nothing_is_behind_it():
    """Set into the ceiling, a black lamp that blocks and one that does not are alike but for that ceiling."""
    solid = textured_box()
    albedo = solid.albedo.copy()
    albedo[-2:] = 0
    solid = replace(solid, albedo=albedo)
    points, normals = [[-0.3, -0.2, -0.5], [-0.5, 0.1, 0]], [[0, 0, 1], [1, 0, 0]]
    a, b = (run(scene, points, normals, 16384) for scene in (solid, replace(solid, bodiless=2)))
    assert (b.values >= a.values - 4 * np.hypot(a.error, b.error)).all()
    np.testing.assert_allclose(a.values, b.values, rtol=0.03)


@pytest.mark.parametrize("tolerance", [0.1, 0.01])
def test_the_tolerance_is_met_and_no_path_wasted(tolerance):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.45, 0.45, (200, 2)), np.full(200, -0.5)])
    scene = textured_box()
    lamps = Lamps(scene, "key", tolerance=tolerance)
    mesh = replace(floor_mesh(), points=points, normals=np.tile([0, 0, 1.0], (200, 1)),
                   clearance=np.tile([0, 0, 1.0], (200, 1)))
    work, progress = methods.bake(mesh, "analytic", 3, lamps=lamps), []
    transfer = methods.run(work, progress.append)
    truth = run(scene, points, mesh.normals, 16384, seed=9).values
    error = np.linalg.norm(transfer.irradiance - truth) / np.linalg.norm(truth)
    record = transfer.record
    assert record.lamps_error <= tolerance and error < 1.5 * tolerance
    assert record.lamps_error > 0.3 * tolerance and record.lamps_rays <= MOST * 200
    assert record.lamps == "key" and "E / pi" in record.basis
    assert progress == sorted(progress) and progress[-1] <= 1 + 1e-9
    again = methods.run(methods.bake(mesh, "analytic", 3, lamps=lamps))
    np.testing.assert_array_equal(again.irradiance, transfer.irradiance)


def test_a_number_of_rays_is_that_many_paths():
    transfer = methods.run(methods.bake(floor_mesh(), "embree", 3, rays=20, lamps=Lamps(lit_floor(True), "k", rays=20)))
    assert transfer.record.lamps_rays == 24 * 4  # a multiple of the batches that tell the error
    assert transfer.irradiance.shape == (4, 3)


def test_where_nothing_emits_it_is_zero_and_said():
    dark = replace(lit_floor(False), emission=np.zeros((4, 3)))
    transfer = methods.run(methods.bake(floor_mesh(), "analytic", 3, lamps=Lamps(dark, "k", "One more.")))
    assert not transfer.irradiance.any() and transfer.record.lamps_error == 0
    assert transfer.record.lamps_notice == f"{paths.DARK} One more."


def test_vertices_and_texels_agree(tmp_path):
    lamps = Lamps(lit_floor(True, 0.5), "k", tolerance=0.01)
    uv = (FLOOR[0][FLOOR[1].ravel()][:, :2] + 1) / 2
    kwargs = {"order": 3, "uv": uv, "side": 32, "lamps": lamps}
    whole = methods.run(bake_texture(surface(), "analytic", **kwargs))
    image = whole.image(3, whole.fill_map()).reshape(32, 32, 4)
    assert (whole.record.terms, whole.record.numbers, whole.record.lamps_error < 0.01) == (9, 12, True)
    y, x = np.mgrid[1:32:6, 1:32:6]
    points = np.stack([(x + 0.5) / 16 - 1, (y + 0.5) / 16 - 1, 0 * x], -1).reshape(-1, 3)
    at_points = run(lamps.scene, points, np.tile([0, 0, 1.0], (len(points), 1)), 4096)
    np.testing.assert_allclose(image[y, x, :3].reshape(-1, 3), at_points.values, rtol=0.05)
    # a bake that was killed goes on from its tiles
    kept = methods.run(bake_texture(surface(), "analytic", folder=tmp_path, key="a", **kwargs))
    resumed = methods.run(bake_texture(surface(), "analytic", folder=tmp_path, key="a", **kwargs))
    np.testing.assert_array_equal(kept.irradiance[0], resumed.irradiance[0])
    np.testing.assert_array_equal(kept.irradiance[0], whole.irradiance[0])
    both = merged([whole, whole])
    assert both.record.lamps_rays == 2 * whole.record.lamps_rays
    assert both.record.lamps_error == pytest.approx(whole.record.lamps_error)
    np.testing.assert_array_equal(both.image(3, both.fill_map())[:, :3], whole.image(3, whole.fill_map())[:, :3])


def test_a_file_holds_it(tmp_path):
    mesh = floor_mesh()
    transfer = methods.run(methods.bake(mesh, "analytic", 3, lamps=Lamps(lit_floor(True), "k", rays=64)))
    exchange.save_npz(tmp_path / "a.npz", mesh, transfer)
    arrays, record = exchange.load_npz(tmp_path / "a.npz")
    np.testing.assert_array_equal(arrays["irradiance"], transfer.irradiance)
    assert record == transfer.record
    exchange.save_npz(tmp_path / "b.npz", mesh, replace(transfer, irradiance=np.zeros((3, 3), np.float32)))
    with pytest.raises(UserError):
        exchange.load_npz(tmp_path / "b.npz")


def test_relative_error_of_nothing_is_nothing():
    assert relative(paths.Irradiance(np.zeros((2, 3), np.float32), np.zeros((2, 3), np.float32))) == 0


def test_emission_that_is_no_number_is_refused():
    scene = lit_floor(False)
    with pytest.raises(UserError, match="emission"):
        LitScene(scene.positions, scene.triangles, scene.albedo, np.full((4, 3), np.nan))
