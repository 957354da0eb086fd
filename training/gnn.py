# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the `gnn` from nothing: `make data`, then `python -m training.gnn`; writes weights that ship, log and curves.

The torch module below is the twin of `backend.gnn.answer` (a test holds them to 1e-5); what it reads is made by the
code that makes it in the add-on. Every step takes some points of one mesh, turned at random.
"""
from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from neural_gash_addon.backend import cones, gnn, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.conformal import DIRECTION_COUNT

from . import data, labels, loop
from .curves import draw

CONE = (32, 12)                # units of stage 1
POINT = (128, 64)              # of stage 2
STEPS, RATE = 12_000, 2e-3
POINTS = 3000                  # of a step
MOST_POINTS = 60_000           # of a mesh in memory
FLOOR = 3e-4                   # of the unshadowed energy: the labels' own noise, and what no eye sees
PARTS = 0.3                    # of the steps see a part of the mesh as what is baked, and the rest as its occluders
HELD_OUT = 0.1
EVERY = 1000                   # steps, the held-out meshes are looked at and all is saved


class Net(nn.Module):
    """Both stages."""

    def __init__(self, cone: tuple[int, int] = CONE, point: tuple[int, int] = POINT) -> None:
        super().__init__()
        self.direction = nn.Parameter(torch.zeros(DIRECTION_COUNT, cone[0]))
        self.cone = nn.ModuleList([nn.Linear(cones.STEPS * cones.CHANNELS, cone[0]), nn.Linear(*cone)])
        sizes = (DIRECTION_COUNT * cone[1], *point, gnn.ORDER ** 2)
        self.point = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes[:-1], sizes[1:], strict=True))
        nn.init.zeros_(self.point[-1].weight)

    def forward(self, seen: Tensor) -> Tensor:
        """The blocked part (n, K) in the motor's frame, of what `cones.read` gives, dense: (F, 25, n)."""
        now = self.cone[0](seen.permute(2, 1, 0)) + self.direction
        now = self.cone[1](now.relu()).relu()          # (n, 25, units)
        now = now.transpose(1, 2).flatten(1)
        for layer in self.point[:-1]:
            now = layer(now).relu()
        return self.point[-1](now)

    def network(self) -> dict[str, np.ndarray]:
        """The same for NumPy."""
        return {name: value.detach().cpu().numpy().copy() for name, value in self.state_dict().items()}


def example(sample: labels.Sample, count: int, rng: np.random.Generator, parts: float = PARTS
            ) -> tuple[Tensor, Tensor]:
    """What some points of a mesh turned at random see (F, 25, n), and their blocked part (n, K) in their frames.

    parts: how often only a part of the mesh is what is baked. Its labels are the same: the rest still blocks.
    """
    turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    positions = sample.positions.astype(np.float64) @ turn.T
    geometry = [(positions, sample.triangles)]
    if rng.random() < parts:
        inside = near(positions, sample.triangles, rng)
        geometry = [(positions, part) for part in (sample.triangles[inside], sample.triangles[~inside]) if len(part)]
    candidates = np.unique(geometry[0][1])
    rows = rng.choice(candidates, min(count, len(candidates)), replace=False)
    rows = rows[np.any(sample.normals[rows] != 0, axis=1)]
    normals = sample.normals[rows].astype(np.float64) @ turn.T
    frames = gnn.frames_of(normals, over=bool(rng.integers(2)))
    voxels = cones.pyramid(geometry)
    chunks = [slice(at, at + gnn.CHUNK) for at in range(0, len(rows), gnn.CHUNK)]
    seen = np.concatenate([cones.read(voxels, positions[rows[here]], normals[here], frames[here]).dense()
                           for here in chunks], 2)
    blocked = sh.cosine_lobe(sample.normals[rows], labels.ORDER) - sample.coefficients[rows]
    local = sh.rotate_each(blocked, frames.transpose(0, 2, 1) @ turn)
    return torch.from_numpy(seen), torch.from_numpy(local.astype(np.float32))


def near(positions: np.ndarray, triangles: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(F,) triangles in a ball about some vertex; all, where those are few."""
    away = np.square(positions - positions[triangles[rng.integers(len(triangles)), 0]]).sum(1)
    inside = (away <= np.quantile(away, rng.uniform(0.05, 0.7)))[triangles].all(1)
    return inside if inside.sum() >= 100 else np.ones_like(inside)


def evaluate(model: nn.Module, held: list[labels.Sample], terms: int = 9) -> list[float]:
    """SRR of each held-out mesh, always of the same points."""
    rng = np.random.default_rng(5)
    out = []
    with torch.no_grad():
        for sample in held:
            seen, truth = (tensor.to(loop.device()) for tensor in example(sample, 1500, rng, parts=0))
            error = (model(seen) - truth)[:, :terms].square().sum()
            out.append(float(error / truth[:, :terms].square().sum().clamp_min(1e-9)))
    return out


def train(kept: list[labels.Sample], held: list[labels.Sample], steps: int, seed: int, checkpoint: Path, log: Path
          ) -> Net:
    """Train, and write log and checkpoint as we go; on from the checkpoint, where there is one of just this."""
    torch.manual_seed(seed)
    model = Net().to(loop.device())

    def loss_of(model: nn.Module, rng: np.random.Generator) -> Tensor:
        seen, truth = (tensor.to(loop.device()) for tensor in example(kept[rng.integers(len(kept))], POINTS, rng))
        floor = FLOOR * len(truth)
        return (((model(seen).float() - truth).square().sum() + floor) / (truth.square().sum() + floor)).log()

    def look(model: nn.Module) -> dict[str, float]:
        found = evaluate(model, held)
        return {"srr_mean": float(np.mean(found)), "srr_median": float(np.median(found)), "srr_worst": max(found)}

    return loop.run(model, loss_of, look, steps=steps, rate=RATE, every=EVERY, seed=seed, checkpoint=checkpoint,
                    log=log)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--meshes", type=int, default=600, help="at most, of the cache")
    parser.add_argument("--cache", type=Path, default=data.CACHE, help="of labelled meshes, from training.data")
    parser.add_argument("--out", type=Path, default=weights.FOLDER, help="folder of the weights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small, and a second thread that must wait loses tenfold
    sets = data.sources(labels.load, arguments.cache, arguments.meshes, MOST_POINTS, HELD_OUT)
    if not all(sets):
        parser.error(f"there are too few labelled meshes in '{arguments.cache}'; make them with `make data`")
    log = Path(__file__).parent / "logs" / "gnn.csv"
    model = train(*sets, arguments.steps, arguments.seed, arguments.cache / "gnn.checkpoint", log)
    arguments.out.mkdir(parents=True, exist_ok=True)
    weights.save(arguments.out / weights.GNN, model.network())
    draw(log, ["srr_median", "srr_mean"])
    found = evaluate(model, sets[1])
    print(f"{len(sets[0])} meshes, {len(sets[1])} held out: SRR median {np.median(found):.4f}, "
          f"mean {np.mean(found):.4f}, worst {max(found):.4f}")


if __name__ == "__main__":
    main()
