# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance from emitters: closed forms, a slow twin, Mitsuba's path integrator, and bad input."""
import numpy as np
import pytest

from neural_gash_addon.backend import irradiance as paths
from neural_gash_addon.backend import methods
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.lit_scene import LitScene
from neural_gash_addon.backend.pictures import Picture

from . import shapes

UP = np.array([[0.0, 0, 1]])


def scene_of(*parts, **more):
    """Of (positions, triangles, albedo, radiance)."""
    sizes = [len(part[1]) for part in parts]
    firsts = np.cumsum([0, *(len(part[0]) for part in parts)])
    spread = [np.repeat([np.broadcast_to(part[k], 3) for part in parts], sizes, axis=0).astype(float) for k in (2, 3)]
    triangles = np.concatenate([part[1] + first for part, first in zip(parts, firsts, strict=False)])
    return LitScene(np.concatenate([part[0] for part in parts]).astype(float), triangles.astype(np.int32), *spread,
                    **more)


def quad(a, b, c, d):
    return np.array([a, b, c, d], float), np.array([[0, 1, 2], [0, 2, 3]])


def ceiling(half, high):
    """A square that faces down."""
    return quad((-half, -half, high), (-half, half, high), (half, half, high), (half, -half, high))


def run(scene, points, normals, rays=1024, **more):
    return methods.run(paths.irradiance(scene, np.atleast_2d(points), np.atleast_2d(normals), rays, **more))


def corner_factor(a, b):
    """Form factor of a rectangle a by b for a parallel element under its corner, one length away (Howell 1982)."""
    x, y = np.hypot(1, a), np.hypot(1, b)
    return (a / x * np.arctan(b / x) + b / y * np.arctan(a / y)) / (2 * np.pi)


@pytest.mark.parametrize(("half", "high"), [(0.5, 1.0), (2.0, 0.1), (0.05, 3.0)])
def test_below_a_square_is_the_form_factor(half, high):
    scene = scene_of((*ceiling(half, high), 0.5, (1, 2, 4)))
    centre = 4 * corner_factor(half / high, half / high)
    corner = corner_factor(2 * half / high, 2 * half / high)
    found = run(scene, [[0, 0, 0], [half, half, 0]], np.repeat(UP, 2, 0), 4096)
    expected = np.pi * np.outer([centre, corner], [1, 2, 4])
    # a small light is met by few of the rays, which bring a 1e-3 of it and may be missed in all batches
    assert (np.abs(found.values - expected) < 4 * found.error + 1e-3 * expected).all()
    assert (found.error < 6e-3 * expected).all()


def test_below_a_disk_is_the_form_factor():
    angle = np.linspace(0, 2 * np.pi, 257)[:-1]
    radius, high = 0.8, 0.6
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle + high], 1)
    index = np.arange(256)
    triangles = np.stack([np.full(256, 256), (index + 1) % 256, index], 1)
    scene = scene_of((np.concatenate([rim, [[0, 0, high]]]), triangles, 0.0, 3.0))
    found = run(scene, [0, 0, 0], UP, 4096)
    assert found.values == pytest.approx(3 * np.pi * radius**2 / (radius**2 + high**2), rel=3e-3)


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("depth", [1, 2, 5])
def test_a_furnace_is_a_geometric_series(albedo, depth):
    positions, triangles = shapes.cube(inside=True)
    scene = scene_of((positions, triangles, albedo, 2.0))
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.49, 0.49, (64, 2)), np.full(64, -0.5)])
    found = run(scene, points, np.repeat(UP, 64, 0), 512, depth=depth)
    expected = 2 * np.pi * sum(albedo ** k for k in range(depth))
    every = found.values[:, 0]
    assert every.mean() == pytest.approx(expected, abs=4 * every.std() / 8 + 1e-3)
    deviation = (every - expected) / found.error[:, 0]
    assert 0.7 < np.sqrt(np.mean(deviation ** 2)) < 1.7  # 8 batches: Student's t of 7 has 1.18


