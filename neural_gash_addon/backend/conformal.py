# SPDX-License-Identifier: GPL-3.0-or-later
"""Conformal geometric algebra R(4,1): the motor that stands for a surface point, and what networks see of it.

A multivector is 32 numbers on the last axis, by grade and then by index, as in `BLADES`: 1, e1 .. e5,
e12, e13, e14, e15, e23 .. e45, e123 .. e345, e1234 .. e2345, e12345. Here e1, e2, e3 are x, y, z,
e4 squares to +1 and e5 to -1; e_inf = e4 + e5 is the point at infinity, e_o = (e5 - e4) / 2 the origin, and
p + p.p/2 e_inf + e_o the point p. (The packages clifford and kingdon order blades the same way.)

Every function takes NumPy arrays or torch tensors and answers in kind, with their dtype and on their device;
torch is never imported here. Source: Neural-GASh, section 2.2, equations (4) and (5).

The pole. The motor M = T R turns e_y to the normal n by the shortest arc, of angle t. At n = -e_y every arc is as
short as the others: going round the pole, R goes round a circle of radius 1. No other choice of R mends that: one
that were continuous would be a continuous frame on the sphere, which there is not. Hence two functions:
`motor` is the paper's, of unit norm everywhere and accurate up to the pole; at the pole itself it takes the arc
through e_x. It suits what needs a frame. `encode` is T R R, the paper's motor with its rotor applied twice, and is
what a continuous network needs: R R = n e_y = n_y + n_x e12 - n_z e23 is linear in n and blind to the sign and to
the arc of R, so it has no half angle and no pole. It is as long as the motor, fills the same blades, still carries
the origin to the point, and tells every point and normal from every other; a step of the normal is a step of the
same length in R R, at the pole as elsewhere. What a continuous network predicts from it, in the axes of the mesh,
therefore does not jump. What it predicts in the motor's frame turns with that frame, twice round the pole.
"""
from __future__ import annotations

import sys
from functools import lru_cache
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = Any  # a NumPy array or a torch tensor; arguments of one call are of one kind, dtype and device

# the vectors in each blade, counted from 1
BLADES: tuple[tuple[int, ...], ...] = tuple(b for grade in range(6) for b in combinations(range(1, 6), grade))
BLADE_COUNT = len(BLADES)  # 32
DIRECTION_COUNT = 25  # visibility samples per point, Neural-GASh section 4.2.1

