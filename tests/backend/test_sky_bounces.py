# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that bounces, by the embedding: a closed form, what holds by construction, and what was learned."""
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch")

from neural_gash_addon.backend import bounce, methods, sky_bake, weights  # noqa: E402
from neural_gash_addon.backend import spherical_harmonics as sh  # noqa: E402
from neural_gash_addon.backend.bounce import BLACK, Bounces, Reflection  # noqa: E402
from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.backend.geometry import TEXEL, TriangleMesh  # noqa: E402
from neural_gash_addon.backend.networks import reflected as networks  # noqa: E402
from neural_gash_addon.backend.progress import run  # noqa: E402
from neural_gash_addon.backend.raycast import Occluders  # noqa: E402
from neural_gash_addon.backend.sky_bake import ScenePoints, Sky, joined, split  # noqa: E402

from . import shapes  # noqa: E402
from .test_sky import IDENTITY, TINY, moved, points_of, torus  # noqa: E402
from .test_sky import trained as any_sky  # noqa: E402

ALBEDO = np.array([0.8, 0.5, 0.1])


def any_decoder(seed=1):
    """One whose weights are anything, so that nothing holds by chance."""
    torch.manual_seed(seed)
    model = networks.Reflected(TINY)
    with torch.no_grad():
        for value in model.parameters():
            value += 0.1 * torch.randn_like(value)
    return model.eval()


class Given:
    """A solution that brings scene points what it is told."""

    used = 1

    def __init__(self, brought):
        self.brought = np.asarray(brought, np.float32)

    def gather(self, mesh, rays, seed=0):
        yield 1.0
        return self.brought


@pytest.fixture
def anything(monkeypatch):
    """Any networks as those that ship, few patches and scene points: what is asked does not hang on their number."""
    monkeypatch.setattr(sky_bake, "POINTS", 512)
    monkeypatch.setattr(sky_bake, "DENSITY", 0)
    monkeypatch.setattr(bounce, "Bounces", partial(Bounces, budget=1000))
    monkeypatch.setattr(sky_bake, "network", any_sky)
    monkeypatch.setattr(sky_bake, "reflecting", any_decoder)


def brought(occluders, points, values, asked, order=5):
    """What an embedding says that bounces bring to points, of what they bring to its scene points."""
    sky, solution = Sky(any_sky(), occluders, points), Given(values)
    run(sky.seen(solution))
    both = sky.transfer(asked.points, asked.normals, order, solution)
    return both - sky.transfer(asked.points, asked.normals, order, None)[:, :, None]


def reflection(mesh, around=(), number=64, colours=()):
    """Everything of ALBEDO, or of colours for the parts around."""
    albedo = [np.tile(ALBEDO, (len(mesh.triangles), 1))]
    for (_, triangles), colour in zip(around, colours or [ALBEDO] * len(around), strict=True):
        albedo.append(np.tile(colour, (len(triangles), 1)))
    return Reflection(np.concatenate(albedo), number)


def bake(mesh, order=3, method="embedding", rays=None, **how):
    return methods.run(methods.bake(mesh, method, order, rays=rays, **how))


def corner():
    """A torus in a corner of a red wall and a green floor."""
    mesh = torus()
    floor = np.array([[-2, -2, -0.45], [2, -2, -0.45], [2, 2, -0.45], [-2, 2, -0.45]], float)
    wall = np.array([[-1.5, -2, -0.45], [-1.5, 2, -0.45], [-1.5, 2, 2], [-1.5, -2, 2]], float)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    around = [(floor, triangles), (wall, triangles)]
    return mesh, around, reflection(mesh, around, colours=[(0.1, 0.8, 0.1), (0.9, 0.1, 0.1)])


