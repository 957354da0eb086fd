# SPDX-License-Identifier: GPL-3.0-or-later
"""What a comparison of methods leaves in the file: a colour attribute of errors, and a chart as an image."""
from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import UserError
from ..backend.exchange import atomic, check_writable
from ..backend.geometry import POINT, TriangleMesh

ERRORS = "neural_gash_error"        # the colour attribute
CHART = "Neural GASh Comparison"    # the image
_OURS = "neural_gash_comparison"    # custom property of the image: it is ours to draw over


def check_errors(obj: bpy.types.Object) -> None:
    """UserError where the mesh has something of the attribute's name that is no such attribute."""
    attribute = obj.data.attributes.get(ERRORS)
    if (attribute is not None and attribute.data_type != "FLOAT_COLOR") or ERRORS in obj.vertex_groups:
        raise UserError(f"'{obj.name}' has an attribute or vertex group '{ERRORS}' that no comparison made; "
                        "rename or remove it to compare.")


def write_errors(obj: bpy.types.Object, mesh: TriangleMesh, colours: NDArray) -> None:
    """Store colours (N, 3) of a mesh's points, as they shall be shown, and make them the ones that Solid shading shows.

    Raises:
        UserError: the mesh has changed since it was read, or see `check_errors`.
    """
    data = obj.data
    if len(mesh.elements) != len(data.vertices if mesh.domain == POINT else data.loops):
        raise UserError(f"'{obj.name}' was changed during the comparison; compare again.")
    check_errors(obj)
    rendered = data.attributes.default_color_name
    if ERRORS in data.attributes:
        data.attributes.remove(data.attributes[ERRORS])  # it may be of the other domain
    attribute = data.attributes.new(ERRORS, "FLOAT_COLOR", mesh.domain)
    values = np.ones((len(mesh.elements), 4), np.float32)
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    values[:, :3] = linear[mesh.elements]
    attribute.data.foreach_set("color", values.ravel())
    data.attributes.active_color_name = ERRORS
    data.attributes.default_color_name = rendered if rendered != ERRORS else ""
    data.update_tag()


def write_chart(pixels: NDArray[np.float32]) -> bpy.types.Image:
    """The chart (H, W, 4), row 0 at the bottom, as an image that is kept in the file; an earlier one is drawn over."""
    height, width = pixels.shape[:2]
    image = next((i for i in bpy.data.images if i.get(_OURS) and not i.library and tuple(i.size) == (width, height)),
                 None)
    if image is None:
        image = bpy.data.images.new(CHART, width, height)
        image[_OURS] = True
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.pack()
    return image


def show(context: bpy.types.Context, image: bpy.types.Image) -> None:
    """Put the image into the Image Editors that are open and show no other than a chart."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            space = area.spaces.active
            if area.type == "IMAGE_EDITOR" and (space.image is None or space.image.get(_OURS)):
                space.image = image


def check_chart(path: Path) -> None:
    """UserError where `save_chart` could not write."""
    if path.suffix.lower() != ".png":
        raise UserError(f"The chart is a picture; give it a name that ends in .png, not '{path.name}'.")
    check_writable(path)


def save_chart(image: bpy.types.Image, path: Path) -> None:
    """Write the image as PNG."""
    with atomic(path) as draft:
        copy = image.copy()  # saving changes where an image is from
        try:
            copy.filepath_raw, copy.file_format = str(draft), "PNG"
            copy.save()
        finally:
            bpy.data.images.remove(copy)
