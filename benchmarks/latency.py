# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the networks' time goes, stage by stage, from a thousand to a million vertices; a table, a chart and memory.

`.venv/bin/python benchmarks/latency.py --out docs` (minutes; the paper's own network takes most of them).
"""
from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from memory import _megabytes
from meshes import knot
from table import machine

from neural_gash_addon.backend import cones, gnn, gnn_bake, methods, paper_bake, refine, sight, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.graph import graph
from neural_gash_addon.backend.neighbours import neighbours
from neural_gash_addon.backend.workers import default_threads

SIZES = (1_000, 4_000, 10_000, 34_000, 100_000, 300_000, 1_000_000)
MOST_PAPER = 1_000_000
ORDER = 3
PAPERS = "3.8K 0.05 s, 8.5K 0.09 s, 9.7K 0.14 s, 22K 0.29 s, 30K 2.69 s, 34K 4.13 s"  # its table 3, an RTX 4060


class Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}

    def __call__(self, stage: str, work: Callable[[], Any]) -> Any:
        """Do the work, on the stage's account."""
        began = time.perf_counter()
        found = work()
        self.stages[stage] = self.stages.get(stage, 0.0) + time.perf_counter() - began
        return found


def gnn_stages(mesh: TriangleMesh) -> dict[str, float]:
    """Stages of `gnn` on one thread, and all of it as it is run."""
    clock, network = Clock(), weights.load_gnn()
    voxels = clock("pool", lambda: gnn_bake.voxels_of(mesh, []))
    for start in range(0, len(mesh.points), gnn.CHUNK):
        part = slice(start, start + gnn.CHUNK)
        points, normals = mesh.points[part], mesh.normals[part]
        frames = clock("encode", lambda normals=normals: gnn.frames_of(normals, over=False))
        seen = clock("read", lambda p=points, n=normals, f=frames: cones.read(voxels, p, n, f))
        local = clock("answer", lambda seen=seen: gnn.answer(seen, network)[:, :ORDER ** 2])
        clock("turn", lambda local=local, frames=frames: sh.rotate_each(local, frames))
    clock("all, two threads", lambda: methods.run(methods.bake(mesh, "gnn", ORDER)))
    return clock.stages


def paper_stages(mesh: TriangleMesh) -> dict[str, float]:
    """Stages of `gnn-paper`, and its refinement."""
    import torch

    from neural_gash_addon.backend.networks import paper

    clock, network = Clock(), paper.TwoStage()
    edges = clock("graph", lambda: graph(mesh.points, neighbours(mesh)))
    known = clock("spread", lambda: sight.places(mesh.points, mesh.normals))
    encoded = clock("encode", lambda: sight.encode(known.points, known.normals))
    x, source, start = (torch.from_numpy(a) for a in (encoded, edges.source, edges.start))
    network.eval()
    parts, found = known.sights(), []
    with torch.no_grad():
        while (part := clock("hear", lambda: next(parts, None))) is not None:
            given = sight.Sight(*map(torch.from_numpy, part))
            found.append(clock("stage 1", lambda given=given: torch.sigmoid(network.visibility.ask(given))))
        seen = torch.cat(found)
        clock("stage 2", lambda: network.coefficients(torch.cat([x, seen], 1), source, start))
    clock("AO", lambda: refine.occlusion(mesh.points, mesh.normals, edges))
    clock.stages["all"] = sum(clock.stages.values())
    return clock.stages


def peak(method: str, count: int) -> float:
    """Peak memory of a bake over that of its mesh, MB, in a process of its own."""
    done = subprocess.run([sys.executable, __file__, "--child", method, str(count)], capture_output=True, text=True,
                          check=True)
    return float(json.loads(done.stdout.splitlines()[-1]))


def child(method: str, count: int) -> None:
    """Bake once, print the peak."""
    mesh = TriangleMesh.from_triangles(*knot(count))
    if method == "gnn-paper":
        paper_bake.import_torch(method)
    held = _megabytes("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak counts anew from here
    methods.run(methods.bake(mesh, method, ORDER))
    print(json.dumps(_megabytes("VmHWM") - held))


def draw(found: dict[str, dict[int, dict[str, float]]], path: Path) -> None:
    """Milliseconds by stage against vertices, a panel for each network."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(found), figsize=(5.5 * len(found), 4.2), layout="constrained", sharey=True)
    for axes, (name, by_size) in zip(panels, found.items(), strict=True):
        for stage in next(iter(by_size.values())):
            style = {"color": "black", "linewidth": 2} if stage.startswith("all") else {}
            axes.plot(list(by_size), [1e3 * stages[stage] for stages in by_size.values()], marker="o", markersize=3,
                      label=stage, **style)
        axes.set(xscale="log", yscale="log", xlabel="vertices", title=name)
        axes.grid(alpha=0.3, which="both")
        axes.legend(loc="lower right", fontsize=8)
    panels[0].set_ylabel("milliseconds")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder of the chart")
    parser.add_argument("--most", type=int, default=SIZES[-1], help="vertices of the largest mesh")
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        child(arguments.child[0], int(arguments.child[1]))
        return
    print(machine(default_threads()) + f"\nThe paper's own (table 3): {PAPERS}.\n")
    found: dict[str, dict[int, dict[str, float]]] = {"gnn": {}, "gnn-paper": {}}
    for name, stages_of in (("gnn", gnn_stages), ("gnn-paper", paper_stages)):
        for size in (size for size in SIZES if size <= arguments.most):
            mesh = TriangleMesh.from_triangles(*knot(size))
            stages_of(mesh) if size == SIZES[0] else None  # the first of all is slower: it is warm then
            stages = stages_of(mesh)
            if not found[name]:
                print(f"| {name}: vertices | " + " | ".join(stages) + " | peak memory |")
                print("|---" * (len(stages) + 2) + "|")
            found[name][len(mesh.points)] = stages
            print(f"| {len(mesh.points):,} | " + " | ".join(f"{1e3 * spent:.0f} ms" for spent in stages.values())
                  + f" | {peak(name, size):.0f} MB |", flush=True)
        print()
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw(found, arguments.out / "latency.png")


if __name__ == "__main__":
    main()
