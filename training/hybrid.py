# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the hybrid from nothing: `make data`, then `python -m training.hybrid`; writes weights, log and curves.

The torch module below is the twin of `backend.hybrid.filtered` (a test holds them to 1e-5); gradients flow through both
passes. What few rays see is traced anew in every step, so no noise is seen twice.
"""
from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from neural_gash_addon.backend import hybrid, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.estimator import BlockedEstimator
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.raycast import Occluders

from . import data, labels, loop
from .curves import draw

PASSES, HIDDEN = 2, 32
RAYS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 64, 128, 256)
PATCH = 2048          # points of a training example: neighbouring ones of one mesh
STEPS, RATE, EVERY = 1600, 5e-3, 200
MOST_POINTS = 30_000  # of a mesh
HELD_OUT = 0.1
FLOOR = 1e-4          # of the blocked energy: the reference's own noise


class Filter(nn.Module):
    """Both passes."""

    def __init__(self, passes: int = PASSES, hidden: int = HIDDEN) -> None:
        super().__init__()
        outputs = hybrid.FORMS + labels.ORDER
        self.passes = nn.ModuleList(
            nn.Sequential(nn.Linear(hybrid.CONTEXT, hidden), nn.ReLU(), nn.Linear(hidden, outputs))
            for _ in range(passes))
        for network in self.passes:
            nn.init.constant_(network[-1].bias, 1.0)

    def forward(self, places: Tensor, normals: Tensor, orders: list[Tensor], blocked: Tensor, unshadowed: Tensor,
                rays: int) -> list[Tensor]:
        """The blocked part (N, K) after each pass."""
        even = torch.cat([torch.zeros(len(blocked), 1), unshadowed[:, 1:] / hybrid.FULL], 1)
        now, out = blocked - blocked[:, :1] * even, []
        for order, network in zip(orders, self.passes, strict=True):
            rows = torch.from_numpy(hybrid.blocks(order.numpy()))
            mixed = self._mixed(places[rows], normals[rows], now[rows], rays, network).flatten(0, 1)
            again = rows.numel() - len(order)  # at the beginning of the last block
            last = rows.numel() - rows.shape[1]
            now = torch.empty_like(now).index_copy(0, order, torch.cat([mixed[:last], mixed[last + again:]]))
            out.append(now + now[:, :1] * even)
        return out

    @staticmethod
    def _mixed(places: Tensor, normals: Tensor, values: Tensor, rays: int, network: nn.Module) -> Tensor:
        bands = sh.order_of(values.shape[2])
        away = places - places.mean(1, keepdim=True)
        size = away.square().sum((1, 2)).div(away.shape[1]).sqrt() + 1e-9
        away = away / size[:, None, None]
        share = values[..., 0]
        context = torch.stack([
            0.5 * size.log(), 2 * normals.mean(1).square().sum(1), 4 * share.mean(1),
            0.5 * (share.var(1, unbiased=False) + hybrid.TINY).log(),
            0.5 * (values[..., 1:4].var(1, unbiased=False).sum(1) + hybrid.TINY).log(),
            torch.full_like(size, 0.5 * float(np.log(rays))),
            torch.full_like(size, float(np.log(values.shape[1])) - 3)], 1)
        given = network(context).clamp(hybrid.LEAST, hybrid.MOST).exp()
        distance, plane, facing, first, second = given[:, :hybrid.FORMS].T[..., None, None]
        apart = away[:, :, None] - away[:, None]  # (b, i, j, 3)
        differ = (values[:, :, None, :4] - values[:, None, :, :4]).square()
        form = (distance * apart.square().sum(-1) + facing * (1 - normals @ normals.swapaxes(1, 2))
                + first * differ[..., 0] + second * differ[..., 1:].sum(-1)
                + plane * (apart * normals[:, :, None]).sum(-1).square())
        weight = torch.exp(-form.clamp_min(0))
        # as it seems to the blocks of which all is open, which NumPy leaves alone
        seen = (share != 0).any(1)[:, None, None]
        band = torch.repeat_interleave(torch.arange(bands), 2 * torch.arange(bands) + 1)
        own = given[:, hybrid.FORMS:][:, band][:, None] * ((hybrid.HALF + rays) / hybrid.HALF)
        mean = (own * values + weight @ values) / (own + weight.sum(2, keepdim=True))
        return torch.where(seen, mean, values)

    def network(self) -> hybrid.Network:
        """The same for NumPy."""
        return [[hybrid.Layer(layer.weight.detach().numpy().T.copy(), layer.bias.detach().numpy().copy())
                 for layer in network if isinstance(layer, nn.Linear)] for network in self.passes]


class Source:
    """A labelled mesh, and what traces it."""

    def __init__(self, path: Path) -> None:
        sample = labels.load(path)
        self.mesh = TriangleMesh.from_triangles(sample.positions, sample.triangles)
        lit = np.any(sample.normals != 0, axis=1)
        self.mesh = replace(self.mesh, points=sample.positions[lit].astype(np.float64),
                            normals=sample.normals[lit].astype(np.float64),
                            clearance=sample.normals[lit].astype(np.float64))
        self.unshadowed = sample.unshadowed[lit].astype(np.float32)
        self.truth = (sample.unshadowed - sample.coefficients)[lit].astype(np.float32)
        self.places, self.normals = hybrid.placed(self.mesh.points, self.mesh.normals)
        self.scene: Occluders | None = None  # made when it is first traced

    def batch(self, rays: int, rng: np.random.Generator, patch: int, order: int = labels.ORDER) -> tuple[tuple, Tensor]:
        """Arguments for `Filter.forward`, and the truth (n, K); of a patch of the mesh, or of all if that is less."""
        points = self.mesh.points
        rows = np.arange(len(points))
        if len(rows) > patch:
            away = np.square(points - points[rng.integers(len(rows))]).sum(1)
            rows = np.argpartition(away, patch)[:patch]
        if self.scene is None:
            self.scene = Occluders([(self.mesh.positions, self.mesh.triangles)])
        mesh = replace(self.mesh, points=points[rows], normals=self.mesh.normals[rows],
                       clearance=self.mesh.clearance[rows])
        estimator = BlockedEstimator(mesh, self.scene, order, int(rng.integers(2**31)), rays)
        every = np.arange(len(rows))
        local = estimator.means(every, estimator.summed(every, 0, rays), 0, rays)
        blocked = estimator.turned_here(every, local)
        places = self.places[rows]
        turned = places @ Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        terms = order * order
        arrays = places, self.normals[rows], blocked, self.unshadowed[rows, :terms], self.truth[rows, :terms]
        places, normals, blocked, unshadowed, truth = (torch.from_numpy(np.ascontiguousarray(a, np.float32))
                                                       for a in arrays)
        return (places, normals, [torch.from_numpy(o) for o in hybrid.curves(turned)], blocked, unshadowed, rays), truth


def srr(found: Tensor, truth: Tensor) -> Tensor:
    """Shadow residual ratio of blocked parts."""
    return (found - truth).square().sum() / truth.square().sum().clamp_min(1e-12)


def evaluate(model: nn.Module, held: list[Source]) -> dict[int, tuple[float, float]]:
    """Median SRR before and after, by rays; order 3, always the same rays."""
    out = {}
    with torch.no_grad():
        for rays in (2, 4, 8, 16, 32):
            found = []
            for number, source in enumerate(held):
                given, truth = source.batch(rays, np.random.default_rng([rays, number]), PATCH, 3)
                if float(truth.square().sum()) >= 1e-6 * len(truth):
                    found.append((float(srr(given[3], truth)), float(srr(model(*given)[-1], truth))))
            out[rays] = tuple(np.median(found, axis=0))
    return out


def train(kept: list[Source], held: list[Source], steps: int, seed: int, checkpoint: Path, log: Path,
          hidden: int = HIDDEN) -> Filter:
    """Train, and write log and checkpoint as we go; on from the checkpoint, where there is one of just this."""
    torch.manual_seed(seed)

    def loss_of(model: nn.Module, rng: np.random.Generator) -> Tensor:
        while True:
            given, truth = kept[rng.integers(len(kept))].batch(int(rng.choice(RAYS)), rng, PATCH)
            if float(truth.square().sum()) >= 1e-6 * len(truth):  # nothing to learn where nothing is blocked
                break
        found = model(*given)
        return (srr(found[-1], truth) + FLOOR).log() + 0.1 * (srr(found[0], truth) + FLOOR).log()

    def look(model: nn.Module) -> dict[str, float]:
        found = {rays: after for rays, (_, after) in evaluate(model, held).items()}
        return {"srr": float(np.exp(np.mean(np.log(list(found.values()))))),
                **{f"srr_{rays}": after for rays, after in found.items()}}

    # on the CPU even beside a GPU: a step is a few milliseconds of each, and the rays are traced here
    return loop.run(Filter(hidden=hidden), loss_of, look, steps=steps, rate=RATE, every=min(EVERY, steps), seed=seed,
                    checkpoint=checkpoint, log=log)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hidden", type=int, default=HIDDEN)
    parser.add_argument("--meshes", type=int, default=300, help="at most, of the cache")
    parser.add_argument("--cache", type=Path, default=data.CACHE, help="of labelled meshes, from training.data")
    parser.add_argument("--out", type=Path, default=weights.FOLDER, help="folder of the weights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small: a second thread gains a third, and loses tenfold where it must wait
    sets = data.sources(Source, arguments.cache, arguments.meshes, MOST_POINTS, HELD_OUT)
    if not all(sets):
        parser.error(f"there are too few labelled meshes in '{arguments.cache}'; make them with `make data`")
    log = Path(__file__).parent / "logs" / "hybrid.csv"
    model = train(*sets, arguments.steps, arguments.seed, arguments.cache / "hybrid.checkpoint", log, arguments.hidden)
    draw(log, [f"srr_{rays}" for rays in (2, 4, 8, 16, 32)])
    arguments.out.mkdir(parents=True, exist_ok=True)
    weights.save_hybrid(arguments.out / weights.HYBRID, model.network())
    print(f"{len(sets[0])} meshes, {len(sets[1])} held out")
    for rays, (before, after) in evaluate(model, sets[1]).items():
        print(f"{rays:4d} rays: SRR {before:.4f} -> {after:.4f}")


if __name__ == "__main__":
    main()
