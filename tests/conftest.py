# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared fixtures: the repository on sys.path, and the real meshes where they are."""
import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """End without C++'s static destructors, if bpy is there.

    One of bpy 4.5's destroys a condition that a thread of its own still waits for, and hangs now and then.
    """
    status = getattr(config, "exit_status", None)
    if "bpy" in sys.modules and status is not None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """What the process is to end with."""
    session.config.exit_status = int(exitstatus)  # type: ignore[attr-defined]


@pytest.fixture(scope="session")
def meshes() -> Path:
    """Folder of real meshes beside the repository; tests that need it skip where it is not."""
    folder = ROOT.parent / "shared" / "meshes"
    if not folder.is_dir():
        pytest.skip("needs the real meshes in ../shared/meshes, which are not part of the repository")
    return folder
