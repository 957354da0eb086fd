# SPDX-License-Identifier: GPL-3.0-or-later
"""OpenEXR files as a bake needs them: RGBA, 32 or 16 bits, lossless, with the record in the header.

Blender's own writer keeps no text in the header, and a bake must be decodable from its file alone.
Format: openexr.com, "OpenEXR File Layout"; single-part scanlines, ZIP compression.
"""
from __future__ import annotations

import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .exchange import atomic, reason

ATTRIBUTE = "neuralGash"  # header attribute that holds the record
_MAGIC, _VERSION = 20000630, 2
_CHANNELS = "ABGR"        # the format wants them by name; of an (H, W, 4) image these are 3, 2, 1, 0
_HALF, _FLOAT = 1, 2
_ZIP = 3
_ROWS = 16                # of a block, by the format
_LONGEST_NAME = 255       # by the format
_LEVEL = 4                # of zlib: more takes far longer for a few per cent


def write(path: Path, image: NDArray, record: str, half: bool = False) -> None:
    """Write an image in one step: what was at `path` stays until the new file is whole.

    Args:
        image: (H, W, 4), row 0 at the bottom, as Blender has it. record: text for the header.
        half: 16 bits a channel instead of 32.
    Raises:
        OSError: there is no room, or the folder cannot be written to.
    """
    height, width = image.shape[:2]
    kind = np.dtype("<f2" if half else "<f4")
    starts = range(0, height, _ROWS)

    def block(start: int) -> bytes:
        rows = image[::-1][start:start + _ROWS]
        raw = np.ascontiguousarray(rows[..., ::-1].transpose(0, 2, 1), dtype=kind).tobytes()  # row, channel, column
        packed = _pack(raw)
        return struct.pack("<ii", start, len(packed)) + packed

    header = _header(width, height, half, record)
    with ThreadPoolExecutor() as pool:
        blocks = list(pool.map(block, starts))
    ends = len(header) + 8 * len(blocks) + np.cumsum([0, *map(len, blocks)])
    with atomic(path) as draft, draft.open("wb") as file:
        file.write(header)
        file.write(ends[:-1].astype("<u8").tobytes())
        file.writelines(blocks)


def read_record(path: Path) -> tuple[str, int, int]:
    """The record in a file's header, and the image's width and height.

    Raises:
        UserError: the file is missing, no OpenEXR, or none that a bake wrote.
    """
    try:
        with path.open("rb") as file:
            attributes = _attributes(file)
    except OSError as error:
        raise UserError(f"'{path}' cannot be read ({reason(error)}).") from error
    except (ValueError, struct.error) as error:
        raise UserError(f"'{path}' is no OpenEXR image.") from error
    if ATTRIBUTE not in attributes or len(attributes.get("dataWindow", b"")) != 16:
        raise UserError(f"'{path}' is an image, but none that Neural GASh baked.")
    x0, y0, x1, y1 = struct.unpack("<4i", attributes["dataWindow"])
    return attributes[ATTRIBUTE].decode("utf-8", "replace"), x1 - x0 + 1, y1 - y0 + 1


def _header(width: int, height: int, half: bool, record: str) -> bytes:
    """Everything before the table of offsets."""
    channels = b"".join(name.encode() + b"\0" + struct.pack("<iiii", _HALF if half else _FLOAT, 0, 1, 1)
                        for name in _CHANNELS) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    values = (("channels", "chlist", channels), ("compression", "compression", bytes([_ZIP])),
              ("dataWindow", "box2i", window), ("displayWindow", "box2i", window), ("lineOrder", "lineOrder", b"\0"),
              (ATTRIBUTE, "string", record.encode()), ("pixelAspectRatio", "float", struct.pack("<f", 1)),
              ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
              ("screenWindowWidth", "float", struct.pack("<f", 1)))
    return struct.pack("<ii", _MAGIC, _VERSION) + b"".join(
        name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
        for name, kind, value in values) + b"\0"


def _attributes(file: BinaryIO) -> dict[str, bytes]:
    """The attributes of a header, which is long where many objects shadow each other.

    Raises ValueError or struct.error where it is none.
    """
    if struct.unpack("<ii", file.read(8))[0] != _MAGIC:
        raise ValueError("magic")
    found = {}
    while name := _word(file):
        _word(file)  # its type
        size, = struct.unpack("<i", file.read(4))
        if size < 0:
            raise ValueError("size")
        found[name] = file.read(size)
    return found


def _word(file: BinaryIO) -> str:
    """A name in a header; '' at its end. Raises ValueError where it is longer than the format has them."""
    out = b""
    while (letter := file.read(1)) not in (b"", b"\0"):
        out += letter
        if len(out) > _LONGEST_NAME:
            raise ValueError("name")
    return out.decode("latin-1")


def _pack(raw: bytes) -> bytes:
    """A block compressed as the format has it: even and odd bytes apart, differences, zlib; raw if that is smaller."""
    data = np.frombuffer(raw, np.uint8)
    apart = np.concatenate([data[::2], data[1::2]])
    differences = apart.copy()
    differences[1:] = apart[1:] - apart[:-1] + np.uint8(128)
    packed = zlib.compress(differences.tobytes(), _LEVEL)
    return packed if len(packed) < len(raw) else raw
