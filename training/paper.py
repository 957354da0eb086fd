# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the paper's networks from nothing: `make data`, then `python -m training.paper --network gnn-paper`.

Stage 1 takes all of two meshes in a step, by points spread over them, turned and scaled at random; visibility is traced
anew, because the directions turn with the normals. Stage 2 and the others take a patch of one.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn
from torch.nn import functional

from neural_gash_addon.backend import conformal, sight, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.graph import Graph, graph
from neural_gash_addon.backend.neighbours import Neighbours
from neural_gash_addon.backend.networks import paper
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.backend.sight import Sight

from . import data, labels, loop
from .curves import draw

ENCODINGS: dict[str, tuple[int, Callable[[np.ndarray, np.ndarray], np.ndarray]]] = {
    "motor": (32, conformal.encode),
    "compact": (8, lambda points, normals: conformal.compact(conformal.encode(points, normals))),
    "half-angle": (32, conformal.motor),
    "plain": (6, lambda points, normals: np.concatenate([points, normals], 1)),
}
NETWORKS: dict[str, Callable[[int], nn.Module]] = {
    "mlp": paper.Mlp, "gnn-paper": paper.TwoStage, "end-to-end": paper.CoefficientsNet, "student": paper.Mlp,
    "visibility": paper.VisibilityNet}
SHIPPED = ("mlp", "gnn-paper")
Model = TypeVar("Model", bound=nn.Module)
STEPS = {"mlp": 3000, "student": 3000, "gnn-paper": 2000, "end-to-end": 2000}
RATE, PATCH, HELD_OUT, LOOKS = 2e-3, 1500, 0.1, 10
MESHES, OTHERS = 2, 256  # of a step of stage 1, and vertices of each beside those that are heard
MOST_LOOKED = 1024       # such vertices of a mesh held out
INNER = 0.6            # of a patch's points count: around the others there is too little of the mesh
SCALES = (0.8, 1.25)
MOST_POINTS = 30_000   # of a mesh
FLOOR = 3e-4  # of the unshadowed energy, as in training.gnn


class Look(NamedTuple):
    """What stage 1 is asked of a mesh."""

    sight: Sight
    visibility: Tensor  # (m, 25) of those asked
    free: float         # share of the mesh's rays that are free


class Example(NamedTuple):
    """A patch of a mesh."""

    encoded: Tensor     # (n, inputs)
    source: Tensor      # (e,)
    start: Tensor       # (n + 1,)
    sights: list[Sight]  # what stage 1 is given of the same vertices
    frames: np.ndarray  # (n, 3, 3) of the motors
    blocked: Tensor     # (n, 9) in these frames; in the axes of the mesh where that is wanted
    visibility: Tensor  # (n, 25) as the mesh lies
    inner: Tensor       # (n,) whose neighbours' neighbours are in the patch, too: those count


def tensors(*arrays: np.ndarray) -> list[Tensor]:
    """Where the training runs."""
    return [torch.from_numpy(np.ascontiguousarray(a)).to(loop.device()) for a in arrays]