def textured_box():
    """The inside of a cube with a small light, a red wall, a striped floor and a box that stands in it."""
    positions, triangles = shapes.cube(inside=True, subdivisions=0)
    centres = positions[triangles].mean(1)
    albedo = np.where(centres[:, :1] < -0.45, [[0.8, 0.1, 0.1]], [[0.6, 0.6, 0.6]])
    floor = np.flatnonzero(centres[:, 2] < -0.45)
    block, light = shapes.cube(subdivisions=0), ceiling(0.2, 0.49)
    room = scene_of((positions, triangles, 0.5, 0), (0.3 * block[0] + [0.2, 0.1, -0.34], block[1], (0.2, 0.3, 0.7), 0),
                    (*light, 0.4, (6, 5, 4)))
    room.albedo[:len(albedo)] = albedo
    pixels = np.zeros((2, 8, 3), np.float32)
    pixels[:, ::2] = [0.9, 0.8, 0.1]
    picture = Picture(floor, 1.5 * positions[triangles[floor]][..., :2], pixels, np.arange(3), np.arange(3), np.ones(3),
                      np.zeros(3))
    room.albedo[floor] = picture.lookups().mean(1)
    return LitScene(room.positions, room.triangles, room.albedo, room.emission, [picture],
                    front_only=np.arange(len(room.triangles)) >= 0)


def brute_force(scene, point, normal, depth, count, rng):
    """Paths in cosine-distributed directions that count what they meet; every ray against every triangle."""
    a = scene.corners[:, 0]
    e, f = scene.corners[:, 1] - a, scene.corners[:, 2] - a
    origins, normals = np.tile(point, (count, 1)), np.tile(normal, (count, 1))
    carried, total, alive = np.ones((count, 3)), np.zeros((count, 3)), np.ones(count, bool)
    for _ in range(depth):
        directions = normals + _on_sphere(rng, count)  # Lambert's lobe: the normal and a point of the unit sphere
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = origins + 1e-6 * normals
        h = np.cross(directions[:, None], f)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / (e * h).sum(-1)
            s = origins[:, None] - a
            u = (s * h).sum(-1) * inverse
            q = np.cross(s, e)
            v = (directions[:, None] * q).sum(-1) * inverse
            t = (f * q).sum(-1) * inverse
        t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
        faces = t.argmin(1)
        row = np.arange(count)
        alive &= np.isfinite(t[row, faces])
        front = (scene.normals[faces] * directions).sum(1) < 0
        total[alive] += (carried * scene.emission[faces] * front[:, None])[alive]
        carried *= scene.albedo_at(faces, u[row, faces], v[row, faces])
        origins = np.where(alive[:, None], origins + np.where(alive, t[row, faces], 0)[:, None] * directions, origins)
        normals = scene.normals[faces] * np.where(front, 1, -1)[:, None]
    return np.pi * total.mean(0), np.pi * total.std(0) / count ** 0.5


def _on_sphere(rng, count):
    v = rng.normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@pytest.mark.parametrize(("point", "normal"), [((-0.3, -0.2, -0.5), (0, 0, 1)), ((-0.5, 0.1, 0.0), (1, 0, 0)),
                                               ((0.2, 0.1, -0.19), (0, 0, 1)), ((0.49, 0.3, -0.45), (-1, 0, 0))])
def test_it_equals_a_slow_twin(point, normal):
    scene = textured_box()
    expected, noise = brute_force(scene, np.array(point, float), np.array(normal, float), paths.DEPTH, 24_000,
                                  np.random.default_rng(1))
    found = run(scene, point, normal, 16384)
    assert np.abs(found.values[0] - expected).max() < 4 * np.hypot(noise, found.error[0]).max()
    assert noise.max() < 0.1 * expected.max()


