# SPDX-License-Identifier: GPL-3.0-or-later
"""The light-transport embedding: lit scene points to codes, and reflected light at any point out of the codes near it.

Xu et al. 2026, "A Generalizable Light Transport 3D Embedding for Global Illumination", sections 3.3 and 3.4. What
differs from the paper, and why (docs/embedding.md has more):
- Scene points carry traced light: what comes straight from emitters, and a few paths of what was reflected. The network
  says how to average the latter over places, and how far the average is off.
- All light is in units of its mean over the room, colour channels are separate items of a batch, and what is read of
  geometry are areas, distances in units of the codes' spacing and cosines: brighter, recoloured, moved, turned or
  mirrored rooms give the same answer by construction, where the paper leaves that to be learned.
- Lengths are read by one fixed scale (its A.3), as areas of scene points; those that no training had are read as the
  nearest that one had, so that a doll's house is a small room.
- The transformer has no stages: its blocks may become wider, and all are of the same codes.
- Its Point Transformer V3 finds a code's surroundings by sparse convolution; here a depthwise one over the nearest
  codes, its kernel a perceptron of how they lie.
- Equation 10 has no normalisation. Over softmax weights of a perceptron of equation 9, as in the works that it cites
  (Zhao et al. 2021, Fan et al. 2022).
"""
from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from .. import embedding
from ..lit_points import DENSITY
from ..serialise import CURVES

HEAD = 32           # numbers of an attention head (Table 3: D / 32 heads)
RELATION = 5        # numbers of `relation`
POOLS = 4           # averages over a code's points, from sharp to wide
_SHARP = (4.0, 1.0, 0.4, 0.1)  # of each at first: weight of the squared distance, in spacings of the codes
_TURNED = 4.0       # at first: what a cosine of 0 between normals takes off the logarithm of a weight
_FARTHEST = 2.0     # a factor on an average is between exp(-2) and exp(2)
_LEAST = 1e-3       # of the mean spacing: points that coincide have none
_AREAS = 2e-2, 4.0  # of scene points, in those of the usual density: beyond, no training had any


@dataclass(frozen=True)
class Settings:
    """Sizes."""

    first: int                          # what a scene point is projected to (equation 1)
    widths: tuple[int, ...]             # of the blocks of the point transformer; codes come to it in the first
    hidden: int                         # of codes that queries read
    halvings: tuple[int, ...] = (2, 2)  # steps of the nearest-neighbour embedding: points to a point, each
    gathered: int = 32                  # k of these
    around: int = 16                    # codes of a depthwise convolution: on a surface, those within two spacings
    patch: int = 1024                   # codes that attend to each other, at most: cost grows with M, not with M²
    neighbours: int = 16                # k of the decoder: more gain little (docs/embedding.md)
    layers: int = 0                     # of the decoder of irradiance, after the one that weighs light
    wider: int = 2                      # perceptrons within are as many times as wide as what they are added to
    dropout: float = 0.0


SMALL = Settings(first=32, widths=(64, 64), hidden=32)
# the paper's Table 3: depths 2, 2, 2, 6, 2 of 128, 128, 128, 256 and 256 channels
FULL = Settings(first=128, widths=(128,) * 6 + (256,) * 8, hidden=128, neighbours=32, layers=6, wider=4, dropout=0.1)


def relation(places: Tensor, normals: Tensor, others: Tensor, other_normals: Tensor, spacing: Tensor) -> Tensor:
    """(n, k, RELATION) how other points lie, whatever the frame: heights over both planes, distances, a cosine.

    Args:
        places, normals: (n, 3). others, other_normals: (n, k, 3). spacing: (n, k) or (n, 1), which
            lengths are divided by.
    """
    way = (others - places[:, None]) / spacing[:, :, None]
    square = way.square().sum(2)
    return torch.stack([(way * normals[:, None]).sum(2), (way * other_normals).sum(2), square.sqrt(), square.log1p(),
                        (normals[:, None] * other_normals).sum(2)], 2)


def _perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, outputs))


def _silent(module: nn.Module) -> nn.Module:
    """The same, its last layer at zero."""
    *_, weight, bias = module.parameters()
    nn.init.zeros_(weight)
    nn.init.zeros_(bias)
    return module


