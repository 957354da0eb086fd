# SPDX-License-Identifier: GPL-3.0-or-later
"""What the extension keeps on this machine, in its own folder: what bakes take, and textures that are half baked."""
from __future__ import annotations

from pathlib import Path

import bpy

from ..backend import costs


def folder() -> Path | None:
    """The extension's, which need not be there yet; None where this is none."""
    package = __package__.rpartition(".")[0]
    return Path(bpy.utils.extension_path_user(package)) if package.startswith("bl_ext.") else None


def register() -> None:
    """From now on plans know this machine."""
    kept = folder()
    if kept is not None:
        costs.keep_in(kept / "costs.json")


def unregister() -> None:
    """No longer."""
    costs.keep_in(None)
