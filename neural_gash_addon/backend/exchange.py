# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes as .npz files, for people who compute. No pickles."""
from __future__ import annotations

import io
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .geometry import TriangleMesh
from .record import BakeRecord
from .transfer import Transfer

# what NumPy raises at files that are missing, something else (.npy: TypeError), empty (EOFError) or damaged
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)


def check_writable(path: Path) -> None:
    """UserError unless a file can be made beside `path` and take its place."""
    if path.is_dir():
        raise UserError(f"'{path}' is a folder, not a file to write.")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise UserError(f"The folder '{path.parent}' cannot be written to ({reason(error)}).") from error


def check_folder(folder: Path) -> None:
    """UserError unless there is such a folder that can be written to, or one can be made."""
    there = next(path for path in (folder, *folder.parents) if os.path.exists(path))
    if not there.is_dir():
        raise UserError(f"The folder '{folder}' cannot be made, as '{there}' is a file.")
    check_writable(there / "draft")


def reason(error: OSError) -> str:
    """Why a file could not be read or written, for the end of a sentence."""
    return (error.strerror or str(error)).lower()


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A file beside `path`, of the same suffix, to write; it takes the place of `path` only once whole.

    Where `path` is a link, what it leads to is replaced, and keeps its permissions.
    """
    path = Path(os.path.realpath(path))
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    draft = Path(name)
    try:
        yield draft
        mask = os.umask(0)
        os.umask(mask)
        draft.chmod(path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~mask)  # mkstemp's are its owner's only
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def save_npz(path: Path, mesh: TriangleMesh, transfer: Transfer) -> None:
    """Write positions (N, 3), normals (N, 3), transfer (N, K), domain, elements (E,) and record (JSON text).

    For the POINT domain the points are the mesh's vertices in their order; for CORNER,
    `elements` gives the point of each face corner. `irradiance` (N, 3) is there where lamps were baked.
    """
    lit = {} if transfer.irradiance is None else {"irradiance": transfer.irradiance}
    write_npz(path, positions=mesh.points.astype(np.float32), normals=mesh.normals.astype(np.float32),
              transfer=transfer.coefficients, domain=np.array(mesh.domain), elements=mesh.elements,
              record=np.array(transfer.record.to_json()), **lit)


def write_npz(path: Path, **arrays: NDArray) -> None:
    """Write arrays in one step. OSError where there is no room: zipfile, left to write to the disk, hides it."""
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    with atomic(path) as draft:
        draft.write_bytes(content.getbuffer())


def load_npz(path: Path) -> tuple[dict[str, NDArray], BakeRecord]:
    """The arrays of a file that `save_npz` wrote, `irradiance` where there is one, and its record.

    Raises:
        UserError: the file is missing, or no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {key: data[key] for key in ("positions", "normals", "transfer", "domain", "irradiance")
                      if key != "irradiance" or key in data}
            record = str(data["record"])
    except _UNREADABLE as error:
        raise UserError(f"'{path}' is missing or no bake that Neural GASh saved.") from error
    found = BakeRecord.from_json(record)
    transfer = arrays["transfer"]
    shape = (len(arrays["positions"]), found.order ** 2, 3)[:2 if found.colours == 1 else 3]
    irradiance = arrays.get("irradiance", np.zeros((shape[0], 3)))
    if (transfer.dtype.kind != "f" or transfer.shape != shape or irradiance.dtype.kind != "f"
            or irradiance.shape != (shape[0], 3)):
        raise UserError(f"'{path}' does not hold the coefficients that its record tells of.")
    return arrays, found
