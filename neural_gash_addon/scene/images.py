# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer textures as Blender images: OpenEXR files, packed or beside the .blend, known to their mesh."""
from __future__ import annotations

import itertools
import os
import re
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import bpy

from ..backend import exr
from ..backend.errors import UserError
from ..backend.exchange import atomic, check_writable, reason
from ..backend.record import BakeRecord
from ..backend.texture import TextureTransfer, image_count

TRANSFER = "neural_gash_images"      # custom property of the mesh: its transfer images by number
BOUNCED = "neural_gash_gloss_images"  # and those of glossy bounces, which are of one light
RECORD = "neural_gash"         # custom property of an image: the record of the bake it belongs to


def make_images(name: str, transfer: TextureTransfer, folder: Path | None, half: bool, parts: str = "",
                label: str = "prt", owners: Sequence[bpy.types.Mesh] = ()) -> list[bpy.types.Image]:
    """New images that hold a texture bake, four coefficients each, and those of the lamps, if there are any.

    Args:
        folder: where the files go; they are packed into the .blend where not given.
        half: 16 bits a channel instead of 32; not for lamps, whose light may be of any size.
        parts: what the record does not say of each object that shares the texture, as JSON.
        label: what the files are called after the object.
        owners: the meshes that the images are for, whose earlier files are replaced.
    Raises:
        UserError: files cannot be written there, or others' are in the way.
    """
    if folder is not None:
        stem = _free_stem(name, folder, label, transfer.record, owners)
        return _load(name, _write(stem, transfer, folder, half, parts), transfer.record, half)
    with tempfile.TemporaryDirectory(prefix="neural_gash-") as temporary:
        stem = _stem(name, label)
        images = _load(name, _write(stem, transfer, Path(temporary), half, parts), transfer.record, half)
        for image in images:
            image.pack()
            image.filepath_raw = f"//{Path(image.filepath_raw).name}"  # the file itself is going
        return images


def _names(record: BakeRecord) -> list[str]:
    """What tells the images of a bake apart: numbers, then those of the lamps, whose first has the irradiance."""
    lamps = image_count(3 * record.lamps_order ** 2) if record.lamps else 0
    return [*map(str, range(image_count(record.terms))), *["lamps", *(f"lamps{n}" for n in range(1, lamps))][:lamps]]


def attach(data: bpy.types.Mesh, images: Sequence[bpy.types.Image], key: str = TRANSFER) -> None:
    """Make the images those of the mesh."""
    data[key] = {str(number): image for number, image in enumerate(images)}


def detach(data: bpy.types.Mesh, key: str = TRANSFER) -> None:
    """Take the mesh its images; a preview may show them until it goes."""
    images = [image for image in _attached(data, key) if image is not None]
    if key in data:
        del data[key]
    remove_unused(images)


def remove_unused(images: Iterable[bpy.types.Image]) -> None:
    """Delete those of some images that a bake made and nothing uses any more."""
    for image in [i for i in images if RECORD in i and i.users == 0]:
        bpy.data.images.remove(image)


def bake_images(data: bpy.types.Mesh, record: BakeRecord, key: str = TRANSFER) -> list[bpy.types.Image]:
    """The images of the bake on a mesh, or of its glossy bounces, whose record has their number.

    Raises:
        UserError: one is missing, cannot be loaded, has another size, or belongs to another bake.
    """
    images = [image for image in _attached(data, key) if image is not None]
    if len(images) != len(_names(record)):
        raise UserError(f"The bake of '{data.name}' has lost some of its images; bake again.")
    for image in images:
        if not image.packed_file:
            path = Path(bpy.path.abspath(image.filepath))
            if not path.is_file():
                raise UserError(f"The image '{image.name}' of the bake is missing ('{path}'); bake again.")
            text, _, _ = exr.read_record(path)
            if text != image.get(RECORD):
                raise UserError(f"The file '{path}' is of another bake than the object's; bake again.")
        if not all(image.size):
            raise UserError(f"The image '{image.name}' of the bake cannot be read ('{image.filepath}'); bake again.")
        if tuple(image.size) != (record.side, record.side):
            raise UserError(f"The image '{image.name}' has {image.size[0]} x {image.size[1]} texels, "
                            f"but the bake has {record.side} x {record.side}; bake again.")
    return images


