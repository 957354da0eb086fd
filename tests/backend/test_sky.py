# SPDX-License-Identifier: GPL-3.0-or-later
"""The embedding for the light of the sky: what holds by construction, and what was learned."""
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch")

from neural_gash_addon.backend import methods, sky_bake, weights  # noqa: E402
from neural_gash_addon.backend import spherical_harmonics as sh  # noqa: E402
from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.backend.geometry import TriangleMesh  # noqa: E402
from neural_gash_addon.backend.hybrid import FULL  # noqa: E402
from neural_gash_addon.backend.networks import sky as networks  # noqa: E402
from neural_gash_addon.backend.networks.embedding import Settings  # noqa: E402
from neural_gash_addon.backend.progress import run  # noqa: E402
from neural_gash_addon.backend.raycast import Occluders  # noqa: E402
from neural_gash_addon.backend.sky_bake import ScenePoints, Sky, joined, split  # noqa: E402

TINY = Settings(first=32, widths=(32,), hidden=16, patch=64)
IDENTITY = np.eye(3)


def torus(rows=24, columns=16, small=0.4):
    u, v = (each.ravel() for each in np.meshgrid(np.arange(rows) * 2 * np.pi / rows,
                                                 np.arange(columns) * 2 * np.pi / columns, indexing="ij"))
    out = 1 + small * np.cos(v)
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (i, np.roll(i, -1, 0), np.roll(i, -1, (0, 1)), np.roll(i, -1, 1)))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return TriangleMesh.from_triangles(np.stack([out * np.cos(u), out * np.sin(u), small * np.sin(v)], 1), triangles)


def moved(mesh, matrix=IDENTITY, offset=0.0):
    return TriangleMesh.from_triangles(mesh.positions @ np.asarray(matrix).T + offset, mesh.triangles)


def trained(seed=0):
    """A network whose weights are anything, so that nothing holds by chance."""
    torch.manual_seed(seed)
    model = networks.SkyEmbedding(TINY)
    with torch.no_grad():
        for value in model.parameters():
            value += 0.1 * torch.randn_like(value)
    return model.eval()


def points_of(mesh, count=256):
    occluders = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    return occluders, run(sky_bake.scene_points(mesh, occluders, count, 64, threads=1))


def bake(mesh, order=3, **how):
    return methods.run(methods.bake(mesh, "embedding", order, **how))


def test_splitting_is_exact_where_all_is_blocked_and_is_undone():
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    whole = sh.cosine_lobe(normals, 5)
    found = split(whole, normals)
    np.testing.assert_allclose(found[:, 0], FULL, rtol=1e-6)
    np.testing.assert_allclose(found[:, 1:], 0, atol=1e-6)
    some = np.random.default_rng(1).normal(size=(50, 25))
    np.testing.assert_allclose(joined(split(some, normals), normals), some, atol=1e-5)


