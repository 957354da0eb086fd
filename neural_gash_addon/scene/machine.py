# SPDX-License-Identifier: GPL-3.0-or-later
"""Where Blender keeps what bakes take on this machine: in the extension's own folder, if it is one."""
from __future__ import annotations

from pathlib import Path

import bpy

from ..backend import costs


def register() -> None:
    """From now on plans know this machine."""
    package = __package__.rpartition(".")[0]
    if package.startswith("bl_ext."):
        costs.keep_in(Path(bpy.utils.extension_path_user(package)) / "costs.json")


def unregister() -> None:
    """No longer."""
    costs.keep_in(None)