def open_sphere(angle=1.0, rows=20, columns=40):
    """The inside of a unit sphere without its cap about +z, and the share of the light that a bounce keeps."""
    polar, around = np.linspace(angle, np.pi, rows + 1), np.arange(columns) * 2 * np.pi / columns
    polar, around = (each.ravel() for each in np.meshgrid(polar, around, indexing="ij"))
    positions = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], 1)
    i = np.arange((rows + 1) * columns).reshape(rows + 1, columns)
    a, b = i[:-1], i[1:]
    a, b, c, d = (each.ravel() for each in (a, b, np.roll(b, -1, 1), np.roll(a, -1, 1)))
    triangles = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)]).astype(np.int32)
    return TriangleMesh.from_triangles(positions, triangles), (1 + np.cos(angle)) / 2


def in_the_open_sphere(order, number, angle=1.0):
    """(K, 3) what bounces bring, the same to all of it.

    In a sphere every part sees every other alike, so a bounce brings albedo times the mean over all of the sphere of
    what was there before. The sky's is what goes through the opening: its area, over the sphere's, of the lobe about z.
    """
    _, closed = open_sphere(angle, 2, 3)
    sky = np.sin(angle) ** 2 / 4 * sh.cosine_lobe(np.array([[0.0, 0, 1]]), order)[0]
    return sky[:, None] * sum(ALBEDO ** b * closed ** (b - 1) for b in range(1, number + 1))


@pytest.mark.parametrize("number", [1, 2, 10])
def test_an_integrating_sphere_is_the_closed_form(number):
    mesh, _ = open_sphere()
    expected = in_the_open_sphere(3, number)
    inside = mesh.points[:, 2] < 0.5  # not at the rim, where patches end
    parts, light = [(mesh.positions, mesh.triangles)], reflection(mesh)
    light.solution = Bounces(parts, light.albedo, Occluders(parts, mesh.resolution), 3, budget=2000)
    run(light.solution.solve(number, tolerance=0))
    found = run(light.solution.gather(mesh, 256))[inside]
    assert np.linalg.norm(found.mean(0) - expected) < 0.02 * np.linalg.norm(expected)
    both = bake(mesh, reflection=light)
    learned = (both.coefficients - bake(mesh).coefficients[:, :, None])[inside]
    assert both.record.bounces == number and both.record.colours == 3
    assert np.linalg.norm(learned.mean(0) - expected) < 0.03 * np.linalg.norm(expected)
    off = np.linalg.norm(learned - expected, axis=(1, 2)) / np.linalg.norm(expected)
    assert np.sqrt(np.square(off).mean()) < 0.08


@pytest.mark.parametrize("matrix, offset", [(Rotation.random(random_state=2).as_matrix(), 0.0), (IDENTITY, 300.0),
                                            (1000 * IDENTITY, 0.0)], ids=["turned", "moved", "larger"])
def test_the_answer_turns_with_the_scene(matrix, offset, anything):
    mesh = torus()
    occluders, points = points_of(mesh)
    other = moved(mesh, matrix, offset)
    seen = Occluders([(other.positions, other.triangles)], other.resolution)
    rotation = matrix / np.cbrt(np.linalg.det(matrix))
    turns = np.broadcast_to(rotation, (len(points.places), 3, 3))
    metres = points.places / sky_bake.embedding.EXTENT / occluders.scale + occluders.centre
    turned = sh.rotate_each(joined(points.blocked, points.normals).astype(float), turns)
    normals = points.normals @ rotation.T
    again = ScenePoints(sky_bake.in_scale(metres @ np.asarray(matrix).T + offset, seen), normals.astype(np.float32),
                        split(turned, normals), 64, mesh)
    values = np.random.default_rng(0).normal(size=(len(points.places), 25, 3)) + 3 * np.eye(25)[0][:, None]
    turned = np.stack([sh.rotate_each(values[..., c], turns) for c in range(3)], 2)
    one, two = brought(occluders, points, values, mesh), brought(seen, again, turned, other)
    back = np.broadcast_to(rotation.T, (len(two), 3, 3))
    two = np.stack([sh.rotate_each(two[..., c].astype(float), back) for c in range(3)], 2)
    np.testing.assert_allclose(two, one, atol=1e-3 if offset == 0 else 1e-2)