class Kernel(nn.Module):
    """Logarithms of weights by how points lie: at first of distance and of turned normals, and what is learned."""

    def __init__(self, sharp: tuple[float, ...]) -> None:
        super().__init__()
        self.sharp = nn.Parameter(torch.tensor(sharp).log())
        self.turned = nn.Parameter(torch.full((len(sharp),), _TURNED).log())
        last = nn.Linear(16, len(sharp), bias=False)  # a bias would not be seen by the softmax
        nn.init.zeros_(last.weight)
        self.learned = nn.Sequential(nn.Linear(RELATION, 16), nn.GELU(), last)

    def forward(self, lie: Tensor) -> Tensor:
        """lie: (n, k, RELATION). To (n, k, len(sharp))."""
        return (self.learned(lie) - self.sharp.exp() * lie[..., 2:3].square()
                - self.turned.exp() * (1 - lie[..., 4:5]))


@dataclass(frozen=True, eq=False)
class Frame:
    """What never changes with the light of a room: M points, of which the first m are codes; as tensors."""

    places: Tensor      # (M, 3) metres
    normals: Tensor     # (M, 3)
    areas: Tensor       # (M,) square metres, about
    spacing: Tensor     # (m,) metres between codes, about
    gathered: Tensor    # (m, k) the points nearest to each code
    halvings: tuple[Tensor, ...]  # of each step from M points to m: (to, k) those before it nearest to each
    around: Tensor      # (m, k) the codes nearest to each, itself first
    orders: Tensor      # (CURVES, m) of the codes along each curve

    @classmethod
    def of(cls, places: Tensor, normals: Tensor, layout: embedding.Layout) -> Frame:
        """places, normals: (M, 3) on their device."""
        gathered, around, orders, areas, *halvings = (torch.from_numpy(array).to(places.device) for array in (
            layout.gathered, layout.around, layout.orders, layout.areas, *layout.halvings))
        return cls(places, normals, areas, _spacing(areas, len(around)), gathered, tuple(halvings), around, orders)

    def lie(self, rows: Tensor) -> Tensor:
        """(n, k, RELATION) of points (n, k) about each of the first n, in units of how far those are apart."""
        first = slice(len(rows))
        spacing = self.spacing if len(rows) == len(self.spacing) else _spacing(self.areas, len(rows))
        return relation(self.places[first], self.normals[first], self.places[rows], self.normals[rows],
                        spacing[:, None])


def _spacing(areas: Tensor, count: int) -> Tensor:
    """(count,) metres between the first so many of the points that areas (M,) are of, about."""
    spacing = (areas[:count] * len(areas) / count).sqrt()
    return spacing.clamp_min(_LEAST * float(spacing.mean()) + 1e-12)


def level(light: Tensor, areas: Tensor) -> Tensor:
    """(B,) mean over a room of light (B, M), by the areas (M,) that its points stand for: the unit of all light."""
    return light @ (areas / areas.sum().clamp_min(1e-30)) if float(areas.sum()) > 0 else light.mean(1)