def test_straight_and_reflected_light_are_all_light():
    scene = textured_box()
    points, normals = [[-0.3, -0.2, -0.5], [0.2, 0.1, -0.19]], np.repeat(UP, 2, 0)
    whole = run(scene, points, normals, 8192)
    straight, reflected = run(scene, points, normals, 8192, depth=1), run(scene, points, normals, 8192, straight=False)
    off = straight.values + reflected.values - whole.values
    assert (np.abs(off) < 4 * np.sqrt(straight.error ** 2 + reflected.error ** 2 + whole.error ** 2)).all()
    assert reflected.values.min() > 0.1 and straight.values.min() > 0.1
    assert not run(scene, points, normals, depth=1, straight=False).values.any()


def test_light_from_the_back_only_where_it_is_to_be():
    floor, light = quad((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)), ceiling(0.5, 1.0)
    above = [[0, 0, 2.0]], [[0, 0, -1.0]]
    both, front = (run(scene_of((*floor, 0.0, 0), (*light, 0.0, 1), front_only=sides), *above, 512)
                   for sides in (None, np.ones(4, bool)))
    assert both.values == pytest.approx(np.pi * 4 * corner_factor(0.5, 0.5), rel=0.01)
    assert not front.values.any()


def test_the_error_falls_and_tells_the_truth():
    scene = textured_box()
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-0.45, 0.45, (200, 2)), np.full(200, -0.5)])
    truth = run(scene, points, np.repeat(UP, 200, 0), 8192, seed=9)
    few, more = (run(scene, points, np.repeat(UP, 200, 0), rays) for rays in (64, 1024))
    for found in (few, more):
        score = (found.values - truth.values)[:, 1] / np.maximum(np.hypot(found.error, truth.error)[:, 1], 1e-9)
        outside = np.hypot(found.error, truth.error)[:, 1] > 0
        assert 0.8 < np.sqrt(np.mean(score[outside] ** 2)) < 1.9
    assert more.error.mean() < 0.35 * few.error.mean()  # a quarter for 16 times the paths


def test_the_same_for_any_threads_and_another_for_another_seed():
    scene = textured_box()
    points = np.column_stack([np.linspace(-0.4, 0.4, 50), np.zeros(50), np.full(50, -0.5)])
    one, two, other = (run(scene, points, np.repeat(UP, 50, 0), 1024, threads=t, seed=s) for t, s in
                       ((1, 0), (2, 0), (1, 1)))
    np.testing.assert_array_equal(one.values, two.values)
    assert (one.values != other.values).any()


# --- by direction ---

def test_even_light_by_direction_is_the_cosine_lobe():
    scene = scene_of((*shapes.cube(inside=True), 0.0, (2.0, 1.0, 0.5)))
    normals = np.array([[0, 0, 1.0], [0.6, 0, 0.8], [-0.48, 0.6, 0.64]])
    found = run(scene, np.zeros((3, 3)), normals, 4096, order=5)
    expected = np.pi * sh.cosine_lobe(normals, 5)[:, :, None] * [2, 1, 0.5]
    assert found.shape.shape == found.shape_error.shape == (3, 25, 3)
    np.testing.assert_allclose(found.shape, expected, atol=0.02)
    assert (found.shape_error < 0.02).all()


def test_a_small_light_by_direction_is_the_harmonics_there():
    """Below a lamp of 5 cm, 4 m off and seen at a slant; and of a second, of another colour, both at once."""
    lamps = [(*ceiling(0.025, 4.0), 0.0, (900, 0, 0)), (*ceiling(0.025, 3.0), 0.0, (0, 0, 500))]
    lamps[0][0][:, 0] += 2.0
    lamps[1][0][:, 1] -= 1.5
    found = run(scene_of(*lamps), [0, 0, 0], UP, 4096, order=5)
    for channel, place, radiance in ((0, [2.0, 0, 4], 900), (2, [0, -1.5, 3], 500)):
        way = np.array(place) / np.linalg.norm(place)
        power = radiance * 0.05 ** 2 * way[2] ** 2 / np.dot(place, place)
        assert found.values[0, channel] == pytest.approx(power, rel=5e-3)
        np.testing.assert_allclose(found.shape[0, :, channel], power * sh.evaluate(way[None], 5)[0], atol=5e-3 * power)
    assert not found.shape[0, :, 1].any()


