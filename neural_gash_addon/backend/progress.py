# SPDX-License-Identifier: GPL-3.0-or-later
"""Generators that yield their progress: parts of longer ones, and driven to their end."""
from __future__ import annotations

import time
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


def clocked(work: Generator[float, None, Result]) -> Generator[float, None, tuple[Result, float]]:
    """Run some work, and tell the seconds that it took; not those in which it was not asked to go on."""
    seconds = 0.0
    try:
        while True:
            began = time.perf_counter()
            try:
                share = next(work)
            finally:
                seconds += time.perf_counter() - began
            yield share
    except StopIteration as end:
        return end.value, seconds
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
