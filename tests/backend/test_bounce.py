# SPDX-License-Identifier: GPL-3.0-or-later
"""Interreflection: the furnace, reciprocity, energy, colour, and Mitsuba's path integrator."""
import numpy as np
import pytest

from neural_gash_addon.backend import methods
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.bounce import Bounces
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.patches import Patches
from neural_gash_addon.backend.raycast import Hits, Occluders

from . import shapes

WHITE = (4 * np.pi) ** 0.5  # L[0] of a sky of radiance 1


def quad(a, b, c, d):
    return np.array([a, b, c, d], float), np.array([[0, 1, 2], [0, 2, 3]])


def box(low, high):
    positions, triangles = shapes.cube(subdivisions=0)
    return (positions + 0.5) * (np.array(high) - low) + low, triangles


def cornell():
    """An open room of 2 m with a red and a green wall and two boxes: parts and their albedos (3,)."""
    return [(quad((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)), (0.7, 0.7, 0.7)),          # floor, up
            (quad((-1, 1, 0), (1, 1, 0), (1, 1, 2), (-1, 1, 2)), (0.7, 0.7, 0.7)),            # back, towards -y
            (quad((-1, -1, 0), (-1, 1, 0), (-1, 1, 2), (-1, -1, 2)), (0.65, 0.05, 0.05)),     # left, towards +x
            (quad((1, 1, 0), (1, -1, 0), (1, -1, 2), (1, 1, 2)), (0.1, 0.5, 0.1)),            # right, towards -x
            (box((-0.6, 0.0, 0.001), (-0.1, 0.5, 1.2)), (0.7, 0.7, 0.7)),
            (box((0.2, -0.5, 0.001), (0.7, 0.0, 0.6)), (0.7, 0.7, 0.7))]


def bounces_of(scene, order=3, number=None, **settings):
    parts = [part for part, _ in scene]
    albedo = np.concatenate([np.tile(colour, (len(part[1]), 1)) for part, colour in scene])
    found = Bounces(parts, albedo, Occluders(parts), order, **settings)
    methods.run(found.solve() if number is None else found.solve(number, tolerance=0))
    return found


def at(scene, points, normals):
    """Points on the first part of a scene."""
    return shapes.at_points(scene[0][0], points, normals)


def test_white_furnace_gives_the_closed_form():
    for geometry in (shapes.cube(inside=True), (shapes.sphere(2)[0], shapes.sphere(2)[1][:, ::-1])):
        for albedo in (0.3, 0.9):
            found = bounces_of([(geometry, (albedo,) * 3)], number=1, budget=500)
            assert not np.abs(found.direct).max() > 0                   # closed: no light from outside
            emitted = np.ones((len(found.direct), 1), np.float32)       # radiosity 1 of its own
            total, now = emitted.astype(float), emitted
            for _ in range(400):
                now = (albedo * found.gathered(now)).astype(np.float32)
                total += now
            np.testing.assert_allclose(total, 1 / (1 - albedo), rtol=1e-4)


def test_what_a_sees_of_b_is_what_b_sees_of_a():
    found = bounces_of(cornell(), budget=150, number=1)
    count = len(found.met)
    seen = np.zeros((count, count))
    rays = found.met.shape[1]
    rows, columns = np.nonzero(found.met >= 0)
    np.add.at(seen, (rows, found.met[rows, columns]), 1 / rays)
    flow = found._areas()[:, None] * seen
    big = (flow + flow.T) > np.percentile((flow + flow.T)[flow > 0], 95)
    # binomial: the variance of A F is about A^2 F / rays; 5 standard errors of the difference
    noise = np.sqrt((found._areas()[:, None] ** 2 * seen + found._areas()[None] ** 2 * seen.T) / rays)
    assert big.sum() > 50
    assert (np.abs(flow - flow.T)[big] < 5 * noise[big]).all()


def test_energy_never_grows_and_the_tail_stops():
    found = bounces_of(cornell())
    assert found.used >= 3 and found.added[-1] < 2e-3
    assert all(b < a for a, b in zip(found.added[:-1], found.added[1:], strict=True))
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.9, 0.9, (200, 2)), np.zeros(200)])
    mesh = at(cornell(), points, np.tile([0., 0, 1], (200, 1)))
    direct = methods.run(methods.bake(mesh, rays=256, occluders=[p for p, _ in cornell()[1:]])).coefficients
    total = direct[:, :, None] + methods.run(found.gather(mesh, 256))
    white = WHITE * total[:, 0]
    assert (white >= WHITE * direct[:, :1] - 1e-6).all() and (white <= 1.001).all()


def test_black_traces_nothing():
    scene = [(part, (0, 0, 0)) for part, _ in cornell()]
    found = bounces_of(scene)
    assert found.used == 0 and not len(found.met)
    mesh = at(scene, [[0, 0, 0]], [[0, 0, 1]])
    assert not methods.run(found.gather(mesh, 64)).any()


def test_convex_shapes_do_not_light_themselves():
    ball = shapes.sphere(3)
    mesh = TriangleMesh.from_triangles(*ball)
    found = bounces_of([(ball, (0.8,) * 3)])
    assert found.used == 1 and found.added[0] < 1e-3
    assert WHITE * methods.run(found.gather(mesh, 64))[:, 0].mean() < 1e-3