class Source:
    """A labelled mesh with its graph, and what traces it."""

    def __init__(self, path: Path) -> None:
        self.sample = labels.load(path)
        triangles = self.sample.triangles
        point, other = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
        order = np.argsort(point, kind="stable")
        start = np.searchsorted(point[order], np.arange(len(self.sample.positions) + 1))
        self.neighbours = Neighbours(start, other[order].astype(np.int32))
        self.places = sight.places(self.sample.positions, self.sample.normals)
        self.blocked = (self.sample.unshadowed - self.sample.coefficients)[:, :paper.COEFFICIENTS]
        self.lit = np.any(self.sample.normals != 0, axis=1)
        self.free = float(self.sample.visibility[self.lit].mean())

    @cached_property
    def graph(self) -> Graph:
        """Made when the first patch is taken."""
        return graph(self.sample.positions.astype(np.float64), self.neighbours)

    @cached_property
    def scene(self) -> Occluders:
        """Made when the mesh is first turned."""
        return Occluders([(self.sample.positions, self.sample.triangles)])

    def look(self, encoding: str, rng: np.random.Generator | None) -> Look:
        """The points that are heard and OTHERS, turned and scaled; as the mesh lies without a generator."""
        sample, places = self.sample, self.places
        left = self.lit.copy()
        left[places.spread] = False
        others = (rng or np.random.default_rng(0)).permutation(np.flatnonzero(left))
        rows = np.concatenate([places.spread, others[:OTHERS if rng else MOST_LOOKED]])
        seen = sample.visibility[rows]
        if rng is not None:
            turn = turned(rng)
            places = places.turned(turn, rng.uniform(*SCALES))
            # in the mesh as it lies, along the directions that the turned normals have, turned back
            directions = np.einsum("nij,dj->ndi", turn.T @ places.frames[rows], sample.directions)
            origins = self.scene.origins(sample.positions[rows], sample.normals[rows])
            seen = self.scene.blocked(np.repeat(origins, seen.shape[1], axis=0),
                                      np.ascontiguousarray(directions.reshape(-1, 3), np.float32)) != 0
        return Look(Sight(*tensors(*places.sight(rows, ENCODINGS[encoding][1]))),
                    *tensors(seen.reshape(len(rows), -1).astype(np.float32)), self.free)

    def example(self, encoding: str, rng: np.random.Generator | None, local: bool) -> Example:
        """A patch, turned and scaled; the whole mesh without a generator. Coefficients are `local` to the motors."""
        sample, places = self.sample, self.places
        rows, inner = np.arange(len(sample.positions)), np.ones(len(sample.positions), bool)
        turn = np.eye(3)
        if rng is not None:
            turn = turned(rng)
            places = places.turned(turn, rng.uniform(*SCALES))
            if len(rows) > PATCH:
                away = np.square(sample.positions - sample.positions[rng.integers(len(rows))]).sum(1)
                rows = np.sort(np.argpartition(away, PATCH)[:PATCH])
                inner = away[rows] <= np.quantile(away[rows], INNER)
        frames = places.frames[rows]
        blocked = sh.rotate_each(self.blocked[rows],
                                 frames.transpose(0, 2, 1) @ turn if local else np.broadcast_to(turn, frames.shape))
        encode = ENCODINGS[encoding][1]
        edges = within(self.graph, rows)
        encoded, source, start, blocked, seen, inner = tensors(
            encode(places.points[rows], places.normals[rows]).astype(np.float32), edges.source, edges.start,
            blocked.astype(np.float32), sample.visibility[rows].astype(np.float32), inner)
        return Example(encoded, source, start, [Sight(*tensors(*places.sight(rows, encode)))], frames, blocked,
                       seen, inner)


def turned(rng: np.random.Generator) -> np.ndarray:
    """A rotation (3, 3), any as likely as any other."""
    return Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()


def within(edges: Graph, rows: np.ndarray) -> Graph:
    """The graph of some vertices (n,), rising, alone."""
    new = np.full(len(edges.start) - 1, -1)
    new[rows] = np.arange(len(rows))
    target = new[np.repeat(np.arange(len(edges.start) - 1), np.diff(edges.start))]
    source = new[edges.source]
    kept = (target >= 0) & (source >= 0)
    return Graph(np.searchsorted(target[kept], np.arange(len(rows) + 1)), source[kept])


def balanced(logits: Tensor, truth: Tensor, free: float) -> Tensor:
    """Binary cross-entropy in which a mesh's blocked and free rays weigh alike (section 4.2.1); free: their share."""
    share = min(max(free, 0.02), 0.98)
    weight = torch.where(truth > 0.5, 0.5 / share, 0.5 / (1 - share))
    return functional.binary_cross_entropy_with_logits(logits.float(), truth, weight)


def shadow_loss(found: Tensor, truth: Tensor) -> Tensor:
    """Logarithm of the shadow residual ratio: a mesh with few shadows counts as one with many."""
    floor = FLOOR * len(truth)
    return (((found.float() - truth).square().sum() + floor) / (truth.square().sum() + floor)).log()


def loss_of(model: nn.Module, example: Example, teacher: nn.Module | None = None) -> Tensor:
    """What is minimised of coefficients; a student, whose are in the axes of the mesh, follows its teacher, too
    (section 4.1.1)."""
    found = answer(model, example)[0][example.inner]
    loss = shadow_loss(found, example.blocked[example.inner])
    if teacher is None:
        return loss
    with torch.no_grad():
        target, _ = answer(teacher, example)
    target, = tensors(sh.rotate_each(target.cpu().numpy(), example.frames).astype(np.float32))
    return loss + shadow_loss(found, target[example.inner])


def is_local(model: nn.Module) -> bool:
    """Whether a network's coefficients are in the motors' frames; the perceptron's are in the axes of the mesh."""
    return not isinstance(model, paper.Mlp)


def answer(model: nn.Module, example: Example) -> tuple[Tensor, Tensor | None]:
    """What a network says of the blocked part, and of the visibility where it has two stages."""
    graph_ = (example.encoded, example.source, example.start)
    return model(*graph_, example.sights) if isinstance(model, paper.TwoStage) else (model(*graph_), None)


def evaluate(model: nn.Module, held: list[Source], encoding: str) -> dict[str, float]:
    """On whole meshes that it was not trained on: SRR, and the balanced accuracy of visibility where it gives one."""
    ratios, accuracies = [], []
    with torch.no_grad():
        for source in held:
            example = source.example(encoding, None, is_local(model))
            found, logits = answer(model, example)
            if logits is not None:
                accuracies.append(accuracy(logits > 0, example.visibility > 0.5))
            energy = example.blocked.square().sum().clamp_min(1e-9)
            ratios.append(float((found - example.blocked).square().sum() / energy))
    out = {"srr_median": float(np.median(ratios)), "srr_mean": float(np.mean(ratios))}
    return {**out, "accuracy": float(np.nanmean(accuracies))} if accuracies else out


