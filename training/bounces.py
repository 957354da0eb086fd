# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the decoder of light that bounces, after `python -m training.bounce_labels`; writes weights and a log.

What the embedding for the light of the sky says of a scene is as it ships, and kept. Each step takes one scene, one of
LOOKS traces of its scene points, and some of its queries. The loss is the logarithm of the relative squared error of
each colour channel, so that a scene where little bounces counts as much as one where much does.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neural_gash_addon.backend import embedding, sky_bake, weights
from neural_gash_addon.backend.nearest import nearest_to
from neural_gash_addon.backend.networks.embedding import Frame, Settings
from neural_gash_addon.backend.networks.reflected import Reflected
from neural_gash_addon.backend.networks.sky import by_band

from . import data, loop
from .bounce_labels import ARRAYS, jobs
from .curves import draw

NAME = "bounces"
STEPS, RATE, EVERY = 2_500, 2e-3, 100
ROWS = 1024          # queries of a step
FLOOR = 1e-6         # of a query's energy, so that a scene where nothing bounces does not decide
TERMS = 9            # that are judged; the others count in the loss by a third


@cache
def trained() -> nn.Module:
    """The embedding that ships."""
    return sky_bake.network().requires_grad_(False)


def begun() -> Reflected:
    """The network before training."""
    model = Reflected(trained().settings).to(loop.device())
    model.begin_from(trained().decoder)
    return model


class Sample:
    """A labelled scene, with what the embedding says of it under each look."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as found:
            places, normals, blocked, bounced, queries, query_normals, self.truth = (found[key] for key in ARRAYS)
        settings: Settings = trained().settings
        layout = embedding.layout(places, settings.halvings, settings.gathered, settings.around)
        parents = nearest_to(places, places[:len(layout.around)], 1)[:, 0]
        self.points, self.facing, self.bounced = places, normals, bounced
        self.frame = Frame.of(_tensor(places), _tensor(normals), layout)
        self.parents = torch.from_numpy(parents.astype(np.int64)).to(loop.device())
        self.places, self.normals = _tensor(queries), _tensor(query_normals)
        near = nearest_to(queries, places, settings.neighbours)
        self.near = torch.from_numpy(near.astype(np.int64)).to(loop.device())
        with torch.no_grad():
            self.codes = [trained().encoder(self.frame, _tensor(each), self.parents) for each in blocked]

    def answer(self, model: nn.Module, rows: NDArray, look: int = 0) -> Tensor:
        """The network's (n, 25, 3) at some queries."""
        codes = model.encode(self.codes[look], self.frame, _tensor(self.bounced[look]), self.parents)
        return model(codes, self.frame, self.places[rows], self.normals[rows], self.near[rows])


