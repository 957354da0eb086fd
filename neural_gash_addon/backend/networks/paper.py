# SPDX-License-Identifier: GPL-3.0-or-later
"""The networks of Neural-GASh, section 4, as the paper gives them.

What it leaves open: four heads a layer; what joins the vertices of stage 1, and that edges tell where a neighbour is
(`sight`); the coefficients network gives the blocked part of the coefficients, so what is analytic stays exact, and in
the frame of each vertex's motor, which the visibilities are in, too; the hidden sizes of the perceptron.
"""
from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from ..conformal import BLADE_COUNT, DIRECTION_COUNT
from ..sight import EDGE, Sight
from .layers import GATv2Conv, TransformerConv

COEFFICIENTS = 9  # three bands
_HEADS = 4


class Mlp(nn.Module):
    """The first version [15]: each vertex by itself. It sees where a point is and how it faces, no shadows."""

    def __init__(self, inputs: int = BLADE_COUNT, hidden: int = 128) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(),
                                    nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, COEFFICIENTS))

    def forward(self, x: Tensor, source: Tensor, start: Tensor) -> Tensor:
        """The blocked part (N, 9) of encodings (N, inputs); the graph does not matter."""
        return self.layers(x)


class VisibilityNet(nn.Module):
    """Stage 1 (section 4.2.1): encodings to logits of the visibility along 25 directions of the motor's frame."""

    def __init__(self, inputs: int = BLADE_COUNT, width: int = 64, blocks: int = 3) -> None:
        super().__init__()
        self.enter = nn.Linear(inputs, width)
        self.blocks = nn.ModuleList(TransformerConv(width, width // _HEADS, _HEADS, EDGE) for _ in range(blocks))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(blocks))
        self.leave = nn.Linear(width, DIRECTION_COUNT)

    def forward(self, x: Tensor, source: Tensor, start: Tensor, edge: Tensor) -> Tensor:
        """(N, inputs) and, of edges, (E, EDGE) to (N, 25)."""
        x = self.enter(x)
        for block, norm in zip(self.blocks, self.norms, strict=True):
            x = x + norm(block(x, source, start, edge)).relu()
        return self.leave(x)

    def ask(self, sight: Sight) -> Tensor:
        """Of the vertices that are asked about: (m, 25)."""
        return self(sight.encoded, sight.source, sight.start, sight.edge)[sight.asked]


class CoefficientsNet(nn.Module):
    """Stage 2 (section 4.2.2): encodings and visibilities to the blocked part of coefficients in the motors' frames.

    With no visibilities as input it is the single end-to-end network of section 4.1.1.
    """

    def __init__(self, inputs: int = BLADE_COUNT + DIRECTION_COUNT, width: int = 96, blocks: int = 5,
                 dropout: float = 0.2) -> None:
        super().__init__()
        self.enter = nn.Linear(inputs, width)
        self.blocks = nn.ModuleList(GATv2Conv(width, width // _HEADS, _HEADS) for _ in range(blocks))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(blocks))
        self.dropout = nn.Dropout(dropout)
        self.leave = nn.Linear(width, COEFFICIENTS)
        nn.init.zeros_(self.leave.weight)  # training begins at "no shadows", not far from it

    def forward(self, x: Tensor, source: Tensor, start: Tensor) -> Tensor:
        """(N, inputs) to (N, 9)."""
        x = self.enter(x)
        for block, norm in zip(self.blocks, self.norms, strict=True):
            x = x + self.dropout(norm(block(x, source, start)).relu())
        return self.leave(x)


class TwoStage(nn.Module):
    """Both stages, one after the other (section 4.2)."""

    def __init__(self, inputs: int = BLADE_COUNT) -> None:
        super().__init__()
        self.visibility = VisibilityNet(inputs)
        self.coefficients = CoefficientsNet(inputs + DIRECTION_COUNT)

    def forward(self, x: Tensor, source: Tensor, start: Tensor, sights: Iterable[Sight]) -> tuple[Tensor, Tensor]:
        """The blocked part (N, 9) and the logits of the visibility (N, 25), both in the motors' frames.

        The second stage takes the first as it is: no gradient goes back through the visibilities.

        Args:
            x, source, start: vertices and the graph that joins them with their neighbours.
            sights: of the same vertices, in their order.
        """
        logits = torch.cat([self.visibility.ask(sight) for sight in sights])
        seen = torch.sigmoid(logits).detach()
        return self.coefficients(torch.cat([x, seen], 1), source, start), logits
