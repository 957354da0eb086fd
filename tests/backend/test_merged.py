# SPDX-License-Identifier: GPL-3.0-or-later
"""A dense mesh is merged to see whether its shadows matter, before a scene is built that may not be wanted."""
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from neural_gash_addon.backend import auto_bake, merged, methods, pilot
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.raycast import Occluders

from .shapes import cube, grid, sphere


def bumpy(depth, level=6):
    positions, triangles = sphere(level)
    return positions * (1 + depth * np.sin(6 * positions).prod(1, keepdims=True)), triangles


def looked(mesh, scene, tolerance=0.02):
    with ThreadPoolExecutor(1) as pool:
        return methods.run(pilot.look(mesh, scene, 3, tolerance, 0, pool, 1))


@pytest.mark.parametrize("smooth, larger", ((True, 1.1), (False, 2.0)))
@pytest.mark.parametrize("depth", (0.15, 0.25))
def test_shadows_seem_as_large_as_they_are(depth, smooth, larger):
    """Or larger, with flat shading, whose normals are not those of the cells; then they are traced."""
    mesh = TriangleMesh.from_triangles(*bumpy(depth, 6 if smooth else 5), smooth=smooth)
    few = merged.merged(mesh, ())
    assert few.mesh.points.shape == mesh.points.shape and len(few.triangles) < len(mesh.triangles)
    true = looked(mesh, Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)).blocked
    assert true / merged.SAFE < looked(few.mesh, few.scene).blocked < larger * true and true > 0.04


def test_points_move_to_the_mean_of_their_cell(monkeypatch):
    """Against a cell after the other."""
    monkeypatch.setattr(merged, "_MOST", 1 << 20)  # or cells would be larger
    positions, triangles = bumpy(0.2, 4)
    mesh = TriangleMesh.from_triangles(positions, triangles)
    few = merged.merged(mesh, ())
    low, step = positions.min(0), np.ptp(positions, axis=0).max() / merged._CELLS
    cells = [tuple(np.minimum((p - low) // step, merged._CELLS - 1).astype(int)) for p in positions]
    for row in range(0, len(positions), 97):
        of = [p for p, cell in zip(positions, cells, strict=True) if cell == cells[row]]
        np.testing.assert_allclose(few.mesh.points[row], np.mean(of, 0), atol=1e-9)
    kept = sum(len({cells[v] for v in triangle}) == 3 for triangle in triangles)
    assert len(few.triangles) == kept


def test_cells_are_larger_where_they_would_be_many(monkeypatch):
    mesh = TriangleMesh.from_triangles(*bumpy(0.2))
    few = merged.merged(mesh, ())
    monkeypatch.setattr(merged, "_MOST", 1 << 20)
    assert len(merged.merged(mesh, ()).vertices) > 5000
    assert 2500 < len(few.vertices) < 3600  # as asked for, on a surface
    assert len(np.unique(few.mesh.points, axis=0)) == len(few.vertices)


def test_no_scene_is_built_where_shadows_are_less_than_the_tolerance(monkeypatch):
    mesh = TriangleMesh.from_triangles(*bumpy(0.2))
    assert merged.dense(mesh, ())
    with monkeypatch.context() as patched:
        patched.setattr(auto_bake, "Occluders", None)
        for whole in (False, True):
            found = methods.run(methods.bake(mesh, "auto", tolerance=0.2, whole=whole))
            assert found.record.method == "analytic" and "less than the tolerance" in found.record.plan
            assert "inside faces" in found.record.plan and 0 < found.record.error_estimate < 0.2
    truth = methods.run(methods.bake(mesh, "embree", rays=64, seed=4)).coefficients
    error = np.linalg.norm(found.coefficients - truth) / np.linalg.norm(truth)
    assert found.record.error_estimate == pytest.approx(error, rel=0.2)


def test_where_shadows_are_larger_they_are_traced():
    mesh = TriangleMesh.from_triangles(*bumpy(0.3))
    for whole in (False, True):
        found = methods.run(methods.bake(mesh, "auto", tolerance=0.1, whole=whole))
        assert found.record.method != "analytic" and found.record.rays > 0


def test_what_else_blocks_counts():
    mesh = TriangleMesh.from_triangles(*grid(130))
    ball, roof = sphere(6), cube(subdivisions=0)
    small = (0.02 * ball[0] + [0.5, 0.5, 0.05], ball[1])
    large = (roof[0] * [0.5, 0.5, 0.05] + [0.5, 0.5, 0.3], roof[1])
    assert methods.run(methods.bake(mesh, "auto", tolerance=0.2, occluders=[small])).record.method == "analytic"
    assert methods.run(methods.bake(mesh, "auto", tolerance=0.2, occluders=[small, large])).record.method != "analytic"


def test_a_mesh_of_which_nothing_is_left_is_not_merged():
    positions, triangles = grid(2)
    far = np.concatenate([1e-6 * positions, [[1.0, 1, 1]]])
    assert merged.merged(TriangleMesh.from_triangles(far, triangles), ()) is None
