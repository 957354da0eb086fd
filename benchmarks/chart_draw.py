# SPDX-License-Identifier: GPL-3.0-or-later
"""The charts: error against time for each point, both in logarithms, drawn from the rows of a run."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from neural_gash_addon.backend.compare import REFERENCE_RAYS, front
from neural_gash_addon.backend.methods import METHODS

Row = dict[str, Any]
Key = tuple[str, int | None, float | None]  # method, rays, tolerance
LABELS = {"srr": "SRR (1: no better than no shadows)", "rel_l2": "relative L2 error of transfer",
          "relit_mean": "relit error, mean of the HDRIs", "relit_worst": "relit error, worst HDRI",
          "openness": "relative L2 error of openness (ambient occlusion)"}
PEER_LABELS = {"trimesh": "trimesh + embreex, plain", "open3d": "Open3D, plain", "cycles-ao": "Cycles AO bake"}
_OURS_MARKS, _PEER_MARKS = "osD^vP*X", "<>1"
_PEER_COLOURS = ("black", "midnightblue", "darkorange")


def _style(method: str) -> dict[str, Any]:
    """Colour and mark, by the place in the table, so that a method is the same in every picture."""
    ours = method in METHODS
    marks = _OURS_MARKS if ours else _PEER_MARKS
    place = list(METHODS if ours else PEER_LABELS).index(method)
    return {"color": f"C{place % 10}" if ours else _PEER_COLOURS[place], "marker": marks[place % len(marks)],
            "label": METHODS[method].label if ours else PEER_LABELS[method], "linestyle": "-" if ours else ":"}


def collected(rows: Sequence[Row], error: str) -> dict[Key, tuple[list[float], list[float]]]:
    """(µs a point, errors) of each method and number of rays, or tolerance, over meshes."""
    found: dict[Key, tuple[list[float], list[float]]] = {}
    for row in rows:
        if row["method"] in (*METHODS, *PEER_LABELS) and np.isfinite(row["seconds"]) and np.isfinite(row[error]):
            times, errors = found.setdefault((row["method"], row["rays"], row["tolerance"]), ([], []))
            times.append(1e6 * row["seconds"] / row["points"])
            errors.append(row[error])
    return found


def _panel(axes: Axes, rows: Sequence[Row], error: str, spread: bool = True,
           named: Callable[[str], bool] = lambda _: True) -> None:
    """One chart: medians over meshes, bars from the 10th to the 90th percentile, front and noise floor."""
    found = collected(rows, error)
    medians = {key: (float(np.median(times)), float(np.median(errors))) for key, (times, errors) in found.items()}
    for method in dict.fromkeys(method for method, *_ in found):
        keys = sorted((key for key in found if key[0] == method), key=lambda key: (key[1] or 0, -(key[2] or 0)))
        x, y = np.array([medians[key] for key in keys]).T
        style = _style(method)
        if spread and len(found[keys[0]][0]) > 1:
            for key, a, b in zip(keys, x, y, strict=True):
                times, errors = (np.percentile(values, (10, 90)) for values in found[key])
                axes.plot(times, (b, b), color=style["color"], alpha=0.3, linewidth=1)
                axes.plot((a, a), np.maximum(errors, 1e-9), color=style["color"], alpha=0.3, linewidth=1)
        axes.plot(x, y, **style, markersize=5, linewidth=1)
        for key, a, b in zip(keys, x, y, strict=True):
            told = key[1] or (key[2] and f"{key[2]:.0%}")
            if told and (key in (keys[0], keys[-1]) or key[1] == 64) and named(method):
                axes.annotate(str(told), (a, b), textcoords="offset points", xytext=(4, 4), fontsize=7,
                              color=style["color"])
    keys = list(medians)
    best = front([medians[key][0] for key in keys], [medians[key][1] for key in keys])
    if best:
        x, y = np.array([medians[keys[index]] for index in best]).T
        axes.step(x, y, where="post", color="black", linewidth=3.5, alpha=0.15, label="Pareto front", zorder=0)
        axes.plot(x, y, "o", markersize=10, markerfacecolor="none", markeredgecolor="black", alpha=0.6)
    floors = [row[error] for row in rows if row["method"] == "reference" and np.isfinite(row[error])]
    if floors:
        axes.axhline(float(np.median(floors)), color="grey", linestyle="--", linewidth=1,
                     label=f"noise of the reference (2 x {REFERENCE_RAYS} rays)")
    axes.set_xscale("log")
    axes.set_yscale("log")
    low, high = axes.get_xlim()
    if high > 10 * low:  # powers of ten are enough; between them labels would lie over each other
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("µs a point, whole job")
    axes.set_ylabel(LABELS[error])
    axes.grid(which="major", alpha=0.3)


def _finish(figure: Any, axes: Sequence[Axes], path: Path) -> None:
    """One legend for all panels, below them."""
    handles: dict[str, Any] = {}
    for panel in axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3 if len(axes) == 1 else 4,
                  fontsize=8)
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def _figure(panels: int) -> tuple[Any, list[Axes]]:
    """A figure with so many panels, at most three in a row."""
    columns = min(panels, 3) if panels != 4 else 2
    lines = -(-panels // columns)
    width = max(5.4 * columns, 9.0)  # of the legend
    figure, axes = pyplot.subplots(lines, columns, figsize=(width, 4.2 * lines + 0.9), squeeze=False,
                                   layout="constrained")
    flat = list(axes.ravel())
    for unused in flat[panels:]:
        unused.remove()
    return figure, flat[:panels]


def _meshes(rows: Sequence[Row]) -> str:
    count = len({row["mesh"] for row in rows})
    return f"{count} mesh{'es' if count != 1 else ''}"


def _by(rows: Sequence[Row], groups: dict[str, Sequence[Row]], error: str, path: Path, spread: bool) -> Path:
    """A panel for each group."""
    figure, axes = _figure(len(groups))
    for panel, (name, own) in zip(axes, groups.items(), strict=True):
        _panel(panel, own, error, spread)
        panel.set_title(f"{name} ({_meshes(own)})")
    _finish(figure, axes, path)
    return path


def draw(rows: Sequence[Row], folder: Path) -> list[Path]:
    """All pictures that the rows allow; their paths."""
    base = [row for row in rows if row["sweep"] == "base"]
    # a peer's rows come from its own sweep, whose meshes are among those of the base
    peers = [row for row in rows if row["sweep"] == "peers" and row["method"] in PEER_LABELS]
    drawn = []
    if base:
        figure, axes = _figure(3)
        for panel, error in zip(axes, ("srr", "rel_l2", "relit_mean"), strict=True):
            _panel(panel, [*base, *peers], error)
        figure.suptitle(f"All meshes: {_meshes(base)} ({_meshes(peers)} for peers), order 3, medians and "
                        "10th to 90th percentile")
        _finish(figure, axes, folder / "all.png")
        drawn.append(folder / "all.png")
        names = sorted({row["category"] for row in base})
        groups = {name: [row for row in base if row["category"] == name] for name in names}
        drawn.append(_by(base, groups, "srr", folder / "categories.png", spread=True))
    scale = [row for row in rows if row["sweep"] == "scale"]
    if scale:
        sizes = sorted({row["points"] for row in scale})
        groups = {f"{size:,} vertices": [row for row in scale if row["points"] == size] for size in sizes}
        drawn.append(_by(scale, groups, "srr", folder / "scales.png", spread=False))
    settings = {"order 2": [row for row in rows if row["sweep"] == "orders" and row["order"] == 2],
                "order 4": [row for row in rows if row["sweep"] == "orders" and row["order"] == 4],
                "order 5": [row for row in rows if row["sweep"] == "orders" and row["order"] == 5],
                "one thread": [row for row in rows if row["sweep"] == "threads"],
                "texture": [row for row in rows if row["sweep"] == "texture"]}
    settings = {name: own for name, own in settings.items() if own}
    if settings:
        drawn.append(_by(rows, settings, "srr", folder / "settings.png", spread=True))
    beside = [row for row in rows if row["sweep"] == "peers"]
    if beside:
        figure, axes = _figure(1)
        _panel(axes[0], beside, "openness")
        axes[0].set_title(f"Openness alone ({_meshes(beside)}); only Cycles bakes nothing else")
        _finish(figure, axes, folder / "openness.png")
        drawn.append(folder / "openness.png")
    return drawn
