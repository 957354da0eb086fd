# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes to train on, made from a seed: many kinds of shape, all free to use.

The same seed gives the same mesh with the same versions of NumPy, SciPy, trimesh and Blender.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from . import objects, organic, places
from .solids import Mesh, about, place, tidy, to_size

VERSION = 1              # raised whenever a seed gives another mesh, so that labels of old ones are not used
FEWEST, MOST = 500, 20_000
_MEDIAN, _SPREAD = 3700, 0.75  # of the log-normal number of vertices aimed at; the mean that comes is about 5,000
_COARSE = 0.2            # of the meshes keep the long thin triangles that they were built with, where they have any
_CREASED = 0.35          # of the meshes are shaded with creases at sharp edges, the others smooth all over
_ATTEMPTS = 20

# what each kind gets of the seeds
CATEGORIES: dict[str, tuple[Callable[[np.random.Generator, int], Mesh], float]] = {
    "primitive": (objects.primitive, 1.0), "suzanne": (objects.suzanne, 0.7), "boolean": (objects.booleans, 1.5),
    "remesh": (objects.remesh, 1.2), "displaced": (organic.displaced, 1.0), "scatter": (places.scatter, 1.5),
    "plates": (places.plates, 0.8), "scissors": (objects.scissors, 1.0), "forceps": (objects.forceps, 1.0),
    "pliers": (objects.pliers, 1.0), "gear": (objects.gear, 0.8), "vessel": (objects.vessel, 1.0),
    "spring": (objects.spring, 0.5), "room": (places.room, 1.2), "stack": (places.stack, 0.7),
    "stairs": (places.stairs, 0.7), "columns": (places.columns, 0.7), "terrain": (places.terrain, 0.5),
    "blobs": (organic.blobs, 1.2), "hollow": (organic.hollow, 1.2), "porous": (organic.porous, 0.6),
    "figure": (organic.figure, 1.5), "tree": (organic.tree, 0.7), "vessels": (organic.vessels, 0.7),
    "folds": (organic.folds, 1.2), "knot": (organic.knot, 0.7), "cloth": (organic.cloth, 0.6),
}
OPEN = ("room", "terrain", "cloth", "suzanne")  # kinds that have borders


class Generated(NamedTuple):
    """A mesh and how it is to be shaded."""

    category: str
    positions: NDArray[np.float64]   # (V, 3)
    triangles: NDArray[np.int32]     # (F, 3) counter-clockwise from outside; rooms from inside
    crease: float | None             # radians between faces from which an edge is sharp; None: smooth all over


def category_of(seed: int) -> str:
    """The kind of mesh that a seed gives."""
    names = list(CATEGORIES)
    shares = np.array([CATEGORIES[name][1] for name in names])
    return names[int(np.random.default_rng([seed, 0]).choice(len(names), p=shares / shares.sum()))]


def generate(seed: int, category: str | None = None) -> Generated:
    """The mesh of a seed; of a certain category, where one is given.

    Raises:
        RuntimeError: no attempt gave a valid mesh, which is a fault of the category.
    """
    category = category or category_of(seed)
    build = CATEGORIES[category][0]
    for attempt in range(1, _ATTEMPTS + 1):
        rng = np.random.default_rng([seed, attempt])
        target = int(np.clip(np.exp(rng.normal(np.log(_MEDIAN), _SPREAD)), 1.2 * FEWEST, 0.75 * MOST))
        coarse = rng.random() < _COARSE
        mesh = tidy(build(rng, target))
        if not len(mesh[1]):
            continue
        mesh = to_size(mesh, max(FEWEST, target // 4) if coarse else target)
        crease = float(np.radians(rng.uniform(25, 65))) if rng.random() < _CREASED else None
        # mostly upright, as things stand in a scene; some any way up
        turn = about("z", rng.uniform(0, 2 * np.pi))
        if rng.random() < 0.3:
            turn = Rotation.random(random_state=np.random.RandomState(int(rng.integers(2**31))))
        mesh = place(mesh, turn=turn)
        if FEWEST <= len(mesh[0]) <= MOST and np.isfinite(mesh[0]).all():
            return Generated(category, np.ascontiguousarray(mesh[0]), np.ascontiguousarray(mesh[1], np.int32), crease)
    raise RuntimeError(f"No mesh of the category '{category}' came of seed {seed}.")
