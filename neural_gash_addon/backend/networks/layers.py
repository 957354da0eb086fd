# SPDX-License-Identifier: GPL-3.0-or-later
"""Attention over a graph's edges: the two layers that Neural-GASh is made of, in plain torch.

Both have the parameters of their namesakes in torch_geometric, under the same names. Edges are sorted by target:
`start` (N + 1,) says where those of a vertex begin in `source` (E,). Without gradients they are taken some at a time,
so that memory does not grow with their number.
"""
from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

EDGES_AT_ONCE = 1 << 14  # what is made of them stays in the cache


def _parts(start: Tensor) -> Iterator[tuple[int, int]]:
    """Runs of vertices with about EDGES_AT_ONCE edges; one run of all where gradients are wanted."""
    count = len(start) - 1
    if torch.is_grad_enabled():
        yield 0, count
        return
    first = 0
    while first < count:
        last = int(torch.searchsorted(start, start[first] + EDGES_AT_ONCE, right=True)) - 1
        last = min(max(last, first + 1), count)
        yield first, last
        first = last


def _target(start: Tensor, first: int, last: int) -> Tensor:
    """(e,) vertex of each edge of vertices first..last, counted from the first."""
    return torch.repeat_interleave(torch.arange(last - first, device=start.device), start[first:last + 1].diff())


def _attended(scores: Tensor, values: Tensor, target: Tensor, count: int) -> Tensor:
    """Means (count, H, C) of values (e, H, C), weighted by the softmax of scores (e, H) over each target's edges.

    Zero where a vertex has no edge.
    """
    index = target[:, None].expand_as(scores)
    top = scores.detach().new_full((count, scores.shape[1]), -math.inf)
    top = top.scatter_reduce(0, index, scores.detach(), "amax")
    weight = (scores - top[target]).exp()
    total = weight.new_zeros(top.shape).index_add(0, target, weight)
    sums = values.new_zeros((count, *values.shape[1:])).index_add(0, target, values * weight[..., None])
    return sums / total.clamp_min(1e-16)[..., None]


class TransformerConv(nn.Module):
    """Dot-product attention (Shi et al. 2021, "Masked Label Prediction"), heads side by side, with a root weight.

    What edges say of themselves, where they do, is added to keys and values.
    """

    def __init__(self, inputs: int, channels: int, heads: int, edge_dim: int = 0) -> None:
        super().__init__()
        self.heads, self.channels = heads, channels
        self.lin_key = nn.Linear(inputs, heads * channels)
        self.lin_query = nn.Linear(inputs, heads * channels)
        self.lin_value = nn.Linear(inputs, heads * channels)
        self.lin_skip = nn.Linear(inputs, heads * channels)
        self.lin_edge = nn.Linear(edge_dim, heads * channels, bias=False) if edge_dim else None

    def forward(self, x: Tensor, source: Tensor, start: Tensor, edge: Tensor | None = None) -> Tensor:
        """(N, inputs) and (E, edge_dim) to (N, heads * channels)."""
        shape = (-1, self.heads, self.channels)
        key, value = self.lin_key(x).view(shape), self.lin_value(x).view(shape)
        query = self.lin_query(x).view(shape) / math.sqrt(self.channels)
        out = []
        for first, last in _parts(start):
            target = _target(start, first, last)
            origin = source[start[first]:start[last]]
            keys, values = key[origin], value[origin]
            if self.lin_edge is not None and edge is not None:
                along = self.lin_edge(edge[start[first]:start[last]]).view(shape)
                keys, values = keys + along, values + along
            scores = (query[first:last][target] * keys).sum(-1)
            out.append(_attended(scores, values, target, last - first).flatten(1))
        return torch.cat(out) + self.lin_skip(x)


class GATv2Conv(nn.Module):
    """Dynamic graph attention (Brody et al. 2022, "How Attentive are Graph Attention Networks?"), heads side by side.

    No self loops are added: a block's skip brings the vertex's own features.
    """

    def __init__(self, inputs: int, channels: int, heads: int) -> None:
        super().__init__()
        self.heads, self.channels = heads, channels
        self.lin_l = nn.Linear(inputs, heads * channels)
        self.lin_r = nn.Linear(inputs, heads * channels)
        self.att = nn.Parameter(torch.empty(1, heads, channels))
        self.bias = nn.Parameter(torch.zeros(heads * channels))
        nn.init.xavier_uniform_(self.att)

    def forward(self, x: Tensor, source: Tensor, start: Tensor) -> Tensor:
        """(N, inputs) to (N, heads * channels)."""
        shape = (-1, self.heads, self.channels)
        left, right = self.lin_l(x).view(shape), self.lin_r(x).view(shape)
        out = []
        for first, last in _parts(start):
            target = _target(start, first, last)
            theirs = left[source[start[first]:start[last]]]
            scores = (functional.leaky_relu(theirs + right[first:last][target], 0.2) * self.att).sum(-1)
            out.append(_attended(scores, theirs, target, last - first).flatten(1))
        return torch.cat(out) + self.bias
