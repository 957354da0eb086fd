# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy previews of texture bakes: their images, filled anew whenever the light changes."""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend import gloss
from ..backend import spherical_harmonics as sh
from ..backend.record import BakeRecord
from ..backend.texture import CHANNELS, image_count
from .gloss_bounce import bounces_for
from .gloss_nodes import build_gloss_group, gloss_image_count, gloss_images, lobe_of
from .images import BOUNCED, RECORD, bake_images

_transfer: dict[tuple[int, ...], NDArray[np.float32]] = {}  # images' session uids -> (texels, terms); the last one only


def can_gloss(record: BakeRecord) -> bool:
    """Whether a bake can be shown glossy: a texture, of transfer that no colour is in yet. With lamps, it has to know
    where their light comes from.
    """
    return record.side > 0 and record.colours == 1 and (not record.lamps or record.lamps_order >= record.order)


def gloss_group(data: bpy.types.Mesh, record: BakeRecord, lobe: str) -> bpy.types.NodeTree:
    """A new group and images for the glossy preview of a bake, of a lobe (`lobes`); dark until `light_gloss`."""
    images = []
    for number in range(gloss_image_count(record.order)):
        image = bpy.data.images.new(f"{data.name} PRT gloss {number}", record.side, record.side, alpha=True,
                                    float_buffer=True, is_data=True)
        image.use_half_precision, image.alpha_mode = False, "CHANNEL_PACKED"
        image[RECORD] = ""
        images.append(image)
    return build_gloss_group(record.order, images, record.uv_map, lobe)


def gloss_whole(node: bpy.types.Node, record: BakeRecord) -> bool:
    """Whether the group of a node is still as `gloss_group` made it for a bake, so far as `light_gloss` needs it."""
    images = gloss_images(node.node_tree)
    return (len(images) == gloss_image_count(record.order) and "Turn X" in node.inputs
            and all(tuple(image.size) == (record.side, record.side) for image in images))


def light_gloss(data: bpy.types.Mesh, record: BakeRecord, node: bpy.types.Node, light: NDArray, turn: NDArray,
                lamps: float = 1.0) -> None:
    """Fill the images for a light, and tell the shader how the object is turned.

    Args:
        node: of a group from `gloss_group`. light: (K, 3) in the frame of the bake.
        turn: (3, 3) from world axes into that frame. lamps: factor on the light of baked lamps.
    Raises:
        UserError: the images of the bake are not whole.
    """
    for axis, row in zip("XYZ", turn, strict=True):
        node.inputs[f"Turn {axis}"].default_value = row.tolist()
    if "Lamps" in node.inputs:
        node.inputs["Lamps"].default_value = lamps
    baked, count = bake_images(data, record), image_count(record.terms)
    transfer = _numbers(baked[:count], record)
    images = gloss_images(node.node_tree)
    numbers = np.empty((len(images), len(transfer), CHANNELS), np.float32)
    gloss.lit_channels(transfer, light, CHANNELS, numbers)
    bounces = bounces_for(data, light, lobe_of(node.node_tree))
    if bounces is not None:
        numbers += _bounced(bake_images(data, bounces, BOUNCED), bounces, numbers.shape)
    if record.lamps:
        numbers += np.float32(lamps) * _lamps(baked[count:], record, numbers.shape)
    for image, pixels in zip(images, numbers, strict=True):
        image.pixels.foreach_set(pixels.ravel())
        image.update()


def _lamps(images: list[bpy.types.Image], record: BakeRecord, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """What lamps add to `gloss.lit_channels`: radiance off what is dull, and the harmonics of what arrives."""
    terms = 3 * record.order ** 2
    values = _read(images, record, terms)
    out = np.zeros((shape[1], shape[0] * shape[2]), np.float32)
    out[:, :3] = values[:, :3] / np.pi
    out[:, 3:3 + terms] = values
    out[:, 3:6] *= np.float32(sh.normalisation(0, 0))  # irradiance to the harmonic
    return out.reshape(shape[1], shape[0], shape[2]).transpose(1, 0, 2)


def _numbers(images: list[bpy.types.Image], record: BakeRecord) -> NDArray[np.float32]:
    """(texels, terms) of a bake's images."""
    key = tuple(image.session_uid for image in images)
    if key not in _transfer:
        _transfer.clear()
        _transfer[key] = _read(images, record, record.terms)
    return _transfer[key]


def _read(images: list[bpy.types.Image], record: BakeRecord, terms: int) -> NDArray[np.float32]:
    """The first numbers (texels, terms) of images."""
    out = np.empty((record.side ** 2, CHANNELS * len(images)), np.float32)
    pixels = np.empty((record.side ** 2, CHANNELS), np.float32)
    for number, image in enumerate(images):
        image.pixels.foreach_get(pixels.ravel())
        out[:, CHANNELS * number:CHANNELS * (number + 1)] = pixels
    return np.ascontiguousarray(out[:, :terms])


def _bounced(images: list[bpy.types.Image], record: BakeRecord, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """What glossy bounces add to `gloss.lit_channels`: their numbers, and the radiance of what is dull."""
    values = _read(images, record, record.terms)
    out = np.zeros((shape[1], shape[0] * shape[2]), np.float32)
    out[:, :3] = values[:, :3] / (np.pi * sh.normalisation(0, 0))
    out[:, 3:3 + record.terms] = values
    return out.reshape(shape[1], shape[0], shape[2]).transpose(1, 0, 2)
