# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the hybrid's network from nothing: `python -m training.hybrid`; writes the weights that ship, log and curves.

The torch module below is the twin of `backend.hybrid.filtered` (a test holds them to 1e-5); gradients
flow through all passes.
"""
from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from neural_gash_addon.backend import hybrid, weights
from neural_gash_addon.backend import spherical_harmonics as sh

from . import hybrid_data, loop
from .curves import draw

PASSES, HIDDEN = 2, 16
PATCH = 6000          # points of a training example: neighbouring ones of one mesh
STEPS, RATE = 7000, 4e-3
HELD_OUT = 6          # every so many-eth mesh is not trained on
FLOOR = 1e-4          # of the blocked energy: the reference's own noise


class Filter(nn.Module):
    """The passes."""

    def __init__(self, passes: int = PASSES, hidden: int = HIDDEN, order: int = hybrid_data.ORDER) -> None:
        super().__init__()
        self.order = order
        self.passes = nn.ModuleList(
            nn.Sequential(nn.Linear(hybrid.FEATURES, hidden), nn.ReLU(), nn.Linear(hidden, order))
            for _ in range(passes))

    def forward(self, points: Tensor, normals: Tensor, point: Tensor, other: Tensor, blocked: Tensor,
                unshadowed: Tensor, rays: int) -> list[Tensor]:
        """The blocked part (N, K) after each pass; point, other: (L,) pairs of neighbours."""
        order = sh.order_of(blocked.shape[1])
        bands = torch.repeat_interleave(torch.arange(order), 2 * torch.arange(order) + 1)
        away = points[other] - points[point]
        square = (away * away).sum(1) + 1e-14
        inverse = square.rsqrt()
        one, two = normals[point], normals[other]
        still = torch.stack([(one * two).sum(1), (one * away).sum(1) * inverse, -(two * away).sum(1) * inverse,
                             0.25 * square.log(), torch.full_like(square, 0.5 * float(np.log(rays)))], 1)
        even = torch.cat([torch.zeros(len(blocked), 1), unshadowed[:, 1:] / hybrid.FULL], 1)
        now, out = blocked - blocked[:, :1] * even, []
        for network in self.passes:
            mine, theirs = now[point], now[other]
            difference = (mine[:, :4] - theirs[:, :4]).square()
            moving = torch.stack([0.25 * (difference[:, 0] + hybrid._TINY).log(),
                                  0.25 * (difference[:, 1:].sum(1) + hybrid._TINY).log(),
                                  4 * mine[:, 0], 4 * theirs[:, 0]], 1)
            given = network(torch.cat([still, moving], 1)).clamp(hybrid.LEAST, hybrid.MOST).exp()[:, :order]
            given = given * (hybrid.HALF / (hybrid.HALF + rays))
            given = given * ((mine[:, 0] != 0) | (theirs[:, 0] != 0))[:, None]
            total = torch.ones(len(now), order).index_add(0, point, given)
            sums = now.index_add(0, point, theirs * given[:, bands])
            now = sums / total[:, bands]
            out.append(now + now[:, :1] * even)
        return out

    def network(self) -> hybrid.Network:
        """The same for NumPy."""
        return [[hybrid.Layer(layer.weight.detach().numpy().T.copy(), layer.bias.detach().numpy().copy())
                 for layer in network if isinstance(layer, nn.Linear)] for network in self.passes]


class Example:
    """One mesh's data."""

    def __init__(self, path: Path) -> None:
        found = np.load(path)
        self.name = path.stem.rsplit("-", 1)[0]
        self.points = hybrid.normalised(found["points"]).astype(np.float32)
        self.normals = found["normals"]
        self.point = np.repeat(np.arange(len(self.points)), np.diff(found["start"]))
        self.other = found["links"].astype(np.int64)
        self.blocked = {rays: found[f"rays_{rays}"] for rays in hybrid_data.RAYS}
        self.reference = found["reference"]
        self.unshadowed = sh.cosine_lobe(self.normals, hybrid_data.ORDER).astype(np.float32)

    def batch(self, rays: int, rng: np.random.Generator | None) -> tuple:
        """Tensors for `Filter.forward`, and the reference; a patch of the mesh where a generator is given."""
        kept = np.ones(len(self.points), bool)
        if rng is not None and len(kept) > PATCH:
            away = np.square(self.points - self.points[rng.integers(len(kept))]).sum(1)
            kept = away <= np.partition(away, PATCH)[PATCH]
        row = np.cumsum(kept) - 1
        links = kept[self.point] & kept[self.other]
        tensors = (self.points[kept], self.normals[kept], row[self.point[links]], row[self.other[links]],
                   self.blocked[rays][kept], self.unshadowed[kept], self.reference[kept])
        *given, truth = (torch.from_numpy(np.ascontiguousarray(t)) for t in tensors)
        return (*given, rays), truth


