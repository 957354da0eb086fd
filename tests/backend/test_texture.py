# SPDX-License-Identifier: GPL-3.0-or-later
"""Texture bakes: atlas, points of texels, seams, tiles that are resumed."""
import json

import numpy as np
import pytest

from neural_gash_addon.backend import methods, metrics, packing, texture
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.atlas import Part, check_area
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.geometry import Surface, TriangleMesh
from neural_gash_addon.backend.raster import Layout
from neural_gash_addon.backend.texels import bilinear, texel_points
from neural_gash_addon.backend.unwrap import unwrap

from . import shapes


def surface(geometry, smooth=True, quads=False):
    """A mesh of triangles (or of pairs of them) as a Surface."""
    positions, triangles = np.asarray(geometry[0], float), np.asarray(geometry[1], np.int32)
    mesh = TriangleMesh.from_triangles(positions, triangles, smooth)
    normals = mesh.normals[mesh.elements[triangles]] if mesh.domain == "POINT" else \
        mesh.normals[mesh.elements].reshape(-1, 3, 3)
    count = len(triangles)
    return Surface(positions, triangles.ravel(), normals.reshape(-1, 3).astype(np.float32),
                   np.repeat(np.arange(count, dtype=np.int32), 3),
                   np.arange(3 * count, dtype=np.int32).reshape(-1, 3), 0.0)


def atlas(mesh, side=128, **settings):
    return methods.run(unwrap(mesh, side=side, **settings))


def lookup(result, uv):
    """Coefficients (n, K) at uv (n, 2), as a shader gets them."""
    side, filled = result.record.side, result.fill_map()
    images = [bilinear(result.image(i, filled).reshape(side, side, 4), uv)
              for i in range(texture.image_count(result.record.terms))]
    return np.concatenate(images, 1)[:, :result.record.order ** 2]


def surface_samples(mesh, uv, count=4000, seed=0, edges=False):
    """Random points of the mesh: uv (n, 2) and unit normals (n, 3); on the triangles' edges if asked."""
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet([1, 1, 1], count)
    if edges:
        weights[:, 2] = 0
        weights /= weights.sum(1, keepdims=True)
    corners = mesh.corners[rng.integers(0, len(mesh.corners), count)]
    normals = np.einsum("nc,ncx->nx", weights, mesh.corner_normals[corners].astype(float))
    return np.einsum("nc,ncx->nx", weights, uv[corners]), normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("geometry", [shapes.cube(), shapes.sphere(), shapes.torus()], ids=["cube", "sphere", "torus"])
