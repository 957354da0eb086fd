# SPDX-License-Identifier: GPL-3.0-or-later
"""A picture to draw in where nothing but NumPy is: rectangles, lines, marks, and letters of 5 x 7 pixels."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]  # 0 to 1, as it shall be shown

# seven rows of five pixels each, top first, in hexadecimal
_FONT = {
    "A": "0E11111F111111", "B": "1E11111E11111E", "C": "0E11101010110E", "D": "1E11111111111E", "E": "1F10101E10101F",
    "F": "1F10101E101010", "G": "0E11101711110F", "H": "1111111F111111", "I": "0E04040404040E", "J": "0702020202120C",
    "K": "11121418141211", "L": "1010101010101F", "M": "111B1515111111", "N": "11191513111111", "O": "0E11111111110E",
    "P": "1E11111E101010", "Q": "0E11111115120D", "R": "1E11111E141211", "S": "0F10100E01011E", "T": "1F040404040404",
    "U": "1111111111110E", "V": "11111111110A04", "W": "11111115151B11", "X": "11110A040A1111", "Y": "11110A04040404",
    "Z": "1F01020408101F", "0": "0E11131519110E", "1": "040C040404040E", "2": "0E11010608101F", "3": "1E01010E01011E",
    "4": "02060A121F0202", "5": "1F101E0101110E", "6": "0608101E11110E", "7": "1F010204080808", "8": "0E11110E11110E",
    "9": "0E11110F01020C", ".": "00000000000C0C", ",": "000000000C0408", ":": "000C0C000C0C00", "%": "18190204081303",
    "(": "02040808080402", ")": "08040202020408", "/": "01010204081010", "-": "0000001F000000", "'": "04040800000000",
    "+": "0004041F040400", " ": "00000000000000", "_": "0000000000001F"}
_UNKNOWN = "1F11111111111F"
_WIDE, _HIGH = 6, 7  # of a letter, with what is between two


class Canvas:
    """Pixels (H, W, 3) of 0 to 1; x to the right and y down, from the top left corner."""

    def __init__(self, width: int, height: int) -> None:
        """White."""
        self.pixels: NDArray[np.float32] = np.ones((height, width, 3), np.float32)

    def rectangle(self, left: float, top: float, right: float, bottom: float, colour: Colour) -> None:
        """Filled; what is outside the picture is cut off."""
        x0, y0, x1, y1 = (max(0, round(v)) for v in (left, top, right, bottom))
        self.pixels[y0:y1, x0:x1] = colour

    def line(self, start: tuple[float, float], end: tuple[float, float], colour: Colour, width: float = 1,
             dashes: int = 0) -> None:
        """A straight line, of dashes of so many pixels if any."""
        steps = int(max(abs(end[0] - start[0]), abs(end[1] - start[1]))) + 1
        for number, (x, y) in enumerate(np.linspace(start, end, steps + 1).tolist()):
            if not dashes or number // dashes % 2 == 0:
                self.rectangle(x - width / 2, y - width / 2, x + width / 2, y + width / 2, colour)

    def mark(self, kind: int, x: float, y: float, radius: int, colour: Colour) -> None:
        """A filled square, diamond, disc or triangle, by its number."""
        height, width = self.pixels.shape[:2]
        rows, columns = np.mgrid[-radius:radius + 1, -radius:radius + 1]
        inside = (np.maximum(abs(rows), abs(columns)) < radius, abs(rows) + abs(columns) <= radius,
                  rows ** 2 + columns ** 2 <= radius ** 2, 2 * abs(columns) <= rows + radius)[kind % 4]
        rows, columns = rows[inside] + round(y), columns[inside] + round(x)
        seen = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        self.pixels[rows[seen], columns[seen]] = colour

    def ring(self, x: float, y: float, radius: int, colour: Colour) -> None:
        """A circle two pixels wide."""
        for angle in np.linspace(0, 2 * np.pi, 8 * radius, endpoint=False).tolist():
            px, py = x + radius * np.cos(angle), y + radius * np.sin(angle)
            self.rectangle(px - 1, py - 1, px + 1, py + 1, colour)

    def text(self, x: float, y: float, words: str, colour: Colour = (0, 0, 0), size: int = 2) -> None:
        """Capitals, whose top left corner is at x, y; a box for each letter that there is none of."""
        for number, letter in enumerate(words.upper()):
            glyph = _FONT.get(letter, _UNKNOWN)
            for row in range(_HIGH):
                bits = int(glyph[2 * row:2 * row + 2], 16)
                for column in range(5):
                    if bits >> (4 - column) & 1:
                        left, top = x + size * (_WIDE * number + column), y + size * row
                        self.rectangle(left, top, left + size, top + size, colour)

    @staticmethod
    def width_of(words: str, size: int = 2) -> int:
        """Pixels that a text takes."""
        return size * (_WIDE * len(words) - 1)
