# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the radiance decoder on the embedding as it ships: label rooms, then `python -m training.radiance`.

The encoder and the irradiance decoder stay as they are, so what they say of a room is computed once for each look at
its light and kept. The loss is that of the embedding, of the harmonics of reflected light above band 0.
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

from neural_gash_addon.backend import embedding_bake, lobes, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.networks.embedding import Codes, Frame, level
from neural_gash_addon.backend.networks.radiance import ORDER, Radiance

from . import embedding, loop
from .curves import draw
from .embedding import CACHE, EPSILON, Sample, held_rows, load, rooms
from .room_labels import VALIDATION_RAYS

NAME = "radiance"
STEPS, RATE, EVERY = 1_800, 2e-3, 100
BANDS = range(1, ORDER)
ROUGHNESS = 0.4, 0.6
PATHS = 64  # as many as a scene point has


@cache
def trained() -> nn.Module:
    """The embedding that ships."""
    return embedding_bake.network().to(loop.device()).requires_grad_(False)


class Room:
    """A labelled room, with what the embedding says of it under each look at its light. Light over the level."""

    def __init__(self, path: Path) -> None:
        self.sample: Sample = load(path, trained().settings)
        with np.load(path) as found:
            self.shapes, self.truth, self.noise = (found[key] for key in ("point_shape", "shape", "shape_noise"))
        sample = self.sample
        middle = sample.points[:, :3].mean(0)
        self.frame = Frame.of(_tensor(sample.points[:, :3] - middle), _tensor(sample.points[:, 3:6]), sample.layout)
        self.lobes, self.asked_lobes = (_tensor(sh.cosine_lobe(each[:, 3:6], ORDER))
                                        for each in (sample.points, sample.queries))
        self.places, self.normals = _tensor(sample.queries[:, :3] - middle), _tensor(sample.queries[:, 3:6])
        self.near = _tensor(sample.near.astype(np.int64))
        self._looks: dict[int, tuple[Tensor, Codes, Tensor, Tensor, Tensor]] = {}

    def look(self, number: int) -> tuple[Tensor, Codes, Tensor, Tensor, Tensor]:
        """Level (3, 1), codes, reflected light of the scene points (3, M), light straight and reflected at queries."""
        if number not in self._looks:
            sample, model = self.sample, trained()
            albedo, emission, direct, indirect = (_tensor(each.T) for each in (
                sample.points[:, 6:9], np.pi * sample.points[:, 9:], sample.direct, sample.looks[number]))
            unit = level(indirect, self.frame.areas).clamp_min(1e-30)[:, None]
            asked, albedo_asked = _tensor(sample.asked.T) / unit, _tensor(sample.albedo.T)
            with torch.no_grad():
                codes = model.encoder(self.frame, albedo, emission / unit, direct / unit, indirect / unit)
                light = model.decoder(codes, self.frame, self.places, self.normals, albedo_asked, asked, self.near)
            self._looks[number] = unit, codes, indirect / unit, asked, light
        return self._looks[number]

    def answer(self, model: nn.Module, rows: NDArray, number: int = 0) -> tuple[Tensor, Tensor, Tensor]:
        """The network's answer (3, n, K), the truth, and the weight of its errors (3, n), at some queries."""
        unit, codes, light, asked, found = self.look(number)
        shape = _tensor(self.shapes[number].astype(np.float32).transpose(2, 0, 1)) / unit[..., None]
        at = torch.from_numpy(rows).to(light.device)
        beyond = model.encode(codes, self.frame, light, shape, self.lobes)
        given = model(codes, beyond, self.frame, self.places[at], self.normals[at], self.asked_lobes[at], asked[:, at],
                      found[:, at], self.near[at])
        guide = _tensor(self.sample.guide[rows].T) / unit
        weight = 1 / ((found[:, at].square() + guide.square()) / 2 + EPSILON)
        return given, _tensor(self.truth[rows].transpose(2, 0, 1)) / unit[..., None], weight


def _tensor(array: NDArray) -> Tensor:
    array = array if array.dtype == np.int64 else np.asarray(array, np.float32)
    return torch.from_numpy(np.ascontiguousarray(array)).to(loop.device())


@cache
def room(path: Path) -> Room:
    """Of the cache, kept in memory."""
    return Room(path)


def sums(found: NDArray | None, held: Room) -> tuple[NDArray, NDArray]:
    """(ORDER,) squared error and squared truth of light by direction (n, K, 3) at `held_rows`, by band.

    Without what the truth's own noise is expected to add. None: of PATHS paths at the queries, whose squared error is
    the variance of the truth, of so many fewer paths.
    """
    rows = held_rows(held.sample)
    noise = np.square(held.noise[rows]).sum((0, 2), dtype=np.float64)
    energy = _bands(held.truth[rows]) - noise
    return noise * VALIDATION_RAYS / PATHS if found is None else _bands(found - held.truth[rows]) - noise, energy


def _bands(shape: NDArray) -> NDArray:
    """(ORDER,) sums of squares of (n, K, 3)."""
    return np.add.reduceat(np.square(shape).sum((0, 2), dtype=np.float64), np.arange(ORDER) ** 2)