def test_atlas_gives_every_face_room_of_its_own(geometry):
    mesh = surface(geometry)
    found = atlas(mesh)
    assert found.side == 128 and found.uv.min() >= 0 and found.uv.max() <= 1
    uv = found.uv[mesh.corners]
    assert not len(Layout(uv, mesh.triangles, 512).overlapping())
    corners = mesh.positions[mesh.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    density = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / area
    assert np.percentile(density, 2) > 0.5 * np.median(density) and density.max() < 2 * np.median(density)
    assert 0.35 < density @ area / 2 < 1   # well filled


def test_polygons_are_not_torn():
    positions, triangles = shapes.torus()
    mesh = surface((positions, triangles))
    # pairs of triangles that share two corners, as Blender's quads do
    count = len(triangles) // 2 * 2
    quads = [(a, b) for a, b in zip(range(0, count, 2), range(1, count, 2), strict=True)
             if len(set(triangles[a]) & set(triangles[b])) == 2]
    assert len(quads) > 50
    faces, corners, vertices, normals = [], [], [], []
    for number, (a, b) in enumerate(quads):
        own = list(dict.fromkeys([*triangles[a], *triangles[b]]))
        start = len(vertices)
        vertices += own
        corners += [[start + own.index(v) for v in triangles[t]] for t in (a, b)]
        faces += [number] * len(own)
        normals += [mesh.corner_normals[np.flatnonzero(triangles.ravel() == v)[0]] for v in own]
    quad = Surface(positions, np.array(vertices), np.array(normals), np.array(faces), np.array(corners), 0.0)
    found = atlas(quad, 256)
    assert not len(Layout(found.uv[quad.corners], quad.triangles, 1024).overlapping())
    uv = found.uv[quad.corners]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    assert (np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > 0).all()


def test_texels_per_metre_decide_the_side():
    mesh = surface(shapes.cube())
    small, large = (methods.run(unwrap(mesh, side=None, texels_per_metre=d)) for d in (32, 64))
    assert large.side == pytest.approx(2 * small.side, rel=0.15)
    uv = large.uv[mesh.corners] * large.side
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    assert np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2 == pytest.approx(6 * 64 ** 2, rel=0.1)


def test_too_small_a_texture_is_refused():
    with pytest.raises(UserError, match="too small"):
        atlas(surface(shapes.torus(), smooth=False), 16, padding=8)
    with pytest.raises(UserError, match="too small for the charts"):  # of which none was placed
        atlas(surface(shapes.torus(), smooth=False), 16, padding=64)


def test_boxes_are_apart_and_as_small_as_turning_makes_them():
    """Rectangles turned by chance: the boxes are the rectangles again, and keep the padding's distance."""
    rng = np.random.default_rng(0)
    sides = rng.uniform(0.2, 3, (200, 2))
    corners = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]]) * sides[:, None, None]
    angle = rng.uniform(0, 7, 200)
    turns = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], 1).reshape(-1, 2, 2)
    local = np.einsum("nij,ntcj->ntci", turns, corners).reshape(-1, 3, 2)
    charts = np.arange(200).repeat(2)
    shuffled = rng.permutation(400)
    turned, boxes = methods.run(packing.boxed(local[shuffled], charts[shuffled]))
    np.testing.assert_allclose(boxes, np.sort(sides, 1)[:, ::-1], rtol=0.01)   # to a sixteenth of a degree
    assert np.abs(turned[np.argsort(shuffled)].reshape(200, 6, 2).min(1)).max() < 1e-12
    lengths = [np.linalg.norm(a - np.roll(a, 1, 1), axis=2) for a in (turned, local[shuffled])]
    np.testing.assert_allclose(*lengths, atol=1e-12)
    for padding, side in ((1, 256), (4, 512)):
        lower, _, scale = methods.run(packing.arranged(boxes, float(sides.prod(1).sum()), side=side, density=None,
                                                       padding=padding))
        upper = lower + boxes * scale
        assert lower.min() >= padding and upper.max() <= side - padding + 1e-9
        apart = np.maximum(lower[:, None] - upper, lower - upper[:, None]).max(-1) + 1e9 * np.eye(200)
        assert apart.min() > 2 * padding + 1 - 1e-9
        assert (boxes * scale + 2 * padding + 1).prod(1).sum() > 0.88 * side ** 2   # well filled
        _, grown, _ = methods.run(packing.arranged(boxes, 1.0, side=None, density=scale, padding=padding))
        assert grown == pytest.approx(side, rel=0.03)


