# SPDX-License-Identifier: GPL-3.0-or-later
"""The points of a texture: where each covered texel lies on the mesh, and how it is shaded (a G-buffer)."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .geometry import INSET, TEXEL, Surface, TriangleMesh, unit
from .raster import Coverage

REPEAT, EXTEND, CLIP, MIRROR = "REPEAT", "EXTEND", "CLIP", "MIRROR"  # what an image shows beyond 0 to 1
_FARTHEST = 1e9      # UVs beyond have no digits left for a place in an image
_AT_ONCE = 1 << 17  # texels computed at a time, so that memory stays small


@dataclass(frozen=True, eq=False)
class NormalMap:
    """A tangent-space normal map on some of a mesh's triangles."""

    image: NDArray[np.float32]      # (H, W, 3) as stored, 0 to 1; row 0 at the bottom
    strength: float                 # 1: as the image says
    triangles: NDArray[np.bool_]    # (F,) those that are shaded with it
    uv: NDArray[np.float64]         # (C, 2) of each face corner, in the image
    tangents: NDArray[np.float32]   # (C, 4) MikkTSpace tangents in the bake frame, and the bitangent's sign
    extension: str = REPEAT         # see `bilinear`


def texel_points(surface: Surface, coverage: Coverage, normal_maps: Sequence[NormalMap] = ()) -> TriangleMesh:
    """The mesh with a point for every covered texel, in the order of `coverage`.

    Points of a coarse mesh that is shaded smooth are lifted to the smooth surface that its normals
    mean, else the facets would shadow it (Hanika 2021, "Hacking the shadow terminator"). Rays keep
    clear of the geometric surface, whatever a normal map says.

    Returns:
        N points of domain TEXEL; `elements` is empty, as texels are placed by `coverage.texels`.
    """
    corners = surface.corners[coverage.faces]
    count = len(corners)
    points, normals, clearance = (np.empty((count, 3)) for _ in range(3))
    for start in range(0, count, _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        places = surface.positions[surface.corner_vertices[corners[part]]]     # (n, 3, 3)
        shading = surface.corner_normals[corners[part]].astype(np.float64)
        weights = coverage.barycentric[part]
        flat = np.einsum("nc,ncx->nx", weights, places)
        below = np.minimum(np.einsum("ncx,ncx->nc", flat[:, None] - places, shading), 0.0)
        points[part] = flat - np.einsum("nc,ncx->nx", weights * below, shading)
        smooth = unit(np.einsum("nc,ncx->nx", coverage.centres[part], shading))
        normals[part] = smooth
        # along the face: what is at right angles to a normal that leans out of it may lead through it
        clearance[part] = smooth + INSET * unit(places.mean(1) - flat)
    for normal_map in normal_maps:
        mapped = np.flatnonzero(normal_map.triangles[coverage.faces])
        for start in range(0, len(mapped), _AT_ONCE):
            rows = mapped[start:start + _AT_ONCE]
            normals[rows] = _mapped(normal_map, corners[rows], coverage.centres[rows], normals[rows])
    return TriangleMesh(surface.positions, surface.triangles, points, normals, clearance,
                        np.zeros(0, np.int32), TEXEL, surface.resolution, texels=coverage.texels, side=coverage.side)


def scattered(surface: Surface, count: int, generator: np.random.Generator) -> Coverage:
    """Random places on the surface by area, as if they were texels."""
    places = surface.positions[surface.triangles]
    area = np.linalg.norm(np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]), axis=1)
    total = float(area.sum())
    faces = generator.choice(len(area), count, p=area / total if total > 0 else None).astype(np.int32)
    a, b = generator.random((2, count))
    root = np.sqrt(a)
    weights = np.stack([1 - root, root * (1 - b), root * b], 1)
    return Coverage(1, np.arange(count), faces, weights, weights)


def _mapped(normal_map: NormalMap, corners: NDArray, weights: NDArray, smooth: NDArray) -> NDArray[np.float64]:
    """(n, 3) shading normals of points in triangles of these corners (n, 3), as Cycles' Normal Map node has them."""
    uv = np.einsum("nc,ncx->nx", weights, normal_map.uv[corners].astype(np.float64))
    tangents = normal_map.tangents[corners].astype(np.float64)                  # (n, 3, 4)
    tangent = np.einsum("nc,ncx->nx", weights, tangents[..., :3])
    sign = np.einsum("nc,nc->n", weights, tangents[..., 3])
    colour = 2 * bilinear(normal_map.image, uv, normal_map.extension) - 1
    strength = max(normal_map.strength, 0.0)
    colour[:, :2] *= strength
    colour[:, 2] = 1 + (colour[:, 2] - 1) * min(strength, 1.0)
    bitangent = sign[:, None] * np.cross(smooth, tangent)
    mapped = unit(colour[:, :1] * tangent + colour[:, 1:2] * bitangent + colour[:, 2:] * smooth)
    return np.where(np.any(mapped != 0, axis=1, keepdims=True), mapped, smooth)


