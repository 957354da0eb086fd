# SPDX-License-Identifier: GPL-3.0-or-later
"""The light-transport embedding for functions of direction: what blocks the sky, or what light arrives.

Xu et al. 2026, "A Generalizable Light Transport 3D Embedding for Global Illumination", as `networks.embedding` has it;
what differs is what scene points carry. There, it is a number; here, (K,) coefficients of a function times the cosine,
over pi: of what is blocked (1, or 0), which is the blocked part of transfer; or of incident radiance. Both are split
(docs/hybrid.md) into what they are on the whole, and how they differ from an even sky of that; these turn with the
scene. Band by band, codes and queries take weighted means of them, and the weights and a factor for each band are read
of numbers that do not turn. So a turned, moved or larger scene gives the turned answer, and a network that has learned
nothing interpolates.

Queries read the scene points nearest to them, each with the key and the value of its code: the numbers of a code alone,
which stands for four points, would be too smooth for shadows.
"""
from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..spherical_harmonics import MAX_ORDER
from .embedding import (
    _SHARP,
    POOLS,
    RELATION,
    Frame,
    Kernel,
    NearestNeighbourEmbedding,
    PointTransformer,
    Settings,
    _factor,
    _perceptron,
    _silent,
    relation,
)

SKY = Settings(first=64, widths=(64, 64), hidden=32)
_OWN = 2.0  # at first: logarithm of the weight of a point's own numbers beside each of the averages about its code
SEEN = 4   # numbers of a scene point that do not turn: its size, the whole, how uneven, and that along the normal


@dataclass(frozen=True, eq=False)
class Codes:
    """What queries read, anchored at the M scene points."""

    values: Tensor  # (M, K), or (M, K, C) of channels
    key: Tensor     # (M, H)
    value: Tensor   # (M, H)


def bands(terms: int) -> Tensor:
    """(K,) the band of each of K coefficients."""
    return torch.arange(terms).float().add(1e-3).sqrt().long()


def by_band(weights: Tensor, terms: int) -> Tensor:
    """Weights (..., MAX_ORDER) of bands to those of K coefficients."""
    return weights[..., bands(terms).to(weights.device)]


class Encoder(nn.Module):
    """Scene points to codes, and back to scene points; as `networks.embedding.Encoder`."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        width, hidden = settings.widths[-1], settings.hidden
        self.pool = Kernel(_SHARP)
        self.embed = NearestNeighbourEmbedding(SEEN, 3 * POOLS, settings)
        self.transform = PointTransformer(settings)
        self.share = nn.Linear(width, (1 + POOLS) * MAX_ORDER)
        _silent(self.share)
        self.own = _perceptron(SEEN, hidden, 2 * hidden)
        self.key_value = nn.Linear(width, 2 * hidden)

    def forward(self, frame: Frame, values: Tensor, parents: Tensor) -> Codes:
        """values: (M, K) at the scene points. parents: (M,) the code nearest to each."""
        along = torch.stack([values[:, 3], values[:, 1], values[:, 2]], 1)   # k = 1, 2, 3 are y, z, x
        size = (frame.areas / frame.areas.mean().clamp_min(1e-30)).clamp_min(1e-3).log()
        whole, off = 4 * values[:, 0], 4 * along.square().sum(1).add(1e-12).sqrt()
        upright = 4 * (along * frame.normals).sum(1) / (whole.abs() + off + 1e-2)
        seen = torch.stack([size, whole.clamp_min(0).log1p(), off.log1p(), upright], 1)
        near, weights = frame.gathered, self.pool(frame.lie(frame.gathered)).softmax(1)  # (m, k, POOLS)
        gathered = values[near]                                                 # (m, k, K)
        pooled = torch.einsum("mkc,mkp->mpc", gathered, weights)
        spread = torch.einsum("mk,mkp->mp", gathered[..., 0].square(), weights).sub(pooled[..., 0].square())
        beside = torch.cat([(4 * pooled[..., 0]).clamp_min(0).log1p(), (4 * spread.clamp_min(1e-12).sqrt()).log1p(),
                            (4 * pooled[..., 1:4].square().sum(2).add(1e-12).sqrt()).log1p()], 1)
        x = self.transform(self.embed(frame, seen[None], beside[None]), frame)[0]
        mix = by_band(self.share(x).view(len(x), 1 + POOLS, MAX_ORDER).softmax(1), values.shape[1])
        mixed = mix[parents, 0] * values + (mix[:, 1:] * pooled).sum(1)[parents]
        key, value = (self.key_value(x)[parents] + self.own(seen)).chunk(2, 1)
        return Codes(mixed, key, value)


class Decoder(nn.Module):
    """Query points and the scene points near them to coefficients; vector attention, equations 7 to 10."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        hidden = settings.hidden
        self.kernel = Kernel((1.0,) * MAX_ORDER)
        self.lie = _perceptron(RELATION, hidden, 2 * hidden)
        self.weigh = nn.Linear(hidden, MAX_ORDER + hidden, bias=False)
        self.norm = nn.LayerNorm(hidden)
        self.enter, self.finish = nn.Linear(hidden, hidden), nn.Linear(hidden, MAX_ORDER)
        _silent(self.finish)

    def forward(self, codes: Codes, frame: Frame, places: Tensor, normals: Tensor, near: Tensor) -> Tensor:
        """(n, K).

        Args:
            places, normals: (n, 3) of queries. near: (n, k) the scene points nearest to each.
        """
        own, factors = self.own(codes, frame, places, normals, near)
        values = codes.values[near]
        found = (by_band(own, values.shape[2]) * values).sum(1)
        return found * by_band(factors, values.shape[2])

    def own(self, codes: Codes, frame: Frame, places: Tensor, normals: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
        """Weights (n, k, MAX_ORDER) of each band of the scene points, and factors (n, MAX_ORDER) on their means."""
        spacing = frame.areas.sqrt().clamp_min(float(frame.spacing.min()) / 2)
        lie = relation(places, normals, frame.places[near], frame.normals[near], spacing[near])
        relates, offset = self.lie(lie).chunk(2, 2)
        weights = self.weigh((codes.key[near] + relates).relu())                # (n, k, MAX_ORDER + H)
        own = (weights[..., :MAX_ORDER] + self.kernel(lie)).softmax(1)
        latent = (weights[..., MAX_ORDER:].softmax(1) * (codes.value[near] + offset)).sum(1)
        return own, _factor(self.finish(functional.gelu(self.enter(self.norm(latent))))[..., None])


class SkyEmbedding(nn.Module):
    """Both. Before training it averages what scene points see by distance and normal, and corrects nothing."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.settings = settings
        self.encoder, self.decoder = Encoder(settings), Decoder(settings)
        with torch.no_grad():
            self.decoder.weigh.weight[:MAX_ORDER] = 0
            self.encoder.share.bias[:MAX_ORDER] = _OWN
