# SPDX-License-Identifier: GPL-3.0-or-later
"""What the light-transport embedding costs against scene points and queries: time, peak memory, and how they grow.

`python benchmarks/embedding.py [--quick]`. Each size in a process of its own, one thread, processor seconds. Weights do
not matter to the cost, so they are drawn at random.
"""
from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from memory import _megabytes

POINTS = (4096, 12_800, 51_200, 200_000)
QUERIES = (16_384, 65_536, 262_144, 1_048_576, 4_194_304)
FEW = 16_384  # queries of a room when its points vary, and
USUAL = 4096  # points of a room when its queries vary


def _child(count: int, queries: int) -> None:
    """Encode a box room and ask it; report."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    import torch

    from neural_gash_addon.backend import embedding_bake, methods
    from neural_gash_addon.backend.lit_points import LitPoints
    from neural_gash_addon.backend.networks.embedding import SMALL, Embedding

    torch.set_num_threads(1)
    torch.manual_seed(0)
    rng = np.random.default_rng(0)

    def surface(number: int) -> LitPoints:
        axis, side = rng.integers(0, 3, number), rng.integers(0, 2, number)
        positions = rng.random((number, 3)) * [8, 6, 3]
        positions[np.arange(number), axis] = side * np.array([8, 6, 3])[axis]
        normals = np.zeros((number, 3))
        normals[np.arange(number), axis] = 1 - 2 * side
        return LitPoints(*(each.astype(np.float32) for each in (positions, normals, *rng.random((4, number, 3)))))

    def asked(room: embedding_bake.Room, queries: LitPoints) -> None:
        methods.run(room.reflected(queries.places, queries.normals, queries.direct))

    model, points, asking = Embedding(SMALL).eval(), surface(count), surface(queries)
    asked(embedding_bake.Room(model, surface(1024)), surface(1024))  # warm
    start, began = _megabytes("VmRSS"), time.process_time()
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak counts anew from here
    room = embedding_bake.Room(model, points)
    encoded, encoding = time.process_time(), _megabytes("VmHWM")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    asked(room, asking)
    print(json.dumps({"encode": encoded - began, "decode": time.process_time() - encoded, "encode_mb": encoding - start,
                      "decode_mb": _megabytes("VmHWM") - start}))


def measured(count: int, queries: int) -> dict[str, float]:
    """Seconds and MB of encoding `count` points, and of asking for some queries."""
    done = subprocess.run([sys.executable, __file__, "--child", str(count), str(queries)], capture_output=True,
                          text=True, check=True)
    return json.loads(done.stdout)


def exponent(sizes: tuple[int, ...], values: list[float]) -> float:
    """Slope of a straight line through logarithms: 1 is linear."""
    return float(np.polyfit(np.log(sizes), np.log(np.maximum(values, 1e-9)), 1)[0])


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the two smaller sizes")
    parser.add_argument("--child", type=int, nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        _child(*arguments.child)
        return
    most = 2 if arguments.quick else 5
    points, queries = POINTS[:most], QUERIES[:most]
    print("| scene points | encoder, s | MB | a query, us |\n|---|---|---|---|")
    found = [measured(count, FEW) for count in points]
    for count, row in zip(points, found, strict=True):
        print(f"| {count:,} | {row['encode']:.2f} | {row['encode_mb']:.0f} | {row['decode'] / FEW * 1e6:.0f} |")
    print(f"| exponent | {exponent(points, [row['encode'] for row in found]):.2f} "
          f"| {exponent(points, [row['encode_mb'] for row in found]):.2f} "
          f"| {exponent(points, [row['decode'] for row in found]):.2f} |\n")
    print("| queries | decoder, s | MB |\n|---|---|---|")
    found = [measured(USUAL, count) for count in queries]
    for count, row in zip(queries, found, strict=True):
        print(f"| {count:,} | {row['decode']:.2f} | {row['decode_mb']:.0f} |")
    print(f"| exponent | {exponent(queries, [row['decode'] for row in found]):.2f} "
          f"| {exponent(queries, [row['decode_mb'] for row in found]):.2f} |")


if __name__ == "__main__":
    main()
