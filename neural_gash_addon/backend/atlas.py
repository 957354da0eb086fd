# SPDX-License-Identifier: GPL-3.0-or-later
"""The UVs and the size of a texture, for one mesh or for several that share it."""
from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .geometry import Surface
from .progress import scaled
from .raster import CHECKED_SIDE, Layout, check_range
from .resolution import MAX_FIT, Trial, fitting_density
from .unwrap import Atlas, Charts, cut, lay_out

MIN_SIDE, MAX_SIDE = 16, 8192
_COLLAPSED = 1e-6  # of the texels that a face has for its area on the mean: less is none
_MOST_LOST = 1e-3  # of a mesh's area, in faces that have none: slivers that nobody sees


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh that gets room in a texture."""

    surface: Surface
    uv: NDArray | None = None   # (C, 2) of each face corner that it has already
    trial: Trial | None = None  # where the error decides how fine the texture is: `resolution.fitting_side` of the mesh
    name: str = ""              # to tell meshes apart in messages


@dataclass(frozen=True, eq=False)
class Placed:
    """Where a mesh is in a texture."""

    uv: NDArray        # (C, 2) of each face corner, 0 to 1
    single_faces: int  # that lie alone in an atlas, as they cannot be charted with their neighbours


def check_part(part: Part) -> None:
    """UserError for a mesh that no texture has room for, whatever else is in it."""
    if part.uv is not None:
        check_range(part.uv[part.surface.corners])
    elif not _areas(part.surface).any():
        raise UserError("All faces have an area of zero, so a texture has nothing to show; bake to vertices.")


def check_area(part: Part) -> None:
    """UserError where a person's UVs, which `check_part` let pass, give faces no area. An atlas may have to."""
    if part.uv is None:
        return
    areas, uv = _areas(part.surface), np.asarray(part.uv, np.float64)[part.surface.corners]
    (a, b), (c, d) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    room = np.abs(a * d - b * c)
    lost = room * areas.sum() <= _COLLAPSED * areas * room.sum()
    if areas[lost].sum() > _MOST_LOST * areas.sum():
        faces = np.unique(part.surface.polygons[lost & (areas > 0)])
        raise UserError(f"{len(faces):,} of the faces have no area in the UV map (the first is {faces[0]}), so a "
                        "texture has no place for them; unwrap them, or let the bake make its own UV map.")


def _areas(surface: Surface) -> NDArray[np.float64]:
    """(F,) twice the area of each triangle."""
    places = surface.positions[surface.triangles]
    found: NDArray[np.float64] = np.linalg.norm(
        np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]), axis=1)
    return found


def place(parts: Sequence[Part], *, side: int | None = None, texels_per_metre: float | None = None, padding: int = 2,
          ) -> Generator[float, None, tuple[list[Placed], int]]:
    """UVs for meshes in one texture without overlaps, and its size.

    Args:
        parts: all of them with UVs or none; all with a trial or none.
        side: texels a side, or texels_per_metre where the UVs are to be made; or neither, where trials decide: each
            mesh then gets as many texels as its own shadows need.
        padding: texels between charts.
    Yields:
        Progress, 0 to 1.
    Returns:
        Where each mesh is, and the side.
    Raises:
        UserError: sizes out of range, UVs outside the texture or missing room, faces that overlap.
    """
    trials = [part.trial for part in parts if part.trial is not None]
    if not trials:
        _check_side(side, texels_per_metre if parts[0].uv is None else None)
    for part in parts:
        check_part(part)
    uvs = [part.uv for part in parts if part.uv is not None]
    if uvs:
        _check_overlaps(parts, uvs, min(side or CHECKED_SIDE, CHECKED_SIDE))
        for number, (trial, uv) in enumerate(zip(trials, uvs, strict=False)):
            side = max(side or 0, (yield from scaled(trial(uv), number / len(parts), 1 / len(parts))))
        return [Placed(uv, 0) for uv in uvs], side or 0
    charts, scales = [], []
    for number, part in enumerate(parts):
        here, share = 0.8 * number / len(parts), 0.8 / len(parts)
        charts.append((yield from scaled(cut(part.surface), here, 0.7 * share)))
        scale = 1.0
        if part.trial is not None:
            scale = yield from scaled(fitting_density(charts[-1], part.trial), here + 0.7 * share, 0.3 * share)
        scales.append(scale)
    joined = Charts.joined(charts, scales)
    if trials:
        atlas = yield from scaled(_fitted(joined, padding), 0.8, 0.2)
    else:
        laying = lay_out(joined, side=side, texels_per_metre=texels_per_metre, padding=padding)
        atlas = yield from scaled(laying, 0.8, 0.2)
        if side is None:
            _check_density(atlas.side)
    uvs = np.split(atlas.uv, np.cumsum([c.corner_count for c in charts])[:-1])
    alone = np.split(atlas.alone, np.cumsum([len(c.polygons) for c in charts])[:-1])
    return [Placed(uv, len(np.unique(c.polygons[a]))) for uv, a, c in zip(uvs, alone, charts, strict=True)], atlas.side