def test_channels_can_be_exchanged_and_less_light_is_less(anything):
    mesh = torus()
    occluders, points = points_of(mesh)
    values = np.random.default_rng(0).uniform(0.1, 1, (len(points.places), 25, 3))
    one = brought(occluders, points, values, mesh)
    np.testing.assert_allclose(brought(occluders, points, values[..., [2, 0, 1]], mesh), one[..., [2, 0, 1]], atol=1e-5)
    np.testing.assert_allclose(brought(occluders, points, values / 8, mesh), one / 8, atol=1e-5)
    grey = brought(occluders, points, np.repeat(values[..., :1], 3, 2), mesh)
    np.testing.assert_allclose(grey, np.repeat(grey[..., :1], 3, 2), atol=1e-6)


def test_before_training_it_is_a_mean_of_scene_points(monkeypatch):
    occluders, points = points_of(torus())
    even = np.linspace(1, 2, 75).reshape(1, 25, 3).repeat(len(points.places), 0)
    sky, solution = Sky(any_sky(), occluders, points), Given(even)
    monkeypatch.setattr(sky_bake, "reflecting", lambda: networks.Reflected(TINY).eval())
    run(sky.seen(solution))
    mesh = torus()
    both, direct = (sky.transfer(mesh.points, mesh.normals, 5, each) for each in (solution, None))
    found = both - direct[:, :, None]
    np.testing.assert_allclose(found, np.broadcast_to(even[:1], found.shape), atol=1e-5)


def test_a_bake_is_the_same_in_any_order_in_chunks_on_any_threads_and_in_tiles(anything, monkeypatch):
    mesh, around, light = corner()
    whole = bake(mesh, reflection=light, occluders=around, threads=1)
    assert whole.coefficients.shape == (len(mesh.points), 9, 3)
    assert whole.record.rays == 2 * 512 * 64 and whole.record.bounces == light.solution.used > 0
    again = bake(mesh, reflection=corner()[2], occluders=around, threads=2)
    np.testing.assert_allclose(again.coefficients, whole.coefficients, atol=1e-5)
    monkeypatch.setattr(sky_bake, "QUERIES_AT_ONCE", 50)
    scene = methods.METHODS["embedding"].sees(mesh, around)
    first = bake(mesh, reflection=light, occluders=around, scene=scene)
    np.testing.assert_allclose(first.coefficients, whole.coefficients, atol=1e-5)
    solved, gathered = [], Bounces.gather
    monkeypatch.setattr(Bounces, "trace", lambda self: solved.append(1))
    monkeypatch.setattr(Bounces, "gather", lambda self, mesh, *a: solved.append(len(mesh.points)) or
                        gathered(self, mesh, *a))
    second = bake(mesh, reflection=light, occluders=around, scene=scene)
    assert solved == [128, 128] and second.record.rays == 0  # points where the error is measured, and no others
    np.testing.assert_allclose(second.coefficients, whole.coefficients, atol=1e-5)


def test_what_ships_is_near_and_knows_how_far_off_it_is():
    mesh, around, light = corner()
    parts = [(mesh.positions, mesh.triangles), *around]
    scene, both = Occluders(parts, mesh.resolution), []
    for seed in (8, 9):
        solution = Bounces(parts, light.albedo, scene, 3, seed, budget=4000)
        run(solution.solve())
        both.append(run(solution.gather(mesh, 1024)))
    one, two = both
    direct = bake(mesh, method="embree", rays=4096, occluders=around, seed=7).coefficients[:, :, None]
    found = bake(mesh, occluders=around, reflection=light)
    learned = found.coefficients - bake(mesh, occluders=around).coefficients[:, :, None]
    assert ((learned - one) * (learned - two)).sum() < 0.06 ** 2 * (one * two).sum()
    assert one[:, 0].mean(0)[1] > 1.2 * one[:, 0].mean(0)[2]  # it is in colour
    truth = direct + (one + two) / 2
    error = np.linalg.norm(found.coefficients - truth) / np.linalg.norm(truth)
    assert 0.5 < found.record.error_estimate / error < 1.6


