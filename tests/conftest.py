# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared fixtures: the repository on sys.path, and the real meshes where they are."""
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))


@pytest.fixture(scope="session")
def meshes() -> Path:
    """Folder of real meshes beside the repository; tests that need it skip where it is not."""
    folder = ROOT.parent / "shared" / "meshes"
    if not folder.is_dir():
        pytest.skip("needs the real meshes in ../shared/meshes, which are not part of the repository")
    return folder
