# SPDX-License-Identifier: GPL-3.0-or-later
"""Peak memory of a bake of a million vertices, in a process of its own."""
from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from table import Table

VERTICES, ORDER, RAYS = 1_000_000, 5, 64


def _megabytes(field: str) -> float:
    """A line of this process's status. Not getrusage: its peak includes the parent's, kept over exec."""
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) for line in file if line.startswith(field)) * 1024 / 1e6


def _child(rays: int) -> None:
    """Build the mesh, bake it, report."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from meshes import knot

    from neural_gash_addon.backend import methods
    from neural_gash_addon.backend.geometry import TriangleMesh

    start = _megabytes("VmRSS")
    mesh = TriangleMesh.from_triangles(*knot(VERTICES))
    built, held = _megabytes("VmHWM"), _megabytes("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak counts anew from here
    transfer = methods.run(methods.bake(mesh, order=ORDER, rays=rays))
    print(json.dumps({"vertices": len(mesh.points), "seconds": transfer.record.seconds, "built": built - start,
                      "held": held - start, "baked": _megabytes("VmHWM") - start}))


def measure(table: Table, quick: bool) -> None:
    """Print the section."""
    rays = 16 if quick else RAYS
    table.heading("Memory", "Peak resident memory over the process's start (after imports) of building a mesh and "
                            f"of baking it (what the mesh holds included) at order {ORDER}, {rays} rays.")
    if not Path("/proc/self/status").exists():
        table.absent("peak memory", "needs Linux's /proc")
        return
    done = subprocess.run([sys.executable, __file__, str(rays)], capture_output=True, text=True, check=False)
    if done.returncode:
        table.absent("peak memory", f"the bake failed: {done.stderr.strip().splitlines()[-1:]}")
        return
    got = json.loads(done.stdout.splitlines()[-1])
    table.add(f"{got['vertices']} vertices: mesh built from triangles (holds {got['held']:.0f} MB)",
              f"{got['built']:.0f} MB", "", got["built"], 1000, " MB", most=True)
    table.add(f"{got['vertices']} vertices: bake, {got['seconds']:.1f} s", f"{got['baked']:.0f} MB", "",
              got["baked"], 1000, " MB", most=True)


if __name__ == "__main__":
    _child(int(sys.argv[1]))
