# SPDX-License-Identifier: GPL-3.0-or-later
"""Points in the order of a space-filling curve, so that those beside each other in the list are so in space.

Z-order interleaves the bits of a cell's coordinates (Morton 1966, "A computer oriented geodetic data base"); the
Hilbert curve also turns each octant so that the path never jumps (Skilling 2004, "Programming the Hilbert curve").
Each also transposed, with x and y changed places, as in Point Transformer V3 (Wu et al. 2024), section 4.1.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BITS = 16    # of each coordinate; three of them fit 64 bits
CURVES = 4   # Z-order, Hilbert, and each transposed

Codes = NDArray[np.uint64]


def orders(points: NDArray) -> NDArray[np.int64]:
    """(CURVES, N) the points' order along each curve; points in one cell keep theirs.

    points: (N, 3) in the unit cube; what is outside counts as on its side.
    """
    cells = (np.clip(points, 0, 1) * (2 ** BITS - 1)).astype(np.uint64)
    transposed = cells[:, [1, 0, 2]]
    codes = np.stack([curve(each) for each in (cells, transposed) for curve in (z_order, hilbert)])
    return np.argsort(codes, axis=1, kind="stable")


def z_order(cells: Codes, bits: int = BITS) -> Codes:
    """(N,) places along the curve of cells (N, 3), each coordinate below 2**bits; x has the highest bit of three."""
    code = np.zeros(len(cells), dtype=np.uint64)
    for bit in range(bits - 1, -1, -1):
        for axis in range(3):
            code = (code << np.uint64(1)) | ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1))
    return code


def hilbert(cells: Codes, bits: int = BITS) -> Codes:
    """(N,) places along the curve of cells (N, 3), each coordinate below 2**bits: next places are next cells."""
    x = [cells[:, axis].copy() for axis in range(3)]
    for bit in range(bits - 1, 0, -1):
        top, below = np.uint64(1 << bit), np.uint64((1 << bit) - 1)
        for axis in range(3):
            set_ = (x[axis] & top) != 0
            # where the bit is set, turn x about; elsewhere, change x and this axis
            change = np.where(set_, np.uint64(0), (x[0] ^ x[axis]) & below)
            x[0] = np.where(set_, x[0] ^ below, x[0] ^ change)
            if axis:
                x[axis] = x[axis] ^ change
    # a Gray code of three bits a step, which is what the places of the curve were turned into
    x[1] ^= x[0]
    x[2] ^= x[1]
    turn = np.zeros_like(x[0])
    for bit in range(bits - 1, 0, -1):
        turn = np.where((x[2] & np.uint64(1 << bit)) != 0, turn ^ np.uint64((1 << bit) - 1), turn)
    return z_order(np.stack([each ^ turn for each in x], 1), bits)
