# SPDX-License-Identifier: GPL-3.0-or-later
"""How many scene points a room has."""
from dataclasses import replace

import numpy as np
import pytest

from neural_gash_addon.backend import lit_points
from neural_gash_addon.backend.lit_scene import LitScene
from neural_gash_addon.backend.progress import run


def square(side, lamp=0.0):
    """One square, `side` metres long, and one as large that only shines and has no body."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]) * side
    positions = np.concatenate([positions, positions + [0, 0, 1]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    return LitScene(positions, triangles, np.full((4, 3), 0.5), np.repeat([[0.0], [0], [lamp], [lamp]], 3, 1),
                    bodiless=2)


@pytest.mark.parametrize("side, count", [(1e-3, 4096), (1, 4096), (13, 32 * 169), (16, 32 * 256), (19.5, 12_168),
                                         (20, 12_288), (1000, 12_288)])
def test_they_are_counted_by_the_area_of_what_has_a_body(side, count):
    assert lit_points.count_of(square(side)) == count


def test_a_scene_has_as_many_as_it_is_large_unless_a_number_is_asked(monkeypatch):
    monkeypatch.setattr(lit_points, "FEWEST", 64)
    scene = square(2.0, lamp=1.0)
    scene = replace(scene, positions=scene.positions)
    for asked, count in ((None, 128), (50, 50)):
        points = run(lit_points.lit_points(scene, scene.occluders(), asked, 8, threads=1))
        assert len(points.places) == len(points.direct) == count and points.direct.max() > 0
