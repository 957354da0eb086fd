# SPDX-License-Identifier: GPL-3.0-or-later
"""World matrices as arrays, and the rotation in them: the frame of a bake."""
from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def as_array(matrix) -> Array:
    """A mathutils matrix as float64."""
    return np.array(matrix, dtype=np.float64)


def rotation_part(matrix: Array) -> Array:
    """Nearest rotation (3, 3) to a world matrix (4, 4), by polar decomposition; a mirror's is -matrix's.

    If an object is only turned by Q between two times, the rotation parts satisfy
    R_now = Q R_then, also under shear, uneven scale and mirrors.
    """
    left, _, right = np.linalg.svd(matrix[:3, :3])
    rotation = left @ right
    return rotation if np.linalg.det(rotation) > 0 else -rotation


def world_matrix(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> Array:
    """The object's world matrix (4, 4): that of the frame which a depsgraph is of, where one is given.

    A render has a depsgraph of its own; the object itself stands as it does in the frame that the window shows.
    """
    return as_array((obj.evaluated_get(depsgraph) if depsgraph else obj).matrix_world)


def bake_frame(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> Array:
    """Rotation part (3, 3) of `world_matrix`, determinant 1."""
    return rotation_part(world_matrix(obj, depsgraph))
