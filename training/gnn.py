# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the `gnn` from nothing: `make data`, then `python -m training.gnn`; writes weights that ship, log and curves.

The torch module below is the twin of `backend.gnn.answer` (a test holds them to 1e-5); what it reads is made by the
code that makes it in the add-on. Every step takes some points of one mesh, turned at random.
"""
from __future__ import annotations

import argparse
import copy
import csv
import time
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn
from tqdm import trange

from neural_gash_addon.backend import cones, gnn, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.conformal import DIRECTION_COUNT

from . import data, labels
from .curves import draw

CONE = (48, 16)                # units of stage 1
POINT = (160, 96)              # of stage 2
STEPS, RATE, WARM_UP = 12_000, 2e-3, 300
POINTS = 3000                  # of a step
MOST_POINTS = 60_000           # of a mesh in memory
FLOOR = 3e-4                   # of the unshadowed energy: the labels' own noise, and what no eye sees
AVERAGED = 0.999               # of the running mean of the weights, which is what ships
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
        """The blocked part (n, K) in the motor's frame, of what `cones.read` gives: (F, 25, n)."""
        now = self.cone[0](seen.permute(2, 1, 0)) + self.direction
        now = self.cone[1](now.relu()).relu()          # (n, 25, units)
        now = now.transpose(1, 2).flatten(1)
        for layer in self.point[:-1]:
            now = layer(now).relu()
        return self.point[-1](now)

    def network(self) -> dict[str, np.ndarray]:
        """The same for NumPy."""
        return {name: value.detach().numpy().copy() for name, value in self.state_dict().items()}


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
    seen = np.concatenate([cones.read(voxels, positions[rows[here]], normals[here], frames[here])
                           for here in chunks], 2)
    blocked = sh.cosine_lobe(sample.normals[rows], labels.ORDER) - sample.coefficients[rows]
    local = sh.rotate_each(blocked, frames.transpose(0, 2, 1) @ turn)
    return torch.from_numpy(seen), torch.from_numpy(local.astype(np.float32))


def near(positions: np.ndarray, triangles: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(F,) triangles in a ball about some vertex; all, where those are few."""
    away = np.square(positions - positions[triangles[rng.integers(len(triangles)), 0]]).sum(1)
    inside = (away <= np.quantile(away, rng.uniform(0.05, 0.7)))[triangles].all(1)
    return inside if inside.sum() >= 100 else np.ones_like(inside)


def evaluate(model: Net, held: list[labels.Sample], terms: int = 9) -> list[float]:
    """SRR of each held-out mesh, always of the same points."""
    rng = np.random.default_rng(5)
    out = []
    with torch.no_grad():
        for sample in held:
            seen, truth = example(sample, 1500, rng, parts=0)
            error = (model(seen) - truth)[:, :terms].square().sum()
            out.append(float(error / truth[:, :terms].square().sum().clamp_min(1e-9)))
    return out


class Trainer:
    """The state of a training, which is saved as it goes on."""

    def __init__(self, steps: int, seed: int, checkpoint: Path) -> None:
        torch.manual_seed(seed)
        self.model = Net()
        self.mean = copy.deepcopy(self.model)
        self.optimiser = torch.optim.AdamW(self.model.parameters(), RATE, weight_decay=1e-3)
        self.steps, self.step, self.seconds, self.seed, self.checkpoint = steps, 0, 0.0, seed, checkpoint
        self.rows: list[list[float]] = []
        if checkpoint.exists():
            kept = torch.load(checkpoint, weights_only=True)
            if (kept["steps"], kept["seed"]) == (steps, seed):
                self.model.load_state_dict(kept["model"])
                self.mean.load_state_dict(kept["mean"])
                self.optimiser.load_state_dict(kept["optimiser"])
                self.step, self.seconds, self.rows = kept["step"], kept["seconds"], kept["rows"]

    def save(self) -> None:
        """Write the checkpoint, whole or not at all."""
        draft = self.checkpoint.with_suffix(".draft")
        torch.save({"steps": self.steps, "seed": self.seed, "model": self.model.state_dict(),
                    "mean": self.mean.state_dict(), "optimiser": self.optimiser.state_dict(), "step": self.step,
                    "seconds": self.seconds, "rows": self.rows}, draft)
        draft.replace(self.checkpoint)

    def rate(self) -> float:
        """Of this step: a short rise, then half a cosine."""
        return RATE * min(1.0, (self.step + 1) / WARM_UP) * 0.5 * (1 + float(np.cos(np.pi * self.step / self.steps)))

    def take(self, seen: Tensor, truth: Tensor) -> float:
        """One step; its loss."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate()
        floor = FLOOR * len(truth)
        loss = (((self.model(seen) - truth).square().sum() + floor) / (truth.square().sum() + floor)).log()
        self.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        self.optimiser.step()
        with torch.no_grad():
            for kept, now in zip(self.mean.parameters(), self.model.parameters(), strict=True):
                kept.lerp_(now, 1 - min(AVERAGED, (self.step + 1) / (self.step + 10)))
        self.step += 1
        return loss.item()


def train(kept: list[labels.Sample], held: list[labels.Sample], steps: int, seed: int, checkpoint: Path, log: Path
          ) -> Net:
    """Train, and write log and checkpoint as we go; on from the checkpoint, where there is one of just this."""
    trainer = Trainer(steps, seed, checkpoint)
    began = time.time() - trainer.seconds
    losses: list[float] = []
    for step in trange(trainer.step, steps, initial=trainer.step, total=steps, desc="training"):
        rng = np.random.default_rng([seed, step])
        losses.append(trainer.take(*example(kept[rng.integers(len(kept))], POINTS, rng)))
        if trainer.step % EVERY == 0 or trainer.step == steps:
            found = evaluate(trainer.mean, held)
            trainer.seconds = time.time() - began
            trainer.rows.append([trainer.step, round(trainer.seconds), round(float(np.mean(losses)), 4),
                                 *(round(float(f(found)), 5) for f in (np.median, np.mean, np.max))])
            losses = []
            trainer.save()
            with log.open("w", newline="") as file:
                csv.writer(file).writerows([["step", "seconds", "loss", "srr_median", "srr_mean", "srr_worst"],
                                            *trainer.rows])
    return trainer.mean


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, default=data.CACHE, help="of labelled meshes, from training.data")
    parser.add_argument("--out", type=Path, default=weights.FOLDER, help="folder of the weights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # steps are small, and a second thread that must wait loses tenfold
    paths = [path for path in sorted(arguments.cache.glob("*.npz")) if data.is_whole(path)]
    sets = [[sample for sample in map(labels.load, part) if len(sample.positions) <= MOST_POINTS]
            for part in data.split(paths, HELD_OUT)]
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