class Surroundings(nn.Module):
    """A depthwise convolution over the codes around each: what tells a code where it is among them."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.kernel, self.leave = _perceptron(RELATION, 16, channels), nn.Linear(channels, channels)
        self.norm = nn.LayerNorm(channels)

    def forward(self, x: Tensor, lie: Tensor, around: Tensor) -> Tensor:
        """x: (B, m, C). lie: (m, k, RELATION) of around (m, k). To (B, m, C)."""
        return self.norm(self.leave((x[:, around] * self.kernel(lie)).mean(2)))


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

    def __init__(self, before: int, channels: int, settings: Settings) -> None:
        super().__init__()
        self.widen = nn.Identity() if before == channels else nn.Linear(before, channels)
        self.surroundings, self.attention = Surroundings(channels), PatchAttention(channels, settings.patch)
        self.mix = _perceptron(channels, settings.wider * channels, channels)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.drop = nn.Dropout(settings.dropout)

    def forward(self, x: Tensor, lie: Tensor, around: Tensor, order: Tensor) -> Tensor:
        """(B, m, before) to (B, m, C)."""
        x = self.widen(x)
        x = x + self.surroundings(x, lie, around)
        x = x + self.drop(self.attention(self.norms[0](x), order))
        return x + self.drop(self.mix(self.norms[1](x)))


class PointTransformer(nn.Module):
    """Equation 4: blocks, each along the next curve; in training, curves come in an order drawn anew each time.

    Wu et al. 2024, "Point Transformer V3", "shuffle order".
    """

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        widths = settings.widths
        self.blocks = nn.ModuleList(Block(before, width, settings)
                                    for before, width in zip(widths[:1] + widths, widths, strict=False))
        self.leave = nn.LayerNorm(widths[-1])

    def forward(self, x: Tensor, frame: Frame) -> Tensor:
        """(B, m, widths[0]) to (B, m, widths[-1])."""
        curves = torch.randperm(CURVES).tolist() if self.training else list(range(CURVES))
        lie = frame.lie(frame.around)
        for number, block in enumerate(self.blocks):
            x = block(x, lie, frame.around, frame.orders[curves[number % CURVES]])
        return self.leave(x)


class Halving(nn.Module):
    """Equations 2 and 3: the greatest, by channel, of what the points about a point are beside it.

    What is greatest also depends on how they lie.
    """

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.difference, self.centre = nn.Linear(before, after, bias=False), nn.Linear(before, after)
        self.offset = _perceptron(RELATION, 16, after)
        self.norm = nn.LayerNorm(after)

    def forward(self, x: Tensor, near: Tensor, lie: Tensor) -> Tensor:
        """(B, before, C) to (B, n, C'), n the points (n, k) `near`, which lie (n, k, RELATION)."""
        kept, difference = x[:, :len(near)], self.difference(x)
        greatest = (difference[:, near] + self.offset(lie)).amax(2)
        return functional.gelu(self.norm(greatest - difference[:, :len(near)] + self.centre(kept)))


class NearestNeighbourEmbedding(nn.Module):
    """Equations 1 to 3: what M points carry to m codes, halving by halving."""

    def __init__(self, carried: int, beside: int, settings: Settings) -> None:
        """carried: numbers of a scene point. beside: further numbers of a code."""
        super().__init__()
        first, width, steps = settings.first, settings.widths[0], len(settings.halvings)
        self.enter = _perceptron(carried, first, first)
        self.halvings = nn.ModuleList(Halving(first, first if step < steps - 1 else width) for step in range(steps))
        self.join = nn.Linear(width + beside, width)

    def forward(self, frame: Frame, carried: Tensor, beside: Tensor) -> Tensor:
        """carried: (B, M, _). beside: (B, m, _). To (B, m, C)."""
        x = self.enter(carried)
        for halving, near in zip(self.halvings, frame.halvings, strict=True):
            x = halving(x, near, frame.lie(near))
        return self.join(torch.cat([x, beside], 2))


@dataclass(frozen=True, eq=False)
class Codes:
    """What queries read of B channels of a room, anchored at m places."""

    light: Tensor   # (B, m) reflected light there, in units of the level
    key: Tensor     # (B, m, H)
    value: Tensor   # (B, m, H)
    further: tuple[tuple[Tensor, Tensor], ...] = ()  # key and value of each layer more


class Encoder(nn.Module):
    """Lit scene points to codes."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        width = settings.widths[-1]
        self.pool = Kernel(_SHARP)
        self.embed = NearestNeighbourEmbedding(5, 3 * POOLS, settings)
        self.transform = PointTransformer(settings)
        self.factor, self.share = nn.Linear(width, 1), nn.Linear(width, POOLS)
        self.key, self.value = nn.Linear(width, settings.hidden), nn.Linear(width, settings.hidden)
        self.further = nn.ModuleList(nn.Linear(width, 2 * settings.hidden) for _ in range(settings.layers))
        _silent(self.factor)
        _silent(self.share)

    def forward(self, frame: Frame, albedo: Tensor, emission: Tensor, direct: Tensor, indirect: Tensor) -> Codes:
        """albedo, emission, direct, indirect: (B, M), the latter three in units of the level."""
        size = (frame.areas * DENSITY).clamp(*_AREAS).log().expand_as(albedo)
        near, weights = frame.gathered, self.pool(frame.lie(frame.gathered)).softmax(1)  # (m, k, POOLS)
        with torch.autocast(near.device.type, enabled=False):  # squares of bright light are beyond halves
            weights, gathered = weights.float(), indirect[:, near]
            pooled, first, squares = (torch.einsum("bmk,mkp->bmp", light, weights)      # (B, m, POOLS)
                                      for light in (gathered, (albedo * direct)[:, near], gathered.square()))
            spread = squares.sub(pooled.square()).clamp_min(1e-12).sqrt()
        x = self.embed(frame, torch.stack([size, albedo, emission.log1p(), direct.log1p(), indirect.log1p()], 2),
                       torch.cat([pooled, first, spread], 2).log1p())
        x = self.transform(x, frame)
        light = (self.share(x).softmax(2) * pooled).sum(2)
        further = tuple(layer(x).chunk(2, 2) for layer in self.further)
        return Codes(light * _factor(self.factor(x)), self.key(x), self.value(x), further)


def _factor(raw: Tensor) -> Tensor:
    """(..., 1) of any size to factors (...), positive, 1 for 0."""
    return (_FARTHEST * torch.tanh(raw[..., 0] / _FARTHEST)).exp()


class Further(nn.Module):
    """A layer more of the decoder: from what a query has found, vector attention once more, and a perceptron."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        hidden = settings.hidden
        self.norms = nn.ModuleList(nn.LayerNorm(hidden) for _ in range(2))
        self.asks = nn.Linear(hidden, hidden, bias=False)
        self.lie = _perceptron(RELATION, hidden, 2 * hidden)
        self.weigh = nn.Linear(hidden, hidden, bias=False)
        self.mix = _perceptron(hidden, settings.wider * hidden, hidden)
        self.drop = nn.Dropout(settings.dropout)

    def forward(self, x: Tensor, key: Tensor, value: Tensor, lie: Tensor, near: Tensor) -> Tensor:
        """(B, n, H) to the same. key, value: (B, m, H) of codes; those near (n, k) to queries lie (n, k, RELATION)."""
        relates, offset = self.lie(lie).chunk(2, 2)
        weights = self.weigh((key[:, near] + relates + self.asks(self.norms[0](x))[:, :, None]).relu()).softmax(2)
        x = x + self.drop((weights * (value[:, near] + offset)).sum(2))
        return x + self.drop(self.mix(self.norms[1](x)))


class Decoder(nn.Module):
    """Query points and the codes near them to reflected light; vector attention, equations 7 to 10.

    How a query lies to its codes is the same for all channels, and so are the layers that read it.
    """

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        hidden = settings.hidden
        self.kernel = Kernel((1.0,))
        self.lie = _perceptron(RELATION, hidden, 2 * hidden)
        self.asks = _perceptron(2, hidden, 2 * hidden)
        self.weigh = nn.Linear(hidden, 1 + hidden, bias=False)
        self.further = nn.ModuleList(Further(settings) for _ in range(settings.layers))
        self.finish = nn.Sequential(nn.LayerNorm(hidden), _silent(_perceptron(hidden, hidden, 1)))

    def forward(self, codes: Codes, frame: Frame, places: Tensor, normals: Tensor, albedo: Tensor, direct: Tensor,
                near: Tensor) -> Tensor:
        """(B, n) reflected light.

        Args:
            places, normals: (n, 3) of queries. albedo: (B, n).
            direct: (B, n) light straight from emitters, which tells what is in the shade of something from what is
                beside it; as all light, in units of the level.
            near: (n, k) the codes nearest to each.
        """
        lie = relation(places, normals, frame.places[near], frame.normals[near], frame.spacing[near])
        relates, offset = self.lie(lie).chunk(2, 2)
        asks, latent = self.asks(torch.stack([direct.log1p(), albedo], 2)).chunk(2, 2)  # (B, n, H)
        weights = self.weigh((codes.key[:, near] + relates + asks[:, :, None]).relu())  # (B, n, k, 1 + H)
        own = (weights[..., 0] + self.kernel(lie)[..., 0]).softmax(2)
        light = (own * codes.light[:, near]).sum(2)
        latent = latent + (weights[..., 1:].softmax(2) * (codes.value[:, near] + offset)).sum(2)
        for layer, (key, value) in zip(self.further, codes.further, strict=True):
            latent = layer(latent, key, value, lie, near)
        return light * _factor(self.finish(latent))


class Embedding(nn.Module):
    """Both. Before training it averages the light of scene points by distance and normal, and corrects nothing."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.settings = settings
        self.encoder, self.decoder = Encoder(settings), Decoder(settings)
        with torch.no_grad():
            self.decoder.weigh.weight[0] = 0
