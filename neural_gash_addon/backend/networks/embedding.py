# SPDX-License-Identifier: GPL-3.0-or-later
"""The light-transport embedding: scene points to codes, and the irradiance at any point out of the codes near it.

Xu et al. 2026, "A Generalizable Light Transport 3D Embedding for Global Illumination", sections 3.3 and 3.4. What
differs from the paper:
- Colour channels are separate problems, as light keeps its colour where it bounces: the irradiance of a channel depends
  on that channel's albedo and emission alone. Each is asked by itself, as an item of a batch.
- Light is linear in emission, so emission is read, and irradiance given, in units of `level`.
- What lamps would give if nothing stood between is a plain sum (`direct`), so it is not learned but read, by scene
  points and queries; the network gives the share of it that arrives, and the light that has bounced.
- Its Point Transformer V3 finds a code's surroundings by sparse convolution; here a depthwise one over the nearest
  codes, its kernel a perceptron of their offsets. Stages are halved as in the nearest-neighbour embedding, by the
  farthest-point order, and not by a grid; the way back up has no blocks of its own, as the paper names none.
- Equation 10 has no normalisation. Over softmax weights of a perceptron of equation 9, as in the works that it cites
  (Zhao et al. 2021, Fan et al. 2022); without the perceptron the query would cancel out of the softmax.
- Positions are also read as sines and cosines: a perceptron is slow to learn fine functions of three numbers.
"""
from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from .. import embedding
from ..embedding import EXTENT, HALVINGS
from ..serialise import CURVES

HEAD = 32             # numbers of an attention head (Table 3: D / 32 heads)
OCTAVES = 6           # of sines and cosines: wavelengths of 20 m to 0.6 m, a few codes' spacings
LAMPS = 1024          # scene points that shine, at most, in `direct`: what a query costs does not grow with the scene
GREATEST = 20.0       # logarithm of irradiance in units of the level: above any scene's, and its exp is finite
BRIGHTEST = 0.95      # albedo of a room, at most: `level` has a pole at 1


@dataclass(frozen=True)
class Settings:
    """Sizes. The paper's Table 3 has them, but for `around`."""

    width: int                  # D, of codes and queries
    depths: tuple[int, ...]     # blocks of each stage of the encoder; the number of codes halves between stages
    channels: tuple[int, ...]   # width of each stage, a multiple of HEAD
    layers: int                 # of the decoder
    dropout: float              # on what blocks and layers add
    gathered: int = 32          # k of the nearest-neighbour embedding: a code sums up about k² scene points
    around: int = 16            # codes of a depthwise convolution: on a surface, those within two spacings
    patch: int = 1024           # codes that attend to each other, at most: cost grows with M, not with M²
    neighbours: int = 32        # k of the decoder: more gain little (Table 4)


SMALL = Settings(width=64, depths=(2, 2, 2), channels=(64, 96, 128), layers=2, dropout=0.0)  # an hour of one CPU core
FULL = Settings(width=128, depths=(2, 2, 2, 6, 2), channels=(128, 128, 128, 256, 256), layers=6, dropout=0.1)


def level(albedo: Tensor, emission: Tensor, areas: Tensor) -> Tensor:
    """(B,) the irradiance in an integrating sphere with a room's mean albedo and emission: pi e / (1 - a).

    A unit for emission and irradiance, not an estimate to be relied on.

    Args:
        albedo, emission: (B, M) of scene points. areas: (M,) that they stand for.
    """
    share = areas / areas.sum().clamp_min(1e-30)
    return math.pi * (emission @ share) / (1 - (albedo @ share).clamp(max=BRIGHTEST))


def direct(places: Tensor, normals: Tensor, lamps: Tensor, lamp_normals: Tensor, areas: Tensor, emission: Tensor
           ) -> Tensor:
    """(B, n) irradiance from lamps, each a disc of its area, with nothing between.

    Args:
        places, normals: (n, 3). lamps, lamp_normals: (L, 3). All in metres. areas: (L,). emission: (B, L).
    """
    way = [lamps[:, axis] - places[:, axis, None] for axis in range(3)]
    square = way[0] ** 2 + way[1] ** 2 + way[2] ** 2
    here = (way[0] * normals[:, 0, None] + way[1] * normals[:, 1, None] + way[2] * normals[:, 2, None]).clamp_min(0)
    there = -(way[0] * lamp_normals[:, 0] + way[1] * lamp_normals[:, 1] + way[2] * lamp_normals[:, 2]).clamp_max(0)
    # on its axis, exactly a disc's; 0 / 0 where a query is on the lamp itself
    seen = here * there * areas / (square * (square + areas / math.pi)).clamp_min(1e-20)
    return emission @ seen.T