@pytest.mark.parametrize("width", [1e-2, 1e-7])
def test_long_and_thin_meshes_have_room(width):
    """A skirting board, and a needle."""
    strip = np.array([[0., 0, 0], [10, 0, 0], [10, width, 0], [0, width, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    found = atlas(surface(strip), 256)
    assert np.ptp(found.uv, axis=0).max() > 0.95
    assert len(methods.run(texture.bake(surface(strip), "analytic", 2, side=64)).texels)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_atlas_does_not_depend_on_scale(scale):
    positions, triangles = shapes.torus()
    near = atlas(surface((positions, triangles)))
    far = atlas(surface((scale * positions, triangles)))
    np.testing.assert_allclose(far.uv, near.uv, atol=0.02)


def test_broken_faces_are_laid_out_without_a_crash():
    positions, triangles = shapes.sphere(2)
    positions = positions.copy()
    positions[triangles[3]] = positions[triangles[3, 0]]              # a point
    positions[triangles[9, 1]] = positions[triangles[9, 2]] + 1e-12   # a line
    triangles = np.concatenate([triangles, triangles[:5], triangles[5:9, ::-1]])  # twice, and turned round
    mesh = surface((positions, triangles))
    found = atlas(mesh, 256)
    assert np.isfinite(found.uv).all() and found.uv.min() >= 0 and found.uv.max() <= 1
    assert 1 <= len(np.unique(mesh.polygons[found.alone])) < 40
    assert not len(Layout(found.uv[mesh.corners], mesh.triangles, 512).overlapping())
    result = methods.run(texture.bake(mesh, "analytic", 2, side=64))
    assert result.record.single_faces >= 1 and methods.run(
        texture.bake(surface(shapes.sphere(2)), "analytic", 2, side=64)).record.single_faces == 0


def test_convex_mesh_equals_the_analytic_coefficients_across_seams():
    mesh = surface(shapes.sphere(3))
    found = atlas(mesh, 256)
    result = methods.run(texture.bake(mesh, "embree", 5, uv=found.uv, side=256, rays=64))
    every = {}
    for name, edges in (("inside", False), ("edges", True)):
        uv, normals = surface_samples(mesh, found.uv, edges=edges)
        every[name] = metrics.rel_l2(lookup(result, uv), sh.cosine_lobe(normals, 5))
    uv = found.uv[mesh.corners]
    starts = {}
    for face, triangle in enumerate(mesh.triangles):
        for edge in range(3):
            pair = (triangle[edge], triangle[(edge + 1) % 3])
            starts[pair] = (uv[face, edge], uv[face, (edge + 1) % 3])
    on_seam = [pair for pair in starts if not np.allclose(starts[pair][0], starts[pair[::-1]][1])
               or not np.allclose(starts[pair][1], starts[pair[::-1]][0])]
    assert len(on_seam) > 10
    share = np.random.default_rng(3).uniform(size=(len(on_seam), 1))
    places = np.array([starts[p][0] for p in on_seam]) * (1 - share) + np.array([starts[p][1] for p in on_seam]) * share
    vertex_normals = np.zeros_like(mesh.positions)
    vertex_normals[mesh.corner_vertices] = mesh.corner_normals
    ends = vertex_normals[np.array(on_seam)]
    normals = ends[:, 0] * (1 - share) + ends[:, 1] * share
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    at_seam = metrics.rel_l2(lookup(result, places), sh.cosine_lobe(normals, 5))
    assert every["inside"] < 0.01 and every["edges"] < 0.01
    assert at_seam < 2 * every["inside"]


def test_floor_under_a_box_has_its_shadow_and_none_where_it_is_open():
    floor = (np.array([[-2., -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    box = shapes.cube()
    occluder = (box[0] * 0.8 + [0, 0, 0.5], box[1])
    mesh = surface(floor)
    uv = (mesh.positions[mesh.corner_vertices][:, :2] + 2) / 4
    result = methods.run(texture.bake(mesh, uv=uv, side=64, order=3, rays=256, occluders=[occluder]))
    reference_points = np.array([[0.9, 0.1, 0], [1.4, -1.2, 0], [0.55, 0.5, 0], [-1.9, 1.9, 0]])
    target = shapes.at_points(floor, reference_points, np.tile([0., 0, 1], (4, 1)))
    truth = methods.run(methods.bake(target, order=3, rays=4096, seed=7, occluders=[occluder])).coefficients
    found = lookup(result, (reference_points[:, :2] + 2) / 4)
    np.testing.assert_allclose(found, truth, atol=0.02)
    assert lookup(result, np.array([[0.5, 0.5]]))[0, 0] < 0.25 * sh.cosine_lobe(np.array([[0., 0, 1]]), 3)[0, 0]
    open_floor = methods.run(texture.bake(mesh, uv=uv, side=64, order=3, rays=64))
    np.testing.assert_allclose(lookup(open_floor, np.random.default_rng(0).uniform(size=(50, 2))),
                               np.tile(sh.cosine_lobe(np.array([[0., 0, 1]]), 3), (50, 1)), atol=1e-6)


def test_closed_box_lets_no_light_in():
    mesh = surface(shapes.cube(inside=True), smooth=False)
    found = atlas(mesh, 64)
    result = methods.run(texture.bake(mesh, uv=found.uv, side=64, order=3, rays=64))
    assert max(np.abs(c).max() for c in result.coefficients) < 1e-6


def test_coarse_smooth_mesh_does_not_shadow_itself():
    mesh = surface(shapes.sphere(1))
    found = atlas(mesh, 64)
    result = methods.run(texture.bake(mesh, uv=found.uv, side=64, order=3, rays=256))
    coverage = Layout(found.uv[mesh.corners], mesh.triangles, 64).coverage()
    exact = sh.cosine_lobe(texel_points(mesh, coverage).normals, 3)
    assert metrics.rel_l2(np.concatenate(result.coefficients), exact) < 0.01


def test_points_are_where_the_uv_map_says():
    mesh = surface(shapes.torus())
    found = atlas(mesh, 128)
    uv = found.uv[mesh.corners]
    coverage = Layout(uv, mesh.triangles, 128).coverage()
    inside = np.abs(coverage.centres - coverage.barycentric).max(1) < 1e-9
    places = np.einsum("nc,ncx->nx", coverage.barycentric, uv[coverage.faces])[inside] * 128
    centres = np.stack([coverage.texels % 128, coverage.texels // 128], 1)[inside] + 0.5
    np.testing.assert_allclose(places, centres, atol=1e-6)
    points = texel_points(mesh, coverage)
    np.testing.assert_allclose(np.linalg.norm(points.normals, axis=1), 1)
    ring = np.hypot(points.points[:, 0], points.points[:, 1]) - 1
    np.testing.assert_allclose(np.hypot(ring, points.points[:, 2]), 0.45, atol=0.02)


class Stopped(Exception):
    pass


def test_a_bake_that_was_killed_goes_on_and_gives_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(texture, "_TILE", 64 * 16)
    mesh = surface(shapes.torus())
    found = atlas(mesh, 64)
    settings = {"order": 3, "tolerance": 0.05, "key": "a"}
    whole = methods.run(texture.bake(mesh, uv=found.uv, side=64, **settings))
    assert len(whole.texels) == 4
    baking = texture.bake(mesh, uv=found.uv, side=64, folder=tmp_path / "tiles", **settings)
    while len(list((tmp_path / "tiles").glob("*.json"))) < 4:   # the job's and three tiles'
        next(baking)
    baking.close()
    torn = tmp_path / "tiles" / "0001.npy"
    torn.write_bytes(torn.read_bytes()[:-100])   # half-written
    traced = []
    original = methods.bake
    monkeypatch.setattr(methods, "bake", lambda *a, **k: traced.append(1) or original(*a, **k))
    again = methods.run(texture.bake(mesh, uv=found.uv, side=64, folder=tmp_path / "tiles", **settings))
    assert len(traced) == 2                       # the torn one, and the one that was missing
    for a, b in zip(whole.coefficients, again.coefficients, strict=True):
        assert a.tobytes() == np.asarray(b).tobytes()
    assert again.record.rays == whole.record.rays and again.record.error_estimate == whole.record.error_estimate
    methods.run(texture.bake(mesh, uv=found.uv, side=64, folder=tmp_path / "tiles", **{**settings, "key": "b"}))
    assert len(traced) == 6                       # another bake: nothing of the first is taken
    (tmp_path / "tiles" / "mine.txt").write_text("kept")
    texture.remove_tiles(tmp_path / "tiles")
    assert [p.name for p in (tmp_path / "tiles").iterdir()] == ["mine.txt"]


def test_record_tells_of_the_texture():
    mesh = surface(shapes.torus())
    record = methods.run(texture.bake(mesh, uv=atlas(mesh, 64).uv, side=64, order=2, rays=16, seed=5)).record
    assert (record.target, record.side, record.domain, record.order, record.seed) == ("texture", 64, "TEXEL", 2, 5)
    assert record.rays == 16 * record.points and 0 < record.error_estimate < 0.2
    assert json.loads(record.to_json())["side"] == 64


def test_overlapping_faces_are_named():
    mesh = surface(shapes.cube())
    uv = atlas(mesh, 64).uv
    uv[mesh.corners[4]] = uv[mesh.corners[9]]
    with pytest.raises(UserError, match="4 and 9"):
        methods.run(texture.bake(mesh, uv=uv, side=64, rays=4))


@pytest.mark.parametrize("side", [0, 8, 10000])
def test_sides_out_of_range_are_refused(side):
    mesh = surface(shapes.cube())
    with pytest.raises(UserError, match="resolution"):
        methods.run(texture.bake(mesh, uv=np.zeros((len(mesh.corner_vertices), 2)), side=side, rays=4))


def test_uv_map_without_area_is_refused():
    mesh = surface(shapes.cube())
    with pytest.raises(UserError):
        methods.run(texture.bake(mesh, uv=np.full((len(mesh.corner_vertices), 2), 0.5), side=32, rays=4))


@pytest.mark.parametrize("lost", ["at the origin", "in the middle", "on a line", "one face"])
def test_faces_without_area_in_the_uv_map_are_named(lost):
    """They would show what texels of others do, or one texel."""
    floor = np.array([[-2., -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]])
    mesh = surface((np.concatenate([floor, floor + [0, 0, 1]]), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])))
    uv = (mesh.positions[mesh.corner_vertices][:, :2] + 2) / 4
    if lost == "one face":
        uv[6:9] = 0.5
    elif lost == "on a line":
        uv[:, 1] = 0.3
    else:
        uv[:] = 0 if lost == "at the origin" else 0.5
    first = 2 if lost == "one face" else 0
    with pytest.raises(UserError, match=rf"^{1 if first else 4} of the faces have no area .* is {first}\)"):
        check_area(Part(mesh, uv))


def test_own_atlas_equals_the_one_made_before():
    mesh = surface(shapes.torus())
    both = [methods.run(texture.bake(mesh, uv=uv, side=64, order=2, rays=16)) for uv in (None, atlas(mesh, 64).uv)]
    np.testing.assert_array_equal(both[0].uv, both[1].uv)
    np.testing.assert_array_equal(both[0].coefficients[0], both[1].coefficients[0])
    sized = methods.run(texture.bake(mesh, texels_per_metre=10, order=2, rays=4))
    assert 20 < sized.record.side < 200
    with pytest.raises(UserError, match="resolution"):
        methods.run(texture.bake(mesh, rays=4))


@pytest.mark.parametrize("tolerance", [0.1, 0.03])
def test_a_fitted_texture_has_the_error_asked_for(tolerance):
    from neural_gash_addon.backend import resolution
    from neural_gash_addon.backend.raster import Coverage
    mesh = surface(shapes.torus())
    uv = atlas(mesh, 512).uv
    side = methods.run(resolution.fitting_side(mesh, uv, error=tolerance, order=3))
    errors = []
    for size in (side, side // 2):
        result = methods.run(texture.bake(mesh, "embree", 3, uv=uv, side=max(size, 16), rays=1024))
        rng = np.random.default_rng(4)
        faces = rng.integers(0, len(mesh.triangles), 1000)
        weights = rng.dirichlet([1, 1, 1], 1000)
        points = texel_points(mesh, Coverage(1, np.arange(1000), faces, weights, weights))
        exact = methods.run(methods.bake(points, "embree", 3, rays=4096, seed=3)).coefficients
        found = lookup(result, np.einsum("nc,ncx->nx", weights, uv[mesh.corners[faces]]))
        errors.append(metrics.rel_l2(found, exact))
    assert errors[0] < 1.5 * tolerance < 6 * errors[1], (side, errors)


@pytest.mark.parametrize(("padding", "levels"), [(2, 1), (4, 2), (8, 3)])
def test_no_seam_at_the_mip_levels_that_the_padding_keeps_apart(padding, levels):
    mesh, side = surface(shapes.sphere()), 512
    result = methods.run(texture.bake(mesh, "analytic", 3, side=side, padding=padding))
    uv, ends = result.uv[mesh.corners], {}
    for face, triangle in enumerate(mesh.triangles):
        for edge in range(3):
            ends[triangle[edge], triangle[(edge + 1) % 3]] = uv[face, edge], uv[face, (edge + 1) % 3]
    cut = {pair for pair, places in ends.items() if not np.allclose(places, ends[pair[::-1]][::-1])}
    assert len(cut) > 10
    vertex_normals = np.zeros_like(mesh.positions)
    vertex_normals[mesh.corner_vertices] = mesh.corner_normals
    filled = result.fill_map()
    images = [result.image(i, filled).reshape(side, side, 4) for i in range(3)]
    for level in range(levels + 1):
        if level:
            images = [im.reshape(len(im) // 2, 2, len(im) // 2, 2, 4).mean((1, 3)) for im in images]
        half = 0.5 / len(images[0])
        error = []
        for pairs in (cut, ends.keys() - cut):
            pairs = np.array(sorted(pairs))
            share = np.random.default_rng(level).uniform(size=(len(pairs), 1))
            places = np.array([ends[tuple(p)] for p in pairs])
            places = np.clip(places[:, 0] * (1 - share) + places[:, 1] * share, half, 1 - half)  # no texture repeats
            normals = vertex_normals[pairs[:, 0]] * (1 - share) + vertex_normals[pairs[:, 1]] * share
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            found = np.concatenate([bilinear(im, places) for im in images], 1)[:, :9]
            error.append(metrics.rel_l2(found, sh.cosine_lobe(normals, 3)))
        assert error[0] <= 2 * error[1], (level, error)


def test_a_lookup_whose_texels_other_charts_took_reads_the_nearest_one():
    from neural_gash_addon.backend import resolution
    from neural_gash_addon.backend.raster import Coverage
    side, covered = 16, np.sort(np.random.default_rng(0).choice(256, 12, replace=False))
    none = np.zeros((12, 3))
    places = np.random.default_rng(1).uniform(0.05, 0.95, (200, 2))
    rows, mix = resolution._around(Coverage(side, covered, np.zeros(12, np.int32), none, none), places)
    np.testing.assert_allclose(mix.sum(1), 1)
    x = places * side - 0.5
    corners = np.floor(x)[:, None] + [(0, 0), (1, 0), (0, 1), (1, 1)]
    lost = ~np.isin(corners[..., 1] * side + corners[..., 0], covered).any(1)
    assert lost.sum() > 50
    at = np.stack([covered % side, covered // side], 1)
    away = np.linalg.norm(at[None] - np.rint(x)[lost, None], axis=2)
    np.testing.assert_allclose(away[np.arange(lost.sum()), rows[lost, 0]], away.min(1))
    assert (mix[lost, 0] == 1).all()