def _fitted(charts: Charts, padding: int) -> Generator[float, None, Atlas]:
    """Charts measured in texels, in a texture as large as that takes, within what an error may ask for."""
    atlas = yield from lay_out(charts, side=None, texels_per_metre=1.0, padding=padding)
    if not MIN_SIDE <= atlas.side <= MAX_FIT:
        atlas = yield from lay_out(charts, side=MIN_SIDE if atlas.side < MIN_SIDE else MAX_FIT, padding=padding)
    return atlas


def _check_density(side: int) -> None:
    """UserError unless a density gives a texture that can be baked."""
    if not MIN_SIDE <= side <= MAX_SIDE:
        choose = "fewer" if side > MAX_SIDE else "more"
        raise UserError(f"At this density the texture would have {side:,.0f} texels a side, and {MIN_SIDE} to "
                        f"{MAX_SIDE} can be baked; choose {choose} texels per metre.")


def _check_side(side: int | None, texels_per_metre: float | None) -> None:
    """UserError unless a texture of this size can be baked."""
    if side is None:
        if not (texels_per_metre is not None and 0 < texels_per_metre < np.inf):
            raise UserError("Give a resolution, or a positive number of texels per metre.")
    elif not MIN_SIDE <= side <= MAX_SIDE:
        raise UserError(f"The resolution must be {MIN_SIDE} to {MAX_SIDE} texels, not {side}.")


def _check_overlaps(parts: Sequence[Part], uvs: Sequence[NDArray], side: int) -> None:
    """UserError that names faces which claim the same texels, or have UVs outside the texture."""
    counts = [len(part.surface.triangles) for part in parts]
    vertices = np.cumsum([0] + [len(part.surface.positions) for part in parts])
    places = np.concatenate([uv[part.surface.corners] for part, uv in zip(parts, uvs, strict=True)])
    triangles = np.concatenate([part.surface.triangles + n for part, n in zip(parts, vertices, strict=False)])
    pairs = Layout(places, triangles, side).overlapping()
    if not len(pairs):
        return
    owner = np.repeat(np.arange(len(parts)), counts)
    face = np.concatenate([part.surface.polygons for part in parts])
    stride = int(face.max()) + 1
    found = np.unique(np.sort(owner[pairs] * stride + face[pairs], axis=1), axis=0)

    def named(key: int) -> str:
        part, number = divmod(int(key), stride)
        return f"{number} of '{parts[part].name}'" if len(parts) > 1 else str(number)

    names = ", ".join(f"{named(a)} and {named(b)}" for a, b in found[:5])
    more = f" and {len(found) - 5:,} more pairs" if len(found) > 5 else ""
    raise UserError(f"Faces lie over each other in the UV map ({names}{more}), so they cannot have shadows of their "
                    "own; unwrap them apart, or let the bake make its own UV map.")
