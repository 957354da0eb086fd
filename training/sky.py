# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the embedding for the light of the sky: `make data`, then `python -m training.sky`; writes weights and a log.

Each step takes one mesh, one of LOOKS noisy traces at its scene points, and some of its labelled points as queries. The
loss is the logarithm of SRR, so a mesh with few shadows counts as much as one with many. Nothing is turned or scaled,
as the answer turns by construction.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neural_gash_addon.backend import embedding, sky_bake, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.nearest import nearest_to
from neural_gash_addon.backend.networks.embedding import Frame, Settings
from neural_gash_addon.backend.networks.sky import SKY, SkyEmbedding
from neural_gash_addon.backend.progress import run
from neural_gash_addon.backend.raycast import Occluders

from . import data, labels, loop
from .curves import draw

NAME = "sky"
STEPS, RATE, EVERY = 3_000, 1.5e-3, 100
QUERIES = 2048       # of a step
LOOKS = 2            # traces of the scene points, each with rays of its own
MOST_POINTS = 40_000
HELD_OUT = 0.1       # of the meshes
JUDGED = 1500        # points of a held-out mesh
FLOOR = 1e-4         # of a point's blocked part, squared, so that a mesh without shadows does not decide
TERMS = 9            # that are judged; the others count in the loss by a third


@dataclass(frozen=True, eq=False)
class Sample:
    """A labelled mesh, with what never changes of it."""

    points: list[sky_bake.ScenePoints]  # of each look; places and normals are the same
    layout: embedding.Layout
    places: NDArray[np.float32]         # (N, 3) queries, in the scale of the scene points
    normals: NDArray[np.float32]        # (N, 3) unit
    near: NDArray[np.int32]             # (N, k) scene points nearest to each
    parents: NDArray[np.int64]          # (M,) code nearest to each scene point
    truth: NDArray[np.float32]          # (N, 25) blocked part, and the noise of 1024 rays
    even: NDArray[np.float32]           # (N, 25) what a sky that is all blocked blocks of each, over hybrid.FULL


@cache
def load(path: Path, settings: Settings = SKY) -> Sample | None:
    """A mesh of the cache, kept in memory; None where nothing of it can be asked."""
    found = labels.load(path)
    rows = np.flatnonzero(np.any(found.normals != 0, axis=1))
    mesh = TriangleMesh.from_triangles(found.positions, found.triangles)
    occluders = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    points = [run(sky_bake.scene_points(mesh, occluders, seed=0, threads=1))]
    surface = sky_bake.on_surface(mesh, sky_bake.POINTS, 0)
    if not len(surface.points) or not len(rows):
        return None
    for seed in range(1, LOOKS):
        blocked = run(sky_bake.traced(surface, occluders, sh.MAX_ORDER, sky_bake.RAYS, seed, 1))
        points.append(sky_bake.ScenePoints(points[0].places, points[0].normals,
                                           sky_bake.split(blocked, surface.normals), sky_bake.RAYS))
    layout = embedding.layout(points[0].places, settings.halvings, settings.gathered, settings.around)
    places, normals = sky_bake.in_scale(found.positions[rows], occluders), found.normals[rows]
    near = nearest_to(places, points[0].places, settings.neighbours)
    parents = nearest_to(points[0].places, points[0].places[:len(layout.around)], 1)[:, 0]
    unshadowed = sh.cosine_lobe(normals, sh.MAX_ORDER)
    even = unshadowed / sky_bake.FULL
    even[:, 0] = 0
    return Sample(points, layout, places, normals, near.astype(np.int32), parents,
                  (unshadowed - found.coefficients[rows]).astype(np.float32), even.astype(np.float32))


