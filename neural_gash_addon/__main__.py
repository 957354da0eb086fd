# SPDX-License-Identifier: GPL-3.0-or-later
"""`python -m neural_gash_addon …` on the bpy module."""
import sys

from . import register, unregister
from .cli import main

if __name__ == "__main__":
    register()
    try:
        code = main(sys.argv[1:])
    finally:
        unregister()
    sys.exit(code)
