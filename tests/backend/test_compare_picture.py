# SPDX-License-Identifier: GPL-3.0-or-later
"""The chart that needs no library: letters, marks where the numbers say, and errors spread along the surface."""
import numpy as np

from neural_gash_addon.backend import canvas, compare_picture
from neural_gash_addon.backend.canvas import Canvas
from neural_gash_addon.backend.compare import Measurement, Setting
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.methods import METHODS
from neural_gash_addon.backend.neighbours import neighbours

from . import shapes


def test_letters():
    words = "".join(m.label for m in METHODS.values()) + "0123456789.,:%()/-'+ "
    assert set(words.upper()) <= set(canvas._FONT)
    glyphs = [g for letter, g in canvas._FONT.items() if letter != " "]
    assert len(set(glyphs)) == len(glyphs) and all(len(g) == 14 for g in canvas._FONT.values())
    drawn = Canvas(40, 20)
    drawn.text(2, 3, "L", size=2)
    dark = drawn.pixels[..., 0] < 0.5
    assert dark[3:17, 2:4].all() and dark[15:17, 2:12].all() and dark.sum() == 14 * 2 + 2 * 8
    drawn.text(38, 18, "\u6f22 out of the picture")  # cut off, not an error
    drawn.mark(2, -3, 5, 4, (1, 0, 0))


def test_marks_lie_where_the_numbers_say():
    """Ten times the time is the same step to the right, ten times the error the same step down."""
    found = [Measurement(Setting("embree", 3, rays), [seconds], rel_l2=error)
             for rays, seconds, error in ((2, 1e-3, 0.5), (8, 1e-2, 0.05), (32, 1e-1, 0.005))]
    image = compare_picture.picture(found, 1000, 0.001, "title", found[0], 0.1)
    assert image.shape == (compare_picture.HEIGHT, compare_picture.WIDTH, 4) and (image[..., 3] == 1).all()
    number = list(METHODS).index("embree")
    hit = np.abs(image[::-1, :compare_picture._RIGHT, :3] - compare_picture._COLOURS[number]).max(-1) < 1e-3
    radius, centres = 7, []
    full = np.abs(np.mgrid[-radius:radius + 1, -radius:radius + 1]).sum(0) <= radius  # a diamond
    for y in range(radius, hit.shape[0] - radius):
        for x in np.flatnonzero(hit[y]):
            if radius <= x < hit.shape[1] - radius and \
                    hit[y - radius:y + radius + 1, x - radius:x + radius + 1][full].all():
                centres.append((x, y))
    assert len(centres) == 3
    (x0, y0), (x1, y1), (x2, y2) = centres
    across = (compare_picture._RIGHT - compare_picture._LEFT) / 4   # a decade: from 0.1 to 1000 microseconds
    down = (compare_picture._BOTTOM - compare_picture._TOP) / 4     # and from 1 down to 0.0001
    assert abs(x1 - x0 - across) <= 1 and abs(x2 - x1 - across) <= 1 and abs(y1 - y0 - down) <= 1
    assert abs(y2 - y1 - down) <= 1 and abs(x0 - compare_picture._LEFT - across) <= 1


def test_no_two_methods_have_the_same_colour():
    """As read off the legend, whose marks are that of each method in its turn."""
    found = [Measurement(Setting(name, 3), [1.0], rel_l2=0.1) for name in METHODS]
    image = compare_picture.picture(found, 1000, 0.001, "title", found[0], 0.1)[::-1, :, :3]
    rows = compare_picture._TOP + 7 + 30 * np.arange(len(METHODS))
    marks = image[rows, compare_picture._RIGHT + 38]
    apart = np.abs(marks[:, None] - marks).max(-1)[~np.eye(len(marks), dtype=bool)]
    assert (marks.min(1) < 0.9).all() and apart.min() > 0.1


def test_nothing_measured_still_draws():
    none = [Measurement(Setting("gnn", 3), refused="No."), Measurement(Setting("analytic", 3), [0.0], rel_l2=0.0)]
    assert np.isfinite(compare_picture.picture(none, 0, 0.0, "t", none[1], 1.0)).all()


def test_heat_is_monotonous():
    colours = compare_picture.heat(np.array([-1, 0, 0.25, 0.5, 1, 2.0]))
    light = colours.sum(1)
    assert light[0] == light[1] and light[4] == light[5] and (np.diff(light[1:5]) > 0).all()


def test_errors_spread_as_by_hand():
    positions, triangles = shapes.grid(9)
    mesh = TriangleMesh.from_triangles(np.concatenate([positions, positions + (0, 0, 5)]),
                                       np.concatenate([triangles, triangles + len(positions)]))
    rows = np.array([0, 40, 80])
    values = np.array([1.0, 2.0, 6.0])
    beside = [set() for _ in mesh.points]
    for a, b, c in mesh.triangles.tolist():
        for one, two in ((a, b), (b, c), (c, a)):
            beside[one].add(two)
            beside[two].add(one)
    slow = dict(zip(rows.tolist(), values.tolist(), strict=True))
    while True:
        new = {p: [slow[q] for q in around if q in slow] for p, around in enumerate(beside) if p not in slow}
        new = {p: (min(v), max(v)) for p, v in new.items() if v}
        if not new:
            break
        found = compare_picture.spread(values, rows, neighbours(mesh))
        for p, (low, high) in new.items():
            assert low - 1e-9 <= found[p] <= high + 1e-9
            slow[p] = found[p]
    assert len(slow) == 81  # the second sheet is connected with none: the median
    assert (found[81:] == 2.0).all() and (found[rows] == values).all()
