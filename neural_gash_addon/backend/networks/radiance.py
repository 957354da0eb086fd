# SPDX-License-Identifier: GPL-3.0-or-later
"""Reflected light by direction, out of the codes of the light-transport embedding: the radiance decoder.

Xu et al. 2026, section 5.3, beside the irradiance decoder and on the same codes. Where the paper's gives 32 x 32 bins
of radiance, this one gives harmonics of radiance times cosine, which is what a glossy lobe is applied to (`gloss`).

Light by direction is split into how much there is, which is irradiance and known (`networks.embedding.Decoder`), and
what it is like: `beyond` is by how much the harmonics, over irradiance, are others than those of a sky of one
brightness over the same normal. That is zero for even light whatever the normal, so codes of another normal can be
read. Scene points carry it traced with few paths; a network that has learned nothing averages it. It is made of sums of
whole bands with weights that no frame changes, so a turned or mirrored room gives turned or mirrored light.
"""
from __future__ import annotations

import torch
from torch import Tensor, nn

from .embedding import _SHARP, POOLS, RELATION, Codes, Frame, Kernel, Settings, _factor, _perceptron, _silent, relation

ORDER = 5  # of the harmonics: bands 3 and 4 of reflected light have as much energy as band 2 (docs/embedding.md)


class Radiance(nn.Module):
    """Codes and the scene points' light by direction to light by direction at queries."""

    def __init__(self, settings: Settings, order: int = ORDER) -> None:
        super().__init__()
        self.settings, self.order = settings, order
        hidden, bands = settings.hidden, order - 1  # band 0 is irradiance
        self.pool = Kernel(_SHARP)
        self.share = nn.Linear(hidden, POOLS * bands)
        self.kernel = Kernel((1.0,) * bands)
        self.lie = _perceptron(RELATION, hidden, 2 * hidden)
        self.asks = _perceptron(2, hidden, 2 * hidden)
        self.weigh = nn.Linear(hidden, bands + hidden, bias=False)
        self.finish = nn.Sequential(nn.LayerNorm(hidden), _silent(_perceptron(hidden, hidden, bands)))
        _silent(self.share)
        with torch.no_grad():
            self.weigh.weight[:bands] = 0

    def encode(self, codes: Codes, frame: Frame, light: Tensor, shape: Tensor, lobes: Tensor) -> Tensor:
        """(B, m, K) `beyond` of each code, of the points about it; 0 in band 0, and where there is no light.

        Args:
            light: (B, M) reflected light of the scene points. shape: (B, M, K) the same by direction.
            lobes: (M, K) of their normals (`spherical_harmonics.cosine_lobe`).
        """
        weights = self.pool(frame.lie(frame.gathered)).softmax(1)                       # (m, k, POOLS)
        beyond = shape - light[..., None] * lobes
        near = torch.cat([light[..., None], beyond[..., 1:]], 2)[:, frame.gathered]     # (B, m, k, K)
        pooled = torch.einsum("bmkc,mkp->bmpc", near, weights)                          # (B, m, POOLS, K)
        share = self.share(codes.value).unflatten(2, (POOLS, self.order - 1)).softmax(2)
        much = (share * pooled[..., :1]).sum(2)                                         # (B, m, order - 1)
        like = (self._each(share) * pooled[..., 1:]).sum(2) / self._each(much).clamp_min(1e-30)
        return nn.functional.pad(like, (1, 0))

    def forward(self, codes: Codes, beyond: Tensor, frame: Frame, places: Tensor, normals: Tensor, lobes: Tensor,
                direct: Tensor, light: Tensor, near: Tensor) -> Tensor:
        """(B, n, K) reflected light by direction, in the unit of `light`; its band 0 is `light`.

        Args:
            beyond: (B, m, K) of `encode`. lobes: (n, K) of the queries' normals.
            direct, light: (B, n) light straight from emitters, and the irradiance decoder's.
            The rest as `networks.embedding.Decoder`.
        """
        bands = self.order - 1
        lie = relation(places, normals, frame.places[near], frame.normals[near], frame.spacing[near])
        relates, offset = self.lie(lie).chunk(2, 2)
        asks, latent = self.asks(torch.stack([direct, light], 2).log1p()).chunk(2, 2)   # (B, n, H)
        weights = self.weigh((codes.key[:, near] + relates + asks[:, :, None]).relu())  # (B, n, k, bands + H)
        own = (weights[..., :bands] + self.kernel(lie)).softmax(2)
        latent = latent + (weights[..., bands:].softmax(2) * (codes.value[:, near] + offset)).sum(2)
        own = own * _factor(self.finish(latent)[..., None])[:, :, None]
        like = torch.cat([torch.einsum("bnk,bnkc->bnc", own[..., band - 1],
                                       beyond[:, :, band ** 2:(band + 1) ** 2][:, near])
                          for band in range(1, self.order)], 2)
        return light[..., None] * (lobes + nn.functional.pad(like, (1, 0)))

    def _each(self, by_band: Tensor) -> Tensor:
        """(..., order - 1) to (..., K - 1): each band's number for each of its harmonics."""
        sizes = torch.tensor([2 * band + 1 for band in range(1, self.order)], device=by_band.device)
        return by_band.repeat_interleave(sizes, by_band.dim() - 1)
