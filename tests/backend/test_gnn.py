# SPDX-License-Identifier: GPL-3.0-or-later
"""The network bake: equal to what was trained, to itself however it is run, blind to poles, and right about shadows."""
import numpy as np
import pytest

from neural_gash_addon.backend import cones, gnn, gnn_bake, methods, metrics, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.record import BakeRecord

from . import shapes
from .test_hybrid import knot

ORDER = 3


def bake(mesh, order=ORDER, **settings):
    return methods.run(methods.bake(mesh, "gnn", order, **settings)).coefficients


def reference(mesh, order=ORDER, **settings):
    return methods.run(methods.bake(mesh, "embree", order, rays=1024, seed=3, **settings)).coefficients


def srr(mesh, found, truth):
    return metrics.srr(found, truth, sh.cosine_lobe(mesh.normals, ORDER))


def jaws(gap=0.12):
    """Two plates that face each other: near in space, and in no way connected."""
    plate = shapes.grid(24)
    below, above = plate[0] - [0.5, 0.5, 0], (plate[0] - [0.5, 0.5, 0]) * [1, -1, 1] + [0, 0, gap]
    return TriangleMesh.from_triangles(np.concatenate([below, above]),
                                       np.concatenate([plate[1], plate[1] + len(below)]))


@pytest.fixture(scope="module")
def case():
    """A mesh and its transfer."""
    mesh = knot()
    return mesh, bake(mesh)


def test_numpy_is_the_torch_module_that_was_trained():
    torch = pytest.importorskip("torch")
    from training.gnn import Net

    torch.manual_seed(0)
    model = Net()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    rng = np.random.default_rng(0)
    for share in (0.0, 0.4, 1.0):  # of cones that see something
        some = np.flatnonzero(rng.random(25 * 700) < share)
        seen = cones.Seen(700, some, rng.random((cones.STEPS * cones.CHANNELS, len(some)), np.float32))
        with torch.no_grad():
            expected = model(torch.from_numpy(seen.dense())).numpy()
        np.testing.assert_allclose(gnn.answer(seen, model.network()), expected, atol=1e-5)


def test_it_sees_most_of_the_shadows(case):
    mesh, found = case
    assert srr(mesh, found, reference(mesh)) < 0.2


def test_it_sees_a_jaw_that_no_edge_leads_to():
    mesh = jaws()
    assert srr(mesh, bake(mesh), reference(mesh)) < 0.2


def test_it_sees_occluders_and_not_only_near_ones():
    """A ball on a floor a hundred times as wide, and in a room."""
    ball = TriangleMesh.from_triangles(*shapes.sphere(4))
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    floor = (corners * 100 - [0, 0, 1.02], np.array([[0, 1, 2], [0, 2, 3]]))
    room = (shapes.cube(inside=True, subdivisions=0)[0] * 30, shapes.cube(inside=True, subdivisions=0)[1])
    for occluder in (floor, room):
        found, truth = bake(ball, occluders=[occluder]), reference(ball, occluders=[occluder])
        assert srr(ball, found, truth) < 0.2


def test_a_convex_mesh_hardly_shadows_itself():
    mesh = TriangleMesh.from_triangles(*shapes.sphere(4))
    assert metrics.rel_l2(bake(mesh), sh.cosine_lobe(mesh.normals, ORDER)) < 0.03


def test_threads_chunks_and_order_of_the_vertices_do_not_matter(case, monkeypatch):
    mesh, found = case
    np.testing.assert_allclose(bake(mesh, threads=1), found, atol=1e-5)
    monkeypatch.setattr(gnn, "CHUNK", 100)
    np.testing.assert_allclose(bake(mesh, threads=2), found, atol=1e-5)
    mixed = np.random.default_rng(1).permutation(len(mesh.positions))
    back = np.argsort(mixed)
    again = bake(TriangleMesh.from_triangles(mesh.positions[mixed], back[mesh.triangles]))
    close = np.abs(again - found[mixed]).max(1) < 1e-4
    assert close.mean() > 0.995  # a place on the border of two voxels may be read from the other


@pytest.mark.parametrize(("scale", "move"), [(1e-3, 0.0), (1e3, 0.0), (1.0, 1e4)])
def test_size_and_place_do_not_matter(case, scale, move):
    mesh, found = case
    moved = TriangleMesh.from_triangles(mesh.positions * scale + move, mesh.triangles)
    assert metrics.rel_l2(bake(moved), found) < 5e-3


def test_turning_the_mesh_turns_the_answer_as_far_as_voxels_allow(case):
    from scipy.spatial.transform import Rotation

    mesh, found = case
    truth = reference(mesh)
    for seed in range(3):
        turn = Rotation.random(random_state=seed).as_matrix()
        turned = bake(TriangleMesh.from_triangles(mesh.positions @ turn.T, mesh.triangles))
        back = sh.rotate_each(turned, np.broadcast_to(turn.T, (len(turned), 3, 3)))
        assert srr(mesh, back, truth) < 1.3 * srr(mesh, found, truth) + 0.02


