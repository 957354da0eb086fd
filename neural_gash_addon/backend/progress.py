# SPDX-License-Identifier: GPL-3.0-or-later
"""Generators that yield their progress, as parts of longer ones."""
from __future__ import annotations

from collections.abc import Generator
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
