# SPDX-License-Identifier: GPL-3.0-or-later
"""Screenshots of the session, loosely compared with those in references/: the same picture, not the same pixels.

Fonts, drivers and versions of Blender move pixels about; what must not happen is a panel that is missing, or a head
that is black or magenta. To renew the references, look at out/window, and run this file in Blender:

    blender -b --python tests/window/likeness.py -- out/window
"""
from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np

REFERENCES = Path(__file__).resolve().parent / "references"
NAMES = ("2_baking", "5_material_preview", "6c_live", "8b_texture_gloss", "10_error")
SIZE = (80, 50)     # of the pictures that are compared
LARGEST = 0.04      # root mean square difference, of 1: two sessions have 0.01, a preview that is black has 0.08


def small(path: Path) -> np.ndarray:
    """(50, 80, 3) of a picture."""
    image = bpy.data.images.load(str(path))
    try:
        image.scale(*SIZE)
        values = np.empty(SIZE[0] * SIZE[1] * image.channels, np.float32)
        image.pixels.foreach_get(values)
        return values.reshape(SIZE[1], SIZE[0], -1)[..., :3]
    finally:
        bpy.data.images.remove(image)


def differences(pictures: Path) -> dict[str, float]:
    """Root mean square difference of each screenshot to its reference; 1 for one that is missing."""
    return {name: float(np.sqrt(np.square(small(pictures / f"{name}.png") - small(REFERENCES / f"{name}.png")).mean()))
            if (pictures / f"{name}.png").exists() else 1.0 for name in NAMES}


def renew(pictures: Path) -> None:
    """Keep some screenshots as references, at a quarter of their size."""
    REFERENCES.mkdir(exist_ok=True)
    for name in NAMES:
        image = bpy.data.images.load(str(pictures / f"{name}.png"))
        image.scale(image.size[0] // 4, image.size[1] // 4)
        image.filepath_raw, image.file_format = str(REFERENCES / f"{name}.png"), "PNG"
        image.save()


if __name__ == "__main__":
    renew(Path(sys.argv[sys.argv.index("--") + 1]))
