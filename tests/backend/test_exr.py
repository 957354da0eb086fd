# SPDX-License-Identifier: GPL-3.0-or-later
"""OpenEXR files read back by a reader that no one here wrote."""
import numpy as np
import OpenImageIO as oiio
import pytest

from neural_gash_addon.backend import exr
from neural_gash_addon.backend.errors import UserError


def picture(height, width, seed=0):
    """Signed values of all sizes, the small and the large included; row 0 at the bottom."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(height, width, 4)) * 10.0 ** rng.uniform(-6, 4, (height, width, 1))
    values[0, 0] = [0.0, -0.0, 1.0, -1.0]
    return values.astype(np.float32)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (16, 16), (17, 5), (64, 33), (100, 100)])
@pytest.mark.parametrize("half", [False, True])
def test_another_reader_gets_the_same_bits(tmp_path, height, width, half):
    image, path = picture(height, width), tmp_path / "a.exr"
    if half:
        image = image.astype(np.float16)
    exr.write(path, image, "hello", half)
    buffer = oiio.ImageBuf(str(path))
    assert not buffer.has_error, buffer.geterror()
    assert buffer.spec().channelnames == ("R", "G", "B", "A")
    assert str(buffer.spec().format) == ("half" if half else "float")
    pixels = buffer.get_pixels(oiio.FLOAT)[::-1]
    np.testing.assert_array_equal(pixels, image.astype(np.float32))


def test_smooth_images_get_smaller(tmp_path):
    y, x = np.mgrid[:256, :256] / 256
    image = np.stack([x, y, x * y, np.zeros_like(x)], -1).astype(np.float32)
    exr.write(tmp_path / "a.exr", image, "")
    assert (tmp_path / "a.exr").stat().st_size < 0.6 * image.nbytes
    np.testing.assert_array_equal(oiio.ImageBuf(str(tmp_path / "a.exr")).get_pixels(oiio.FLOAT)[::-1], image)


def test_record_is_in_the_header(tmp_path):
    path = tmp_path / "a.exr"
    exr.write(path, picture(20, 30), '{"order": 5, "name": "Käse"}')
    assert exr.read_record(path) == ('{"order": 5, "name": "Käse"}', 30, 20)
    header = oiio.ImageInput.open(str(path)).spec()
    assert header.get_string_attribute(exr.ATTRIBUTE) == '{"order": 5, "name": "Käse"}'


@pytest.mark.parametrize("content", [b"", b"x" * 100, b"v/1\x01\x02\0\0\0", b"v/1\x01\x02\0\0\0channels\0chlist\0\xff"])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "a.exr").write_bytes(content)
    with pytest.raises(UserError):
        exr.read_record(tmp_path / "a.exr")


def test_foreign_and_missing_images_are_refused(tmp_path):
    spec = oiio.ImageSpec(4, 4, 4, oiio.FLOAT)
    out = oiio.ImageOutput.create(str(tmp_path / "b.exr"))
    out.open(str(tmp_path / "b.exr"), spec)
    out.write_image(np.zeros((4, 4, 4), np.float32))
    out.close()
    with pytest.raises(UserError, match="none that Neural GASh baked"):
        exr.read_record(tmp_path / "b.exr")
    with pytest.raises(UserError, match="cannot be read"):
        exr.read_record(tmp_path / "c.exr")


def test_a_write_that_fails_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "a.exr"
    path.write_bytes(b"before")
    monkeypatch.setattr(exr.zlib, "compress", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError):
        exr.write(path, picture(8, 8), "")
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]


def test_a_record_of_any_length_is_read(tmp_path):
    """Of thousands of objects that shadow each other, by their names."""
    text = "x" * 200_000
    exr.write(tmp_path / "a.exr", np.zeros((4, 4, 4), np.float32), text)
    assert exr.read_record(tmp_path / "a.exr") == (text, 4, 4)