def answer(model: nn.Module, sample: Sample, rows: NDArray, look: int = 0) -> tuple[Tensor, Tensor]:
    """The blocked part (n, 25) at some queries: the network's, and the truth."""
    where = loop.device()

    def tensor(array: NDArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(where)

    points = sample.points[look]
    frame = Frame.of(tensor(points.places), tensor(points.normals), sample.layout)
    codes = model.encoder(frame, tensor(points.blocked), tensor(sample.parents))
    found = model.decoder(codes, frame, tensor(sample.places[rows]), tensor(sample.normals[rows]),
                          tensor(sample.near[rows].astype(np.int64)))
    return found + found[:, :1] * tensor(sample.even[rows]), tensor(sample.truth[rows])


def residual(found: Tensor, truth: Tensor) -> Tensor:
    """SRR, of a mesh with few shadows less than that."""
    floor = FLOOR * len(truth)
    return ((found - truth).square().sum() + floor) / (truth.square().sum() + floor)


def loss(found: Tensor, truth: Tensor) -> Tensor:
    """Of one mesh."""
    return residual(found[:, :TERMS], truth[:, :TERMS]).log() + residual(found, truth).log() / 3


def near_mean(count: int) -> Callable[[Sample, NDArray], NDArray]:
    """The blocked part as the mean of that of the scene points nearest to each query, by distance and normal."""
    def give(sample: Sample, rows: NDArray) -> NDArray:
        points = sample.points[0]
        near = nearest_to(sample.places[rows], points.places, count)
        square = np.square(points.places[near] - sample.places[rows, None]).sum(2)
        facing = (points.normals[near] * sample.normals[rows, None]).sum(2)
        weight = np.exp(-2 * square / square.mean(1, keepdims=True).clip(1e-20)) * np.exp(4 * (facing - 1))
        found = np.einsum("nk,nkc->nc", weight / weight.sum(1, keepdims=True), points.blocked[near])
        return found + found[:, :1] * sample.even[rows]

    return give


def judged(give: Callable[[Sample, NDArray], NDArray | Tensor], held: list[Sample]) -> list[float]:
    """SRR of each held-out mesh, always of the same points."""
    out = []
    for sample in held:
        rows = np.random.default_rng(5).permutation(len(sample.places))[:JUDGED]
        truth = sample.truth[rows, :TERMS]
        error = np.square(np.asarray(give(sample, rows))[:, :TERMS] - truth).sum()
        out.append(float(error / max(np.square(truth).sum(), 1e-9)))
    return out


def network(model: nn.Module) -> Callable[[Sample, NDArray], NDArray]:
    """What it gives."""
    def give(sample: Sample, rows: NDArray) -> NDArray:
        with torch.no_grad():
            return answer(model, sample, rows)[0].cpu().numpy()

    return give


def train(kept: list[Sample], held: list[Sample], steps: int, seed: int, checkpoint: Path, log: Path) -> SkyEmbedding:
    """Train, and write log and checkpoint as we go; on from the checkpoint, where there is one of just this."""
    torch.manual_seed(seed)
    model = SkyEmbedding(SKY).to(loop.device())

    def loss_of(model: nn.Module, rng: np.random.Generator) -> Tensor:
        sample = kept[rng.integers(len(kept))]
        rows = rng.permutation(len(sample.places))[:QUERIES]
        found, truth = answer(model, sample, rows, int(rng.integers(LOOKS)))
        return loss(found.float(), truth)

    def look(model: nn.Module) -> dict[str, float]:
        found = judged(network(model), held)
        return {"srr_log": float(np.mean(np.log(found))), "srr_median": float(np.median(found)),
                "srr_mean": float(np.mean(found))}

    return loop.run(model, loss_of, look, steps=steps, rate=RATE, every=EVERY, seed=seed, checkpoint=checkpoint,
                    log=log)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--meshes", type=int, default=300, help="at most, of the cache")
    parser.add_argument("--cache", type=Path, default=data.CACHE, help="of labelled meshes, from training.data")
    parser.add_argument("--out", type=Path, default=weights.FOLDER, help="folder of the weights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small, and a second thread that must wait loses tenfold
    kept, held = ([sample for sample in part if sample is not None]
                  for part in data.sources(load, arguments.cache, arguments.meshes, MOST_POINTS, HELD_OUT))
    if not kept or not held:
        parser.error(f"there are too few labelled meshes in '{arguments.cache}'; make them with `make data`")
    log = Path(__file__).parent / "logs" / f"{NAME}.csv"
    model = train(kept, held, arguments.steps, arguments.seed, arguments.cache / f"{NAME}.checkpoint", log)
    arguments.out.mkdir(parents=True, exist_ok=True)
    weights.save(arguments.out / weights.SKY,
                 {name: value.cpu().numpy() for name, value in model.state_dict().items()})
    draw(log, ["srr_median", "srr_mean"])
    print(f"{len(kept)} meshes, {len(held)} held out; SRR: median, mean, worst")
    untrained = SkyEmbedding(SKY).to(loop.device()).eval()
    means = {f"mean of the {count} nearest scene points": near_mean(count) for count in (4, 16, 64)}
    for name, give in {"network": network(model), "before training": network(untrained), **means}.items():
        found = judged(give, held)
        print(f"{name:40} {np.median(found):.4f} {np.mean(found):.4f} {max(found):.4f}")


if __name__ == "__main__":
    main()
