# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes as .npz: what was saved comes back, and nothing half-written is ever in place."""
from __future__ import annotations

import numpy as np
import pytest

from neural_gash_addon.backend import exchange, methods
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.transfer import Transfer

from . import shapes


@pytest.fixture(scope="module")
def baked():
    """Three points of a cube with their unshadowed transfer."""
    mesh = shapes.at_points(shapes.cube(), np.eye(3) / 2, np.eye(3))
    return mesh, methods.run(methods.bake(mesh, "analytic", 3))


def _names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", ["bake.npz", "a 'b' \"c\" ü 屋根.npz"])
def test_round_trip(baked, tmp_path, name):
    mesh, transfer = baked
    exchange.save_npz(tmp_path / name, mesh, transfer)
    arrays, record = exchange.load_npz(tmp_path / name)
    np.testing.assert_array_equal(arrays["positions"], mesh.points.astype(np.float32))
    np.testing.assert_array_equal(arrays["normals"], mesh.normals.astype(np.float32))
    np.testing.assert_array_equal(arrays["transfer"], transfer.coefficients)
    assert arrays["transfer"].dtype == np.float32 and str(arrays["domain"]) == mesh.domain
    assert record == transfer.record
    assert _names(tmp_path) == [name]


def test_no_pickles(baked, tmp_path):
    exchange.save_npz(tmp_path / "bake.npz", *baked)
    with np.load(tmp_path / "bake.npz", allow_pickle=False) as data:
        assert all(data[key].dtype.kind in "fiuU" for key in data.files)
        assert {"positions", "normals", "transfer", "domain", "elements", "record"} == set(data.files)


def _array(path):
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def _other_npz(path):
    np.savez(path, positions=np.zeros(3))


def _pickle(path):
    empty = np.zeros((0, 3))
    np.savez(path, positions=np.array([{}], dtype=object), normals=empty, transfer=empty, domain="POINT", record="{}")


def _cut(path):
    mesh = shapes.at_points(shapes.cube(), np.eye(3) / 2, np.eye(3))
    exchange.save_npz(path, mesh, methods.run(methods.bake(mesh, "analytic", 3)))
    path.write_bytes(path.read_bytes()[:-40])


@pytest.mark.parametrize("write", [
    lambda path: None, lambda path: path.write_bytes(b""), lambda path: path.write_text("not a bake"),
    lambda path: path.write_bytes(b"PK\x03\x04 not a zip"), lambda path: path.mkdir(),
    _array, _other_npz, _pickle, _cut,
], ids=["missing", "empty", "text", "broken zip", "folder", "npy", "other npz", "pickle", "cut off"])
def test_no_bake_is_one_sentence(write, tmp_path):
    path = tmp_path / "bake.npz"
    write(path)
    with pytest.raises(UserError, match="bake.npz") as caught:
        exchange.load_npz(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("record", ["", "{", "[]", '{"schema": 99}', '{"schema": 1}'])
def test_damaged_record_is_one_sentence(record, tmp_path):
    path, empty = tmp_path / "bake.npz", np.zeros((0, 3))
    np.savez(path, positions=empty, normals=empty, transfer=empty, domain="POINT", record=record)
    with pytest.raises(UserError):
        exchange.load_npz(path)


@pytest.mark.parametrize("error", [OSError("disk full"), UserError("No."), KeyboardInterrupt()])
def test_atomic_keeps_the_old_file_when_the_writer_fails(error, tmp_path):
    path = tmp_path / "bake.npz"
    path.write_bytes(b"old")
    with pytest.raises(type(error)), exchange.atomic(path) as draft:
        draft.write_bytes(b"half")
        raise error
    assert path.read_bytes() == b"old" and _names(tmp_path) == ["bake.npz"]


def test_atomic_replaces_and_stays_readable_for_others(tmp_path):
    path = tmp_path / "bake.npz"
    path.write_bytes(b"old")
    with exchange.atomic(path) as draft:
        assert draft.suffix == path.suffix and draft.parent == path.parent
        draft.write_bytes(b"new")
        assert path.read_bytes() == b"old"
    plain = tmp_path / "plain"
    plain.touch()
    assert path.read_bytes() == b"new" and path.stat().st_mode == plain.stat().st_mode


def test_save_that_fails_keeps_the_old_bake(baked, tmp_path):
    mesh, transfer = baked
    path = tmp_path / "bake.npz"
    exchange.save_npz(path, mesh, transfer)
    before = path.read_bytes()
    with pytest.raises(AttributeError):
        exchange.save_npz(path, mesh, Transfer(transfer.coefficients, None))
    assert path.read_bytes() == before and _names(tmp_path) == ["bake.npz"]


def test_check_writable(tmp_path):
    exchange.check_writable(tmp_path / "new.npz")
    assert not _names(tmp_path)
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "missing" / "a.npz", tmp_path / "file" / "a.npz", tmp_path):
        with pytest.raises(UserError, match="folder"):
            exchange.check_writable(path)