def accuracy(found: Tensor, truth: Tensor) -> float:
    """Balanced: the mean of the shares of free and of blocked rays that are found to be so."""
    right = (found == truth).float()
    return float(right[truth].mean() + right[~truth].mean()) / 2


def misjudged(model: paper.VisibilityNet, held: list[Source], encoding: str) -> dict[str, float]:
    """Share of rays that stage 1 gets wrong, balanced."""
    found = []
    for look in (source.look(encoding, None) for source in held):
        found.append(1 - accuracy(model.ask(look.sight) > 0, look.visibility > 0.5))
    return {"misjudged": float(np.nanmean(found)), "worst": float(np.nanmax(found))}


def train(network: str, encoding: str, seed: int, kept: list[Source], held: list[Source], steps: int, log: Path,
          checkpoint: Path, teacher: nn.Module | None = None) -> nn.Module:
    """Train, and write log and checkpoint as we go; on from the checkpoint, where there is one of just this.

    Two stages are trained one after the other.
    """
    def drawn(rng: np.random.Generator) -> Source:
        return kept[rng.integers(len(kept))]

    def fit(model: Model, loss: loop.Loss, look: loop.Look, steps: int, stage: str = "") -> Model:
        return loop.run(model, loss, look, steps=steps, rate=RATE, every=max(1, steps // LOOKS), seed=seed,
                        checkpoint=checkpoint.with_name(checkpoint.name + stage),
                        log=log.with_name(f"{log.stem}{stage}.csv"))

    def fit_stage_1(model: Model, steps: int, stage: str = "") -> Model:
        def seen(model: paper.VisibilityNet, rng: np.random.Generator) -> Tensor:
            looks = [drawn(rng).look(encoding, rng) for _ in range(MESHES)]
            return torch.stack([balanced(model.ask(each.sight), each.visibility, each.free) for each in looks]).mean()

        return fit(model, seen, lambda model: misjudged(model, held, encoding), steps, stage)

    torch.manual_seed(seed)
    model = NETWORKS[network](ENCODINGS[encoding][0]).to(loop.device())
    if isinstance(model, paper.VisibilityNet):
        return fit_stage_1(model, steps)
    if isinstance(model, paper.TwoStage):
        model.visibility = fit_stage_1(model.visibility, steps, "-visibility")
        model.visibility.requires_grad_(False)
    return fit(model, lambda model, rng: loss_of(model, drawn(rng).example(encoding, rng, is_local(model)), teacher),
               lambda model: evaluate(model, held, encoding), steps)


def sources(cache: Path, most: int) -> list[list[Source]]:
    """Meshes to train on, and meshes held out; at most so many of both together."""
    return data.sources(Source, cache, most, MOST_POINTS, HELD_OUT)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--network", choices=list(STEPS), default="gnn-paper")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--meshes", type=int, default=600, help="at most, of the cache")
    parser.add_argument("--cache", type=Path, default=data.CACHE, help="of labelled meshes, from training.data")
    parser.add_argument("--out", type=Path, help="folder of the weights; not given: the add-on's, if they ship")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small, and a second thread that must wait loses tenfold
    sets = sources(arguments.cache, arguments.meshes)
    if not all(sets):
        parser.error(f"there are too few labelled meshes in '{arguments.cache}'; make them with `make data`")
    teacher = None
    if arguments.network == "student":
        teacher = paper.TwoStage()
        arrays = weights.load(weights.FOLDER / "gnn-paper.safetensors")
        teacher.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in arrays.items()})
        teacher.to(loop.device()).eval()
    log = Path(__file__).parent / "logs" / f"{arguments.network}.csv"
    model = train(arguments.network, "motor", arguments.seed, *sets, arguments.steps or STEPS[arguments.network], log,
                  arguments.cache / f"{arguments.network}.checkpoint", teacher)
    draw(log, ["srr_median", "srr_mean"])
    if arguments.network == "gnn-paper":
        draw(log.with_name("gnn-paper-visibility.csv"), ["misjudged"])
    out = arguments.out or (weights.FOLDER if arguments.network in SHIPPED else arguments.cache)
    out.mkdir(parents=True, exist_ok=True)
    weights.save(out / f"{arguments.network}.safetensors",
                 {name: value.detach().cpu().numpy() for name, value in model.state_dict().items()})
    print(f"{len(sets[0])} meshes, {len(sets[1])} held out: {evaluate(model, sets[1], 'motor')}")


if __name__ == "__main__":
    main()
