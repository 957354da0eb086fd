# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the paper's networks from nothing: `make data`, then `python -m training.paper --network gnn-paper`.

Each step takes a patch of one mesh, turned at random; visibility is traced anew, because the directions turn with
the normals. `--encoding` and `--seed` are for the ablation of the encoding, whose logs are in logs/.
"""
from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn
from torch.nn import functional
from tqdm import trange

from neural_gash_addon.backend import conformal, paper_bake, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.graph import Graph, graph
from neural_gash_addon.backend.neighbours import Neighbours
from neural_gash_addon.backend.networks import paper
from neural_gash_addon.backend.raycast import Occluders

from . import data, labels
from .curves import draw

ENCODINGS: dict[str, tuple[int, Callable[[np.ndarray, np.ndarray], np.ndarray]]] = {
    "motor": (32, conformal.encode),
    "compact": (8, lambda points, normals: conformal.compact(conformal.encode(points, normals))),
    "half-angle": (32, conformal.motor),
    "plain": (6, lambda points, normals: np.concatenate([points, normals], 1)),
}
NETWORKS: dict[str, Callable[[int], nn.Module]] = {
    "mlp": paper.Mlp, "gnn-paper": paper.TwoStage, "end-to-end": paper.CoefficientsNet, "student": paper.Mlp}
STEPS = {"mlp": 6000, "student": 6000, "gnn-paper": 2500, "end-to-end": 2500}
RATE, PATCH, MOST_POINTS, EVERY, HELD_OUT = 2e-3, 1500, 30_000, 250, 0.1
FLOOR = 3e-4  # of the unshadowed energy, as in training.gnn


class Example(NamedTuple):
    """A patch of a mesh."""

    encoded: Tensor     # (n, inputs)
    source: Tensor      # (e,)
    start: Tensor       # (n + 1,)
    blocked: Tensor     # (n, 9) in world axes
    visibility: Tensor  # (n, 25)


class Source:
    """A labelled mesh with its graph."""

    def __init__(self, path: Path) -> None:
        self.sample = labels.load(path)
        triangles = self.sample.triangles
        point, other = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
        order = np.argsort(point, kind="stable")
        start = np.searchsorted(point[order], np.arange(len(self.sample.positions) + 1))
        self.graph = graph(self.sample.positions.astype(np.float64), Neighbours(start, other[order].astype(np.int32)))
        self.blocked = (self.sample.unshadowed - self.sample.coefficients)[:, :paper.COEFFICIENTS]

    def example(self, encoding: str, rng: np.random.Generator | None, traced: bool = True) -> Example:
        """A patch, turned, with its visibility where it is `traced`; all of the mesh as it is without a generator."""
        sample = self.sample
        turn = np.eye(3) if rng is None else Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        positions, normals = (a.astype(np.float64) @ turn.T for a in (sample.positions, sample.normals))
        rows = np.arange(len(positions))
        if rng is not None and len(rows) > PATCH:
            away = np.square(positions - positions[rng.integers(len(rows))]).sum(1)
            rows = np.sort(np.argpartition(away, PATCH)[:PATCH])
        blocked = sh.rotate_each(self.blocked[rows], np.broadcast_to(turn, (len(rows), 3, 3)))
        seen = sample.visibility[rows]
        if rng is not None and traced:
            scene = Occluders([(positions, sample.triangles)])
            directions = np.einsum("nij,dj->ndi", labels.motor_frames(normals[rows]), sample.directions)
            origins = np.repeat(scene.origins(positions[rows], normals[rows]), seen.shape[1], axis=0)
            seen = scene.blocked(origins, np.ascontiguousarray(directions.reshape(-1, 3), np.float32)) != 0
        encoded = ENCODINGS[encoding][1](paper_bake.placed(positions)[rows], normals[rows])
        edges = within(self.graph, rows)
        return Example(*(torch.from_numpy(np.ascontiguousarray(a)) for a in (
            encoded.astype(np.float32), edges.source, edges.start, blocked.astype(np.float32),
            seen.reshape(len(rows), -1).astype(np.float32))))


def within(edges: Graph, rows: np.ndarray) -> Graph:
    """The graph of some vertices (n,), rising, alone."""
    new = np.full(len(edges.start) - 1, -1)
    new[rows] = np.arange(len(rows))
    target = new[np.repeat(np.arange(len(edges.start) - 1), np.diff(edges.start))]
    source = new[edges.source]
    kept = (target >= 0) & (source >= 0)
    return Graph(np.searchsorted(target[kept], np.arange(len(rows) + 1)), source[kept])


def balanced(logits: Tensor, truth: Tensor) -> Tensor:
    """Binary cross-entropy in which blocked and free rays weigh alike, however few there are (section 4.2.1)."""
    share = truth.mean().clamp(0.01, 0.99)
    weight = torch.where(truth > 0.5, 0.5 / share, 0.5 / (1 - share))
    return functional.binary_cross_entropy_with_logits(logits, truth, weight)


def shadow_loss(found: Tensor, truth: Tensor) -> Tensor:
    """Logarithm of the shadow residual ratio: a mesh with few shadows counts as one with many."""
    floor = FLOOR * len(truth)
    return (((found - truth).square().sum() + floor) / (truth.square().sum() + floor)).log()


def loss_of(network: str, model: nn.Module, example: Example, teacher: nn.Module | None) -> Tensor:
    """What is minimised: coefficients, and for two stages visibility; a student follows its teacher (4.1.1)."""
    found = model(example.encoded, example.source, example.start)
    if network == "gnn-paper":
        coefficients, logits = found
        return shadow_loss(coefficients, example.blocked) + balanced(logits, example.visibility)
    if teacher is None:
        return shadow_loss(found, example.blocked)
    with torch.no_grad():
        target, _ = teacher(example.encoded, example.source, example.start)
    return shadow_loss(found, example.blocked) + shadow_loss(found, target)


class Score(NamedTuple):
    """How a network does on meshes it was not trained on."""

    srr_median: float
    srr_mean: float
    accuracy: float  # balanced, of visibility; NaN where there is none


def evaluate(model: nn.Module, held: list[Source], encoding: str) -> Score:
    """On whole meshes."""
    model.eval()
    ratios, accuracies = [], []
    with torch.no_grad():
        for source in held:
            example = source.example(encoding, None)
            found = model(example.encoded, example.source, example.start)
            if isinstance(found, tuple):
                right = (found[1] > 0) == (example.visibility > 0.5)
                free = example.visibility > 0.5
                accuracies.append(float(right[free].float().mean() + right[~free].float().mean()) / 2)
                found = found[0]
            energy = example.blocked.square().sum().clamp_min(1e-9)
            ratios.append(float((found - example.blocked).square().sum() / energy))
    model.train()
    return Score(float(np.median(ratios)), float(np.mean(ratios)),
                 float(np.nanmean(accuracies)) if accuracies else float("nan"))


def train(network: str, encoding: str, seed: int, kept: list[Source], held: list[Source], steps: int, log: Path,
          teacher: nn.Module | None = None) -> nn.Module:
    """Train, and write the log as we go."""
    torch.manual_seed(seed)
    inputs = ENCODINGS[encoding][0]
    model = NETWORKS[network](inputs)
    optimiser = torch.optim.AdamW(model.parameters(), RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps, pct_start=0.05)
    began, losses = time.time(), []
    log.parent.mkdir(exist_ok=True)
    with log.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["step", "seconds", "loss", *Score._fields])
        for step in trange(steps, desc=f"{network}, {encoding}, seed {seed}"):
            rng = np.random.default_rng([seed, step])
            example = kept[rng.integers(len(kept))].example(encoding, rng, traced=network == "gnn-paper")
            loss = loss_of(network, model, example, teacher)
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
            if (step + 1) % EVERY == 0 or step + 1 == steps:
                score = evaluate(model, held, encoding)
                writer.writerow([step + 1, round(time.time() - began), round(float(np.mean(losses)), 4),
                                 *(round(value, 5) for value in score)])
                file.flush()
                losses = []
    return model


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--network", choices=list(NETWORKS), default="gnn-paper")
    parser.add_argument("--encoding", choices=list(ENCODINGS), default="motor")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--meshes", type=int, default=400, help="at most, of the cache")
    parser.add_argument("--cache", type=Path, default=data.CACHE, help="of labelled meshes, from training.data")
    parser.add_argument("--out", type=Path, help="folder of the weights; none are written where not given")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small, and a second thread that must wait loses tenfold
    paths = [path for path in sorted(arguments.cache.glob("*.npz")) if data.is_whole(path)]
    paths = [paths[i] for i in np.random.default_rng(0).permutation(len(paths))[:arguments.meshes]]
    sets = [[Source(path) for path in part if path.stat().st_size < 100 * MOST_POINTS]
            for part in data.split(paths, HELD_OUT)]
    if not all(sets):
        parser.error(f"there are too few labelled meshes in '{arguments.cache}'; make them with `make data`")
    teacher = None
    if arguments.network == "student":
        teacher = paper.TwoStage()
        arrays = weights.load(weights.FOLDER / "gnn-paper.safetensors")
        teacher.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in arrays.items()})
        teacher.eval()
    log = Path(__file__).parent / "logs" / f"{arguments.network}-{arguments.encoding}-{arguments.seed}.csv"
    steps = arguments.steps or STEPS[arguments.network]
    model = train(arguments.network, arguments.encoding, arguments.seed, *sets, steps, log, teacher)
    draw(log, ["srr_median", "srr_mean"])
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        weights.save(arguments.out / f"{arguments.network}.safetensors",
                     {name: value.detach().numpy() for name, value in model.state_dict().items()})
    print(f"{len(sets[0])} meshes, {len(sets[1])} held out: {evaluate(model, sets[1], arguments.encoding)}")


if __name__ == "__main__":
    main()
