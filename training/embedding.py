# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the light-transport embedding: label rooms, then `python -m training.embedding`; writes weights and a log.

As Xu et al. 2026: points in space and not pictures, relative L2; of logarithms (equation 12), and at the end, which the
paper has not, of values, whose least error is at the mean of noisy labels: see docs/embedding.md. Rooms are neither
turned nor moved, as the network gives the same for those by construction; each colour channel is a room of its own, the
scene points' light has another noise in each of room_labels.LOOKS looks, and each step has some of the points or all.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neural_gash_addon.backend import embedding, weights
from neural_gash_addon.backend.nearest import nearest_to
from neural_gash_addon.backend.networks.embedding import FULL, SMALL, Embedding, Frame, Settings, level

from . import data, loop
from .curves import draw

CACHE = data.CACHE / "rooms"
EPSILON = 0.1        # of the level: errors below it are mostly noise
SHARES = 1.0, 0.7, 0.5  # of a room's scene points, of which one is drawn for each step
HELD_OUT = 1024      # queries of a room, when it is judged
NAME = "embedding"


@dataclass(frozen=True)
class Phase:
    """A part of a training, which begins with the weights of the one before."""

    loss: str      # of LOSSES
    steps: int
    rate: float
    rooms: int     # of a step
    queries: int   # of each of them, in three channels
    every: int     # steps, the held-out rooms are looked at and all is saved


@dataclass(frozen=True)
class Recipe:
    """How a configuration is trained."""

    settings: Settings
    phases: tuple[Phase, ...]


# 8,192 queries a step, as section 4. The small one takes three quarters of an hour of a CPU core
RECIPES = {"small": Recipe(SMALL, (Phase("logarithms", 600, 2e-3, 4, 2048, 60),
                                   Phase("values", 800, 1e-3, 4, 2048, 80))),
           "full": Recipe(FULL, (Phase("logarithms", 2_000_000, 2e-4, 4, 2048, 10_000),))}


@dataclass(frozen=True, eq=False)
class Sample:
    """A labelled room, with what never changes of it."""

    points: NDArray[np.float32]     # (M, 12) position, normal, albedo, emission
    direct: NDArray[np.float32]     # (M, 3) light straight from emitters, there
    looks: NDArray[np.float32]      # (LOOKS, M, 3) reflected light there, noisy
    queries: NDArray[np.float32]    # (N, 9) position, normal, albedo
    asked: NDArray[np.float32]      # (N, 3) light straight from emitters
    truth: NDArray[np.float32]      # (N, 3) reflected light
    noise: NDArray[np.float32]      # (N, 3) its standard error
    layout: embedding.Layout
    near: NDArray[np.int32]         # (N, k) codes nearest to each query
    albedo: NDArray[np.float32]     # (N, 3) as a bake knows it, of scene points near by
    guide: NDArray[np.float32]      # (N, 3) about the truth, with a noise of its own: mean of scene points

    @property
    def level(self) -> NDArray[np.float32]:
        """(3,) of the first look."""
        return level(torch.from_numpy(self.looks[0].T), torch.from_numpy(self.layout.areas)).numpy()


@cache
def load(path: Path, settings: Settings, share: float = 1.0) -> Sample:
    """A room of the cache with a share of its scene points, kept in memory."""
    with np.load(path) as found:
        points, direct, looks, queries, asked, truth, noise = (found[key] for key in (
            "scene_points", "point_direct", "point_indirect", "queries", "direct", "indirect", "indirect_noise"))
    first = slice(round(share * len(points)))  # of points in farthest-point order, which are a good sample too
    points, direct, looks = points[first], direct[first], looks[:, first]
    layout = embedding.layout(points[:, :3], settings.halvings, settings.gathered, settings.around)
    near = nearest_to(queries[:, :3], points[:len(layout.around), :3], settings.neighbours)
    albedo = embedding.colours(queries[:, :3], queries[:, 3:6], near[:, 0], layout.gathered, points)
    return Sample(points, direct, looks, queries, asked, truth, noise, layout, near.astype(np.int32), albedo,
                  near_mean(queries, points, looks.mean(0), 16))


def rooms(cache: Path, split: str) -> list[Path]:
    """Those of a split, by name."""
    return sorted(cache.glob(f"{split}-*.npz"))


