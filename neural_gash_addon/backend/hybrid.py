# SPDX-License-Identifier: GPL-3.0-or-later
"""Few rays, and a small network that says how much of its neighbours' blocked part each point takes.

Every point's blocked part B_i is traced with few rays. Points are then laid along a space-filling curve and cut into
blocks of SIZE (after Wu et al. 2024, "Point Transformer V3": neighbours by sorting, not by searching). Within a block,
band by band, each becomes a mean, (s B_i + sum_j w_ij B_j) / (s + sum_j w_ij), where -log w_ij is a quadratic form of
how far apart two points are, how far one is off the other's tangent plane, how they face, and how what the rays saw
differs. The coefficients of that form, and s, are what the network gives, once for each block. A second pass does the
same along another curve, whose blocks have their borders elsewhere.

Nothing in it changes when the mesh is moved or scaled, or turned (the curves are laid in axes of its own): so the
answer turns with the mesh. s grows with the rays: with many, the traced value stays. Where nothing was blocked in a
block, nothing is computed.

The network is a perceptron with one hidden layer for each pass; it runs in NumPy.
"""
from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import spherical_harmonics as sh
from .estimator import morton_order
from .geometry import unit

SIZE = 32                 # points of a block
CONTEXT = 7               # numbers that the network sees of a block, see `_context`
FORMS = 5                 # coefficients of the form: distance, tangent plane, normals, band 0, band 1
FULL = 0.5 / np.pi ** 0.5  # coefficient 0 of a point of which all is blocked
LEAST, MOST = -6.0, 12.0  # of the logarithms that the network gives
HALF = 64.0               # rays at which s is twice what it is with none
TINY = 1e-6               # of a variance: below the noise of any number of rays
_BLOCKS = 64, 128         # at a time, at least and at most: less is all overhead, more overflows the cache
_BETWEEN = 1024           # gaps filled by one worker at a time
_TURN = np.array([[0.8, -0.48, 0.36], [0.6, 0.64, -0.48], [0.0, 0.6, 0.8]])  # of the second curve


@dataclass(frozen=True, eq=False)
class Layer:
    """One layer of a perceptron."""

    weight: NDArray[np.float32]  # (inputs, outputs)
    bias: NDArray[np.float32]    # (outputs,)


Network = Sequence[Sequence[Layer]]  # of each pass, its layers


