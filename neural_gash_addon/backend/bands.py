# SPDX-License-Identifier: GPL-3.0-or-later
"""How many bands of transfer a plan bakes: those whose energy would be seen at the tolerance, and no more.

What counts is a band of the whole transfer (unshadowed less blocked), not its shadows alone: these have all
frequencies, but the cosine has not. Of an open hemisphere's transfer at order 5, band 2 is 34 %, band 3 nothing, band 4
8 %. Bands are orthogonal, so what is dropped and what the others have wrong add up as squares.

Bounced light is not looked at. It is a mean of other points' transfer with weights that are not negative, in which band
0 adds up and the others cancel partly: so its high bands are mostly a smaller part of it than of direct transfer.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import spherical_harmonics as sh

LEAST_ORDER = 2
MOST_DROPPED = 0.95  # of a tolerance


@dataclass(frozen=True)
class Bands:
    """What order is baked of the one that was asked for."""

    order: int
    asked: int
    dropped: float  # relative L2 of the bands that are not baked, over the whole
    left: float     # relative L2 that may be wrong with the others, over these
    reason: str = ""  # one sentence

    def whole(self, error: float | None) -> float | None:
        """The relative L2 error over all bands that were asked for, of one over those that are baked."""
        if error is None or not self.dropped:
            return error
        return (self.dropped ** 2 + (1 - self.dropped ** 2) * error ** 2) ** 0.5


def all_of(order: int, tolerance: float | None) -> Bands:
    """No band is dropped, and nothing is said of it."""
    return Bands(order, order, 0.0, 1.0 if tolerance is None else tolerance)


def of_open_sky(order: int, tolerance: float) -> Bands:
    """The fewest bands that are enough where nothing blocks: what the others have is known, and alike at all points."""
    bands = np.arange(order)
    energy = np.square(sh.cosine_lobe_bands(order)) * (2 * bands + 1)
    parts = [float(energy[fewer:].sum() / energy.sum()) ** 0.5 for fewer in range(order)]
    fewest = next((n for n in range(LEAST_ORDER, order) if parts[n] <= MOST_DROPPED * tolerance), order)
    return chosen(fewest, order, tolerance, [(part, part) for part in parts])


def chosen(order: int, asked: int, tolerance: float, parts: Sequence[tuple[float, float]]) -> Bands:
    """So many bands; parts: what those from each on are of the whole, and at most."""
    if order == asked:
        last = asked - 1
        known = asked > LEAST_ORDER and np.isfinite(parts[last][0])
        reason = f"Band {last} is {_percent(parts[last][0])} of the whole: order {asked} is kept." if known else ""
        return Bands(asked, asked, 0.0, tolerance, reason)
    dropped, most = parts[order]
    left = (max(tolerance ** 2 - most ** 2, 0.0) / (1 - dropped ** 2)) ** 0.5
    which = {1: f"Band {order} is", 2: f"Bands {order} and {order + 1} are"}.get(
        asked - order, f"Bands {order} to {asked - 1} are")
    return Bands(order, asked, dropped, left, f"{which} {_percent(dropped)} of the whole: order {order} is enough.")


def _percent(part: float) -> str:
    return f"{100 * part:.2g} %" if part >= 1e-4 or not part else "below 0.01 %"
