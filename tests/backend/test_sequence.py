# SPDX-License-Identifier: GPL-3.0-or-later
"""The bake of every frame in one file."""
from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load_file

from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.record import BakeRecord
from neural_gash_addon.backend.sequence import Writer, open_sequence
from neural_gash_addon.backend.transfer import Transfer

from .shapes import cube, sphere

MESH = TriangleMesh.from_triangles(*cube(), smooth=False)
RECORD = BakeRecord("embree", 3, len(MESH.points), MESH.domain, 64, 0, 0.1, 0.02, fingerprint="a:1")


def frames(count: int) -> list[Transfer]:
    rng = np.random.default_rng(0)
    return [Transfer(rng.normal(size=(len(MESH.points), 9)).astype(np.float32),
                     replace(RECORD, fingerprint=f"f{k}:1", rays=k,
                             frame=(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)))
            for k in range(count)]


def write(path, transfers, first=5):
    writer = Writer(path, first, len(transfers), MESH)
    for transfer in transfers:
        writer.add(MESH, transfer)
    return writer


def test_every_frame_comes_back(tmp_path):
    path, transfers = tmp_path / "a.prtseq", frames(4)
    write(path, transfers).end()
    sequence = open_sequence(path)
    for number, transfer in enumerate(transfers):
        found, record = sequence.frame(5 + number)
        np.testing.assert_allclose(found, transfer.coefficients, rtol=5e-4, atol=1e-6)
        assert record == transfer.record
    np.testing.assert_array_equal(sequence.elements, MESH.elements)
    assert sequence.frame(-99)[1] == transfers[0].record and sequence.frame(99)[1] == transfers[-1].record
    bare = 4 * len(MESH.points) * 9 * 2
    assert bare < path.stat().st_size < bare + 4 * len(MESH.elements) + (1 << 14) + 4 * (1 << 10) + 9


def test_cut_after_it_was_opened(tmp_path):
    """Were it mapped, that would end the process."""
    path = tmp_path / "a.prtseq"
    write(path, frames(40)).end()
    sequence = open_sequence(path)
    with open(path, "r+b") as file:
        file.truncate(100)
    with pytest.raises(UserError, match="missing or cut"):
        sequence.frame(44)
    path.unlink()
    with pytest.raises(UserError, match="missing or cut"):
        sequence.frame(5)


def test_it_is_a_safetensors_file(tmp_path):
    path, transfers = tmp_path / "a.prtseq", frames(2)
    write(path, transfers).end()
    arrays = load_file(path)
    np.testing.assert_array_equal(arrays["coefficients"][1], transfers[1].coefficients.astype(np.float16))
    np.testing.assert_array_equal(arrays["elements"], MESH.elements)


def test_nothing_is_left_of_what_was_given_up(tmp_path):
    path = tmp_path / "a.prtseq"
    write(path, frames(2)).end()
    before = path.read_bytes()
    write(path, frames(1)).discard()
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_other_points_are_refused(tmp_path):
    writer = write(tmp_path / "a.prtseq", frames(1))
    with pytest.raises(UserError, match="change in the course"):
        writer.add(TriangleMesh.from_triangles(*sphere(2)), frames(1)[0])
    with pytest.raises(UserError, match="change in the course"):
        writer.add(MESH, Transfer(np.zeros((len(MESH.points), 16), np.float32), RECORD))
    writer.discard()


def test_a_file_that_cannot_be_made(tmp_path):
    with pytest.raises(UserError, match="cannot be written"):
        Writer(tmp_path / "no" / "a.prtseq", 1, 1, MESH)


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "text", "length", "record", "count", "shape",
                                    "elements"])
def test_damaged_files_are_refused(tmp_path, damage):
    path = tmp_path / "a.prtseq"
    if damage != "missing":
        write(path, frames(3)).end()
        data = path.read_bytes()
        text = data[8:8 + int.from_bytes(data[:8], "little")]
        header = json.loads(text)
        if damage == "record":
            header["__metadata__"]["record"] = "{}"
        if damage == "count":
            header["__metadata__"]["frames"] = "[]"
        if damage == "shape":
            header["coefficients"]["shape"][1] -= 1
        changed = data[:8] + json.dumps(header).encode().ljust(len(text)) + data[8 + len(text):]
        if damage == "elements":
            changed = data[:-4] + b"\xff\xff\xff\x7f"
        path.write_bytes({"empty": b"", "cut": data[:-200], "text": b"hello, this is no sequence at all",
                          "length": b"\xff" * 8 + data[8:]}.get(damage, changed))
    with pytest.raises(UserError, match="missing or no sequence"):
        open_sequence(path)