@pytest.mark.parametrize("straight", [True, False])
def test_irradiance_follows_from_light_by_direction_and_is_the_same_without_it(straight):
    scene = textured_box()
    points = np.array([[0.1, 0.2, -0.5], [-0.5, 0.1, 0.1], [0.3, -0.3, -0.5]])
    normals = np.array([[0, 0, 1.0], [1, 0, 0], [0, 0, 1]])
    found = run(scene, points, normals, 512, order=3, straight=straight)
    np.testing.assert_allclose(found.shape[:, 0], found.values * sh.normalisation(0, 0), rtol=1e-5)
    np.testing.assert_allclose(found.shape_error[:, 0], found.error * sh.normalisation(0, 0), rtol=1e-3)
    alone = run(scene, points, normals, 512, straight=straight)
    assert alone.shape is None and alone.shape_error is None
    np.testing.assert_allclose(alone.values, found.values, rtol=1e-5)


def test_the_parts_add_up_by_direction():
    scene, points, normals = textured_box(), [[-0.2, -0.2, -0.5]], UP
    parts = [run(scene, points, normals, 8192, order=5, seed=seed, **more)
             for seed, more in enumerate((dict(), dict(depth=1), dict(straight=False)))]
    off = parts[0].shape - parts[1].shape - parts[2].shape
    noise = np.sqrt(sum(np.square(part.shape_error) for part in parts))
    assert np.abs(off / noise).max() < 5 and (noise < 0.05 * parts[0].shape[0, 0].max()).all()


def test_light_by_direction_in_a_box_agrees_with_mitsuba():
    """Radiance along cosine-distributed rays, by its path integrator, times harmonics."""
    mi = pytest.importorskip("mitsuba", reason="needs mitsuba, a development dependency, as an independent renderer")
    mi.set_variant("scalar_rgb")
    walls, light = shapes.cube(inside=True, subdivisions=0), ceiling(0.25, 0.45)
    red = walls[0][walls[1]].mean(1)[:, 0] < -0.45
    parts = [(walls[0], walls[1][~red], (0.7, 0.7, 0.7), 0), (walls[0], walls[1][red], (0.7, 0.1, 0.1), 0),
             (*light, (0.4, 0.4, 0.4), (6, 5, 4))]
    point, normal = np.array([0.15, -0.2, -0.5]), UP[0]
    world = {"type": "scene"}
    for index, (positions, triangles, albedo, emission) in enumerate(parts):
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict({"type": "twosided", "material": {
            "type": "diffuse", "reflectance": {"type": "rgb", "value": list(albedo)}}})
        if np.any(emission):
            properties["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": list(emission)}})
        shape = mi.Mesh(f"part{index}", len(positions), len(triangles), props=properties)
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = positions.astype(np.float32).ravel()
        parameters["faces"] = triangles.astype(np.uint32).ravel()
        parameters.update()
        world[f"part{index}"] = shape
    world = mi.load_dict(world)
    integrator = mi.load_dict({"type": "path", "max_depth": paths.DEPTH, "rr_depth": 100})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0)
    rng, count = np.random.default_rng(0), 6000
    ways = normal + _on_sphere(rng, count)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    radiance = np.array([np.array(integrator.sample(world, sampler, mi.RayDifferential3f(
        mi.Ray3f(list(point + 1e-4 * normal), list(way))))[0]) for way in ways])
    each = np.pi * sh.evaluate(ways, 5)[:, :, None] * radiance[:, None]
    expected, noise = each.mean(0), each.std(0) / count ** 0.5
    front = np.arange(sum(len(part[1]) for part in parts)) >= 0  # Mitsuba's lights shine from their fronts alone
    found = run(scene_of(*parts, front_only=front), point, normal, 16384, order=5)
    score = (found.shape[0] - expected) / np.hypot(noise, found.shape_error[0])
    assert np.abs(score).max() < 4.5 and np.sqrt(np.mean(score ** 2)) < 1.6
    assert np.median(noise) < 0.02 * expected[0].mean()  # and the agreement means something


