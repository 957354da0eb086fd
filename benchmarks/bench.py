# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure the bake against its peers and print a table of ratios: `python benchmarks/bench.py [--quick]`."""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import ambient
import bounces
import equal_error
import memory
import textures
import throughput
from table import Table, machine

from neural_gash_addon.backend.workers import default_threads

PARTS = ("throughput", "memory", "error", "job", "ambient", "texture", "bounces")


def main() -> int:
    """Run the parts asked for; exit code 1 where a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer meshes, rays and repetitions (minutes)")
    parser.add_argument("--only", choices=PARTS, action="append", help="a part to measure")
    args = parser.parse_args()
    parts = args.only or PARTS
    threads = default_threads()
    table = Table()
    print(machine(threads), flush=True)
    if "throughput" in parts:
        throughput.measure(table, threads, args.quick)
    if "memory" in parts:
        memory.measure(table, args.quick)
    if "error" in parts:
        equal_error.measure(table, threads, args.quick)
    if "job" in parts:
        equal_error.measure_whole_job(table, threads, args.quick)
    if "ambient" in parts:
        ambient.measure(table, threads)
    if "texture" in parts:
        textures.measure(table, threads, args.quick)
    if "bounces" in parts:
        bounces.measure(table, threads)
    missed = table.missed()
    print(f"\n{len(missed)} target(s) missed" + "".join(f"\n- {row}" for row in missed))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
