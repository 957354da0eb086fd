# SPDX-License-Identifier: GPL-3.0-or-later
"""Timing and the printed table."""
from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version

PEERS = ("numpy", "embreex", "torch", "trimesh", "open3d-cpu", "mitsuba", "libigl", "bpy")


def seconds(work: Callable[[], object]) -> float:
    """Wall clock of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def processor_seconds(work: Callable[[], object], threads: int) -> float:
    """What the clock would say of one call if nobody else used the machine: processor time of this thread, which waits
    while others work for it, and that of the others, spread evenly over `threads`.
    """
    mine, every = time.thread_time(), time.process_time()
    work()
    mine, every = time.thread_time() - mine, time.process_time() - every
    return mine + (every - mine) / threads


def interleaved(reps: int, *works: Callable[[], float]) -> list[list[float]]:
    """Each work's own measurement, `reps` times, taken in turns so that a busy machine disturbs all alike."""
    out: list[list[float]] = [[] for _ in works]
    for _ in range(reps):
        for results, work in zip(out, works, strict=True):
            results.append(work())
    return out


def ratio(numerators: list[float], denominators: list[float]) -> float:
    """Median of the ratios of measurements that were taken beside each other."""
    return statistics.median(a / b for a, b in zip(numerators, denominators, strict=True))


@dataclass
class Table:
    """Rows in the order that they were measured; each is printed as soon as it is known."""

    rows: list[tuple[str, str, str, str, str, str]] = field(default_factory=list)

    def heading(self, title: str, note: str) -> None:
        """Start a section, with a sentence on what is measured."""
        print(f"\n### {title}\n\n{note}\n")
        print("| what | ours | other | ratio | target | met |")
        print("|---|---|---|---|---|---|", flush=True)

    def add(self, what: str, ours: str, other: str, value: float | None = None, target: float | None = None,
            unit: str = "×", most: bool = False) -> None:
        """A row. `value` is held against `target`: at least it, or at most it where `most`."""
        shown = "" if value is None else f"{value:.3g}{unit}"
        goal = "" if target is None else f"{'≤' if most else '≥'} {target:g}{unit}"
        met = ""
        if value is not None and target is not None:
            met = "yes" if (value <= target if most else value >= target) else "NO"
        self.rows.append((what, ours, other, shown, goal, met))
        print("| " + " | ".join(self.rows[-1]) + " |", flush=True)

    def absent(self, what: str, reason: object) -> None:
        """A row for a peer that could not be measured."""
        self.add(f"{what}: not measured ({reason})", "", "")

    def missed(self) -> list[str]:
        """What did not meet its target."""
        return [row[0] for row in self.rows if row[5] == "NO"]


def machine(threads: int) -> str:
    """Processor, threads and versions, in one line."""
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            model = next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass  # not Linux: what `platform` says must do
    found = []
    for name in PEERS:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"no {name}")
    return f"{model}, {threads} threads, Python {platform.python_version()}, {', '.join(found)}"