def test_more_bounces_are_more_light(anything):
    mesh, around, _ = corner()
    one, two, many = (bake(mesh, occluders=around, reflection=reflection(mesh, around, number))
                      for number in (1, 2, 64))
    assert one.record.bounces == 1 and two.record.bounces == 2 < many.record.bounces
    light = [each.coefficients[:, 0].mean(0) for each in (one, two, many)]
    assert (light[0] < light[1]).all() and (light[1] < light[2]).all()
    assert light[2][0] / light[0][0] > light[2][2] / light[0][2]  # of albedo 0.8 more than of 0.1


def test_where_nothing_bounces_nothing_is_computed(anything, monkeypatch):
    mesh, around, light = corner()
    monkeypatch.setattr(Bounces, "trace", None)
    black = bake(mesh, occluders=around, reflection=Reflection(0 * light.albedo, 4))
    np.testing.assert_array_equal(black.coefficients, bake(mesh, occluders=around).coefficients)
    assert black.record.bounces == 0 and black.record.colours == 1 and BLACK not in black.record.plan
    cube = TriangleMesh.from_triangles(*shapes.cube())
    assert bake(cube, reflection=reflection(cube)).coefficients.shape == (len(cube.points), 9)
    none = bake(mesh, occluders=around, reflection=Reflection(light.albedo, 0))
    assert none.coefficients.shape == (len(mesh.points), 9) and none.record.colours == 1


@pytest.mark.parametrize("positions, triangles", [
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 1, 2], [2, 1, 0]]),
    ([[0, 0, 0], [1e-12, 0, 0], [0, 1e-12, 0]], [[0, 1, 2]])],
    ids=["one triangle", "no area", "doubles", "tiny"])
def test_strange_meshes_have_numbers(anything, positions, triangles):
    mesh = TriangleMesh.from_triangles(np.array(positions, float), np.array(triangles, np.int32))
    around = [(mesh.positions + [0, 0, 0.5], mesh.triangles)]
    found = bake(mesh, 5, occluders=around, reflection=reflection(mesh, around))
    assert np.isfinite(found.coefficients).all() and found.record.terms == found.coefficients[0].size


def test_texels_have_their_bounces(anything):
    mesh, around, light = corner()
    texels = TriangleMesh(mesh.positions, mesh.triangles, mesh.points, mesh.normals, mesh.clearance,
                          np.arange(len(mesh.points), dtype=np.int32), TEXEL, mesh.resolution)
    np.testing.assert_allclose(bake(texels, occluders=around, reflection=light).coefficients,
                               bake(mesh, occluders=around, reflection=corner()[2]).coefficients, atol=1e-5)


def test_progress_rises_and_closing_ends_it(anything):
    mesh, around, light = corner()
    before = torch.get_num_threads()
    seen = list(methods.bake(mesh, "embedding", 3, occluders=around, reflection=light, threads=1))
    assert seen == sorted(seen) and seen[0] >= 0 and seen[-1] <= 1 and torch.get_num_threads() == before
    for stop in (0.2, 0.4, 0.55):
        work = methods.bake(mesh, "embedding", 3, occluders=around, reflection=corner()[2], threads=1)
        next(share for share in work if share > stop)
        work.close()
        assert torch.get_num_threads() == before


def test_without_weights_one_sentence_says_so(monkeypatch, tmp_path):
    mesh, around, light = corner()
    monkeypatch.setattr(sky_bake, "network", any_sky)
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    with pytest.raises(UserError, match=r"'bounces\.safetensors' are missing"):
        bake(mesh, occluders=around, reflection=light)


@pytest.mark.parametrize("method", list(methods.METHODS))
def test_methods_that_say_so_follow_bounces_and_others_leave_them_out(method, anything):
    entry = methods.METHODS[method]
    assert entry.bounces == (method in {"embree", "auto", "hybrid", "sparse", "embedding"})
    if "paper" in method or method == "mlp":
        return  # what they take is asked for elsewhere
    mesh, around, light = corner()
    found = bake(mesh, method=method, rays=16 if entry.traces else None, occluders=around, reflection=light)
    assert found.coefficients.shape == (len(mesh.points), 9, 3)[:3 if entry.bounces else 2]
    assert (found.record.bounces > 0) == entry.bounces and (light.solution is not None) == entry.bounces
