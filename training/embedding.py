# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the light-transport embedding: label rooms, then `python -m training.embedding`; writes weights and a log.

As Xu et al. 2026: relative L2 in log space, points in space and not pictures. A room turned about the
vertical or mirrored is another room; each colour channel is one, too. Brighter lamps would be nothing new, as the
network is linear in emission.
"""
from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neural_gash_addon.backend import embedding, weights
from neural_gash_addon.backend.nearest import nearest_to
from neural_gash_addon.backend.networks.embedding import (
    FULL,
    SMALL,
    Embedding,
    Layout,
    Settings,
    direct,
    level,
    shining,
)

from . import data, loop
from .curves import draw

CACHE = data.CACHE / "rooms"
EPSILON = 0.1        # of equation 12, which leaves it open: errors below a tenth of the level are mostly noise
HELD_OUT = 512       # queries of a room, when it is judged
NAME = "embedding"


@dataclass(frozen=True)
class Recipe:
    """How a configuration is trained."""

    settings: Settings
    steps: int
    rate: float
    rooms: int     # of a step
    queries: int   # of each of them
    every: int     # steps, the held-out rooms are looked at and all is saved


RECIPES = {"small": Recipe(SMALL, 4_000, 5e-4, 1, 1024, 250),            # an hour of one CPU core
           "full": Recipe(FULL, 2_000_000, 2e-4, 3, 8192, 10_000)}       # Table 3


@dataclass(frozen=True, eq=False)
class Sample:
    """A labelled room, with what never changes however it is turned."""

    points: NDArray[np.float32]       # (M, 12) position, normal, albedo, emission
    queries: NDArray[np.float32]      # (N, 9) position, normal, albedo
    irradiance: NDArray[np.float32]   # (N, 3)
    noise: NDArray[np.float32]        # (N, 3) its standard error
    areas: NDArray[np.float32]        # (M,)
    direct: NDArray[np.float32]       # (3, M) unshadowed, at scene points
    asked: NDArray[np.float32]        # (3, N) the same at queries
    layout: embedding.Layout
    near: NDArray[np.int32]           # (N, k) codes nearest to each query

    @property
    def level(self) -> NDArray[np.float32]:
        """(3,)."""
        return level(*(torch.from_numpy(array) for array in (self.points[:, 6:9].T, self.points[:, 9:].T, self.areas))
                     ).numpy()


@cache
def load(path: Path, settings: Settings) -> Sample:
    """A room of the cache, kept in memory."""
    with np.load(path) as found:
        points, queries, irradiance, noise = (
            found[key] for key in ("scene_points", "queries", "irradiance", "noise"))
    stages = len(settings.depths)
    layout = embedding.layout(points[:, :3], stages, settings.gathered, settings.around)
    near = nearest_to(queries[:, :3], points[:len(layout.around[0]), :3], settings.neighbours)
    areas = embedding.areas(points[:, :3])
    emission = torch.from_numpy(points[:, 9:].T)
    rows, lamp_areas = shining(emission, torch.from_numpy(areas))
    lamps = torch.from_numpy(points)[rows]
    unshadowed = (direct(*(torch.from_numpy(each) for each in (at[:, :3], at[:, 3:6])), lamps[:, :3], lamps[:, 3:6],
                         lamp_areas, emission[:, rows]).numpy() for at in (points, queries))
    return Sample(points, queries, irradiance, noise, areas, *unshadowed, layout, near.astype(np.int32))


def rooms(cache: Path, split: str) -> list[Path]:
    """Those of a split, by name."""
    out = []
    for path in sorted(cache.glob("*.npz")):
        with np.load(path) as found:
            if str(found["split"]) == split:
                out.append(path)
    return out


def turn(rng: np.random.Generator) -> NDArray[np.float64]:
    """(3, 3) of a room about the vertical, and mirrored; half of the rooms stand along the axes, as rooms do."""
    angle = np.pi / 2 * rng.integers(4) if rng.random() < 0.5 else rng.uniform(0, 2 * np.pi)
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ np.diag([rng.choice([-1, 1]), 1, 1])


def answer(model: nn.Module, sample: Sample, rows: NDArray, channels: list[int], matrix: NDArray
           ) -> tuple[Tensor, Tensor]:
    """log(1 + irradiance / level) of some queries of a room that is turned: the network's, and the truth (B, n)."""
    where = loop.device()

    def tensor(array: NDArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(where)

    positions, asked = sample.points[:, :3] @ matrix.T, sample.queries[rows]
    places = embedding.normalised(positions, positions)
    orders = [torch.from_numpy(order).to(where) for order in embedding.orders(places, len(sample.layout.around))]
    unit = tensor(sample.level[channels]).clamp_min(1e-30)[:, None]
    codes = model.encoder(
        tensor(places), tensor(sample.points[:, 3:6] @ matrix.T), tensor(sample.areas),
        tensor(sample.points[:, 6:9].T[channels]), tensor(sample.points[:, 9:].T[channels]) / unit,
        tensor(sample.direct[channels]) / unit, Layout.of(sample.layout, where), orders)
    found = model.decoder(
        codes, tensor(places[:codes.shape[1]]), tensor(embedding.normalised(asked[:, :3] @ matrix.T, positions)),
        tensor(asked[:, 3:6] @ matrix.T), tensor(asked[:, 6:].T[channels]),
        tensor(sample.asked[channels][:, rows]) / unit,
        torch.from_numpy(sample.near[rows].astype(np.int64)).to(where))
    return found, (tensor(sample.irradiance[rows].T[channels]) / unit).log1p()


def relative(found: Tensor, truth: Tensor) -> Tensor:
    """Relative L2 of logarithms, by the mean of both; no gradient through that, as in Müller et al. 2021.

    Equation 12 divides by what was found. There a few points that are far too dark outweigh all others, and a training
    at one room a step went astray.
    """
    return ((found - truth) / ((found.detach() + truth) / 2 + EPSILON)).square().mean()


def held_rows(sample: Sample) -> NDArray:
    """The queries by which a room is judged."""
    return np.random.default_rng(5).permutation(len(sample.queries))[:HELD_OUT]


def judged(found: NDArray, sample: Sample) -> dict[str, float]:
    """Errors of irradiance (n, 3) at `held_rows`.

    Squared error over squared truth, of logarithms and of irradiance itself, which is mostly what is beside lamps; and
    equation 12, which forgives what is too bright and not what is too dark, as it divides by what was found.
    """
    truth, unit = sample.irradiance[held_rows(sample)], sample.level.clip(1e-30)
    logs = [np.log1p(each / unit) for each in (found, truth)]
    return {"log_mse": _share(*logs), "rel_mse": _share(found, truth),
            "equation_12": float(np.square((logs[0] - logs[1]) / (logs[0] + EPSILON)).mean())}


def _share(found: NDArray, truth: NDArray) -> float:
    return float(np.square(found - truth).sum() / np.square(truth).sum())


def network(model: nn.Module, sample: Sample) -> NDArray:
    """What it gives at `held_rows`: (n, 3)."""
    with torch.no_grad():
        found, _ = answer(model, sample, held_rows(sample), [0, 1, 2], np.eye(3))
    return found.expm1().T.cpu().numpy() * sample.level


def unshadowed(sample: Sample) -> NDArray:
    """(n, 3) direct light of all that shines at `held_rows`, as if nothing stood between."""
    return sample.asked[:, held_rows(sample)].T


BASELINES = {
    "the room's true mean": lambda sample: np.tile(sample.irradiance.mean(0), (len(held_rows(sample)), 1)),
    "integrating sphere": lambda sample: np.tile(sample.level, (len(held_rows(sample)), 1)),
    "direct, unshadowed": unshadowed,
    "direct, unshadowed, and the sphere's bounces": lambda sample: (
        unshadowed(sample) + sample.level * (sample.areas @ sample.points[:, 6:9]) / sample.areas.sum()),
}


def train(recipe: Recipe, kept: list[Path], held: list[Sample], seed: int, checkpoint: Path, log: Path) -> Embedding:
    """Train, and write log and checkpoint as we go; on from the checkpoint, where there is one of just this."""
    torch.manual_seed(seed)
    model = Embedding(recipe.settings).to(loop.device())

    def loss_of(model: nn.Module, rng: np.random.Generator) -> Tensor:
        losses = []
        for _ in range(recipe.rooms):
            sample = load(kept[rng.integers(len(kept))], recipe.settings)
            rows = rng.permutation(len(sample.queries))[:recipe.queries]
            found, truth = answer(model, sample, rows, [int(rng.integers(3))], turn(rng))
            losses.append(relative(found.float(), truth))
        return torch.stack(losses).mean()

    def look(model: nn.Module) -> dict[str, float]:
        found = [judged(network(model, sample), sample) for sample in held]
        return {name: float(np.mean([each[name] for each in found])) for name in found[0]}

    return loop.run(model, loss_of, look, steps=recipe.steps, rate=recipe.rate, every=recipe.every, seed=seed,
                    checkpoint=checkpoint, log=log)


def table(model: nn.Module, held: list[Sample]) -> str:
    """The network beside what needs no training, and the noise of the truth."""
    lines = [f"{'mean of the rooms, and in brackets the median':46}{'log MSE':>16}{'rel. MSE':>18}{'equation 12':>18}"]

    def row(name: str, *columns: list[float]) -> str:
        return f"{name:46}" + "".join(f"{np.mean(each):9.4f} ({np.median(each):.4f})" for each in columns)

    for name, give in {"network": lambda sample: network(model, sample), **BASELINES}.items():
        found = [judged(give(sample), sample) for sample in held]
        lines.append(row(name, *([each[key] for each in found] for key in found[0])))
    noisy = [(sample.irradiance[held_rows(sample)], sample.noise[held_rows(sample)], sample.level) for sample in held]
    lines.append(row("noise of the truth", [_share(np.log1p(truth / unit) + noise / (truth + unit),
                                                   np.log1p(truth / unit)) for truth, noise, unit in noisy],
                     [_share(truth + noise, truth) for truth, noise, _ in noisy]))
    return "\n".join(lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--configuration", choices=RECIPES, default="small")
    parser.add_argument("--steps", type=int, help="instead of the configuration's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, default=CACHE, help="of labelled rooms, from training.room_labels")
    parser.add_argument("--out", type=Path, default=weights.FOLDER, help="folder of the weights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small, and a second thread that must wait loses tenfold
    recipe = RECIPES[arguments.configuration]
    if arguments.steps:
        recipe = Recipe(recipe.settings, arguments.steps, recipe.rate, recipe.rooms, recipe.queries, recipe.every)
    kept = rooms(arguments.cache, "train")
    held = [load(path, recipe.settings) for path in rooms(arguments.cache, "validation")]
    if not kept or not held:
        parser.error(f"there are too few labelled rooms in '{arguments.cache}'; make them with "
                     "`python -m training.room_labels`")
    log = Path(__file__).parent / "logs" / f"{NAME}.csv"
    model = train(recipe, kept, held, arguments.seed, arguments.cache / f"{NAME}.checkpoint", log)
    arguments.out.mkdir(parents=True, exist_ok=True)
    weights.save(arguments.out / weights.EMBEDDING,
                 {name: value.cpu().numpy() for name, value in model.state_dict().items()})
    draw(log, ["loss", "log_mse", "rel_mse"])
    print(f"{len(kept)} rooms, {len(held)} held out\n{table(model, held)}")


if __name__ == "__main__":
    main()
