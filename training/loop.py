# SPDX-License-Identifier: GPL-3.0-or-later
"""What all trainings share: steps of AdamW, a running mean of the weights, checkpoints, early stop and a log.

A training that was stopped goes on from its last checkpoint as if it had not been: whatever is drawn at random in a
step is drawn from the seed and the number of the step.
"""
from __future__ import annotations

import copy
import csv
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import trange

AVERAGED = 0.999   # of the running mean of the weights, which is what is judged and kept
CLIP = 1.0         # norm of the gradients
WARM_UP = 0.03     # of all steps, the rate rises; then it falls along half a cosine
PATIENCE = 8       # looks at the held-out meshes without progress, after which a training ends

Loss = Callable[[nn.Module, np.random.Generator], Tensor]
Look = Callable[[nn.Module], dict[str, float]]
Model = TypeVar("Model", bound=nn.Module)
_LOGGER = logging.getLogger(__name__)


def device() -> torch.device:
    """Where trainings run: the GPU, if there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


class Training:
    """The state of one training, which is saved as it goes on."""

    def __init__(self, model: nn.Module, steps: int, rate: float, seed: int) -> None:
        """model: on its device, with weights drawn from `seed`."""
        self.model, self.mean, self.best = model, copy.deepcopy(model), copy.deepcopy(model)
        self.steps, self.rate, self.seed = steps, rate, seed
        self.optimiser = torch.optim.AdamW(model.parameters(), rate, weight_decay=1e-3)
        self.where = next(model.parameters()).device
        self.mixed = self.where.type == "cuda"
        self.scaler = torch.amp.GradScaler(self.where.type, enabled=self.mixed)
        self.step, self.seconds, self.since = 0, 0.0, 0  # since: looks since the best one
        self.rows: list[dict[str, float]] = []

    _PARTS = ("model", "mean", "best", "optimiser", "scaler")
    _NUMBERS = ("step", "seconds", "since", "rows")

    def save(self, path: Path) -> None:
        """Write a checkpoint, whole or not at all."""
        draft = path.with_suffix(".draft")
        torch.save({"steps": self.steps, "rate": self.rate, "seed": self.seed,
                    **{name: getattr(self, name).state_dict() for name in self._PARTS},
                    **{name: getattr(self, name) for name in self._NUMBERS}}, draft)
        draft.replace(path)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint, if there is one of just this training."""
        if not path.exists():
            return
        kept = torch.load(path, weights_only=True, map_location=self.where)
        shapes = {name: value.shape for name, value in kept["model"].items()}
        if ((kept["steps"], kept["rate"], kept["seed"]) != (self.steps, self.rate, self.seed)
                or shapes != {name: value.shape for name, value in self.model.state_dict().items()}):
            _LOGGER.warning("'%s' is of another training, which begins anew.", path)
            return
        for name in self._PARTS:
            getattr(self, name).load_state_dict(kept[name])
        for name in self._NUMBERS:
            setattr(self, name, kept[name])

    def rate_now(self) -> float:
        """Of this step."""
        rise = min(1.0, (self.step + 1) / (WARM_UP * self.steps + 1))
        return self.rate * rise * 0.5 * (1 + float(np.cos(np.pi * self.step / self.steps)))

    def take(self, loss_of: Loss) -> float:
        """One step; its loss."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate_now()
        torch.manual_seed(hash((self.seed, self.step)))
        with torch.autocast(self.where.type, enabled=self.mixed):
            loss = loss_of(self.model, np.random.default_rng([self.seed, self.step]))
        self.optimiser.zero_grad()
        self.scaler.scale(loss).backward()
        self.scaler.unscale_(self.optimiser)
        nn.utils.clip_grad_norm_(self.model.parameters(), CLIP)
        self.scaler.step(self.optimiser)
        self.scaler.update()
        with torch.no_grad():
            for kept, now in zip(self.mean.parameters(), self.model.parameters(), strict=True):
                kept.lerp_(now, 1 - min(AVERAGED, (self.step + 1) / (self.step + 10)))
        self.step += 1
        return loss.item()

    def look(self, look: Look, loss: float) -> None:
        """Judge the running mean, and keep it if it is the best so far; the first number counts, less is better."""
        self.mean.eval()
        with torch.no_grad():
            found = look(self.mean)
        name = next(iter(found))
        if not self.rows or found[name] <= min(row[name] for row in self.rows):
            self.since = 0
            self.best.load_state_dict(self.mean.state_dict())
        else:
            self.since += 1
        self.rows.append({"step": self.step, "seconds": round(self.seconds), "loss": round(loss, 4),
                          **{key: round(float(value), 5) for key, value in found.items()}})


def run(model: Model, loss_of: Loss, look: Look, *, steps: int, rate: float, every: int, seed: int,
        checkpoint: Path, log: Path) -> Model:
    """Train to the end, or until PATIENCE looks have brought nothing.

    Args:
        model: with weights drawn from `seed`; its device is where the training runs, on CUDA in mixed precision.
        loss_of: the loss of one step, which draws its example from the generator that it is given.
        look: judges a model on held-out meshes; columns of the log, of which the first decides.
        every: steps between two looks, after each of which `checkpoint` and `log` (.csv) are written.
    Returns:
        The best running mean, in `eval` mode.
    """
    training = Training(model, steps, rate, seed)
    training.resume(checkpoint)
    began, losses = time.time() - training.seconds, []
    log.parent.mkdir(parents=True, exist_ok=True)
    with trange(training.step, steps, initial=training.step, total=steps, desc=log.stem) as bar:
        for _ in bar:
            if training.since >= PATIENCE:
                break
            training.model.train()
            losses.append(training.take(loss_of))
            if training.step % every == 0 or training.step == steps:
                training.seconds = time.time() - began
                training.look(look, float(np.mean(losses)))
                losses = []
                training.save(checkpoint)
                with log.open("w", newline="") as file:
                    writer = csv.DictWriter(file, list(training.rows[0]))
                    writer.writeheader()
                    writer.writerows(training.rows)
                bar.set_postfix(training.rows[-1], refresh=False)
    best = copy.deepcopy(model)
    best.load_state_dict(training.best.state_dict())
    return best.eval()
