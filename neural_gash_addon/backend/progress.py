# SPDX-License-Identifier: GPL-3.0-or-later
"""Generators that yield their progress: parts of longer ones, and driven to their end."""
from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TypeVar

Result = TypeVar("Result")


def scaled(work: Generator[float, None, Result], start: float, share: float) -> Generator[float, None, Result]:
    """Run some work as progress start..start+share of the whole; it is closed with the whole."""
    try:
        while True:
            yield start + share * next(work)
    except StopIteration as end:
        return end.value
    finally:
        work.close()


def run(work: Generator[float, None, Result], progress: Callable[[float], None] | None = None) -> Result:
    """Drive some work to its end, calling `progress` with the share done (0 to 1)."""
    try:
        while True:
            share = next(work)
            if progress:
                progress(share)
    except StopIteration as end:
        return end.value
    finally:
        work.close()
