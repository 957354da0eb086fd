# SPDX-License-Identifier: GPL-3.0-or-later
"""Curves of a training, drawn from its log."""
from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path


def draw(log: Path, columns: Sequence[str]) -> Path:
    """A picture beside the log (.csv with a column `step`), error over steps; its path."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    with log.open(newline="") as file:
        rows = list(csv.DictReader(file))
    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for column in columns:
        axes.plot([int(row["step"]) for row in rows], [float(row[column]) for row in rows], label=column)
    axes.set(xlabel="step", ylabel="error", yscale="log", title=log.stem)
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    path = log.with_suffix(".png")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
    return path