def by_band(found: NDArray | None, held: Room) -> NDArray:
    """(ORDER,) squared error over squared truth, see `sums`."""
    error, energy = sums(found, held)
    return error / energy


def in_lobe(found: NDArray | None, held: Room, roughness: float) -> float:
    """The same of what a GGX lobe reflects, over all directions."""
    damped = lobes.ggx_attenuation(roughness, ORDER) ** 2
    error, energy = sums(found, held)
    return float(damped @ error / (damped @ energy))


def network(model: nn.Module, held: Room) -> NDArray:
    """What it gives at `held_rows`: (n, K, 3)."""
    with torch.no_grad():
        found, *_ = held.answer(model, held_rows(held.sample))
    return found.permute(1, 2, 0).cpu().numpy() * held.look(0)[0].cpu().numpy()[:, 0]


def near_mean(held: Room, count: int) -> NDArray:
    """(n, K, 3) light by direction of scene points, averaged as `embedding.near_mean` averages irradiance."""
    sample, rows = held.sample, held_rows(held.sample)
    shapes = held.shapes[0].astype(np.float32).reshape(len(sample.points), -1)
    return embedding.near_mean(sample.queries[rows], sample.points, shapes, count).reshape(len(rows), -1, 3)


def lobe(held: Room) -> NDArray:
    """(n, K, 3) the embedding's irradiance as if it came evenly from all of the hemisphere."""
    unit, *_, light = held.look(0)
    rows = held_rows(held.sample)
    return np.einsum("nk,cn->nkc", held.asked_lobes.cpu().numpy()[rows], (light * unit).cpu().numpy()[:, rows])


def table(model: nn.Module, held: list[Room]) -> str:
    """The network beside what needs no training: median of the rooms, and in brackets the mean."""
    untrained = Radiance(trained().settings).to(loop.device()).eval()
    ways: dict[str, Callable[[Room], NDArray] | None] = {
        "network": lambda each: network(model, each), "before training": lambda each: network(untrained, each),
        "irradiance of the embedding, even": lobe,
        **{f"mean of the {count} nearest scene points": lambda each, count=count: near_mean(each, count)  # type: ignore
           for count in (16, 64)}, f"{PATHS} paths at the query": None}
    lines = [f"{'median of the rooms, in brackets the mean':42}" + "".join(f"{f'band {b}':>16}" for b in range(ORDER))
             + "".join(f"{f'roughness {r}':>16}" for r in ROUGHNESS)]
    for name, give in ways.items():
        found = []
        for each in held:
            given = None if give is None else give(each)
            found.append([*by_band(given, each), *(in_lobe(given, each, roughness) for roughness in ROUGHNESS)])
        lines.append(f"{name:42}" + "".join(f"{median:8.3f} ({mean:.3f})" for median, mean in
                                            zip(np.median(found, 0), np.mean(found, 0), strict=True)))
    return "\n".join(lines)


def train(kept: list[Path], held: list[Room], steps: int, seed: int, checkpoint: Path, log: Path) -> Radiance:
    """Train, and write log and checkpoint as we go; on from the checkpoint, where there is one of just this."""
    torch.manual_seed(seed)
    model = Radiance(trained().settings).to(loop.device())

    def loss_of(model: nn.Module, rng: np.random.Generator) -> Tensor:
        drawn = room(kept[rng.integers(len(kept))])
        rows = np.arange(len(drawn.sample.queries))
        given, truth, weight = drawn.answer(model, rows, int(rng.integers(len(drawn.shapes))))
        return ((given - truth).square()[..., 1:].sum(2) * weight).mean()

    def look(model: nn.Module) -> dict[str, float]:
        errors, bands = [], []
        for each in held:
            given, truth, weight = each.answer(model, held_rows(each.sample))
            errors.append(float(((given - truth).square()[..., 1:].sum(2) * weight).mean()))
            bands.append(by_band(network(model, each), each))
        return {"relative": float(np.mean(errors)),
                **{f"band {band}": float(np.median([found[band] for found in bands])) for band in BANDS}}

    return loop.run(model, loss_of, look, steps=steps, rate=RATE, every=EVERY, seed=seed, checkpoint=checkpoint,
                    log=log)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, default=CACHE, help="of labelled rooms, from training.room_labels")
    parser.add_argument("--out", type=Path, default=weights.FOLDER, help="folder of the weights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small, and a second thread that must wait loses tenfold
    kept = rooms(arguments.cache, "train")
    held = [room(path) for path in rooms(arguments.cache, "validation")]
    if not kept or not held:
        parser.error(f"there are too few labelled rooms in '{arguments.cache}'; make them with "
                     "`python -m training.room_labels`")
    log = Path(__file__).parent / "logs" / f"{NAME}.csv"
    model = train(kept, held, arguments.steps, arguments.seed, arguments.cache / f"{NAME}.checkpoint", log)
    arguments.out.mkdir(parents=True, exist_ok=True)
    weights.save(arguments.out / weights.RADIANCE,
                 {name: value.cpu().numpy() for name, value in model.state_dict().items()})
    draw(log, ["loss", "relative"])
    print(f"{len(kept)} rooms, {len(held)} held out\n{table(model, held)}")


if __name__ == "__main__":
    main()
