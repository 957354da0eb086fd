# SPDX-License-Identifier: GPL-3.0-or-later
"""Benchmarks that take too long to be run here begin, at least."""
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_benchmark_finds_what_it_measures():
    """What they import from the package is there, under that name."""
    names = sorted(file.stem for file in (ROOT / "benchmarks").glob("*.py"))
    assert len(names) > 30
    code = (f"import sys; sys.path[:0] = [{str(ROOT)!r}, {str(ROOT / 'benchmarks')!r}]\n"
            + "\n".join(f"import {name}" for name in names))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert not done.returncode, done.stderr