def test_scene_points_are_of_the_surface_by_area_with_what_is_blocked_there():
    mesh = torus()
    occluders, points = points_of(mesh)
    assert len(points.places) == 256 and points.blocked.shape == (256, 25)
    places = points.places / sky_bake.embedding.EXTENT / occluders.scale + occluders.centre
    across = np.hypot(places[:, 0], places[:, 1])
    assert np.abs(np.hypot(across - 1, places[:, 2]) - 0.4).max() < 0.03
    # Pappus: the outer half of the area has 0.5 + r / (pi R) of it
    assert (across > 1).mean() == pytest.approx(0.5 + 0.4 / np.pi, abs=0.04)
    inner = across < 0.75
    assert points.blocked[inner, 0].mean() > 10 * points.blocked[across > 1.2, 0].mean()
    nothing = TriangleMesh.from_triangles(np.zeros((3, 3)) + [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
                                          np.array([[0, 1, 2]], np.int32))
    assert len(sky_bake.on_surface(nothing, 16, 0).points) == 0


@pytest.mark.parametrize("matrix, offset", [(Rotation.random(random_state=2).as_matrix(), 0.0), (IDENTITY, 300.0),
                                            (1000 * IDENTITY, 0.0)], ids=["turned", "moved", "larger"])
def test_the_answer_turns_with_the_scene(matrix, offset):
    model, mesh = trained(), torus()
    occluders, points = points_of(mesh)
    other = moved(mesh, matrix, offset)
    seen = Occluders([(other.positions, other.triangles)], other.resolution)
    rotation = matrix / np.cbrt(np.linalg.det(matrix))
    blocked = joined(points.blocked, points.normals)
    turned = sh.rotate_each(blocked.astype(np.float64), np.broadcast_to(rotation, (len(blocked), 3, 3)))
    normals = points.normals @ rotation.T
    metres = points.places / sky_bake.embedding.EXTENT / occluders.scale + occluders.centre
    again = ScenePoints(sky_bake.in_scale(metres @ np.asarray(matrix).T + offset, seen), normals.astype(np.float32),
                        split(turned, normals), 64)
    # the box of a turned mesh is another, and so is what is a length of one
    again = ScenePoints(again.places, again.normals, again.blocked, 64)
    one = Sky(model, occluders, points).blocked(mesh.points, mesh.normals, 5)
    two = Sky(model, seen, again).blocked(other.points, other.normals, 5)
    back = sh.rotate_each(two.astype(np.float64), np.broadcast_to(rotation.T, (len(two), 3, 3)))
    np.testing.assert_allclose(back, one, atol=1e-4 if offset == 0 else 1e-3)


def test_before_training_it_is_a_mean_of_scene_points():
    model = networks.SkyEmbedding(TINY).eval()
    occluders, points = points_of(torus())
    even = ScenePoints(points.places, points.normals, np.full_like(points.blocked, 0.1), 64)
    mesh = torus()
    found = split(Sky(model, occluders, even).blocked(mesh.points, mesh.normals, 5), mesh.normals)
    np.testing.assert_allclose(found, 0.1, rtol=1e-4)


def test_a_bake_is_the_same_in_any_order_in_chunks_and_on_any_threads(shipped, monkeypatch):
    mesh = torus()
    whole = bake(mesh, threads=1)
    count = sky_bake.count_of(mesh, Occluders([(mesh.positions, mesh.triangles)]))
    assert whole.record.method == "embedding" and whole.record.rays == count * sky_bake.RAYS
    np.testing.assert_allclose(bake(mesh, threads=2).coefficients, whole.coefficients, atol=1e-5)
    monkeypatch.setattr(sky_bake, "QUERIES_AT_ONCE", 50)
    np.testing.assert_allclose(bake(mesh, threads=1).coefficients, whole.coefficients, atol=1e-5)
    rows = np.random.default_rng(3).permutation(len(mesh.points))
    inverse = np.argsort(rows).astype(np.int32)
    other = TriangleMesh.from_triangles(mesh.positions[rows], inverse[mesh.triangles])
    np.testing.assert_allclose(bake(other, threads=1).coefficients, whole.coefficients[rows], atol=1e-5)
    scene = methods.METHODS["embedding"].sees(mesh, ())
    np.testing.assert_allclose(bake(mesh, scene=scene).coefficients, whole.coefficients, atol=1e-5)


def test_the_number_of_scene_points_is_by_surface_and_extent_alone():
    def count(mesh):
        return sky_bake.count_of(mesh, Occluders([(mesh.positions, mesh.triangles)]))

    coarse = torus(12, 8)  # of which each face is cut into four
    middles, triangles = coarse.positions[coarse.triangles], coarse.triangles
    cut = np.concatenate([(middles + np.roll(middles, -1, 1)) / 2, middles], 1)  # (F, 6, 3)
    fine = TriangleMesh.from_triangles(cut.reshape(-1, 3), (np.array([[0, 1, 2], [3, 0, 2], [4, 1, 0], [5, 2, 1]])
                                                            + 6 * np.arange(len(triangles))[:, None, None]
                                                            ).reshape(-1, 3).astype(np.int32))
    area = 2 * np.pi ** 2 * 2 * 0.4 / 2.8 ** 2  # of a torus as long as a unit
    assert count(torus(96, 64)) == pytest.approx(sky_bake.DENSITY * area, rel=0.01)
    for other in (fine, moved(coarse, 1e3 * IDENTITY), moved(coarse, 1e-3 * IDENTITY, 5.0)):
        assert count(other) == pytest.approx(count(coarse), abs=1)
    assert count(moved(coarse, np.diag([1, 1, 1e-3]))) == sky_bake.POINTS
    balls = np.concatenate([torus().positions + [0, 0, 0.01 * n] for n in range(9)])
    faces = np.concatenate([torus().triangles + 384 * n for n in range(9)])
    assert count(TriangleMesh.from_triangles(balls, faces)) == sky_bake.MOST


@pytest.fixture
def shipped(monkeypatch):
    """Any network as the one that ships."""
    monkeypatch.setattr(sky_bake, "network", trained)


def test_what_ships_is_far_nearer_than_no_shadows_and_knows_how_far_off_it_is():
    mesh = torus(96, 64)
    floor = np.array([[-4, -4, -0.5], [4, -4, -0.5], [4, 4, -0.5], [-4, 4, -0.5]], float)
    around = [(floor, np.array([[0, 1, 2], [0, 2, 3]], np.int32))]
    truth = methods.run(methods.bake(mesh, "embree", 3, rays=1024, occluders=around, seed=9)).coefficients
    found = bake(mesh, occluders=around)
    unshadowed = sh.cosine_lobe(mesh.normals, 3)
    assert np.square(found.coefficients - truth).sum() < 0.05 * np.square(unshadowed - truth).sum()
    error = np.linalg.norm(found.coefficients - truth) / np.linalg.norm(truth)
    assert 0.5 < found.record.error_estimate / error < 1.6
    higher = bake(mesh, 5, occluders=around).coefficients
    np.testing.assert_allclose(higher[:, :9], found.coefficients, atol=1e-6)


def test_a_convex_mesh_has_no_shadows_and_what_is_enclosed_is_dark(shipped):
    ball = torus(64, 32, 0.9999)  # nearly: the hole of a spindle is not seen from outside
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    cube = TriangleMesh.from_triangles(corners, triangles, smooth=False)
    np.testing.assert_allclose(bake(cube).coefficients, sh.cosine_lobe(cube.normals, 3), atol=1e-6)
    shell = [(3 * corners, triangles)]
    dark = bake(cube, occluders=shell).coefficients
    assert np.abs(dark).max() < 0.9  # of anything that the network may be: only numbers are asked for
    assert np.isfinite(bake(ball).coefficients).all()


@pytest.mark.parametrize("positions, triangles", [
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 1, 2], [2, 1, 0]]),
    ([[1e18, 0, 0], [-1e18, 0, 0], [0, 1e18, 0]], [[0, 1, 2]]),
    ([[0, 0, 0], [1e-12, 0, 0], [0, 1e-12, 0]], [[0, 1, 2]])],
    ids=["one triangle", "no area", "a loose vertex", "doubles", "enormous", "tiny"])
