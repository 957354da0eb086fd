# SPDX-License-Identifier: GPL-3.0-or-later
"""The transfer of every frame of an animation in one file, of which a frame at a time is mapped.

A safetensors file (see `weights`): `coefficients` (frames, N, K) as 16-bit floats, exact to a two-thousandth, which is
below the error of any bake; `elements` (E,), the point of each vertex or face corner. Its metadata: the record
of the first frame, and of each frame what differs from it: fingerprint, rotation, error, at times the method.
"""
from __future__ import annotations

import json
import struct
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .exchange import atomic, reason
from .geometry import TriangleMesh
from .record import BakeRecord
from .transfer import Transfer

SUFFIX = ".prtseq"
_ROOM, _ROOM_PER_FRAME = 1 << 14, 1 << 10  # bytes of the header, which is written last and stands first


@dataclass(frozen=True, eq=False)
class Sequence:
    """A file of a `Writer`. No map of it is kept: reading one of a file that was cut ends the process, and on Windows
    no mapped file can be replaced."""

    path: Path
    first: int                            # frame
    start: int                            # byte at which the coefficients begin
    shape: tuple[int, ...]                # of those of a frame: (N, K) or (N, K, 3)
    elements: NDArray[np.int32]           # (E,)
    records: list[BakeRecord]             # of each frame

    def frame(self, number: int) -> tuple[NDArray[np.float32], BakeRecord]:
        """The coefficients (N, K) of a frame and their record; of the nearest one that there is.

        Raises:
            UserError: the file is gone or cut.
        """
        index = int(np.clip(number - self.first, 0, len(self.records) - 1))
        count = int(np.prod(self.shape))
        try:
            mapped = np.memmap(self.path, "<f2", "r", self.start + 2 * count * index, self.shape)
            return np.array(mapped, np.float32), self.records[index]
        except (OSError, ValueError) as error:
            raise UserError(f"'{self.path}' is missing or cut.") from error


class Writer:
    """Writes a file frame by frame; it takes the place of another only at the end."""

    def __init__(self, path: Path, first: int, count: int, mesh: TriangleMesh) -> None:
        """For `count` frames from `first`. mesh: of the first. Raises UserError where no file can be made."""
        self._path, self._first, self._mesh = path, first, mesh
        self._room = _ROOM + _ROOM_PER_FRAME * count
        self._records: list[BakeRecord] = []
        self._shape: tuple[int, ...] = ()
        self._files = ExitStack()
        try:
            draft = self._files.enter_context(atomic(path))
            self._file = self._files.enter_context(open(draft, "wb"))  # noqa: SIM115  closed with the stack
            self._file.seek(8 + self._room)
        except OSError as error:
            self.discard()
            raise UserError(f"'{path}' cannot be written ({reason(error)}).") from error

    def add(self, mesh: TriangleMesh, transfer: Transfer) -> None:
        """The next frame. UserError where the mesh is no longer of the same points, or the disk is full."""
        if not np.array_equal(mesh.elements, self._mesh.elements) or (
                self._shape and transfer.coefficients.shape != self._shape):
            raise UserError("Its vertices, faces or split normals change in the course of the animation, so one file "
                            "cannot hold it.")
        self._shape = transfer.coefficients.shape
        self._records.append(transfer.record)
        self._write(np.ascontiguousarray(transfer.coefficients, "<f2").tobytes())

    def end(self) -> None:
        """Write what stands first, and put the file in its place. UserError as `add`."""
        count = len(self._records)
        size = 2 * count * int(np.prod(self._shape))
        elements = np.ascontiguousarray(self._mesh.elements, "<i4")
        base = asdict(self._records[0])
        every = [{name: value for name, value in asdict(r).items() if value != base[name]} for r in self._records]
        about = {"record": self._records[0].to_json(), "first": str(self._first), "frames": json.dumps(every)}
        header = {"__metadata__": about,
                  "coefficients": {"dtype": "F16", "shape": [count, *self._shape], "data_offsets": [0, size]},
                  "elements": {"dtype": "I32", "shape": [len(elements)],
                               "data_offsets": [size, size + elements.nbytes]}}
        text = json.dumps(header).encode()
        if len(text) > self._room:
            raise UserError("The records of the frames take more room than a sequence has for them.")
        self._write(elements.tobytes())
        self._file.seek(0)
        self._write(struct.pack("<Q", self._room) + text.ljust(self._room))
        try:
            self._files.close()
        except OSError as error:
            raise UserError(f"'{self._path}' cannot be written ({reason(error)}).") from error

    def discard(self) -> None:
        """Leave no file, unless `end` put it in its place."""
        given_up = UserError("given up")
        self._files.__exit__(type(given_up), given_up, None)

    def _write(self, data: bytes) -> None:
        try:
            self._file.write(data)
        except OSError as error:
            raise UserError(f"'{self._path}' cannot be written ({reason(error)}).") from error


def open_sequence(path: Path) -> Sequence:
    """What a file holds, but for the coefficients.

    Raises:
        UserError: it is missing, cut, or none that a `Writer` wrote.
    """
    try:
        with open(path, "rb") as file:
            length, = struct.unpack("<Q", file.read(8))
            if length > path.stat().st_size:
                raise ValueError(length)
            header = json.loads(file.read(length))
        about = header["__metadata__"]
        base = BakeRecord.from_json(about["record"])
        records = [replace(base, **{**entry, "frame": tuple(entry.get("frame", base.frame))})
                   for entry in json.loads(about["frames"])]
        start, place = (8 + length + header[name]["data_offsets"][0] for name in ("coefficients", "elements"))
        shape, (count,) = tuple(header["coefficients"]["shape"]), header["elements"]["shape"]
        elements = np.fromfile(path, "<i4", count, offset=place)
        held = (len(records), base.points, base.order ** 2, 3)[:3 if base.colours == 1 else 4]
        if (shape != held or place < start + 2 * np.prod(shape) or not 0 < count == len(elements)
                or elements.min() < 0 or elements.max() >= base.points):
            raise ValueError(shape)
        return Sequence(path, int(about["first"]), start, shape[1:], elements, records)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, struct.error) as error:
        raise UserError(f"'{path}' is missing or no sequence that Neural GASh baked.") from error