def placed(points: NDArray, normals: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (N, 3) about their mean and normals (N, 3), in axes of their own; unit: twice the reach of the farthest.

    The first axis leads to the farthest point, the second to the one that is farthest from it. So they are the same
    however they are turned, moved and scaled; and however they are listed, unless several points are equally far: of
    those, the first counts.
    """
    away = np.ascontiguousarray(points.T)
    away = away - away.mean(1, keepdims=True)
    reach = np.sqrt(np.square(away).sum(0))
    most = float(reach.max(initial=0.0)) or 1.0
    one = unit(away[:, _first_of_the_greatest(reach)])
    off = away - one[:, None] * np.einsum("xn,x->n", away, one)
    two = unit(off[:, _first_of_the_greatest(np.square(off).sum(0))])
    axes = np.stack([one, two, np.cross(one, two)])
    return _turned(axes / (2 * most), away), _turned(axes, np.ascontiguousarray(normals.T))


def _first_of_the_greatest(values: NDArray) -> int:
    """Of (N,), rounding aside."""
    return int(np.argmax(values >= values.max() * (1 - 1e-9)))


def curves(places: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each pass, indices (N,) that walk the points (N, 3), `placed`, along a curve."""
    return morton_order(places), second_curve(places)


def second_curve(places: NDArray) -> NDArray[np.int64]:
    """The second of `curves`. The first is `morton_order` itself."""
    return morton_order(_turned(_TURN.T, places.T))


def evenness(normals: NDArray) -> float:
    """How alike the normals (N >= SIZE, 3) of a block of the curve along which they lie face: 0 (all ways) to 1."""
    whole = len(normals) - len(normals) % SIZE
    means = np.einsum("bnx->bx", normals[:whole].reshape(-1, SIZE, 3)) / SIZE
    return float(np.square(means).sum(1).mean())


def _turned(axes: NDArray, rows: NDArray) -> NDArray[np.float64]:
    """(axes (3, 3) @ rows (3, N)).T, not by BLAS: its threads would spin for a while on cores that trace rays."""
    return np.einsum("xy,yn->xn", axes, rows).T


def levelled(blocked: NDArray, unshadowed: NDArray, sign: int) -> NDArray[np.float32]:
    """Blocked part (n, K) less (sign -1) or plus (1) what it would be if as much of the sky were blocked evenly.

    unshadowed: (n, K) of the same points. A neighbour that faces another way is so read as it would be here.
    """
    out = np.array(blocked, np.float32)
    out[:, 1:] += sign * blocked[:, :1] * unshadowed[:, 1:] / np.float32(FULL)
    return out


def filtered(places: NDArray, normals: NDArray, orders: Sequence[NDArray | None], blocked: NDArray[np.float32],
             unshadowed: NDArray[np.float32], rays: int, network: Network, pool: Executor
             ) -> NDArray[np.float32]:
    """The blocked part of all points after all passes.

    What is passed on is the share that is blocked (in coefficient 0), and how the rest differs from
    that share of the unshadowed transfer: a neighbour that faces another way is so read as it would
    be here if its sky were blocked evenly. Exact where all is blocked, or nothing.

    Args:
        places, normals: (N, 3) from `placed`. orders: from `curves`; None: along the points as they are.
        blocked: (N, K), traced with `rays` rays from each point. unshadowed: (N, K).
        network: from `weights.load_hybrid`.
    Returns:
        (N, K).
    """
    count, terms = blocked.shape
    known = np.concatenate([places.T, normals.T], dtype=np.float32)
    even = unshadowed.T[1:] / np.float32(FULL)  # NumPy is quick along long last axes
    now = np.empty((terms + 1, count), np.float32)
    now[:terms] = blocked.T
    now[1:terms] -= now[0] * even
    now[terms] = 1  # it counts, in sums over neighbours
    for order, layers in zip(orders, network, strict=True):
        out = np.empty((terms + 1, count + 1), np.float32)
        out[terms] = 1
        every = blocks(np.arange(count) if order is None else order)
        size, rest = every.shape[1], count % every.shape[1]
        into = every.copy()
        into[-1:, :-count % size] = count  # the last column is for what the block before has already
        step = int(np.clip(len(every) // 4 + 1, *_BLOCKS))  # work for all threads, where it is enough

        def part(start: int, now: NDArray = now, out: NDArray = out, order: NDArray | None = order,
                 every: NDArray = every, into: NDArray = into, size: int = size, rest: int = rest, step: int = step,
                 layers: Sequence[Layer] = layers) -> None:
            rows, along = every[start:start + step], slice(start * size, (start + step) * size)
            straight = order is None and (not rest or start + step < len(every))  # nothing is to be fetched
            values, here = (a[:, along].reshape(len(a), -1, size) if straight else a.take(rows, 1)
                            for a in (now[:, :count], known))
            seen = values[0].any(1)
            if seen.all():
                found = mixed(here[:3], here[3:], values, rays, layers)
            else:
                found = values[:terms].copy()
                if seen.any():
                    values, here = values[:, seen], here[:, seen]
                    found[:, seen] = mixed(here[:3], here[3:], values, rays, layers)
            found = found.reshape(terms, -1)
            if straight:
                out[:terms, along.start:along.start + found.shape[1]] = found
            else:
                targets = into[start:start + step].ravel()
                for row, column in zip(out, found, strict=False):
                    row[targets] = column

        list(pool.map(part, range(0, len(every), step)))
        now = out
    found = now[:terms, :count]
    found[1:] += found[0] * even
    return found.T


def between(some: NDArray[np.float32], unshadowed: NDArray[np.float32], pool: Executor
            ) -> NDArray[np.float32]:
    """The blocked part of all points (n, K) along a curve, from that of the first, the third and so on.

    The others take the mean of the two beside them, as `filtered` passes on what is blocked.

    Args:
        some: (ceil(n / 2), K). unshadowed: (n, K).
    """
    out = np.empty(unshadowed.shape, np.float32)

    def part(start: int) -> None:
        here = some[start:start + _BETWEEN + 1]  # and the one after
        even = unshadowed[2 * start:2 * (start + len(here)), 1:] / np.float32(FULL)
        filled = out[2 * start:2 * (start + _BETWEEN)]
        filled[::2] = here[:_BETWEEN]
        gaps = filled[1::2]
        values = here.copy()
        values[:, 1:] -= values[:, :1] * even[::2]
        gaps[:] = values[:len(gaps)]
        both = gaps[:len(values) - 1]
        both += values[1:]
        both *= np.float32(0.5)
        gaps[:, 1:] += gaps[:, :1] * even[1::2][:len(gaps)]

    list(pool.map(part, range(0, len(some), _BETWEEN)))
    return out


def blocks(order: NDArray) -> NDArray[np.int64]:
    """(b, SIZE) of an order (N,), cut into as many as that takes; the last reaches back until it is whole too.

    All in one block where there are fewer points than it would have.
    """
    size = max(min(SIZE, len(order)), 1)
    whole = len(order) - len(order) % size
    out = order[:whole].reshape(-1, size)
    return out if whole == len(order) else np.concatenate([out, order[None, -size:]])


def mixed(places: NDArray[np.float32], normals: NDArray[np.float32], values: NDArray[np.float32], rays: int,
          layers: Sequence[Layer]) -> NDArray[np.float32]:
    """One pass of b blocks of n points.

    Args:
        places, normals: (3, b, n): NumPy is quick along long last axes.
        values: (K + 1, b, n), of which the last is 1. rays: from each point.
    Returns:
        (K, b, n).
    """
    terms, count, points = len(values) - 1, *places.shape[1:]
    bands = sh.order_of(terms)
    mean = np.full(points, 1 / points, np.float32)  # of a block, as a product
    away = places - (places @ mean)[..., None]
    squares = dot(away, away)
    size = np.sqrt(squares @ mean) + np.float32(1e-9)
    away /= size[:, None]
    squares /= np.square(size)[:, None]
    seen = values[:4].copy()
    context = _context(size, normals, seen, rays, mean)
    distance, plane, facing, first, second, *own = perceptron(context, layers, bands).T[..., None]
    # log w, but for the tangent planes: what depends on one point only, and products of two
    seen[0] *= np.sqrt(first)
    seen[1:] *= np.sqrt(second)
    alone = distance * squares
    alone += dot(seen, seen)
    one, other = np.empty((2, 12, count, points), np.float32)
    np.multiply(away, 2 * distance, out=one[:3])
    np.multiply(normals, facing, out=one[3:6])
    np.multiply(seen, 2, out=one[6:10])
    np.subtract(-facing, alone, out=one[10])
    one[11] = other[10] = 1
    other[:3], other[3:6], other[6:10] = away, normals, seen
    np.negative(alone, out=other[11])
    weight = other.transpose(1, 2, 0) @ one.transpose(1, 0, 2)  # (b, other, one)
    # how far the other lies off one's tangent plane
    np.multiply(normals, np.sqrt(plane), out=one[:3])
    np.negative(dot(one[:3], away), out=one[3])
    other[3] = 1
    height = other[:4].transpose(1, 2, 0) @ one[:4].transpose(1, 0, 2)
    weight -= np.square(height, out=height)
    sums = (values.transpose(1, 0, 2) @ np.exp(weight, out=weight)).transpose(1, 0, 2)
    mine = np.stack(own) * np.float32((HALF + rays) / HALF)  # (bands, b, 1)
    out = np.repeat(mine, 2 * np.arange(bands) + 1, 0) * values[:terms]
    out += sums[:terms]
    for band, total in enumerate(mine + sums[terms]):
        out[band ** 2:(band + 1) ** 2] /= total
    return out


def dot(one: NDArray[np.float32], two: NDArray[np.float32]) -> NDArray[np.float32]:
    """Of vectors (k, ...)."""
    out = one[0] * two[0]
    for a, b in zip(one[1:], two[1:], strict=True):
        out += a * b
    return out


def _context(size: NDArray[np.float32], normals: NDArray[np.float32], seen: NDArray[np.float32], rays: int,
             mean: NDArray[np.float32]) -> NDArray[np.float32]:
    """(b, CONTEXT) of blocks: their size (b,), how their points face (3, b, n), what they see (4, b, n)."""
    average = seen @ mean
    apart = seen - average[..., None]
    varying = np.square(apart, out=apart) @ mean
    out = np.empty((CONTEXT, len(size)), np.float32)
    out[0], out[3] = size, varying[0] + np.float32(TINY)
    out[4] = varying[1:].sum(0) + np.float32(TINY)
    out[1] = 2 * np.square(normals @ mean).sum(0)
    out[2] = 4 * average[0]
    for row in out[0], out[3], out[4]:
        np.log(row, out=row)
        row *= np.float32(0.5)
    out[5] = 0.5 * np.log(rays)
    out[6] = np.log(len(mean)) - 3
    return out.T


def perceptron(seen: NDArray[np.float32], layers: Sequence[Layer], bands: int) -> NDArray[np.float32]:
    """(b, FORMS + bands) from `_context`: the coefficients of the form, and s of each band."""
    for layer in layers[:-1]:
        seen = np.maximum(seen @ layer.weight + layer.bias, 0)
    last = layers[-1]
    out = seen @ last.weight[:, :FORMS + bands] + last.bias[:FORMS + bands]
    return np.exp(np.clip(out, LEAST, MOST))
