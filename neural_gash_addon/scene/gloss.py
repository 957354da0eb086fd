# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy previews of texture bakes: their images, filled anew whenever the light changes."""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend import gloss
from ..backend.record import BakeRecord
from ..backend.texture import CHANNELS
from .gloss_nodes import build_gloss_group, gloss_image_count, gloss_images
from .images import RECORD, bake_images

_transfer: dict[tuple[int, ...], NDArray[np.float32]] = {}  # images' session uids -> (texels, K); the last one only


def can_gloss(record: BakeRecord) -> bool:
    """Whether a bake can be shown glossy: a texture, of transfer that no colour is in yet."""
    return record.side > 0 and record.colours == 1


def gloss_group(data: bpy.types.Mesh, record: BakeRecord) -> bpy.types.NodeTree:
    """A new group and images for the glossy preview of a bake; dark until `light_gloss`."""
    images = []
    for number in range(gloss_image_count(record.order)):
        image = bpy.data.images.new(f"{data.name} PRT gloss {number}", record.side, record.side, alpha=True,
                                    float_buffer=True, is_data=True)
        image.use_half_precision, image.alpha_mode = False, "CHANNEL_PACKED"
        image[RECORD] = ""
        images.append(image)
    return build_gloss_group(record.order, images, record.uv_map)


def light_gloss(data: bpy.types.Mesh, record: BakeRecord, node: bpy.types.Node, light: NDArray, turn: NDArray) -> None:
    """Fill the images for a light, and tell the shader how the object is turned.

    Args:
        node: of a group from `gloss_group`. light: (K, 3) in the frame of the bake.
        turn: (3, 3) from world axes into that frame.
    Raises:
        UserError: the images of the bake are not whole.
    """
    for axis, row in zip("XYZ", turn, strict=True):
        node.inputs[f"Turn {axis}"].default_value = row.tolist()
    transfer = _coefficients(data, record)
    images = gloss_images(node.node_tree)
    numbers = np.empty((len(images), len(transfer), CHANNELS), np.float32)
    gloss.lit_channels(transfer, light, CHANNELS, numbers)
    for image, pixels in zip(images, numbers, strict=True):
        image.pixels.foreach_set(pixels.ravel())
        image.update()


def _coefficients(data: bpy.types.Mesh, record: BakeRecord) -> NDArray[np.float32]:
    """(texels, K) of a bake's images."""
    images = bake_images(data, record)
    key = tuple(image.session_uid for image in images)
    if key not in _transfer:
        _transfer.clear()
        out = np.empty((record.side ** 2, CHANNELS * len(images)), np.float32)
        pixels = np.empty((record.side ** 2, CHANNELS), np.float32)
        for number, image in enumerate(images):
            image.pixels.foreach_get(pixels.ravel())
            out[:, CHANNELS * number:CHANNELS * (number + 1)] = pixels
        _transfer[key] = np.ascontiguousarray(out[:, :record.terms])
    return _transfer[key]