_REVERSE = [(-1) ** (len(b) * (len(b) - 1) // 2) for b in BLADES]
_SCALAR, _E12, _E13, _E23 = (BLADES.index(b) for b in ((), (1, 2), (1, 3), (2, 3)))
# v e_inf = v e4 + v e5, so one number of the translation fills two blades
_AT_INFINITY = [(BLADES.index((*v, 4)), BLADES.index((*v, 5))) for v in ((1,), (2,), (3,), (1, 2, 3))]
_COMPACT = [_SCALAR, _E12, _E13, _E23, *(first for first, _ in _AT_INFINITY)]


def _library(array: Array) -> Any:
    """The module, numpy or torch, whose functions work on this array; TypeError for anything else."""
    if isinstance(array, np.ndarray):
        return np
    torch = sys.modules.get("torch")  # where there is a tensor, there is torch
    if torch is not None and isinstance(array, torch.Tensor):
        return torch
    raise TypeError(f"a NumPy array or a torch tensor is needed, not {type(array).__name__}")


def _constant(values: NDArray | list[int], like: Array) -> Array:
    """A few numbers as an array of the kind, dtype and device of `like`."""
    if _library(like) is np:
        return np.asarray(values, dtype=like.dtype)
    return like.new_tensor(values)


@lru_cache(maxsize=1)
def product_table() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Products of blades, e_i e_j = sign[i, j] e_index[i, j]: (index, sign), each (32, 32).

    Sorting the vectors of both blades gives a sign by exchange; vectors met twice go, with their square.
    """
    index = np.zeros((BLADE_COUNT, BLADE_COUNT), dtype=np.int64)
    sign = np.zeros_like(index)
    for i, left in enumerate(BLADES):
        for j, right in enumerate(BLADES):
            exchanges = sum(a > b for a in left for b in right)
            negative = exchanges + (5 in left and 5 in right)  # e5 e5 = -1
            index[i, j] = BLADES.index(tuple(sorted(set(left) ^ set(right))))
            sign[i, j] = (-1) ** negative
    index.setflags(write=False)
    sign.setflags(write=False)
    return index, sign


def multiply(left: Array, right: Array) -> Array:
    """Geometric product: (..., 32) and (..., 32) to (..., 32), leading axes broadcast."""
    index, sign = product_table()
    total = 0
    for i in range(BLADE_COUNT):
        # e_i e_j = +-e_k has j = index[i, k] too, because e_i e_i = +-1
        j = index[i]
        total = total + left[..., i:i + 1] * (right[..., j.tolist()] * _constant(sign[i, j], right))
    return total


def reverse(multivectors: Array) -> Array:
    """Each blade's vectors in reverse order: (..., 32) to (..., 32). The inverse of a unit motor."""
    return multivectors * _constant(_REVERSE, multivectors)


def sandwich(motors: Array, multivectors: Array) -> Array:
    """M X ~M: what the motors, (..., 32), carry the multivectors, (..., 32), to. Leading axes broadcast."""
    return multiply(multiply(motors, multivectors), reverse(motors))


def motor(points: Array, normals: Array) -> Array:
    """The paper's motor M = T R, which carries the origin to the point and e_y to the normal.

    Args:
        points: (..., 3), any unit.
        normals: (..., 3), of any length; a zero normal counts as e_y.
    Returns:
        (..., 32), M ~M = 1. At n = -e_y, R = e12. Not to be differentiated there: `encode` can be, everywhere.
    Errors:
        ValueError where the shapes differ or do not end in 3.
    """
    lib = _library(points)
    _check(points, normals)
    x, y, z = normals[..., 0], normals[..., 1], normals[..., 2]
    radius = lib.hypot(x, z)  # squares of what float32 holds near the pole may underflow, hypot does not
    length = lib.hypot(radius, y)
    y = lib.where(length > 0, y, lib.ones_like(y))
    length = lib.where(length > 0, length, lib.ones_like(y))
    # cos(t/2) and sin(t/2); the larger from a sum of numbers of one sign, the smaller from sin t = 2 sin cos: there
    # is no cancellation as there is in n + e_y near the pole
    larger = lib.sqrt(0.5 + 0.5 * abs(y) / length)
    smaller = 0.5 * (radius / length) / larger
    up = y >= 0
    cosine, sine = lib.where(up, larger, smaller), lib.where(up, smaller, larger)
    off = radius > 1e-30 * length  # nearer is the pole: with subnormal numbers x / radius has no digits left
    divisor = lib.where(off, radius, lib.ones_like(radius))
    return _assemble(points, cosine, sine * lib.where(off, x / divisor, lib.ones_like(x)), -sine * (z / divisor))


def encode(points: Array, normals: Array) -> Array:
    """What a network sees of a surface point: T R R, continuous everywhere (see above).

    Args:
        points: (..., 3), any unit; networks want them near 1.
        normals: (..., 3) unit vectors; a zero normal gives zero.
    Returns:
        (..., 32), of unit norm as the motor is. A polynomial: linear in the normal and in the point.
    Errors:
        ValueError where the shapes differ or do not end in 3.
    """
    _check(points, normals)
    return _assemble(points, normals[..., 1], normals[..., 0], -normals[..., 2])


def _check(points: Array, normals: Array) -> None:
    if points.shape != normals.shape or points.shape[-1:] != (3,):
        raise ValueError(f"points {tuple(points.shape)} and normals {tuple(normals.shape)} must both be (..., 3)")


def _assemble(points: Array, scalar: Array, e12: Array, e23: Array) -> Array:
    """T R for the rotor R = scalar + e12 + e23: R - 1/2 (p R) e_inf, (..., 32)."""
    x, y, z = -0.5 * points[..., 0], -0.5 * points[..., 1], -0.5 * points[..., 2]
    translation = (x * scalar - y * e12, y * scalar + x * e12 - z * e23, z * scalar + y * e23, x * e23 + z * e12)
    shape, like = (*scalar.shape, BLADE_COUNT), translation[0]
    out = np.zeros(shape, dtype=like.dtype) if _library(points) is np else like.new_zeros(shape)
    out[..., _SCALAR], out[..., _E12], out[..., _E23] = scalar, e12, e23
    for value, (with_e4, with_e5) in zip(translation, _AT_INFINITY, strict=True):
        out[..., with_e4] = value
        out[..., with_e5] = value
    return out


def compact(motors: Array) -> Array:
    """The 8 numbers of a motor that are not copies or zero by grade: (..., 32) to (..., 8).

    In order: 1, e12, e13, e23, then e1, e2, e3 and e123 times e_inf; those of a dual quaternion. The third is
    zero for `motor` and `encode`, not for their products.
    """
    return motors[..., _COMPACT]


def frames(motors: Array) -> Array:
    """The rotation part of unit motors: (..., 32) to (..., 3, 3), columns the images of e_x, e_y, e_z.

    For `motor` the second column is the normal. The matrix of the quaternion (1, -e23, e13, -e12).
    """
    w, x, y, z = motors[..., _SCALAR], -motors[..., _E23], motors[..., _E13], -motors[..., _E12]
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return _library(motors).stack(rows, -1).reshape((*w.shape, 3, 3))


@lru_cache(maxsize=1)
def hemisphere_directions() -> NDArray[np.float64]:
    """The 25 directions of the visibility samples, in the motor's frame: (25, 3) unit vectors about e_y.

    The paper says only that they are sampled on the hemisphere. Here they are a sunflower in the unit disc, raised
    to the hemisphere (Malley's method): density cos/pi, so the visible share is the ambient occlusion, and each
    direction stands for as much irradiance as any other. The lowest is 8 degrees above the surface.
    """
    i = np.arange(DIRECTION_COUNT)
    share = (i + 0.5) / DIRECTION_COUNT
    phi = i * np.pi * (3 - np.sqrt(5))
    out = np.stack([np.sqrt(share) * np.cos(phi), np.sqrt(1 - share), np.sqrt(share) * np.sin(phi)], 1)
    out.setflags(write=False)
    return out