def around(pole, radius, count=400):
    """Unit normals on a small circle about a pole."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    out = np.stack([np.sin(radius) * np.cos(angle), np.full(count, np.cos(radius)), np.sin(radius) * np.sin(angle)], 1)
    return out * pole


@pytest.mark.parametrize("pole", [-1.0, 1.0])
def test_normals_at_the_pole_of_the_motor_are_like_any_others(pole):
    """Coefficients change as little round the poles of both frames as they do round a place far from them."""
    cup = shapes.torus()
    voxels = gnn_bake.voxels_of(TriangleMesh.from_triangles(*cup), [])
    network = weights.load_gnn()
    place = np.array([0.2, 0.4, 0.1])

    def spread(normals):
        mesh = shapes.at_points(cup, np.broadcast_to(place, normals.shape), normals)
        found = gnn.blocked(mesh, voxels, network, ORDER, np.arange(len(normals)))
        assert np.isfinite(found).all()
        return np.linalg.norm(found - found.mean(0), axis=1).max()

    elsewhere = spread(around(1.0, 1e-3)[:, [1, 0, 2]])
    assert spread(around(pole, 1e-3)) < 2 * elsewhere + 1e-3
    assert spread(np.array([[0, pole, 0], [1e-9, pole, 0], [0, pole, -1e-30]])) < 2 * elsewhere + 1e-3


def test_the_frames_change_over_without_a_step():
    """Through the blend of the two frames, and all round: no step larger than the steps beside it."""
    cup = shapes.torus()
    voxels = gnn_bake.voxels_of(TriangleMesh.from_triangles(*cup), [])
    angle = np.linspace(0, 2 * np.pi, 4000)
    normals = np.stack([np.sin(angle), np.cos(angle), np.zeros_like(angle)], 1)
    mesh = shapes.at_points(cup, np.broadcast_to([0.2, 0.4, 0.1], normals.shape), normals)
    found = gnn.blocked(mesh, voxels, weights.load_gnn(), ORDER, np.arange(len(normals)))
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    flips = np.abs(np.abs(normals[1:, 1]) - 1) < 1e-5
    assert steps[flips].max() <= np.quantile(steps, 0.999) + 1e-6


def test_frames_carry_up_to_the_normal_whatever_their_pole():
    normals = np.random.default_rng(2).normal(size=(200, 3))
    normals = np.concatenate([normals / np.linalg.norm(normals, axis=1)[:, None], [[0, 1, 0], [0, -1, 0]]])
    for over in (False, True):
        frames = gnn.frames_of(normals, over)
        np.testing.assert_allclose(frames[:, :, 1], normals, atol=1e-12)
        np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape),
                                   atol=1e-12)
        assert np.allclose(np.linalg.det(frames), 1)


def test_a_lower_order_is_the_beginning_of_a_higher_one(case):
    mesh, found = case
    for order in (2, 4, 5):
        terms = min(order, ORDER) ** 2
        np.testing.assert_allclose(bake(mesh, order)[:, :terms], found[:, :terms], atol=1e-5)


def test_the_record_says_that_nothing_was_traced_or_measured(case):
    mesh, _ = case
    record: BakeRecord = methods.run(methods.bake(mesh, "gnn", 2)).record
    assert (record.method, record.rays, record.probe_rays, record.error_estimate) == ("gnn", 0, 0, None)


@pytest.mark.parametrize(("positions", "triangles"), [
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]]),
    ([[1, 1, 1]] * 3, [[0, 1, 2]]),
    ([[0, 0, 0], [1e18, 0, 0], [0, 1e18, 0]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0]] * 2, [[0, 1, 2], [3, 4, 5], [0, 2, 1]])],
    ids=["three vertices", "isolated vertex", "a line", "one place", "enormous", "duplicates"])
def test_poor_meshes_give_finite_transfer(positions, triangles):
    mesh = TriangleMesh.from_triangles(np.array(positions, float), np.array(triangles))
    assert np.isfinite(bake(mesh)).all()


def test_weights_that_are_missing_or_altered_are_refused(tmp_path):
    with pytest.raises(UserError, match="gnn.safetensors"):
        weights.load_gnn.__wrapped__(tmp_path / weights.GNN)
    for name in (weights.GNN, weights.CHECKSUMS):
        (tmp_path / name).write_bytes((weights.FOLDER / name).read_bytes())
    whole = (tmp_path / weights.GNN).read_bytes()
    (tmp_path / weights.GNN).write_bytes(whole[:-4] + b"\0\0\0\1")
    with pytest.raises(UserError, match="gnn.safetensors"):
        weights.load_gnn.__wrapped__(tmp_path / weights.GNN)