def _attached(data: bpy.types.Mesh, key: str) -> list[bpy.types.Image | None]:
    """The images of a mesh in their order; None for one that was deleted."""
    stored = data.get(key)
    if not hasattr(stored, "keys"):
        return []
    return [image if isinstance(image := stored[key], bpy.types.Image) else None
            for key in sorted(filter(str.isdecimal, stored.keys()), key=int)]


def _stem(name: str, label: str, number: int = 0) -> str:
    """What the files of an object are called, but for their number and suffix."""
    clean = re.sub(r"[^\w.-]+", "_", name) or "mesh"
    return f"{clean}_{number}_{label}" if number else f"{clean}_{label}"


def _free_stem(name: str, folder: Path, label: str, record: BakeRecord, owners: Sequence[bpy.types.Mesh]) -> str:
    """`_stem` with the first number at which no file is replaced that holds the bake of another mesh.

    Names may differ in what no file name has, an object may have had the name before, and copies share files.
    """
    others = [mesh for mesh in bpy.data.meshes if mesh.users and mesh not in owners]
    taken = {_plain(bpy.path.abspath(image.filepath)) for mesh in others for key in (TRANSFER, BOUNCED)
             for image in _attached(mesh, key) if image is not None and not image.packed_file}
    return next(stem for number in itertools.count() if taken.isdisjoint(
        map(_plain, _paths(folder, stem := _stem(name, label, number), record))))


def _plain(path: Path | str) -> str:
    """A path to compare with others; not all file systems tell capitals from small letters."""
    return os.path.realpath(path).casefold()


def _paths(folder: Path, stem: str, record: BakeRecord) -> list[Path]:
    """The image files of a bake."""
    return [folder / f"{stem}_{name}.exr" for name in _names(record)]


def _is_lamps(path: Path) -> bool:
    return re.search(r"_lamps\d*$", path.stem) is not None


def _write(stem: str, transfer: TextureTransfer, folder: Path, half: bool, parts: str) -> list[Path]:
    """Write the files, each in one step, and the record beside them."""
    paths = _paths(folder, stem, transfer.record)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"The folder '{folder}' cannot be made ({reason(error)}).") from error
    check_writable(paths[0])
    record_file = folder / f"{stem}.json"
    for path in filter(Path.exists, [*paths, record_file]):
        try:
            if path == record_file:
                BakeRecord.from_json(path.read_text())
            else:
                exr.read_record(path)
        except (OSError, ValueError, UserError) as error:
            raise UserError(f"There is a file '{path}' that no bake made; choose another folder.") from error
    side, filled, text = transfer.record.side, transfer.fill_map(), transfer.record.to_json()
    try:
        with ExitStack() as drafts:  # which take their places together, once all are whole
            for number, path in enumerate(paths):
                image = transfer.image(number, filled).reshape(side, side, 4)
                exr.write(drafts.enter_context(atomic(path)), image, text, half and not _is_lamps(path))
            beside = drafts.enter_context(atomic(record_file))
            beside.write_text((f'{text[:-1]}, "objects": {parts}}}' if parts else text) + "\n")
    except OSError as error:
        raise UserError(f"The textures cannot be written to '{folder}' ({reason(error)}).") from error
    return paths


def _load(name: str, paths: list[Path], record: BakeRecord, half: bool) -> list[bpy.types.Image]:
    """The files as images whose numbers mean themselves."""
    images = []
    for path, part in zip(paths, _names(record), strict=True):
        image = bpy.data.images.load(str(path), check_existing=False)
        image.name = f"{name} PRT {part}"
        image.colorspace_settings.name = "Non-Color"
        image.alpha_mode = "CHANNEL_PACKED"
        image.use_half_precision = half and not _is_lamps(path)
        image[RECORD] = record.to_json()
        if bpy.data.is_saved:
            with suppress(ValueError):  # another drive, on Windows
                image.filepath = bpy.path.relpath(str(path))
        images.append(image)
    return images