def _tensor(array: NDArray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(loop.device())


@cache
def sample(path: Path) -> Sample:
    """Of the cache, kept in memory."""
    return Sample(path)


def loss(found: Tensor, truth: Tensor) -> Tensor:
    """Of one scene: (n, 25, 3) both."""
    floor = FLOOR * len(truth)
    square, energy = ((each.square().sum(0)) for each in (found - truth, truth))
    low = ((square[:TERMS].sum(0) + floor) / (energy[:TERMS].sum(0) + floor)).log().mean()
    return low + ((square.sum(0) + floor) / (energy.sum(0) + floor)).log().mean() / 3


def relative(found: NDArray, held: Sample, terms: slice = slice(TERMS)) -> float:
    """Relative L2 error of some coefficients against two truths, whose noise is independent and so cancels."""
    one, two = (each[:, terms] for each in held.truth)
    found = found[:, terms]
    error = float(((found - one) * (found - two)).sum(dtype=np.float64))
    energy = float((one * two).sum(dtype=np.float64))
    return (max(error, 0.0) / max(energy, 1e-12)) ** 0.5


def network(model: nn.Module, held: Sample) -> NDArray[np.float32]:
    """What it gives at all queries: (n, 25, 3)."""
    with torch.no_grad():
        return held.answer(model, np.arange(len(held.places))).cpu().numpy()


def as_shadows(held: Sample) -> NDArray[np.float32]:
    """What bounces, interpolated with the weights that the embedding has for what is blocked: no further training."""
    model, bounced = trained(), _tensor(held.bounced[0])
    with torch.no_grad():
        own = model.decoder.own(held.codes[0], held.frame, held.places, held.normals, held.near)[0]
        return torch.einsum("nkx,nkxc->nxc", by_band(own, bounced.shape[1]), bounced[held.near]).cpu().numpy()


def near_mean(held: Sample, count: int) -> NDArray[np.float32]:
    """The mean of the scene points nearest to each query, by distance and normal."""
    queries, normals = held.places.cpu().numpy(), held.normals.cpu().numpy()
    near = nearest_to(queries, held.points, count)
    square = np.square(held.points[near] - queries[:, None]).sum(2)
    facing = (held.facing[near] * normals[:, None]).sum(2)
    weight = np.exp(-2 * square / square.mean(1, keepdims=True).clip(1e-20)) * np.exp(4 * (facing - 1))
    return np.einsum("nk,nkxc->nxc", weight / weight.sum(1, keepdims=True), held.bounced[0][near]).astype(np.float32)


def table(model: nn.Module, held: list[Sample]) -> str:
    """The network beside what needs no training: relative L2 of each scene; median, mean, worst, and of bands 3, 4."""
    untrained = begun().eval()
    ways: dict[str, Callable[[Sample], NDArray]] = {
        "network": lambda each: network(model, each), "before training": lambda each: network(untrained, each),
        "weights of what is blocked": as_shadows,
        **{f"mean of the {count} nearest scene points": lambda each, count=count: near_mean(each, count)  # type: ignore
           for count in (1, 4, 16)}}
    lines = [f"{'relative L2 of what bounces':40}{'median':>8}{'mean':>8}{'worst':>8}{'25 terms':>10}"]
    for name, give in ways.items():
        given = [give(each) for each in held]
        low, all_of = ([relative(found, each, terms) for found, each in zip(given, held, strict=True)]
                       for terms in (slice(TERMS), slice(None)))
        lines.append(f"{name:40}{np.median(low):8.4f}{np.mean(low):8.4f}{max(low):8.4f}{np.median(all_of):10.4f}")
    return "\n".join(lines)


def train(kept: list[Path], held: list[Sample], steps: int, seed: int, checkpoint: Path, log: Path) -> Reflected:
    """Train, and write log and checkpoint as we go; on from the checkpoint, where there is one of just this."""
    torch.manual_seed(seed)
    model = begun()

    def loss_of(model: nn.Module, rng: np.random.Generator) -> Tensor:
        drawn = sample(kept[rng.integers(len(kept))])
        rows = rng.permutation(len(drawn.places))[:ROWS]
        return loss(drawn.answer(model, rows, int(rng.integers(len(drawn.codes)))), _tensor(drawn.truth[0][rows]))

    def look(model: nn.Module) -> dict[str, float]:
        found = [relative(network(model, each), each) for each in held]
        return {"log": float(np.mean(np.log(np.maximum(found, 1e-3)))), "median": float(np.median(found)),
                "mean": float(np.mean(found))}

    return loop.run(model, loss_of, look, steps=steps, rate=RATE, every=EVERY, seed=seed, checkpoint=checkpoint,
                    log=log)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, default=data.CACHE, help="of labelled meshes, from training.data")
    parser.add_argument("--out", type=Path, default=weights.FOLDER, help="folder of the weights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small, and a second thread that must wait loses tenfold
    there = [(path, out) for _, path, out in jobs(arguments.cache) if data.is_whole(path, ARRAYS)]
    kept, held = [path for path, out in there if not out], [sample(path) for path, out in there if out]
    if not kept or not held:
        parser.error(f"there are too few labelled scenes in '{arguments.cache}'; make them with "
                     "`python -m training.bounce_labels`")
    log = Path(__file__).parent / "logs" / f"{NAME}.csv"
    model = train(kept, held, arguments.steps, arguments.seed, arguments.cache / f"{NAME}.checkpoint", log)
    arguments.out.mkdir(parents=True, exist_ok=True)
    weights.save(arguments.out / weights.BOUNCES,
                 {name: value.cpu().numpy() for name, value in model.state_dict().items()})
    draw(log, ["median", "mean"])
    print(f"{len(kept)} scenes, {len(held)} held out\n{table(model, held)}")


if __name__ == "__main__":
    main()