def answer(model: nn.Module, sample: Sample, rows: NDArray, look: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Reflected light over the level at some queries (3, n): the network's, the truth and the guide."""
    where = loop.device()

    def tensor(array: NDArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(where)

    middle = sample.points[:, :3].mean(0)
    frame = Frame.of(tensor(sample.points[:, :3] - middle), tensor(sample.points[:, 3:6]), sample.layout)
    albedo, emission, direct, indirect = (tensor(each.T) for each in (
        sample.points[:, 6:9], np.pi * sample.points[:, 9:], sample.direct, sample.looks[look]))
    unit = level(indirect, frame.areas).clamp_min(1e-30)[:, None]
    codes = model.encoder(frame, albedo, emission / unit, direct / unit, indirect / unit)
    found = model.decoder(codes, frame, tensor(sample.queries[rows, :3] - middle), tensor(sample.queries[rows, 3:6]),
                          tensor(sample.albedo[rows].T), tensor(sample.asked[rows].T) / unit,
                          tensor(sample.near[rows].astype(np.int64)))
    return found, tensor(sample.truth[rows].T) / unit, tensor(sample.guide[rows].T) / unit


def of_logarithms(found: Tensor, truth: Tensor, _: Tensor) -> Tensor:
    """Equation 12: relative L2 of log(1 + light / level). No gradient through what it is relative to."""
    logs = found.log1p()
    return ((logs - truth.log1p()) / (logs.detach() + EPSILON)).square().mean()


def of_values(found: Tensor, truth: Tensor, guide: Tensor) -> Tensor:
    """Relative L2 of light, by what was found and by the guide; no gradient through that, as in Müller et al. 2021.

    The truth is noisy, and least squares of values aim at its mean as long as they are not weighted by it.
    """
    return ((found - truth).square() / ((found.detach().square() + guide.square()) / 2 + EPSILON)).mean()


Loss = Callable[[Tensor, Tensor, Tensor], Tensor]
LOSSES: dict[str, Loss] = {"logarithms": of_logarithms, "values": of_values}


def held_rows(sample: Sample) -> NDArray:
    """The queries by which a room is judged."""
    return np.random.default_rng(5).permutation(len(sample.queries))[:HELD_OUT]


def judged(found: NDArray, sample: Sample) -> dict[str, float]:
    """Errors of reflected light (n, 3) at `held_rows`, in each over what they would be of darkness.

    `relative` as `of_values`, without what the truth's own noise is expected to add; squared error over squared
    truth, likewise; and that of the logarithm of 1 + light / level, with the noise.
    """
    rows, unit = held_rows(sample), sample.level.clip(1e-30)
    truth, noise = sample.truth[rows], sample.noise[rows]
    beyond = np.square(found - truth) - np.square(noise)
    weight = 1 / ((np.square(found) + np.square(sample.guide[rows])) / 2 + EPSILON * unit ** 2)
    logs = [np.log1p(each / unit) for each in (found, truth)]
    return {"relative": float((beyond * weight).mean()), "squares": float(beyond.sum() / np.square(truth).sum()),
            "logs": float(np.square(logs[0] - logs[1]).sum() / np.square(logs[1]).sum())}


def network(model: nn.Module, sample: Sample) -> NDArray:
    """What it gives at `held_rows`: (n, 3)."""
    with torch.no_grad():
        found, *_ = answer(model, sample, held_rows(sample))
    return found.T.cpu().numpy() * sample.level


def sphere(sample: Sample, rows: NDArray) -> NDArray:
    """(n, 3) reflected light in an integrating sphere of the room's mean albedo and mean light off surfaces."""
    share = sample.layout.areas / sample.layout.areas.sum()
    first = share @ (sample.points[:, 6:9] * sample.direct)
    return np.tile(first / (1 - share @ sample.points[:, 6:9]), (len(rows), 1))


def one_bounce(sample: Sample, rows: NDArray) -> NDArray:
    """(n, 3) light off scene points, each a disc, as if nothing stood between; the sphere's for further bounces."""
    areas, out = sample.layout.areas, []
    for some in np.array_split(rows, -(-len(rows) // 1024)):
        way = sample.points[None, :, :3] - sample.queries[some, None, :3]
        square = np.square(way).sum(2)
        here = np.einsum("nmx,nx->nm", way, sample.queries[some, 3:6]).clip(0)
        there = -np.einsum("nmx,mx->nm", way, sample.points[:, 3:6]).clip(max=0)
        form = here * there * areas / np.pi / (square * (square + areas / np.pi)).clip(1e-20)
        out.append(form @ (sample.points[:, 6:9] * sample.direct))
    return np.concatenate(out) / (1 - areas @ sample.points[:, 6:9] / areas.sum())


def near_mean(queries: NDArray, points: NDArray, light: NDArray, count: int) -> NDArray[np.float32]:
    """(N, 3) light (M, 3) of scene points, averaged over those of the `count` nearest that face as the query does."""
    near = nearest_to(queries[:, :3], points[:, :3], count)
    square = np.square(points[near, :3] - queries[:, None, :3]).sum(2)
    facing = (points[near, 3:6] * queries[:, None, 3:6]).sum(2)
    weight = np.exp(-2 * square / square.mean(1, keepdims=True).clip(1e-20)) * np.exp(4 * (facing - 1))
    return np.einsum("nk,nkc->nc", weight / weight.sum(1, keepdims=True), light[near]).astype(np.float32)


def nearest_points(count: int) -> Callable[[Sample, NDArray], NDArray]:
    """`near_mean` of the first look, at some queries."""
    return lambda sample, rows: near_mean(sample.queries[rows], sample.points, sample.looks[0], count)


# reflected light at some queries of a room, without training
BASELINES: dict[str, Callable[[Sample, NDArray], NDArray]] = {
    "integrating sphere": sphere, "one bounce off scene points": one_bounce,
    **{f"mean of the {count} nearest scene points": nearest_points(count) for count in (16, 64, 256)}}


def train(recipe: Recipe, kept: list[Path], held: list[Sample], seed: int, cache: Path, logs: Path, name: str = NAME
          ) -> Embedding:
    """Train phase after phase, and write logs, and checkpoints in the cache, as we go; on from these, where there are.

    A checkpoint of a phase that is older than that of the phase before is of another training.
    """
    torch.manual_seed(seed)
    model = Embedding(recipe.settings).to(loop.device())
    before: Path | None = None
    for number, phase in enumerate(recipe.phases):
        checkpoint = cache / f"{name}-{phase.loss}.checkpoint"
        if before and checkpoint.exists() and checkpoint.stat().st_mtime < before.stat().st_mtime:
            checkpoint.unlink()
        model = in_phase(model, recipe.settings, phase, kept, held, seed + number * 1000, checkpoint,
                         logs / f"{name}-{phase.loss}.csv")
        before = checkpoint
    return model


def in_phase(model: Embedding, settings: Settings, phase: Phase, kept: list[Path], held: list[Sample], seed: int,
             checkpoint: Path, log: Path) -> Embedding:
    """Train in one phase."""
    loss = LOSSES[phase.loss]

    def loss_of(model: nn.Module, rng: np.random.Generator) -> Tensor:
        losses = []
        for _ in range(phase.rooms):
            sample = load(kept[rng.integers(len(kept))], settings, SHARES[rng.integers(len(SHARES))])
            rows = rng.permutation(len(sample.queries))[:phase.queries]
            found, *known = answer(model, sample, rows, int(rng.integers(len(sample.looks))))
            losses.append(loss(found.float(), *known))
        return torch.stack(losses).mean()

    def look(model: nn.Module) -> dict[str, float]:
        found = [judged(network(model, sample), sample) for sample in held]
        return {name: float(np.mean([each[name] for each in found])) for name in found[0]}

    return loop.run(model, loss_of, look, steps=phase.steps, rate=phase.rate, every=phase.every, seed=seed,
                    checkpoint=checkpoint, log=log)


def table(model: nn.Module, held: list[Sample]) -> str:
    """The network beside what needs no training."""
    lines = [f"{'mean of the rooms, and in brackets the median':46}{'relative':>18}{'squares':>18}{'logarithms':>18}"]
    for name, give in {"network": lambda sample, _: network(model, sample), **BASELINES}.items():
        found = [judged(give(sample, held_rows(sample)), sample) for sample in held]
        columns = [[each[key] for each in found] for key in found[0]]
        lines.append(f"{name:46}" + "".join(f"{np.mean(each):9.4f} ({np.median(each):.4f})" for each in columns))
    return "\n".join(lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--configuration", choices=RECIPES, default="small")
    parser.add_argument("--steps", type=int, nargs="+", help="of each phase, instead of the configuration's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, default=CACHE, help="of labelled rooms, from training.room_labels")
    parser.add_argument("--out", type=Path, default=weights.FOLDER, help="folder of the weights")
    parser.add_argument("--logs", type=Path, default=Path(__file__).parent / "logs", help="folder of the log")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small, and a second thread that must wait loses tenfold
    recipe = RECIPES[arguments.configuration]
    if arguments.steps:
        if len(arguments.steps) != len(recipe.phases):
            parser.error(f"--steps needs {len(recipe.phases)} numbers, one of each phase")
        recipe = replace(recipe, phases=tuple(replace(phase, steps=steps) for phase, steps in
                                              zip(recipe.phases, arguments.steps, strict=True)))
    kept = rooms(arguments.cache, "train")
    held = [load(path, recipe.settings) for path in rooms(arguments.cache, "validation")]
    if not kept or not held:
        parser.error(f"there are too few labelled rooms in '{arguments.cache}'; make them with "
                     "`python -m training.room_labels`")
    name = NAME if arguments.configuration == "small" else f"{NAME}-{arguments.configuration}"
    model = train(recipe, kept, held, arguments.seed, arguments.cache, arguments.logs, name)
    arguments.out.mkdir(parents=True, exist_ok=True)
    weights.save(arguments.out / weights.EMBEDDING,
                 {name: value.cpu().numpy() for name, value in model.state_dict().items()})
    for phase in recipe.phases:
        draw(arguments.logs / f"{name}-{phase.loss}.csv", ["loss", "relative", "squares"])
    print(f"{len(kept)} rooms, {len(held)} held out\n{table(model, held)}")


if __name__ == "__main__":
    main()
