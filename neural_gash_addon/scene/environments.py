# SPDX-License-Identifier: GPL-3.0-or-later
"""The HDR environments that Blender ships, as SH light: what errors are relit with."""
from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import bpy

from ..backend.errors import UserError
from ..backend.light import project_equirect
from ..backend.spherical_harmonics import MAX_ORDER
from .world import Array, linear_pixels


@lru_cache(maxsize=1)
def shipped_environments() -> dict[str, Array]:
    """Light (MAX_ORDER**2, 3) of each by its name; the first K rows are that of a lower order.

    Raises:
        UserError: this Blender has none.
    """
    folder = Path(bpy.utils.system_resource("DATAFILES")) / "studiolights" / "world"
    found = {}
    for path in sorted(folder.glob("*.exr")):
        image = bpy.data.images.load(str(path))
        try:
            found[path.stem] = project_equirect(linear_pixels(image), MAX_ORDER)
        finally:
            bpy.data.images.remove(image)
    if not found:
        raise UserError(f"There are no environments in '{folder}' to compare under; this Blender is not whole.")
    return found
