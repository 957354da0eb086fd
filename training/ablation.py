# SPDX-License-Identifier: GPL-3.0-or-later
"""Does the conformal encoding help? The paper's networks, trained alike on four encodings, three seeds each.

`python -m training.ablation --network mlp` (and `--network visibility`, stage 1 of the paper's network, in which its
shadows are learned): logs go to logs/ablation, and are drawn to docs/. What is there is not trained again. The same
meshes, patches, turns and steps for all; only the numbers that the first layer reads differ, and its width with them.
"""
from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
import torch

from . import data, paper

LOGS = Path(__file__).parent / "logs" / "ablation"
SEEDS = (0, 1, 2)
STEPS = {"mlp": 1000, "visibility": 400}
ERRORS = {"mlp": ("srr_median", "SRR of held-out meshes, median"),
          "visibility": ("misjudged", "rays of held-out meshes misjudged, balanced")}
MESHES = 200


def curves_of(network: str, encoding: str, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps (n,) and a column of the logs (SEEDS, n)."""
    steps, found = [], []
    for seed in SEEDS:
        with (LOGS / f"{network}-{encoding}-{seed}.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        steps = [int(row["step"]) for row in rows]
        found.append([float(row[column]) for row in rows])
    least = min(map(len, found))  # a training may end early
    return np.array(steps[:least]), np.array([row[:least] for row in found])


def draw(network: str, path: Path) -> None:
    """Mean over seeds, and the span from the least to the greatest, over steps."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.5), layout="constrained")
    for encoding in paper.ENCODINGS:
        steps, found = curves_of(network, encoding, ERRORS[network][0])
        line, = axes.plot(steps, found.mean(0), label=f"{encoding} ({paper.ENCODINGS[encoding][0]})")
        axes.fill_between(steps, found.min(0), found.max(0), color=line.get_color(), alpha=0.15)
    axes.set(xlabel="step", ylabel=ERRORS[network][1], title=f"{network}: encodings, {len(SEEDS)} seeds")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def table(network: str) -> str:
    """Markdown: error at the end, its mean over seeds and its spread, from the least to the greatest."""
    column, what = ERRORS[network]
    lines = [f"| {network}, {STEPS[network]} steps | numbers | {what} | spread over seeds | training loss |",
             "|---|---|---|---|---|"]
    for encoding, (width, _) in paper.ENCODINGS.items():
        last, loss = (curves_of(network, encoding, name)[1][:, -1] for name in (column, "loss"))
        lines.append(f"| {encoding} | {width} | {last.mean():.4f} | {np.ptp(last):.4f} | {loss.mean():.4f} |")
    return "\n".join(lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--network", choices=list(STEPS), default="mlp")
    parser.add_argument("--cache", type=Path, default=data.CACHE, help="of labelled meshes, from training.data")
    parser.add_argument("--docs", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    sets = paper.sources(arguments.cache, MESHES)
    if not all(sets):
        parser.error(f"there are too few labelled meshes in '{arguments.cache}'; make them with `make data`")
    for seed in SEEDS:
        for encoding in paper.ENCODINGS:
            name = f"{arguments.network}-{encoding}-{seed}"
            paper.train(arguments.network, encoding, seed, *sets, STEPS[arguments.network], LOGS / f"{name}.csv",
                        arguments.cache / f"{name}.checkpoint")
    draw(arguments.network, arguments.docs / f"encodings-{arguments.network}.png")
    print(table(arguments.network))


if __name__ == "__main__":
    main()