def test_strange_meshes_have_numbers(shipped, positions, triangles):
    mesh = TriangleMesh.from_triangles(np.array(positions, float), np.array(triangles, np.int32))
    found = bake(mesh, 5)
    assert np.isfinite(found.coefficients).all()
    assert not found.coefficients[~mesh.normals.any(1)].any()


def test_progress_rises_and_closing_ends_it(shipped):
    work, seen = methods.bake(torus(), "embedding", 3, threads=1), []
    before = torch.get_num_threads()
    for share in work:
        seen.append(share)
        if share > 0.2:
            break
    work.close()
    assert seen == sorted(seen) and torch.get_num_threads() == before


def test_without_torch_or_weights_one_sentence_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    with pytest.raises(UserError, match=r"'sky\.safetensors' are missing"):
        bake(torus())
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(UserError, match="'embedding' needs PyTorch.*pip install torch"):
        bake(torus())


def test_bands_are_those_of_the_coefficients():
    assert networks.bands(25).tolist() == [0] + [1] * 3 + [2] * 5 + [3] * 7 + [4] * 9


def test_scene_points_face_to_the_side_that_is_shaded():
    mesh = torus()
    inside = replace(mesh, normals=-mesh.normals, clearance=-mesh.clearance)
    found = bake(inside)
    assert np.abs(found.coefficients).max() < 0.02  # it looks into the ring, where all is dark
    assert found.record.error_estimate is None or found.record.error_estimate >= 0