def test_red_walls_redden():
    found = bounces_of(cornell(), budget=2000)
    mesh = at(cornell(), [[-0.9, -0.5, 0], [0.9, -0.5, 0]], [[0, 0, 1], [0, 0, 1]])
    left, right = methods.run(found.gather(mesh, 1024))[:, 0]
    assert left[0] > 1.5 * left[1] and right[1] > 1.2 * right[0]


def test_turning_everything_turns_the_answer():
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    points, normals = np.array([[-0.5, -0.5, 0], [0.9, 0.3, 0]]), np.tile([0., 0, 1], (2, 1))
    turned = [((part[0] @ turn.T, part[1]), colour) for part, colour in cornell()]
    both = []
    for scene, t in ((cornell(), np.eye(3)), (turned, turn)):
        found = bounces_of(scene, budget=4000)
        both.append(methods.run(found.gather(at(scene, points @ t.T, normals @ t.T), 4096)))
    expected = np.stack([sh.rotate(x, turn) for x in both[0]])
    assert np.linalg.norm(both[1] - expected) < 0.03 * np.linalg.norm(expected)


def test_gathering_does_not_depend_on_threads():
    points = np.column_stack([np.random.default_rng(0).uniform(-0.9, 0.9, (50, 2)), np.zeros(50)])
    mesh = at(cornell(), points, np.tile([0., 0, 1], (50, 1)))
    one, two = (methods.run(bounces_of(cornell(), budget=500, threads=t).gather(mesh, 64)) for t in (1, 2))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("budget", [40, 5000])
def test_points_sampled_on_a_patch_are_hits_of_that_patch(budget):
    ball, plane = shapes.sphere(2), quad((-2, -2, -2), (2, -2, -2), (2, 2, -2), (-2, 2, -2))
    patches = Patches([ball, plane], budget)
    sides = 2 * np.arange(patches.count)
    points, normals, _ = patches.sample(sides, 16, np.random.default_rng(0))
    scene = Occluders([ball, plane])
    origins = scene.origins((points + 0.01 * normals).reshape(-1, 3), np.zeros((points[..., 0].size, 3)))
    hits = scene.hits(origins, np.ascontiguousarray(-normals.reshape(-1, 3), np.float32))
    assert isinstance(hits, Hits) and len(hits.rays) == len(origins) and hits.front.all()
    assert (patches.of_hits(hits) == np.repeat(sides, 16)).mean() > 0.995   # but for points on a cut
    assert patches.patch_areas.sum() == pytest.approx(patches.areas.sum())
    assert budget / 3 < patches.count < 4 * budget + 100


@pytest.mark.parametrize("number", [1, 3])
def test_room_agrees_with_mitsuba(number):
    """Radiance of points under a constant sky against the path integrator of the same depth, within its noise."""
    mi = pytest.importorskip("mitsuba", reason="needs mitsuba, a development dependency, as an independent renderer")
    mi.set_variant("scalar_rgb")
    scene = cornell()
    rng = np.random.default_rng(1)
    points = np.concatenate([np.column_stack([rng.uniform(-0.95, 0.95, (10, 2)), np.zeros(10)]),
                             np.column_stack([rng.uniform(-0.9, 0.9, 6), np.ones(6), rng.uniform(0.1, 1.9, 6)])])
    normals = np.repeat([[0., 0, 1], [0, -1., 0]], [10, 6], axis=0)
    mesh = at(scene, points, normals)
    direct = methods.run(methods.bake(mesh, rays=4096, occluders=[p for p, _ in scene[1:]])).coefficients
    found = bounces_of(scene, number=number)
    ours = 0.7 * WHITE * (direct[:, :1] + methods.run(found.gather(mesh, 4096))[:, 0])
    world = {"type": "scene", "integrator": {"type": "path", "max_depth": 2 + number, "rr_depth": 100},
             "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [1, 1, 1]}}}
    for index, ((positions, triangles), colour) in enumerate(scene):
        shape = mi.Mesh(f"part{index}", len(positions), len(triangles), props=_diffuse(mi, colour))
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = positions.astype(np.float32).ravel()
        parameters["faces"] = triangles.astype(np.uint32).ravel()
        parameters.update()
        world[f"part{index}"] = shape
    world = mi.load_dict(world)
    theirs, spread = [], []
    for point, normal in zip(points, normals, strict=True):
        sensor = mi.load_dict({
            "type": "radiancemeter", "origin": list(point + 1e-3 * normal), "direction": list(-normal),
            "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}})
        runs = [np.array(mi.render(world, sensor=sensor, spp=2048, seed=seed)).ravel()[:3] for seed in range(4)]
        theirs.append(np.mean(runs, axis=0))
        spread.append(np.std(runs, axis=0, ddof=1) / 2)
    theirs, spread = np.array(theirs), np.array(spread)
    # Mitsuba's noise (4 of its standard errors, of which 4 runs tell roughly) and 1 % for ours
    assert (np.abs(ours - theirs) < 4 * np.maximum(spread, 0.004) + 0.01 * theirs).mean() > 0.95
    assert np.linalg.norm(ours - theirs) < 0.015 * np.linalg.norm(theirs)
    alone = 0.7 * WHITE * direct[:, :1]
    assert np.linalg.norm(alone - theirs) > 0.1 * np.linalg.norm(theirs)


def _diffuse(mi, colour):
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "material": {
        "type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}})
    return properties
