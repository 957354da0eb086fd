# SPDX-License-Identifier: GPL-3.0-or-later
"""Generated rooms: closed, lit, of many kinds; their light beside Mitsuba's path integrator; the Cornell box."""
import numpy as np
import pytest

from neural_gash_addon.backend import irradiance, methods
from training import floor_plans, room_labels, rooms, solids

SEEDS = range(20)


@pytest.fixture(scope="module")
def some():
    return [rooms.generate(seed) for seed in SEEDS]


def test_the_shell_is_closed_and_faces_inwards():
    boxes = [np.array([(0, 0, 0), (3, 4, 2.5)]), np.array([(3, 1, 0), (5, 2, 2.5)]),
             np.array([(0.5, 4, 0), (1.5, 4.2, 2)]), np.array([(-1, 4.2, 0), (2, 7, 2.2)])]
    faces = floor_plans.shell(boxes)
    positions, triangles = solids.merge(list(faces.values()))
    corners = positions[triangles]
    volume = np.einsum("fx,fx->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert -volume == pytest.approx(sum(np.prod(high - low) for low, high in boxes))  # the boxes only touch
    # each edge is walked once each way: closed, and no corner lies within another's edge
    ends = np.stack([corners, np.roll(corners, -1, 1)], 2).reshape(-1, 6).round(9)
    there = {tuple(e) for e in ends}
    assert len(there) == len(ends) and there == {(*e[3:], *e[:3]) for e in ends}
    floor = sum(solids.area(mesh) for (_, axis, up), mesh in faces.items() if axis == 2 and up)
    assert floor == pytest.approx(12 + 2 + 0.2 + 8.4)


def test_rooms_are_closed_and_lit(some):
    for seed, scene in zip(SEEDS, some, strict=True):
        assert len(scene.emitters) and np.ptp(scene.positions, axis=0).max() <= floor_plans.LARGEST
        occluders = scene.occluders()
        asked = room_labels.visible_points(scene, 200, seed, occluders)
        assert len(asked) == 200
        rng = np.random.default_rng(seed)
        ways = asked[:, 3:6] + rng.normal(size=(200, 3)) * 0.3
        ways *= np.sign((ways * asked[:, 3:6]).sum(1, keepdims=True))
        hits = occluders.hits(occluders.origins(asked[:, :3], asked[:, 3:6]), np.ascontiguousarray(ways, np.float32))
        assert len(hits.rays) == 200                # nothing looks out
        assert hits.front.mean() > 0.97             # and all faces the way light comes


def test_rooms_are_of_many_kinds(some):
    plans = [floor_plans.plan(np.random.default_rng(seed)) for seed in range(200)]
    count = np.bincount([len(p.rooms) for p in plans], minlength=4)
    assert (count[1:] > 15).all() and not count[0]
    assert 0.2 < np.mean([any(len(r) > 1 for r, _ in p.rooms) for p in plans]) < 0.8
    assert all(len(p.doors) == len(p.rooms) - 1 for p in plans)
    assert 0.5 < np.mean([len(scene.pictures) > 0 for scene in some]) <= 1
    emitted = [scene.areas[scene.emitters].sum() for scene in some]
    assert np.quantile(emitted, 0.9) > 5 * np.quantile(emitted, 0.1)
    spread = np.concatenate([np.ptp(scene.albedo, axis=1) for scene in some])
    assert (spread > 0.4).mean() > 0.05 and (spread < 0.1).mean() > 0.1  # saturated and muted
    picture = next(p for scene in some for p in scene.pictures)
    assert picture.lookups().std(1).max() > 0.02                       # albedo varies within a face


def test_the_same_seed_is_the_same_room(some):
    again = rooms.generate(SEEDS[3])
    for key in ("positions", "triangles", "albedo", "emission"):
        np.testing.assert_array_equal(getattr(again, key), getattr(some[3], key))
    assert any(len(a.triangles) != len(some[0].triangles) for a in some[1:])


@pytest.mark.parametrize("seed", [449, 3_000_006])
def test_an_opening_may_be_as_wide_as_the_wall(seed):
    """Rounding left less than no room to place it in."""
    assert len(rooms.generate(seed).triangles) > 50


def test_given_meshes_stand_in_rooms(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    ring = trimesh.creation.annulus(0.2, 1, 0.5, sections=77)
    ring.apply_translation([3, 4, 5])
    ring.export(tmp_path / "ring.ply")
    files, rng, rings = [tmp_path / "ring.ply"], np.random.default_rng(0), 0
    for _ in range(300):
        meshes, _ = rooms._piece(rng, files)
        if len(meshes[0][1]) == len(ring.faces):
            rings += 1
            low, high = meshes[0][0].min(0), meshes[0][0].max(0)
            assert low + high == pytest.approx([0, 0, high[2]], abs=1e-6) and low[2] == pytest.approx(0, abs=1e-9)
            assert 0.3 <= (high - low).max() <= 1.2
            assert (high - low) / (high - low).max() == pytest.approx(ring.extents / ring.extents.max(), rel=1e-4)
    assert rings == pytest.approx(300 * rooms._SEEN, abs=25)
    assert any(len(rooms.generate(s, files).triangles) != len(rooms.generate(s).triangles) for s in range(3))


def test_the_cornell_box_has_its_measurements():
    scene = rooms.cornell_box()
    assert scene.positions.min(0) == pytest.approx([0, 0, 0]) and scene.positions.max(0) == pytest.approx(
        [0.556, 0.5592, 0.5488])
    light = scene.emitters
    assert scene.areas[light].sum() == pytest.approx(0.130 * 0.105)
    assert scene.normals[light] == pytest.approx(np.tile([0, 0, -1.0], (2, 1)))
    down = scene.normals[:, 2] < -0.9
    assert scene.areas[down].sum() == pytest.approx(0.556 * 0.5592)  # the light fills the hole in the ceiling
    # the blocks: 165 mm and 330 mm high, near enough squares of 165 mm, and their faces look outwards
    for high, near in ((0.165, (0.371, 0.169)), (0.33, (0.188, 0.351))):
        top = np.flatnonzero(np.isclose(scene.corners[:, :, 2], high).all(1))
        assert np.sqrt(scene.areas[top].sum()) == pytest.approx(0.165, abs=0.004)
        centre = scene.corners[top].mean((0, 1))
        assert centre[:2] == pytest.approx(near, abs=0.005)
        sides = np.flatnonzero(np.isclose(scene.corners[:, :, 2].max(1), high) & (np.abs(scene.normals[:, 2]) < 0.1)
                               & (np.linalg.norm(scene.corners.mean(1)[:, :2] - centre[:2], axis=1) < 0.12))
        out = ((scene.corners[sides].mean(1) - centre)[:, :2] * scene.normals[sides, :2]).sum(1)
        assert len(sides) == 8 and (out > 0).all()
    red, green = (scene.albedo[:, k] > 2 * scene.albedo[:, 1 - k] for k in (0, 1))
    assert scene.normals[red, 0].min() > 0.99 and scene.normals[green, 0].max() < -0.99


def test_the_cornell_box_agrees_with_another_copy(meshes):
    """Areas and emitted power of the copy in ../shared/meshes, which was made by others of the same data."""
    found = np.load(meshes / "scenes" / "scene_cornell_box.npz")
    corners = found["verts"][found["faces"]] / 1000
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    scene = rooms.cornell_box()
    assert (scene.emission.T @ scene.areas) == pytest.approx(found["face_emission"].T @ areas, rel=0.01)
    for colour in ((0.14, 0.45, 0.091), (0.63, 0.065, 0.05)):
        ours, theirs = ((np.abs(a - colour) < 1e-3).all(1) for a in (scene.albedo, found["face_albedo"]))
        assert scene.areas[ours].sum() == pytest.approx(areas[theirs].sum(), rel=0.01)


# --- Mitsuba ---

POINTS, SAMPLES, REPEATS = 24, 1024, 4


def mitsuba_irradiance(mi, scene, asked):
    """Irradiance (N, 3) by radiance meters that look at the points, and its standard error."""
    world = {"type": "scene", "integrator": {"type": "path", "max_depth": 1 + irradiance.DEPTH, "rr_depth": 100}}
    textured = {int(t): number for number, picture in enumerate(scene.pictures) for t in picture.triangles}
    groups: dict = {}
    for face in range(len(scene.triangles)):
        key = textured.get(face, (*scene.albedo[face], *scene.emission[face]))
        groups.setdefault(key, []).append(face)
    for index, (key, faces) in enumerate(groups.items()):
        properties = mi.Properties()
        if isinstance(key, int):
            picture = scene.pictures[key]
            pixels = np.ascontiguousarray(picture.pixels)
            reflectance = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "wrap_mode": "repeat"}
        else:
            reflectance = {"type": "rgb", "value": list(scene.albedo[faces[0]])}
        properties["bsdf"] = mi.load_dict({"type": "twosided", "material": {
            "type": "diffuse", "reflectance": reflectance}})
        if not isinstance(key, int) and any(key[3:]):
            properties["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": list(key[3:])}})
        shape = mi.Mesh(f"part{index}", 3 * len(faces), len(faces), has_vertex_texcoords=isinstance(key, int),
                        props=properties)
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = scene.corners[faces].astype(np.float32).ravel()
        parameters["faces"] = np.arange(3 * len(faces), dtype=np.uint32)
        if isinstance(key, int):
            uv = picture.uv
            parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
        parameters.update()
        world[f"part{index}"] = shape
    world = mi.load_dict(world)
    values = []
    for point, normal, albedo in asked.reshape(-1, 3, 3).astype(float):
        meter = mi.load_dict({
            "type": "radiancemeter", "origin": list(point + 5e-4 * normal), "direction": list(-normal),
            "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}})
        values.append([np.pi / albedo * np.array(mi.render(world, sensor=meter, spp=SAMPLES, seed=seed)).reshape(3)
                       for seed in range(REPEATS)])
    values = np.array(values)
    return values.mean(1), values.std(1, ddof=1) / REPEATS ** 0.5


def not_emitting(scene, asked, occluders):
    """Those of points (N, 9) that show a meter no light of their own, and are not so dark as to amplify its noise."""
    below = occluders.hits(occluders.origins(asked[:, :3] + 1e-4 * asked[:, 3:6], asked[:, 3:6]),
                           np.ascontiguousarray(-asked[:, 3:6]))
    return asked[below.rays][~scene.emission[below.faces].any(1) & (asked[below.rays, 6:].min(1) > 0.04)]


def test_light_in_the_cornell_box_agrees_with_mitsuba():
    """Little noise there: a bias of half a per cent would be seen."""
    mi = pytest.importorskip("mitsuba", reason="needs mitsuba, a development dependency, as an independent renderer")
    mi.set_variant("scalar_rgb")
    scene = rooms.cornell_box()
    occluders = scene.occluders()
    asked = not_emitting(scene, room_labels.visible_points(scene, 80, 0, occluders), occluders)
    expected, noise = mitsuba_irradiance(mi, scene, asked)
    found = methods.run(irradiance.irradiance(scene, asked[:, :3], asked[:, 3:6], 16384, occluders=occluders))
    sigma = np.hypot(np.maximum(noise, 0.5 * np.median(noise / expected) * expected), found.error)
    assert np.sqrt(np.mean(((found.values - expected) / sigma) ** 2)) < 1.4  # 1.1 was seen
    total = np.sqrt(np.square(sigma).sum(0)) / expected.sum(0)
    assert total.max() < 2e-3
    assert found.values.sum(0) / expected.sum(0) == pytest.approx(1, abs=4 * total.max())


@pytest.mark.parametrize("seed", [0, 5, 10])
def test_light_in_rooms_agrees_with_mitsuba(seed):
    mi = pytest.importorskip("mitsuba", reason="needs mitsuba, a development dependency, as an independent renderer")
    mi.set_variant("scalar_rgb")
    scene = rooms.generate(seed)
    occluders = scene.occluders()
    asked = not_emitting(scene, room_labels.visible_points(scene, 4 * POINTS, seed, occluders), occluders)[:POINTS]
    expected, noise = mitsuba_irradiance(mi, scene, asked)
    found = methods.run(irradiance.irradiance(scene, asked[:, :3], asked[:, 3:6], 8192, seed=seed))
    # four repeats tell a standard error to a third, so it is not taken below half of what is usual here
    lit = expected.min(1) > 1e-3 * expected.max()
    usual = np.median(noise[lit] / expected[lit])
    sigma = np.hypot(np.maximum(noise, 0.5 * usual * expected), found.error)
    score = (found.values - expected)[lit] / sigma[lit]
    # 4 standard errors each, but for the tail that few rare paths of a bright bulb make, and for all together
    assert (np.abs(score) < 4).mean() > 0.97 and np.sqrt(np.mean(score ** 2)) < 1.6
    assert (np.abs((found.values - expected).sum(0)) < 4 * np.sqrt(np.square(sigma).sum(0))).all()
    assert found.values[~lit] == pytest.approx(expected[~lit], abs=2e-3 * expected.max())
    assert lit.mean() > 0.7 and np.median(sigma[lit] / expected[lit]) < 0.08  # and the agreement means something
