# SPDX-License-Identifier: GPL-3.0-or-later
"""The generated meshes: the same from the same seed, valid in every category, outward where closed."""
import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from training import fields, meshes, solids


def sides(triangles: np.ndarray) -> np.ndarray:
    """Directed edges (3F, 2)."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def is_closed(triangles: np.ndarray) -> bool:
    """Whether each side is run along as often one way as the other."""
    there, back = sides(triangles), sides(triangles)[:, ::-1]
    return np.array_equal(*(s[np.lexsort(s.T)] for s in (there, back)))


def parts(triangles: np.ndarray) -> list[np.ndarray]:
    """The triangles of each connected part."""
    a, b = sides(triangles).T
    count = triangles.max() + 1
    _, of_vertex = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)
    part = of_vertex[triangles[:, 0]]
    return [triangles[part == p] for p in np.unique(part)]


@pytest.mark.parametrize("category", meshes.CATEGORIES)
def test_every_category_is_valid(category):
    mesh = meshes.generate(11, category)
    assert mesh.category == category
    assert mesh.positions.dtype == np.float64 and np.isfinite(mesh.positions).all()
    assert meshes.FEWEST <= len(mesh.positions) <= meshes.MOST
    assert mesh.triangles.dtype == np.int32
    assert np.array_equal(np.unique(mesh.triangles), np.arange(len(mesh.positions)))  # in range, none unused
    a, b, c = mesh.triangles.T
    assert not ((a == b) | (b == c) | (c == a)).any()
    closed = [part for part in parts(mesh.triangles) if is_closed(part)]
    assert closed or category in meshes.OPEN
    assert all(solids.volume((mesh.positions, part)) > 0 for part in closed)


def test_a_room_faces_inward():
    mesh = meshes.generate(11, "room")
    shell = max((p for p in parts(mesh.triangles) if not is_closed(p)), key=len)
    corners = mesh.positions[shell] - np.mean([mesh.positions.min(0), mesh.positions.max(0)], 0)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * corners.mean(1)).sum(1) < 0).mean() > 0.95


def test_the_same_seed_gives_the_same_mesh():
    for seed, category in ((3, None), (4, "boolean"), (5, "remesh"), (6, "blobs")):  # Blender has many threads
        one, two = meshes.generate(seed, category), meshes.generate(seed, category)
        assert one.category == two.category and one.crease == two.crease
        assert np.array_equal(one.positions, two.positions) and np.array_equal(one.triangles, two.triangles)
    assert not np.array_equal(meshes.generate(1, "knot").positions[:9], meshes.generate(2, "knot").positions[:9])


def test_seeds_give_all_categories():
    assert {meshes.category_of(seed) for seed in range(600)} == set(meshes.CATEGORIES)


def test_refined_edges_are_short_and_the_shape_is_the_same():
    mesh = solids.cylinder(0.2, 5.0, 16)
    fine = solids.refine(mesh, 0.3)
    edges = fine[0][sides(fine[1])]
    assert np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1).max() <= 0.3
    assert is_closed(fine[1])
    assert solids.volume(fine) == pytest.approx(solids.volume(mesh))
    assert solids.area(fine) == pytest.approx(solids.area(mesh))


def test_a_net_is_where_its_field_is_zero():
    mesh = fields.surface(fields.ellipsoid((0.1, 0, 0), 0.8), np.full(3, -3.0), np.full(3, 3.0), 3000)
    assert np.linalg.norm(mesh[0] - [0.1, 0, 0], axis=1) == pytest.approx(0.8, abs=0.005)
    assert is_closed(mesh[1]) and len(mesh[0]) == pytest.approx(3000, rel=0.15)
    assert solids.volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.01)
    assert trimesh.Trimesh(*mesh, process=False).euler_number == 2
