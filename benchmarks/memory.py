# SPDX-License-Identifier: GPL-3.0-or-later
"""Peak memory of a bake, in a process of its own or in this one."""
from __future__ import annotations

import ctypes
import gc
import json
import resource
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from table import Table

VERTICES, ORDER, RAYS = 1_000_000, 5, 64
# What a bake may take: GB of addresses, before the machine swaps; and seconds, before nobody waits any longer.
MOST, LONGEST = 10, 120


def _megabytes(field: str) -> float:
    """A line of this process's status. Not getrusage: its peak includes the parent's, kept over exec."""
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) for line in file if line.startswith(field)) * 1024 / 1e6


class Watch:
    """Peak memory of this process from here on, over what it holds now."""

    def __init__(self) -> None:
        """Give back what is free, so that what is taken again counts; NaN where there is no Linux."""
        self._held = float("nan")
        gc.collect()
        with suppress(OSError, AttributeError):  # another system, or another library of C
            ctypes.CDLL(None).malloc_trim(0)
            _peak_anew()
            self._held = _megabytes("VmRSS")

    def peak(self) -> float:
        """MB."""
        return max(_megabytes("VmHWM") - self._held, 0.0) if self._held == self._held else float("nan")


def _peak_anew() -> None:
    """VmHWM counts from here on."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _child(method: str, mesh_name: str, order: int, rays: int | None) -> None:
    """Build a mesh, bake it, report."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    import trimesh  # noqa: F401  which reads files, and is no part of a bake
    from meshes import named

    from neural_gash_addon.backend import methods

    resource.setrlimit(resource.RLIMIT_AS, (MOST << 30, MOST << 30))
    start = _megabytes("VmRSS")
    mesh = named(mesh_name)
    built, held = _megabytes("VmHWM"), _megabytes("VmRSS")
    _peak_anew()
    transfer = methods.run(methods.bake(mesh, method, order, rays=rays))
    print(json.dumps({"vertices": len(mesh.points), "seconds": transfer.record.seconds, "built": built - start,
                      "held": held - start, "baked": _megabytes("VmHWM") - start}))


def peak(method: str, mesh: str, order: int, rays: int | None) -> dict[str, float] | str:
    """Vertices, seconds, and MB over the process's start: built, held, baked. Or why there are none.

    mesh: a name for `meshes.named`.
    """
    if not Path("/proc/self/status").exists():
        return "needs Linux's /proc"
    try:
        done = subprocess.run([sys.executable, __file__, method, mesh, str(order), str(rays or 0)],
                              capture_output=True, text=True, check=False, timeout=LONGEST)
    except subprocess.TimeoutExpired:
        return f"more than {LONGEST} s"
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:]
        short = not last or any(word in last[0] for word in ("MemoryError", "allocate", "bad_alloc"))
        return f"more than {MOST} GB" if short else f"the bake failed: {last[0]}"
    return json.loads(done.stdout.splitlines()[-1])


def measure(table: Table, quick: bool) -> None:
    """Print the section."""
    rays = 16 if quick else RAYS
    table.heading("Memory", "Peak resident memory over the process's start (after imports) of building a mesh and "
                            f"of baking it (what the mesh holds included) at order {ORDER}, {rays} rays.")
    got = peak("embree", f"knot {VERTICES}", ORDER, rays)
    if isinstance(got, str):
        table.absent("peak memory", got)
        return
    table.add(f"{got['vertices']} vertices: mesh built from triangles (holds {got['held']:.0f} MB)",
              f"{got['built']:.0f} MB", "", got["built"], 1000, " MB", most=True)
    table.add(f"{got['vertices']} vertices: bake, {got['seconds']:.1f} s", f"{got['baked']:.0f} MB", "",
              got["baked"], 1000, " MB", most=True)


if __name__ == "__main__":
    _child(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]) or None)
