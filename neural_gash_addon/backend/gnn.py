# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer from a network that reads a pooled graph of the surface: no rays, and occluders however far along it.

The two stages of Neural-GASh (section 4.2), made to see far. Its networks pass messages between neighbours on the
surface, so a vertex knows nothing of a jaw that is near in space and far along the mesh (section 4.4.2). Here the
graph is pooled: its coarse nodes are voxels at a pyramid of scales (`voxels`), and a point has an edge to the node
at each of fifteen distances along each of 25 directions, those of the paper's visibility samples in the frame of the
point's motor (`cones`). Stage 1 is one perceptron that all directions share, with a bias for each: what blocks this
cone. Stage 2 is one of all directions together: the blocked part of the coefficients in the motor's frame, which is
then turned. What is not blocked is exact.

A motor's frame spins about the pole -e_y (see `conformal`). Points that face there are given another, whose pole is
+e_y, and between the two the answers are blended: so no two neighbours differ by where a pole is.

The networks run in NumPy; torch trains them (`training.gnn`).
"""
from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from . import cones, conformal
from . import spherical_harmonics as sh
from .cones import Seen
from .geometry import TriangleMesh
from .voxels import Pyramid
from .workers import BLAS_SERIAL

ORDER = 5              # bands that the network gives
CHUNK = 4096           # points at a time, at most: many, as threads wait for each other between calls of NumPy
_TILE = 64             # outputs and inputs multiplied at a time, at most
_BLEND = (-0.4, -0.6)  # heights of the normal between which the frame's pole changes
_OVER = np.diag([1.0, -1.0, -1.0])  # half a turn about e_x

Network = Mapping[str, NDArray[np.float32]]  # weights (outputs, inputs) and biases of the layers, see `answer`


def blocked(mesh: TriangleMesh, voxels: Pyramid, network: Network, order: int, rows: NDArray) -> NDArray[np.float32]:
    """The blocked part (n, K) of some points, given by their indices (n,); on the calling thread."""
    points, normals = mesh.points[rows], mesh.normals[rows]
    share = np.clip((normals[:, 1] - _BLEND[0]) / (_BLEND[1] - _BLEND[0]), 0, 1)
    share = share * share * (3 - 2 * share)  # of the frame whose pole is +e_y
    one, two = np.flatnonzero(share < 1), np.flatnonzero(share > 0)
    here = np.concatenate([one, two])  # read at once: a small mesh would wait for the calls of NumPy twice
    frames = np.concatenate([frames_of(normals[one], over=False), frames_of(normals[two], over=True)])
    local = answer(cones.read(voxels, points[here], normals[here], frames), network)[:, :order * order]
    turned = np.concatenate([1 - share[one], share[two]])[:, None] * sh.rotate_each(local, frames)
    out = np.zeros((len(rows), order * order), np.float32)
    out[one] = turned[:len(one)]
    out[two] += turned[len(one):]
    return out


def frames_of(normals: NDArray, over: bool) -> NDArray[np.float64]:
    """Rotations (n, 3, 3) that carry e_y to normals (n, 3): of the motor, or of the one whose pole is +e_y."""
    if over:
        normals = normals @ _OVER
    frames = conformal.frames(conformal.motor(np.zeros_like(normals), normals))
    return _OVER @ frames if over else frames


def answer(seen: Seen, network: Network) -> NDArray[np.float32]:
    """The blocked part (n, ORDER**2) in the frames in which `seen` was read."""
    directions, count = conformal.DIRECTION_COUNT, seen.points
    bounds = np.searchsorted(seen.cones, np.arange(directions + 1) * count).tolist()
    # max(x + b, 0) is max(x, -b) + b, and that b goes into the next layer's: a pass less over the most numbers
    bias = (network["direction"] + network["cone.0.bias"]).T  # (units, 25)
    now, empty = _product(network["cone.0.weight"], seen.features), np.zeros_like(bias)
    _clip(now, empty, bias, bounds)
    weight = network["cone.1.weight"]
    bias = weight @ bias + network["cone.1.bias"][:, None]
    now, empty = _product(weight, now), weight @ empty
    _clip(now, empty, bias, bounds)
    # a cone with nothing in it is like all others of its direction, and about half are
    every = np.repeat(empty, count, 1)
    for row, values in zip(every, now, strict=True):
        row[seen.cones] = values
    # einsum, because BLAS would spread so small a product over threads of its own
    bias = np.einsum("ij,j->i", network["point.0.weight"], bias.ravel()) + network["point.0.bias"]
    now = _product(network["point.0.weight"], every.reshape(-1, count))  # of each unit of stage 1, all directions
    now += bias[:, None]
    np.maximum(now, 0, out=now)
    now = _layer(network, "point.1", now)
    np.maximum(now, 0, out=now)
    return _layer(network, "point.2", now).T


def _clip(values: NDArray[np.float32], empty: NDArray[np.float32], bias: NDArray[np.float32], bounds: list[int]
          ) -> None:
    """max(x, -b), in place, of values (units, m) of cones and (units, 25) of empty ones, with biases (units, 25).

    bounds: the cones from one to the next are of one direction.
    """
    np.maximum(empty, -bias, out=empty)
    for direction, (start, stop) in enumerate(pairwise(bounds)):
        part = values[:, start:stop]
        np.maximum(part, -bias[:, direction, None], out=part)


def _layer(network: Network, name: str, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(outputs, n) of values (inputs, n)."""
    out = _product(network[f"{name}.weight"], values)
    out += network[f"{name}.bias"][:, None]
    return out


def _product(weight: NDArray[np.float32], values: NDArray[np.float32]) -> NDArray[np.float32]:
    """weight (outputs, inputs) @ values (inputs, n), as `workers.product`, in tiles: no side is small."""
    inputs = weight.shape[1]
    inner = _divisor(inputs)
    out = _tiled(weight[:, :inner], values[:inner])
    for start in range(inner, inputs, inner):
        out += _tiled(weight[:, start:start + inner], values[start:start + inner])
    return out


def _tiled(weight: NDArray[np.float32], values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same with few inputs."""
    (outputs, inputs), count = weight.shape, values.shape[1]
    rows = _divisor(outputs)
    columns = BLAS_SERIAL // (rows * inputs)
    out = np.empty((outputs, count), np.float32)
    tiles, parts = weight.reshape(-1, 1, rows, inputs), out.reshape(outputs // rows, rows, count)
    whole = count - count % columns
    if whole:
        np.matmul(tiles, values[:, :whole].reshape(inputs, -1, columns).transpose(1, 0, 2),
                  out=parts[:, :, :whole].reshape(len(parts), rows, -1, columns).transpose(0, 2, 1, 3))
    np.matmul(tiles[:, 0], values[:, whole:], out=parts[:, :, whole:])
    return out


def _divisor(side: int) -> int:
    """The largest that is at most _TILE."""
    return next(part for part in range(min(side, _TILE), 0, -1) if side % part == 0)
