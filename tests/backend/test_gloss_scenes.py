# SPDX-License-Identifier: GPL-3.0-or-later
"""Whole glossy pictures of three scenes that shadow themselves against Mitsuba 3's path tracer.

Camera, visibility and integration are Mitsuba's own; the BSDF that it samples is the lobe written
out. With nine bands the two must be the same but for noise, which `compare` takes out; with the
five of a bake they differ by what is cut off.
"""
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks import pictures
from neural_gash_addon.backend import embree_bake, gloss, methods
from neural_gash_addon.backend import spherical_harmonics as sh

from . import shapes
from .test_gloss_mitsuba import sky

trimesh = pytest.importorskip("trimesh")

ORDER, MORE = 5, 9
SAMPLES = 64
FLOOR = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], float), np.array([[0, 1, 2], [0, 2, 3]])
# exponent -> the most that five bands may lose, in the open and where little light comes in
OPEN, NARROW = {1: 0.05, 10: 0.10, 50: 0.24}, {1: 0.15, 10: 0.25, 50: 0.48}


def join(*parts):
    starts = np.cumsum([0, *(len(positions) for positions, _ in parts)])
    return (np.concatenate([positions for positions, _ in parts]),
            np.concatenate([triangles + n for (_, triangles), n in zip(parts, starts, strict=False)]).astype(np.int32))


def box(size, place):
    made = trimesh.creation.box(size)
    return np.array(made.vertices) + place, np.array(made.faces)


def ring():
    positions, triangles = shapes.torus(sections=48)
    return join((positions + [0, 0, 0.45], triangles), FLOOR), (2.5, -3.5, 3.0), (0, 0, 0.2), OPEN


def alcove():
    positions, triangles = shapes.cube(inside=True)
    front = positions[triangles][..., 1].max(1) < -0.49
    ball = shapes.sphere()
    return join((3 * positions, triangles[~front]), (0.7 * ball[0] + [0.4, 0.2, -0.8], ball[1])), \
        (0.8, -5, 0.6), (0, 0, -0.2), NARROW


def table():
    legs = [box((0.3, 0.3, 1), (x, y, 0.5)) for x in (-1, 1) for y in (-0.7, 0.7)]
    return join(FLOOR, box((2.6, 2, 0.15), (0, 0, 1.075)), *legs), (3.5, -4.5, 2.5), (0, 0, 0.5), OPEN


class Scene(NamedTuple):
    eyes: list             # two, of points of their own
    products: dict         # how -> two (N, K, 3)
    traced: object
    lost: dict             # exponent -> the most that five bands may lose


@pytest.fixture(scope="module", params=[ring, alcove, table], ids=lambda made: made.__name__)
def scene(request, tmp_path_factory):
    mi = pytest.importorskip("mitsuba", reason="needs mitsuba, a development dependency, as an independent renderer")
    mi.set_variant("scalar_rgb")  # an LLVM that is too old for the others ends the process
    geometry, origin, target, lost = request.param()
    camera, lamp = pictures.Camera(origin, target, 40, 32, 24), sky()
    eyes = [pictures.Seen(geometry, camera, 4, seed) for seed in (0, 1)]
    products = {"five": [], "nine": [], "open": []}
    for seed, eye in enumerate(eyes):
        wide = methods.run(embree_bake.bake(eye.mesh, MORE, rays=512, tolerance=None, occluders=(), seed=seed,
                                            threads=None)).coefficients
        baked = methods.run(methods.bake(eye.mesh, order=ORDER, rays=512, seed=seed)).coefficients
        for how, transfer in (("five", baked), ("nine", wide), ("open", sh.cosine_lobe(eye.mesh.normals, ORDER))):
            products[how].append(gloss.transferred(transfer, lamp))
    traced = pictures.PathTraced(mi, geometry, camera, lamp, tmp_path_factory.mktemp("scene"))
    return Scene(eyes, products, traced, lost)


@pytest.mark.parametrize("exponent", OPEN)
def test_pictures(scene, exponent):
    (first, full), (second, also) = (scene.traced.picture(exponent, SAMPLES, seed) for seed in (1, 2))
    truth = np.stack([first, second])
    where = full & also & scene.eyes[0].covered & scene.eyes[1].covered
    assert where.mean() > 0.5 and (full == scene.eyes[0].covered).mean() > 0.97   # the cameras agree
    found = {how: np.stack([eye.picture(product, exponent) for eye, product in zip(scene.eyes, both, strict=True)])
             for how, both in scene.products.items()}
    five, nine, unshadowed = (pictures.compare(found[how], truth, where) for how in ("five", "nine", "open"))
    assert nine[1] < {1: 0.06, 10: 0.05, 50: 0.15}[exponent]   # 6 %: what 64 paths of a wide lobe can tell
    assert abs((found["nine"] - truth)[:, where].mean()) < 0.02 * truth[:, where].mean()
    assert five[1] < scene.lost[exponent] < 0.6 * unshadowed[1]


def test_compare_takes_noise_out():
    rng = np.random.default_rng(0)
    truth, where = rng.uniform(0.5, 1.5, (60, 80, 3)), np.ones((60, 80), bool)
    scale = np.sqrt(np.square(truth).mean())
    bias = 0.1 * scale * rng.choice([-1, 1], truth.shape)
    noise = 0.2 * scale * rng.normal(size=(2, *truth.shape))
    error, shared, left = pictures.compare(truth + bias + noise, np.stack([truth, truth]), where)
    assert abs(shared - 0.1) < 0.01 and abs(left - 0.2 / np.sqrt(2)) < 0.01
    np.testing.assert_allclose(error ** 2, shared ** 2 + left ** 2)