def shining(emission: Tensor, areas: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (L,) of scene points that stand for all that shine, and the areas (L,) that they stand for.

    The first LAMPS: in farthest-point order they are spread over all. emission: (B, M). areas: (M,).
    """
    every = emission.any(0).nonzero()[:, 0]
    rows = every[:LAMPS]
    return rows, areas[rows] * (areas[every].sum() / areas[rows].sum().clamp_min(1e-30))


def _waves(places: Tensor) -> Tensor:
    """(N, 3) normalised positions to (N, 3 + 6 OCTAVES): themselves, their sines and cosines."""
    turns = (places[:, :, None] * 2.0 ** torch.arange(OCTAVES, device=places.device)).flatten(1) * 2 * math.pi
    return torch.cat([places, turns.sin(), turns.cos()], 1)


def _perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, outputs))


@dataclass(frozen=True, eq=False)
class Layout:
    """`backend.embedding.Layout` as tensors."""

    gathered: list[Tensor]
    around: list[Tensor]
    above: list[Tensor]

    @classmethod
    def of(cls, layout: embedding.Layout, where: torch.device) -> Layout:
        """On a device."""
        return cls(*([torch.from_numpy(each).to(where) for each in part]
                     for part in (layout.gathered, layout.around, layout.above)))


class Halving(nn.Module):
    """Equations 1 to 3: of M points the first m, each with the greatest of its neighbours' projections, by channel.

    The projection of concat(X_k - X_l, X_l) is linear, so it is taken before neighbours are gathered: no (m, k, D)
    array is made.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.difference, self.centre = nn.Linear(inputs, outputs, bias=False), nn.Linear(inputs, outputs)
        self.norm = nn.LayerNorm(outputs)

    def forward(self, x: Tensor, gathered: Tensor) -> Tensor:
        """x: (B, M, inputs). gathered: (m, k) rows of x. To (B, m, outputs)."""
        batch, count, _ = x.shape
        each = self.difference(x)
        rows = (gathered + count * torch.arange(batch, device=x.device)[:, None, None]).flatten(0, 1)
        greatest = functional.embedding_bag(rows, each.flatten(0, 1), mode="max").view(batch, len(gathered), -1)
        kept = slice(len(gathered))
        return functional.gelu(self.norm(greatest - each[:, kept] + self.centre(x[:, kept])))


class Surroundings(nn.Module):
    """A depthwise convolution over the codes around each: what tells a code where it is among them."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.kernel, self.leave = _perceptron(3, 16, channels), nn.Linear(channels, channels)
        self.norm = nn.LayerNorm(channels)

    def forward(self, x: Tensor, places: Tensor, around: Tensor) -> Tensor:
        """x: (B, m, C). places: (m, 3) normalised. around: (m, k). To (B, m, C)."""
        kernel = self.kernel((places[around] - places[:, None]) * EXTENT)
        return self.norm(self.leave((x[:, around] * kernel).mean(2)))


class PatchAttention(nn.Module):
    """Attention among the codes of a patch: a run of at most `patch` codes along a space-filling curve."""

    def __init__(self, channels: int, patch: int) -> None:
        super().__init__()
        self.heads, self.patch = channels // HEAD, patch
        self.enter, self.leave = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)

    def forward(self, x: Tensor, order: Tensor) -> Tensor:
        """x: (B, m, C). order: (m,) of the codes along the curve. To (B, m, C)."""
        batch, count, channels = x.shape
        patches = -(-count // self.patch)
        size = -(-count // patches)          # patches of one size: the last lacks fewer codes than there are patches
        lacking = patches * size - count
        rows = functional.pad(self.enter(x[:, order]), (0, 0, 0, lacking))
        query, key, value = rows.view(batch * patches, size, 3, self.heads, HEAD).permute(2, 0, 3, 1, 4).unbind()
        mask = None
        if lacking:  # what fills the last patch is not attended to
            real = torch.arange(patches * size, device=x.device) < count
            mask = real.view(patches, 1, 1, size).repeat(batch, 1, 1, 1)
        found = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        found = found.transpose(1, 2).reshape(batch, patches * size, channels)[:, :count]
        return self.leave(found[:, torch.argsort(order)])


class Block(nn.Module):
    """Of Point Transformer V3: surroundings, attention, perceptron, each added to what was there."""

    def __init__(self, channels: int, patch: int, dropout: float) -> None:
        super().__init__()
        self.surroundings, self.attention = Surroundings(channels), PatchAttention(channels, patch)
        self.mix = _perceptron(channels, 4 * channels, channels)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, places: Tensor, around: Tensor, order: Tensor) -> Tensor:
        """(B, m, C) to the same."""
        x = x + self.surroundings(x, places, around)
        x = x + self.dropout(self.attention(self.norms[0](x), order))
        return x + self.dropout(self.mix(self.norms[1](x)))


class Encoder(nn.Module):
    """Scene points to codes: two halvings, stages of blocks, and back up to the first stage's codes."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        width, channels = settings.width, settings.channels
        self.enter = _perceptron(3 + 6 * OCTAVES + 7, width, width)
        sizes = (*[width] * HALVINGS, *channels)
        self.halvings = nn.ModuleList(Halving(a, b) for a, b in zip(sizes[:-1], sizes[1:], strict=True))
        self.depths = settings.depths
        self.blocks = nn.ModuleList(Block(size, settings.patch, settings.dropout)
                                    for size, depth in zip(channels, settings.depths, strict=True)
                                    for _ in range(depth))
        self.down = nn.ModuleList(nn.Linear(b, a) for a, b in zip(channels[:-1], channels[1:], strict=True))
        self.leave = nn.Sequential(nn.LayerNorm(channels[0]), nn.Linear(channels[0], width))

    def forward(self, places: Tensor, normals: Tensor, areas: Tensor, albedo: Tensor, emission: Tensor,
                direct: Tensor, layout: Layout, orders: list[Tensor]) -> Tensor:
        """To the codes (B, m, D) of B channels of a room.

        Args:
            places: (M, 3) of scene points in farthest-point order, normalised. normals: (M, 3). areas: (M,).
            albedo, emission, direct: (B, M), the latter two in units of the level.
            layout: of the scene points. orders: (CURVES, m) of each stage.
        """
        shared = torch.cat([_waves(places), normals, areas[:, None].clamp_min(1e-6).log()], 1)
        own = torch.stack([albedo, emission.log1p(), direct.log1p()], 2)
        x = self.enter(torch.cat([shared.expand(len(albedo), -1, -1), own], 2))
        # each block takes the next curve; in training, in an order drawn anew (Wu et al. 2024, "shuffle order")
        curves = torch.randperm(CURVES).tolist() if self.training else list(range(CURVES))
        levels, blocks = [], zip(self.blocks, itertools.cycle(curves), strict=False)
        for number, (halving, gathered) in enumerate(zip(self.halvings, layout.gathered, strict=True)):
            x = halving(x, gathered)
            stage = number - HALVINGS + 1
            if stage < 0:
                continue
            for each, curve in itertools.islice(blocks, self.depths[stage]):
                x = each(x, places[:x.shape[1]], layout.around[stage], orders[stage][curve])
            levels.append(x)
        for below, above, linear in zip(levels[-2::-1], layout.above[::-1], reversed(self.down), strict=True):
            x = below + linear(x)[:, above]
        return self.leave(x)


class VectorAttention(nn.Module):
    """Equations 8 to 10: each query takes of the codes near it, by a weight for each channel.

    The perceptron of equation 9 begins with a linear layer, so query, key and offset go through that one by one, before
    codes are gathered: D / 4 numbers are, and not D.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        hidden = width // 4
        self.query, self.key = nn.Linear(width, hidden), nn.Linear(width, hidden, bias=False)
        self.offset, self.weigh = nn.Linear(width, hidden, bias=False), nn.Linear(hidden, width, bias=False)
        self.value = nn.Linear(width, width)

    def forward(self, asked: Tensor, codes: Tensor, near: Tensor, offset: Tensor) -> Tensor:
        """asked: (B, n, D). codes: (B, m, D). near: (n, k) rows of codes. offset: (n, k, D), of equation 7."""
        relation = self.query(asked)[:, :, None] - self.key(codes)[:, near] + self.offset(offset)
        weights = self.weigh(relation.relu()).softmax(2)
        return (weights * (self.value(codes)[:, near] + offset)).sum(2)


class Decoder(nn.Module):
    """Query points and the codes near them to the logarithm of their irradiance."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        width = settings.width
        self.enter = _perceptron(3 + 6 * OCTAVES + 5, width, width)
        self.offset = _perceptron(3, width, width)
        self.attention = nn.ModuleList(VectorAttention(width) for _ in range(settings.layers))
        self.mix = nn.ModuleList(_perceptron(width, 4 * width, width) for _ in range(settings.layers))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2 * settings.layers))
        self.dropout = nn.Dropout(settings.dropout)
        self.finish = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.GELU())
        self.leave = nn.Linear(width, 2)

    def forward(self, codes: Tensor, code_places: Tensor, places: Tensor, normals: Tensor, albedo: Tensor,
                direct: Tensor, near: Tensor) -> Tensor:
        """(B, n) log(1 + irradiance in units of the level).

        Args:
            codes: (B, m, D), at code_places (m, 3).
            places, normals: (n, 3) of queries. albedo, direct: (B, n). near: (n, k) the codes nearest to each.
        """
        shared = torch.cat([_waves(places), normals], 1)
        x = self.enter(torch.cat([shared.expand(len(albedo), -1, -1), torch.stack([albedo, direct.log1p()], 2)], 2))
        offset = self.offset((places[:, None] - code_places[near]) * EXTENT)
        for number, (attention, mix) in enumerate(zip(self.attention, self.mix, strict=True)):
            x = x + self.dropout(attention(self.norms[2 * number](x), codes, near, offset))
            x = x + self.dropout(mix(self.norms[2 * number + 1](x)))
        arrives, bounced = self.leave(self.finish(x)).unbind(2)
        return (direct * arrives.sigmoid() + functional.softplus(bounced).clamp(max=GREATEST).expm1()).log1p()


class Embedding(nn.Module):
    """Both. Before training it gives each point half of the direct light, and the level, as softplus(0) = log 2."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.settings = settings
        self.encoder, self.decoder = Encoder(settings), Decoder(settings)
        nn.init.zeros_(self.decoder.leave.weight)
        nn.init.zeros_(self.decoder.leave.bias)
