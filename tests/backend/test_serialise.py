# SPDX-License-Identifier: GPL-3.0-or-later
"""Space-filling curves against what defines them, and a published value."""
import numpy as np
import pytest

from neural_gash_addon.backend import serialise

BITS = 4
CELLS = np.stack(np.meshgrid(*[np.arange(2 ** BITS)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.uint64)
CURVES = [serialise.z_order, serialise.hilbert]


@pytest.mark.parametrize("curve", CURVES)
def test_each_cell_has_its_own_place_and_each_cube_a_run_of_places(curve):
    path = CELLS[np.argsort(curve(CELLS, BITS))]
    assert (np.sort(curve(CELLS, BITS)) == np.arange(len(CELLS))).all()
    for bit in range(1, BITS):  # each aligned cube of side 2**bit is entered once and left when all of it was seen
        runs = (path >> np.uint64(bit)).reshape(-1, 8 ** bit, 3)
        assert (runs == runs[:, :1]).all()


def test_next_places_of_the_hilbert_curve_are_next_cells():
    path = CELLS[np.argsort(serialise.hilbert(CELLS, BITS))].astype(int)
    assert (np.abs(np.diff(path, axis=0)).sum(1) == 1).all()


def test_hilbert_gives_the_value_that_skilling_prints():
    """Skilling (2004), the program's example: the cell 5, 10, 20 of 32**3."""
    assert serialise.hilbert(np.array([[5, 10, 20]], np.uint64), 5).tolist() == [7865]


def test_z_order_is_the_bits_in_turn():
    places = serialise.z_order(CELLS, BITS)
    for cell, place in zip(CELLS[::97].tolist(), places[::97].tolist(), strict=True):
        assert f"{place:012b}" == "".join("".join(bits) for bits in zip(*(f"{c:04b}" for c in cell), strict=True))


def test_orders_hold_every_point_once_and_transposing_swaps_x_and_y():
    points = np.random.default_rng(0).random((500, 3))
    found = serialise.orders(points)
    assert found.shape == (serialise.CURVES, 500)
    assert (np.sort(found, axis=1) == np.arange(500)).all()
    np.testing.assert_array_equal(found[2:], serialise.orders(points[:, [1, 0, 2]])[:2])
    assert len({tuple(order) for order in found}) == serialise.CURVES
    # what lies along a curve lies near: far nearer than what lies in any order
    jumps = np.linalg.norm(np.diff(points[found], axis=1), axis=2).mean(1)
    assert (jumps < 0.4 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()).all()


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((7, 3), 0.5), np.array([[-1, 2, 0.5], [0, 1, 0.5]])],
                         ids=["none", "one place", "outside"])
def test_degenerate_points_keep_their_order(points):
    np.testing.assert_array_equal(serialise.orders(points), [np.arange(len(points))] * serialise.CURVES)
