# SPDX-License-Identifier: GPL-3.0-or-later
"""A comparison of methods as a picture: error against time, both in logarithms; and errors of points as colours."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .canvas import Canvas, Colour
from .compare import Measurement, front
from .methods import METHODS
from .neighbours import Neighbours

WIDTH, HEIGHT = 1440, 800
_LEFT, _TOP, _RIGHT, _BOTTOM = 120, 70, 820, 720  # of the axes
_LEAST = 1e-6  # error below which all are shown alike
_GREY, _BLACK = (0.85, 0.85, 0.85), (0.0, 0.0, 0.0)
_COLOURS: tuple[Colour, ...] = ((0.12, 0.47, 0.71), (0.95, 0.45, 0.0), (0.17, 0.63, 0.17), (0.84, 0.15, 0.16),
                                (0.58, 0.4, 0.74), (0.55, 0.34, 0.29), (0.89, 0.47, 0.76), (0.35, 0.35, 0.35),
                                (0.09, 0.7, 0.75), (0.7, 0.7, 0.1))
# of an error, from none to the most: dark blue, violet, orange, light yellow, as they shall be shown
_HEAT = np.array([[0.05, 0.03, 0.35], [0.5, 0.05, 0.6], [0.95, 0.45, 0.2], [1.0, 0.95, 0.6]])


def heat(share: NDArray) -> NDArray[np.float64]:
    """Colours (N, 3), as they shall be shown, of errors (N,) as parts of the most."""
    at = np.clip(share, 0, 1) * (len(_HEAT) - 1)
    return np.stack([np.interp(at, np.arange(len(_HEAT)), channel) for channel in _HEAT.T], -1)


def spread(values: NDArray, rows: NDArray, links: Neighbours) -> NDArray[np.float64]:
    """Values (n,) known at points `rows` (n,), at all N points: others have the mean of the nearest along the surface.

    Points that no known one is connected with have the median.
    """
    count = len(links.start) - 1
    point = np.repeat(np.arange(count), np.diff(links.start))
    one, two = np.concatenate([point, links.points]), np.concatenate([links.points, point])  # open edges have one way
    found = np.full(count, np.nan)
    found[rows] = values
    while True:
        use = np.isnan(found[one]) & ~np.isnan(found[two])
        if not use.any():
            break
        sums = np.bincount(one[use], found[two[use]], count)
        numbers = np.bincount(one[use], minlength=count)
        found[numbers > 0] = sums[numbers > 0] / numbers[numbers > 0]
    return np.nan_to_num(found, nan=float(np.median(values)) if len(values) else 0.0)


def picture(found: Sequence[Measurement], points: int, floor: float, title: str, shown: Measurement, most: float
            ) -> NDArray[np.float32]:
    """The chart.

    Args:
        found: what was measured. points: whose time is the unit. floor: rel L2 that the reference's noise has.
        shown: the one whose errors are the heat map's, and `most`, where its colours end (both named below).
    Returns:
        (HEIGHT, WIDTH, 4), row 0 at the bottom, as they shall be shown.
    """
    canvas = Canvas(WIDTH, HEIGHT)
    measured = [m for m in found if m.seconds]
    times = [1e6 * m.median / max(points, 1) for m in measured]
    errors = [max(m.rel_l2 if np.isfinite(m.rel_l2) else 0.0, _LEAST) for m in measured]
    axis = _Axes(canvas, times, [*errors, max(floor, _LEAST)])
    canvas.text(_LEFT, 24, title)
    axis.frame()
    level = axis.y(max(floor, _LEAST))
    canvas.line((_LEFT, level), (_RIGHT, level), (0.5, 0.5, 0.5), 2, dashes=8)
    corner: tuple[float, float] | None = None
    best = front(times, errors)
    for index in best:
        x, y = axis.x(times[index]), axis.y(errors[index])
        if corner:
            canvas.line(corner, (x, corner[1]), _GREY, 6)
            canvas.line((x, corner[1]), (x, y), _GREY, 6)
        corner = x, y
    names = list(METHODS)
    for method in dict.fromkeys(m.setting.method for m in measured):
        number = names.index(method)
        own = sorted((m.setting.rays or 0, -(m.setting.tolerance or 0), t, e)
                     for m, t, e in zip(measured, times, errors, strict=True)
                     if m.setting.method == method and (m.setting.tolerance is None) != METHODS[method].plans)
        for (*_, t0, e0), (*_, t1, e1) in zip(own, own[1:], strict=False):
            canvas.line((axis.x(t0), axis.y(e0)), (axis.x(t1), axis.y(e1)), _COLOURS[number % len(_COLOURS)], 2)
    for index, m in enumerate(measured):
        number = names.index(m.setting.method)
        x, y = axis.x(times[index]), axis.y(errors[index])
        canvas.mark(number, x, y, 7, _COLOURS[number % len(_COLOURS)])
        if index in best:
            canvas.ring(x, y, 11, _BLACK)
        told = m.setting.rays if m.setting.tolerance is None else f"{100 * m.setting.tolerance:.3g}%"
        if told:
            canvas.text(x + 13, y - 12, str(told), _COLOURS[number % len(_COLOURS)], 1)
    _legend(canvas, found, measured, floor, shown, most)
    out = np.ones((HEIGHT, WIDTH, 4), np.float32)
    out[..., :3] = canvas.pixels[::-1]
    return out


class _Axes:
    """Where a time and an error lie in the picture, both in logarithms."""

    def __init__(self, canvas: Canvas, times: Sequence[float], errors: Sequence[float]) -> None:
        self._canvas = canvas
        self._x, self._y = (self._decades(values) for values in (times, errors))

    @staticmethod
    def _decades(values: Sequence[float]) -> tuple[int, int]:
        logs = np.log10(np.maximum(values, 1e-12)) if len(values) else np.zeros(1)
        low = int(np.floor(logs.min() - 0.1))
        return low, max(int(np.ceil(logs.max() + 0.1)), low + 1)

    def x(self, value: float) -> float:
        low, high = self._x
        return float(_LEFT + (_RIGHT - _LEFT) * (np.log10(max(value, 1e-12)) - low) / (high - low))

    def y(self, value: float) -> float:
        low, high = self._y
        return float(_BOTTOM - (_BOTTOM - _TOP) * (np.log10(max(value, 1e-12)) - low) / (high - low))

    def frame(self) -> None:
        """Lines and numbers at the decades."""
        for decade in range(self._x[0], self._x[1] + 1):
            x, words = self.x(10.0 ** decade), f"{10.0 ** decade:g}"
            self._canvas.line((x, _TOP), (x, _BOTTOM), _GREY)
            self._canvas.text(x - self._canvas.width_of(words) / 2, _BOTTOM + 10, words)
        for decade in range(self._y[0], self._y[1] + 1):
            y, words = self.y(10.0 ** decade), f"{100 * 10.0 ** decade:g}%"
            self._canvas.line((_LEFT, y), (_RIGHT, y), _GREY)
            self._canvas.text(_LEFT - 10 - self._canvas.width_of(words), y - 7, words)
        for start, end in (((_LEFT, _TOP), (_LEFT, _BOTTOM)), ((_LEFT, _BOTTOM), (_RIGHT, _BOTTOM))):
            self._canvas.line(start, end, _BLACK, 2)
        words = "microseconds a point, whole job"
        self._canvas.text((_LEFT + _RIGHT - self._canvas.width_of(words)) / 2, _BOTTOM + 40, words)
        self._canvas.text(_LEFT, _TOP - 20, "relative L2 error of transfer", size=1)


def _legend(canvas: Canvas, found: Sequence[Measurement], measured: Sequence[Measurement], floor: float,
            shown: Measurement, most: float) -> None:
    """What the marks are, beside the axes."""
    left, y = _RIGHT + 30, _TOP
    done = {m.setting.method for m in measured}
    for number, (name, method) in enumerate(METHODS.items()):
        if name not in {m.setting.method for m in found}:
            continue
        canvas.mark(number, left + 8, y + 7, 7, _COLOURS[number % len(_COLOURS)])
        canvas.text(left + 26, y, method.label + ("" if name in done else " (not run)"))
        y += 30
    y += 14
    for words in ("A number beside a mark: rays a point,", "or the tolerance that was asked for."):
        canvas.text(left, y, words, size=1)
        y += 14
    y += 10
    canvas.ring(left + 11, y + 7, 11, _BLACK)
    canvas.text(left + 34, y, "nothing is quicker and better")
    y += 34
    canvas.line((left, y + 7), (left + 26, y + 7), (0.5, 0.5, 0.5), 2, dashes=6)
    canvas.text(left + 34, y, f"noise of reference {100 * floor:.2g}%")
    y += 50
    canvas.text(left, y, "Heat map:")
    canvas.text(left, y + 24, shown.setting.name)
    colours = heat(np.linspace(0, 1, 300))
    for column, colour in enumerate(colours):
        canvas.rectangle(left + column, y + 52, left + column + 1, y + 76, tuple(colour))
    canvas.text(left, y + 84, "0")
    words = f"{100 * most:.2g}%"
    canvas.text(left + 300 - canvas.width_of(words), y + 84, words)
    canvas.text(left, y + 110, "error of a point, of the RMS of transfer", size=1)