def bilinear(image: NDArray, uv: NDArray, extension: str = REPEAT) -> NDArray[np.float64]:
    """Colours (n, 3) of an image (H, W, 3) at uv (n, 2); at 0 where that is no number.

    Args:
        extension: what is beyond 0 to 1, as Blender calls it: 'REPEAT', 'EXTEND' (what is at the edge), 'CLIP'
            (black), 'MIRROR' (it repeats, every other time mirrored).
    """
    uv = np.where(np.abs(uv) < _FARTHEST, uv, 0)
    size = np.array(image.shape[1::-1])
    if extension == CLIP:
        image, uv, size = np.pad(image, ((1, 1), (1, 1), (0, 0))), (uv * size + 1) / (size + 2), size + 2
    width, height = size.tolist()
    if extension == MIRROR:
        uv = 1 - np.abs(uv % 2 - 1)
    if extension != REPEAT:
        uv = np.clip(uv, 0.5 / size, 1 - 0.5 / size)
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    column, row = np.floor(x), np.floor(y)
    s, t = (x - column)[:, None], (y - row)[:, None]
    c, r = column.astype(np.int64) % width, row.astype(np.int64) % height
    after, above = (c + 1) % width, (r + 1) % height
    return ((1 - t) * ((1 - s) * image[r, c] + s * image[r, after])
            + t * ((1 - s) * image[above, c] + s * image[above, after]))


def fill_map(covered: NDArray[np.bool_], texels: int = 8) -> NDArray[np.int64]:
    """Which covered texel each texel of a texture shows, so that no filter or mip level reads an empty one.

    Args:
        covered: (side, side). texels: how far from the covered ones the nearest is found; farther
            away, any near one serves, as only small mip levels reach there.
    Returns:
        (side * side,) index of a covered texel; of itself where it is covered; 0 where none is.
    """
    side = covered.shape[0]
    source = np.where(covered, np.arange(side * side).reshape(side, side), -1)
    for _ in range(texels):
        if not (source < 0).any():
            return source.ravel()
        source = _spread(source)
    return np.maximum(_fill(source), 0).ravel()


def mirrored(covered: NDArray[np.bool_], source: NDArray[np.int64], texels: int = 8
             ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Empty texels near covered ones, and for each the covered texel as far inside as it is outside.

    Twice what the nearest covered texel shows, less what the mirrored one does, goes on beyond a chart
    as it goes within: so mip levels, whose texels reach over its outline, are as right there as inside.

    Args:
        covered: (side, side). source: (side * side,) of `fill_map`. texels: how far outside.
    Returns:
        (n,) texels, and (n,) mirrored ones, all in the same part of the texture without a gap between.
    """
    side = covered.shape[0]
    rows, columns = np.nonzero(~covered)
    nearest = source[rows * side + columns]
    up, along = nearest // side - rows, nearest % side - columns
    steps = np.maximum(np.abs(up), np.abs(along))
    near = (steps > 0) & (steps <= texels)
    rows, columns, up, along, steps = (a[near] for a in (rows, columns, up, along, steps))
    whole = np.all([(rows + 2 * up >= 0), (rows + 2 * up < side), (columns + 2 * along >= 0),
                    (columns + 2 * along < side)], axis=0)
    for step in range(1, texels + 1):
        share = 1 + np.minimum(step / steps, 1)
        row = np.clip(np.rint(rows + share * up).astype(np.int64), 0, side - 1)
        column = np.clip(np.rint(columns + share * along).astype(np.int64), 0, side - 1)
        whole &= covered[row, column]
    outside, inside = rows * side + columns, (rows + 2 * up) * side + columns + 2 * along
    return outside[whole], inside[whole]


def _spread(source: NDArray[np.int64]) -> NDArray[np.int64]:
    """Empty texels take the nearest of what their eight neighbours show."""
    side = source.shape[0]
    rows, columns = np.nonzero(source < 0)
    padded = np.pad(source, 1, constant_values=-1)
    best = np.full(len(rows), np.inf)
    chosen = np.full(len(rows), -1)
    for dy in (0, 1, 2):
        for dx in (0, 1, 2):
            seen = padded[rows + dy, columns + dx]
            distance = np.where(seen >= 0, (seen // side - rows) ** 2.0 + (seen % side - columns) ** 2.0, np.inf)
            nearer = distance < best
            best[nearer], chosen[nearer] = distance[nearer], seen[nearer]
    out = source.copy()
    out[rows, columns] = chosen
    return out


def _fill(source: NDArray[np.int64]) -> NDArray[np.int64]:
    """Empty texels take what a texel shows that shares their cell of the finest grid in which one is full."""
    side = source.shape[0]
    if side == 1 or not (source < 0).any():
        return source
    half = (side + 1) // 2
    padded = np.full((2 * half, 2 * half), -1)
    padded[:side, :side] = source
    coarse = _fill(padded.reshape(half, 2, half, 2).max((1, 3)))
    return np.where(source < 0, coarse.repeat(2, 0).repeat(2, 1)[:side, :side], source)
