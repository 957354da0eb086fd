# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that bounces, by direction of the sky that it comes from, out of the codes for what blocks the sky.

A decoder more, as the paper's section 5.3 has one beside that of irradiance, on the codes of `networks.sky`. Scene
points carry what bounces bring them, in (K, C) coefficients of transfer, traced with few rays. Band by band, points and
queries take weighted means of that; the weights and a factor for each band are read of numbers that do not turn, and of
ratios of what bounces, over all colour channels alike. So a turned, moved or larger scene has the turned answer,
channels can be exchanged, less light of one colour is less of it, and a network that has learned nothing interpolates.
Other than what is blocked, what bounces has no lobe about the normal that it arrives at: it is not split.
"""
from __future__ import annotations

import torch
from torch import Tensor, nn

from ..spherical_harmonics import MAX_ORDER
from .embedding import _SHARP, POOLS, RELATION, Frame, Kernel, Settings, _factor, _perceptron, _silent, relation
from .sky import Codes, Decoder, by_band

_OWN = 3.0     # at first: logarithm of the weight of a point's own numbers beside each of the averages about its code
_LEAST = 1e-2  # of the mean of what bounces: ratios of less say nothing
SEEN = 2 + POOLS  # ratios that are read at a scene point: its own, the averages, and how uneven they are


class Reflected(nn.Module):
    """Codes, and what bounces bring to scene points, to what they bring to queries."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.settings = settings
        hidden = settings.hidden
        self.pool = Kernel(_SHARP)
        self.read = nn.Sequential(nn.Linear(2 * hidden + SEEN, 2 * hidden), nn.GELU())
        self.share = nn.Linear(2 * hidden, (1 + POOLS) * MAX_ORDER)
        self.key_value = nn.Linear(2 * hidden, 2 * hidden)
        self.kernel = Kernel((1.0,) * MAX_ORDER)
        self.lie = _perceptron(RELATION, hidden, 2 * hidden)
        self.weigh = nn.Linear(hidden, MAX_ORDER + hidden, bias=False)
        self.finish = nn.Sequential(nn.LayerNorm(hidden), _silent(_perceptron(hidden, hidden, MAX_ORDER)))
        _silent(self.share)
        _silent(self.key_value)
        with torch.no_grad():
            self.share.bias[:MAX_ORDER] = _OWN
            self.weigh.weight[:MAX_ORDER] = 0

    def begin_from(self, decoder: Decoder) -> None:
        """Take the weights of the decoder of what is blocked, which a training begins with."""
        for mine, its in ((self.kernel, decoder.kernel), (self.lie, decoder.lie), (self.weigh, decoder.weigh)):
            mine.load_state_dict(its.state_dict())

    def encode(self, codes: Codes, frame: Frame, bounced: Tensor, parents: Tensor) -> Codes:
        """Codes at the M scene points, with values (M, K, C).

        Args:
            codes: of what is blocked (`sky.Encoder`). bounced: (M, K, C), C colour channels.
            parents: (M,) the code nearest to each.
        """
        weights = self.pool(frame.lie(frame.gathered)).softmax(1)                       # (m, k, POOLS)
        near = bounced[frame.gathered]                                                  # (m, k, K, C)
        pooled = torch.einsum("mkxc,mkp->mpxc", near, weights)                          # (m, POOLS, K, C)
        whole = bounced[:, 0].mean(1)                                                   # (M,)
        least = _LEAST * whole.mean().clamp_min(1e-12)
        means = pooled[:, :, 0].mean(2).clamp_min(0)                                    # (m, POOLS)
        spread = torch.einsum("mk,mk->m", whole[frame.gathered].square(), weights[..., -1]) - means[:, -1].square()
        means, spread = means[parents] + least, spread[parents].clamp_min(1e-12 * least ** 2).sqrt() + least
        seen = torch.cat([((whole.clamp_min(0) + least) / means[:, -1]).log()[:, None],
                          (means[:, :-1] / means[:, -1:]).log(), (means[:, -1:] / (whole.mean() + least)).log(),
                          (spread / means[:, -1]).log()[:, None]], 1)
        x = self.read(torch.cat([codes.key, codes.value, seen], 1))
        mix = by_band(self.share(x).unflatten(1, (1 + POOLS, MAX_ORDER)).softmax(1),
                      bounced.shape[1])                                                 # (M, 1 + POOLS, K)
        mixed = mix[:, 0, :, None] * bounced
        for number in range(POOLS):  # one after another, as all at once is five times what is kept
            mixed = mixed + mix[:, 1 + number, :, None] * pooled[parents, number]
        key, value = self.key_value(x).chunk(2, 1)
        return Codes(mixed, codes.key + key, codes.value + value)

    def forward(self, codes: Codes, frame: Frame, places: Tensor, normals: Tensor, near: Tensor) -> Tensor:
        """(n, K, C). Arguments as `sky.Decoder`; codes of `encode`, or of fewer bands."""
        spacing = frame.areas.sqrt().clamp_min(float(frame.spacing.min()) / 2)
        lie = relation(places, normals, frame.places[near], frame.normals[near], spacing[near])
        relates, offset = self.lie(lie).chunk(2, 2)
        weights = self.weigh((codes.key[near] + relates).relu())                        # (n, k, MAX_ORDER + H)
        own = (weights[..., :MAX_ORDER] + self.kernel(lie)).softmax(1)
        latent = (weights[..., MAX_ORDER:].softmax(1) * (codes.value[near] + offset)).sum(1)
        own = own * _factor(self.finish(latent)[..., None])[:, None]
        return torch.cat([torch.einsum("nk,nkxc->nxc", own[..., band], codes.values[:, band ** 2:(band + 1) ** 2][near])
                          for band in range(round(codes.values.shape[1] ** 0.5))], 1)