def srr(found: Tensor, truth: Tensor) -> Tensor:
    """Shadow residual ratio of blocked parts."""
    return (found - truth).square().sum() / truth.square().sum().clamp_min(1e-12)


def evaluate(model: nn.Module, examples: list[Example], order: int = 3) -> dict[int, tuple[float, float]]:
    """Median SRR before and after, by rays."""
    out = {}
    terms = order * order
    with torch.no_grad():
        for rays in hybrid_data.RAYS:
            found = []
            for example in examples:
                given, truth = example.batch(rays, None)
                given = (*given[:4], given[4][:, :terms].contiguous(), given[5][:, :terms].contiguous(), rays)
                after = model(*given)[-1]
                found.append((float(srr(given[4], truth[:, :terms])), float(srr(after, truth[:, :terms]))))
            out[rays] = tuple(np.median(found, axis=0))
    return out


def train(kept: list[Example], held: list[Example], steps: int, checkpoint: Path, log: Path, passes: int = PASSES,
          hidden: int = HIDDEN, seed: int = 0) -> Filter:
    """Train, and write log and checkpoint as we go; on from the checkpoint, where there is one of just this."""
    torch.manual_seed(seed)

    def loss_of(model: nn.Module, rng: np.random.Generator) -> Tensor:
        while True:
            given, truth = kept[rng.integers(len(kept))].batch(int(rng.choice(hybrid_data.RAYS)), rng)
            if float(truth.square().sum()) >= 1e-6 * len(truth):  # nothing to learn where nothing is blocked
                break
        found = model(*given)
        return (srr(found[-1], truth) + FLOOR).log() + 0.1 * (srr(found[0], truth) + FLOOR).log()

    def look(model: nn.Module) -> dict[str, float]:
        found = {rays: after for rays, (_, after) in evaluate(model, held).items()}
        mean = float(np.exp(np.mean(np.log(list(found.values())))))
        return {"srr": mean, **{f"srr_{rays}": after for rays, after in found.items()}}

    # patches are small and of irregular shape: a GPU would wait for them
    return loop.run(Filter(passes, hidden), loss_of, look, steps=steps, rate=RATE, every=500, seed=seed,
                    checkpoint=checkpoint, log=log)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--passes", type=int, default=PASSES)
    parser.add_argument("--hidden", type=int, default=HIDDEN)
    parser.add_argument("--out", type=Path, default=weights.FOLDER, help="folder of the weights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small: a second thread gains a third, and loses tenfold where it must wait
    paths = sorted(hybrid_data.CACHE.glob("*.npz"))
    examples = [Example(path) for path in paths]
    held = examples[::HELD_OUT]
    kept = [e for e in examples if e not in held]
    log = Path(__file__).parent / "logs" / "hybrid.csv"
    model = train(kept, held, arguments.steps, hybrid_data.CACHE / "hybrid.checkpoint", log, arguments.passes,
                  arguments.hidden)
    draw(log, [f"srr_{rays}" for rays in (2, 4, 8, 16, 32)])
    arguments.out.mkdir(parents=True, exist_ok=True)
    weights.save_hybrid(arguments.out / weights.HYBRID, model.network())
    for rays, (before, after) in evaluate(model, held).items():
        print(f"{rays:4d} rays: SRR {before:.4f} -> {after:.4f}")


if __name__ == "__main__":
    main()
