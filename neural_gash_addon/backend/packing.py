# SPDX-License-Identifier: GPL-3.0-or-later
"""Charts placed in a square texture: each in a box, the boxes in rows.

xatlas packs by the charts' own outlines, but holds the interpreter's lock for all of it: seconds for
some thousand charts, with the window standing still, and a further time for each density that it is
tried at. Boxes in rows take milliseconds. They fill a texture a tenth less where a mesh has few large
charts, and up to half more where it has thousands of small ones.
"""
from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from .errors import UserError

Array = NDArray[np.float64]

_ANGLES = 24     # in a right angle, at which a chart's box is measured first,
_HALVINGS = 6    # and then between the two beside the best, to a sixteenth of a degree
_CLEARLY = 1e-6  # smaller has to be a box that is preferred to an upright one
_STEP = 0.985    # of the texels a metre, from one try to the next
_THINNEST = 0.1  # of the texels a metre that charts would have if they needed no room between them


def boxed(local: Array, charts: NDArray[np.int64]) -> Generator[float, None, tuple[Array, Array]]:
    """Turn each chart so that its bounding box is small, lies along x, and begins at 0.

    Args:
        local: (F, 3, 2) of each triangle's corners. charts: (F,) number of its chart, 0 to n-1.
    Yields:
        Progress, 0 to 1.
    Returns:
        The triangles' corners (F, 3, 2), and width and height of each box (n, 2).
    """
    order = np.argsort(charts, kind="stable")
    starts = 3 * np.flatnonzero(np.diff(charts[order], prepend=-1))
    sizes = np.diff(starts, append=3 * len(order))
    x, y = np.ascontiguousarray(local[order].reshape(-1, 2).T)

    def spans(angle: Array) -> tuple[Array, Array, Array, Array]:
        """Corners (3F,) turned by the angle (n,) of their chart, and the extent (n,) of each along x and y."""
        c, s = np.repeat(np.cos(angle), sizes), np.repeat(np.sin(angle), sizes)
        u, v = c * x - s * y, s * x + c * y
        return u, v, *(np.maximum.reduceat(w, starts) - np.minimum.reduceat(w, starts) for w in (u, v))

    best = np.zeros(len(starts))
    width, height = spans(best)[2:]
    step = np.pi / 2 / _ANGLES
    turns = [(n * step, False) for n in range(1, _ANGLES)]
    turns += [(sign * step * 0.5 ** n, True) for n in range(1, _HALVINGS + 1) for sign in (-1, 1)]
    for number, (turn, further) in enumerate(turns):
        yield number / len(turns)
        angle = best + turn if further else np.full(len(best), turn)
        wide, high = spans(angle)[2:]
        better = wide * high < width * height * (1 - _CLEARLY)
        best[better], width[better], height[better] = angle[better], wide[better], high[better]
    best[height > width] += np.pi / 2
    u, v, width, height = spans(best)
    for w in (u, v):
        w -= np.repeat(np.minimum.reduceat(w, starts), sizes)
    out = np.empty_like(local)
    out[order] = np.stack([u, v], 1).reshape(-1, 3, 2)
    return out, np.stack([width, height], 1)


def arranged(boxes: Array, area: float, *, side: int | None, density: float | None, padding: int
             ) -> Generator[float, None, tuple[Array, int, float]]:
    """Place boxes in a square texture, each with `padding` texels around it, and one more between two.

    So a lookup in a mip level whose texels are as wide as the padding does not read another chart's: it
    reaches one and a half of them.

    Args:
        boxes: (n, 2) width and height. area: of the charts in them.
        side: texels a side, into which the boxes go as large as they fit; or, where not given, density: texels per
            unit, and the texture is as large as that takes.
        padding: texels around each.
    Yields:
        Progress, 0 to 1.
    Returns:
        Lower left corner of each box (n, 2) in texels, the side, and the texels per unit.
    Raises:
        UserError: the texture is too small for the boxes.
    """
    gap = 2 * padding + 1
    order = np.lexsort((-boxes[:, 0], -boxes[:, 1]))
    size = boxes[order]
    # (w d + gap)(h d + gap), summed, is a d^2 + b d + c
    a, b, c = float((size[:, 0] * size[:, 1]).sum()), gap * float(size.sum()), float(len(size)) * gap * gap
    widest = float(size.max(initial=0.0))
    if side is None:
        scale, least = density or 1.0, 0.0
        room = max((a * scale * scale + b * scale + c) ** 0.5, widest * scale + gap)
    else:
        room = side + 1.0  # the last box of a row needs no texel after it
        left = room * room - c
        scale = 2 * left / max(b + max(b * b + 4 * a * left, 0.0) ** 0.5, 1e-300) * (1 - 1e-9)
        longest = (room - gap) / max(widest, 1e-300)
        scale, least = min(scale, longest), _THINNEST * min(side / max(area ** 0.5, 1e-300), longest)
    tries = 0
    while scale > least:
        yield 1 - _STEP ** tries
        tries += 1
        corners = _rows(size * scale + gap, room)
        if corners is not None:
            out = np.empty_like(corners)
            out[order] = corners + padding
            return out, side or int(np.ceil(room - 1)), scale
        if side is None:
            room /= _STEP
        else:
            scale *= _STEP
    raise UserError(f"A texture of {side} x {side} is too small for the charts of this mesh; "
                    "choose a higher resolution or a smaller padding.")


def _rows(boxes: Array, room: float) -> Array | None:
    """Corners (n, 2) of boxes (n, 2), highest first, each in the first row that has room; None where there is not."""
    corners = np.empty_like(boxes)
    bottoms, left = np.zeros(len(boxes)), np.zeros(len(boxes))
    rows, top = 0, 0.0
    for number, (width, height) in enumerate(boxes.tolist()):
        row = int((left[:rows] >= width).argmax()) if rows else 0
        if not rows or left[row] < width:
            if top + height > room * (1 + 1e-12) or width > room * (1 + 1e-12):
                return None
            row, rows = rows, rows + 1
            bottoms[row], left[row] = top, room
            top += height
        corners[number] = room - left[row], bottoms[row]
        left[row] -= width
    return corners