# --- bad input ---

def test_no_emitter_gives_zero_and_says_so():
    scene = scene_of((*shapes.cube(inside=True), 0.5, 0.0))
    found = run(scene, [0, 0, -0.5], UP)
    assert not found.values.any() and not found.error.any() and "emits" in found.notice
    dark = run(scene, [0, 0, -0.5], UP, order=3)
    assert dark.shape.shape == (1, 9, 3) and not dark.shape.any() and "emits" in dark.notice
    assert run(textured_box(), [0, 0, -0.5], UP, 64).notice == ""


def test_sealed_open_and_degenerate_give_no_nan():
    cube, light = shapes.cube(subdivisions=0), ceiling(0.5, 2.0)
    scene = scene_of((*cube, 0.5, 0), (*light, 0.5, 1), (*quad((0, 0, 1), (0, 0, 1), (0, 0, 1), (0, 0, 1)), 0.5, 1),
                     (*quad((0, 0, 1), (1, 0, 1), (2, 0, 1), (3, 0, 1)), 0.5, 0))
    points = np.array([[0, 0, 0.0], [0, 0, 0.5], [0, 0, 5], [0, 0, 1], [1e4, 0, 0]])
    with np.errstate(all="raise"):
        found = run(scene, points, np.repeat(UP, 5, 0), 256, order=5)
    assert all(np.isfinite(each).all() for each in (found.values, found.error, found.shape, found.shape_error))
    assert not found.values[0].any()   # within the cube
    assert (found.values[1] > 0.1).all()
    assert not found.values[2].any()   # looks away, into the open


def test_a_single_triangle():
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]])
    scene = scene_of((*triangle, 0.5, 1.0))
    found = run(scene, [[0.3, 0.3, 0], [0.3, 0.3, 1e-2], [0.3, 0.3, 0]], [[0, 0, 1], [0, 0, -1], [0, 0, 0]], 512)
    assert not found.values[[0, 2]].any()  # it does not light itself; no normal, no light
    assert found.values[1] == pytest.approx(np.pi, rel=0.02)


def test_what_is_no_number_is_refused():
    positions, triangles = shapes.cube(inside=True)
    for change, words in ((dict(emission=-1), "emission"), (dict(emission=np.nan), "emission"),
                          (dict(albedo=1.5), "colours"), (dict(albedo=np.nan), "colours")):
        with pytest.raises(UserError, match=words):
            scene_of((positions, triangles, change.get("albedo", 0.5), change.get("emission", 1)))
    with pytest.raises(UserError, match="coordinates"):
        scene_of((positions * np.nan, triangles, 0.5, 1))
    with pytest.raises(UserError, match="no faces"):
        scene_of((positions, triangles[:0], 0.5, 1))
    scene = scene_of((positions, triangles, 0.5, 1))
    with pytest.raises(UserError, match="coordinates"):
        run(scene, [np.nan, 0, 0], UP)
    with pytest.raises(UserError, match="rays"):
        run(scene, [0, 0, 0], UP, 4)


def test_it_can_be_stopped():
    scene = textured_box()
    points = np.zeros((4000, 3)) + [0, 0, -0.5]
    baking = paths.irradiance(scene, points, np.repeat(UP, 4000, 0), 1024, threads=2)
    first = next(baking)
    baking.close()
    assert 0 < first < 0.1
