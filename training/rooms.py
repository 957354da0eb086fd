# SPDX-License-Identifier: GPL-3.0-or-later
"""Closed rooms with furniture and lamps, made from a seed, to learn the light in them; and the Cornell box.

Metres, Z up. One to three rooms, some L-shaped, with walls of a thickness and openings between; everything that
emits is closed. The same seed gives the same scene with the same versions of NumPy, SciPy, trimesh and Blender, and
the same files of meshes.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neural_gash_addon.backend.lit_scene import LitScene
from neural_gash_addon.backend.pictures import Picture

from . import data
from .floor_plans import ATTEMPTS, Plan, Rectangle, overlap, plan, shell
from .objects import Rng, any_primitive
from .places import furniture, stack
from .solids import Mesh, about, area, ball, box, cylinder, merge, place

VERSION = 1         # raised whenever a seed gives another scene
_GAP = 1e-3         # between things that touch, so that no two surfaces are one
_TEXTURE = 64       # pixels a side
_AROUND_DOOR = 0.7  # metres kept free on either side of an opening
_SEEN = 0.15        # of the pieces are meshes from files, where there are any


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh of one finish."""

    mesh: Mesh
    colour: NDArray                      # (3,) albedo
    emission: NDArray | float = 0.0      # (3,) radiance
    texture: NDArray | None = None       # (H, W, 3) albedo instead of the colour
    repeat: float = 1.0                  # metres after which the texture repeats

    def placed(self, offset: Sequence[float], angle: float) -> Part:
        """Turned about z by an angle, and moved."""
        return replace(self, mesh=place(self.mesh, offset, about("z", angle)))


def assembled(parts: Sequence[Part]) -> LitScene:
    """One scene of all parts; textures are laid on along the axis that a triangle faces most."""
    positions, triangles = merge([part.mesh for part in parts])
    sizes = [len(part.mesh[1]) for part in parts]
    albedo = np.repeat(np.array([part.colour for part in parts], float), sizes, axis=0)
    emission = np.repeat(np.array([np.broadcast_to(part.emission, 3) for part in parts], float), sizes, axis=0)
    pictures, first = [], 0
    for part, size in zip(parts, sizes, strict=True):
        if part.texture is not None:
            rows = np.arange(first, first + size)
            corners = positions[triangles[rows]]
            facing = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).argmax(1)
            across = np.array([[1, 2], [0, 2], [0, 1]])[facing]                       # (f, 2)
            uv = np.take_along_axis(corners, across[:, None], 2) / part.repeat
            pictures.append(Picture(rows, uv, part.texture.astype(np.float32), np.arange(3), np.arange(3),
                                    np.ones(3), np.zeros(3)))
            albedo[rows] = pictures[-1].lookups().mean(1)
        first += size
    return LitScene(positions, triangles, albedo, emission, pictures)


# --- finishes ---

def colour(rng: Rng) -> NDArray[np.float64]:
    """(3,) albedo: off-white, muted or saturated."""
    kind, hue = rng.random(), rng.uniform(0, 2 * np.pi)
    wheel = 0.5 + 0.5 * np.cos(hue - np.array([0, 2, 4]) * np.pi / 3)
    if kind < 0.35:
        value, saturation = rng.uniform(0.5, 0.85), rng.uniform(0, 0.12)
    elif kind < 0.72:
        value, saturation = rng.uniform(0.15, 0.75), rng.uniform(0.1, 0.5)
    else:
        value, saturation = rng.uniform(0.3, 0.8), rng.uniform(0.75, 0.97)
    return np.clip(value * (1 - saturation * (1 - wheel)), 0.02, 0.88)


def texture(rng: Rng) -> tuple[NDArray[np.float64], float]:
    """(H, W, 3) albedo that tiles: a checker, stripes or noise in two colours; and metres after which it repeats."""
    one, other = colour(rng), colour(rng)
    x, y = np.meshgrid(*[(np.arange(_TEXTURE) + 0.5) / _TEXTURE] * 2)
    kind, cells = rng.choice(["checker", "stripes", "noise"]), 2 * int(rng.integers(1, 5))
    if kind == "checker":
        share = (np.floor(x * cells) + np.floor(y * cells)) % 2
    elif kind == "stripes":
        share = (np.floor((x if rng.random() < 0.5 else y) * 2 * cells) % 2)
    else:
        waves = rng.integers(-6, 7, (12, 2))  # whole ones, so that it tiles
        share = sum(np.sin(2 * np.pi * (i * x + j * y) + rng.uniform(0, 6.3)) for i, j in waves)
        share = np.clip(0.5 + rng.uniform(0.15, 0.6) * share / 2, 0, 1)
    return one + share[..., None] * (other - one), rng.uniform(0.4, 2.5)


def _finished(rng: Rng, mesh: Mesh, textured: float = 0.25, tint: NDArray | None = None) -> Part:
    """A mesh with a colour, or with a texture in a share of the cases."""
    if rng.random() < textured:
        pixels, repeat = texture(rng)
        return Part(mesh, pixels.mean((0, 1)), texture=pixels, repeat=repeat)
    return Part(mesh, colour(rng) if tint is None else tint)


# --- what they are made of ---

def _walls(rng: Rng, layout: Plan) -> list[Part]:
    """Floors, ceilings, walls and the insides of openings."""
    boxes, rooms = [], []
    for number, (rectangles, high) in enumerate(layout.rooms):
        for x0, y0, x1, y1 in rectangles:
            boxes.append(np.array([(x0, y0, 0), (x1, y1, high)]))
            rooms.append(number)
    for (x0, y0, x1, y1), high in layout.doors:
        boxes.append(np.array([(x0, y0, 0), (x1, y1, high)]))
        rooms.append(-1)
    groups: dict[tuple[int, int, bool], list[Mesh]] = {}
    for (number, axis, up), mesh in shell(boxes).items():
        groups.setdefault((rooms[number], axis, up), []).append(mesh)
    paint = {number: colour(rng) for number in sorted({*rooms})}
    parts = []
    for (number, axis, up), meshes in sorted(groups.items()):
        mesh = merge(meshes)
        if axis == 2 and up:
            parts.append(_finished(rng, mesh, 0.5))
        elif axis == 2:
            parts.append(Part(mesh, np.full(3, rng.uniform(0.55, 0.85)) if rng.random() < 0.8 else colour(rng)))
        else:  # a wall of its own colour now and then
            own = colour(rng) if rng.random() < 0.25 else paint[number]
            parts.append(_finished(rng, mesh, 0.15, own))
    return parts


# --- what stands in them ---

def _bed(rng: Rng) -> list[Mesh]:
    wide, long, high = rng.choice([0.9, 1.4, 1.8]), 2.0, rng.uniform(0.25, 0.4)
    return [box((wide, long, high), (0, 0, high / 2 + 0.05)), box((0.97 * wide, 0.97 * long, 0.2), (0, 0, high + 0.16)),
            box((wide, 0.06, 0.6), (0, long / 2 + 0.04, high + 0.2)),
            box((0.5, 0.3, 0.12), (0.2 * wide, 0.4 * long, high + 0.33))]


def _desk_lamp(rng: Rng) -> tuple[list[Mesh], list[Mesh]]:
    """A standing ball on a foot: what it is made of, and what shines."""
    high, radius = rng.uniform(0.2, 1.5), rng.uniform(0.08, 0.2)
    return ([cylinder(0.12, 0.03, 20), cylinder(0.015, high, 8)],
            [place(ball(radius, 2), (0, 0, high + radius + _GAP))])


def _piece(rng: Rng, files: Sequence[Path]) -> tuple[list[Mesh], list[Mesh]]:
    """What a piece of furniture is made of, standing on z = 0, and what of it shines."""
    if files and rng.random() < _SEEN:
        positions, triangles = data.read(files[int(rng.integers(len(files)))])
        size = rng.uniform(0.3, 1.2) / np.ptp(positions, axis=0).max()
        low, high = positions.min(0), positions.max(0)
        return [((positions - [*(low + high)[:2] / 2, low[2]]) * size, triangles)], []
    kind = rng.choice(["furniture", "bed", "boxes", "stack", "primitive", "lamp"], p=[0.58, 0.1, 0.12, 0.05, 0.1, 0.05])
    if kind == "furniture":
        which, parts = furniture(rng)
        return parts, [place(ball(0.09, 2), (0, 0, 1.38))] if which == "lamp" else []
    if kind == "bed":
        return _bed(rng), []
    if kind == "lamp":
        return _desk_lamp(rng)
    if kind == "boxes":
        sizes = rng.uniform(0.2, 0.8, (int(rng.integers(1, 3)), 3))
        middles = np.cumsum(sizes[:, 2] + _GAP) - sizes[:, 2] / 2
        return [box(size, (0, 0, middle)) for size, middle in zip(sizes, middles, strict=True)], []
    mesh = place(stack(rng, 0), scale=0.4) if kind == "stack" else any_primitive(rng, rng.uniform(0.2, 0.7))
    return [mesh], []


def _footprint(meshes: Sequence[Mesh]) -> Rectangle:
    every = np.concatenate([p for p, _ in meshes])[:, :2]
    return (*every.min(0), *every.max(0))


def _stand(rng: Rng, room: list[Rectangle], high: float, meshes: list[Mesh], taken: list[Rectangle]
           ) -> tuple[tuple[float, float, float], float] | None:
    """Where a piece can stand in a room, and how it is turned there; None where there is no place."""
    lowest = min(p[:, 2].min() for p, _ in meshes)
    if max(p[:, 2].max() for p, _ in meshes) - lowest > high - 0.1:
        return None
    for _ in range(ATTEMPTS):
        x0, y0, x1, y1 = room[int(rng.integers(len(room)))]
        angle = np.pi / 2 * int(rng.integers(4)) + (rng.uniform(-0.5, 0.5) if rng.random() < 0.3 else 0.0)
        a0, b0, a1, b1 = _footprint([place(m, turn=about("z", angle)) for m in meshes])
        space = np.array([x1 - x0 - (a1 - a0), y1 - y0 - (b1 - b0)]) - 4 * _GAP
        if (space < 0).any():
            continue
        share = rng.random(2)
        if rng.random() < 0.6:  # against a wall
            share[int(rng.integers(2))] = rng.choice([0.0, 1.0])
        x, y = np.array([x0 - a0, y0 - b0]) + 2 * _GAP + share * space
        here = (x + a0, y + b0, x + a1, y + b1)
        if not any(overlap(here, other, 0.02) for other in taken):
            taken.append(here)
            return (x, y, _GAP - lowest), angle
    return None


def _lamps(rng: Rng, room: list[Rectangle], high: float) -> list[Mesh]:
    """What shines at the ceiling or the walls of a room; never nothing."""
    x0, y0, x1, y1 = room[int(rng.integers(len(room)))]
    kind = rng.choice(["panels", "balls", "strip", "wall", "one panel"], p=[0.25, 0.2, 0.2, 0.1, 0.25])
    if kind in ("panels", "one panel"):
        sizes, thick = rng.uniform(0.2, 0.45, 2) * min(x1 - x0, y1 - y0, 3.0), rng.uniform(0.02, 0.06)
        columns, rows = rng.integers(1, 3, 2) if kind == "panels" else (1, 1)
        near = np.array([rng.uniform(0.3, 0.7), rng.uniform(0.3, 0.7)])
        places = [((i + 1) / (columns + 1), (j + 1) / (rows + 1)) for i in range(columns) for j in range(rows)]
        places = [near] if columns * rows == 1 else places
        sizes = np.minimum(sizes, [0.6 * (x1 - x0) / columns, 0.6 * (y1 - y0) / rows])
        return [box((*sizes, thick), (x0 + a * (x1 - x0), y0 + b * (y1 - y0), high - thick / 2 - _GAP))
                for a, b in places]
    if kind == "balls":
        radius, drop = rng.uniform(0.08, 0.2), rng.uniform(0, 0.6)
        return [place(ball(radius, 2), (x, y, high - radius - drop - 0.02))
                for x, y in rng.uniform([x0 + 0.4, y0 + 0.4], [x1 - 0.4, y1 - 0.4], (int(rng.integers(1, 4)), 2))]
    thick = rng.uniform(0.02, 0.05)
    along_x = rng.random() < 0.5
    low, up, other = (x0, x1, (y0, y1)) if along_x else (y0, y1, (x0, x1))
    if kind == "strip":  # along a wall, at the ceiling or at the floor
        long, across = rng.uniform(0.5, 0.9) * (up - low), rng.choice([other[0] + 0.12, other[1] - 0.12])
        size, z = (long, thick, thick), rng.choice([high - 0.1, high - thick, 0.08])
    else:                # a lit rectangle on a wall, as a screen or a window; beside what may be an opening it hangs
        long, across = rng.uniform(0.2, 0.5) * (up - low), rng.choice([other[0] + thick, other[1] - thick])
        size, z = (long, thick, rng.uniform(0.3, 0.9)), rng.uniform(1.2, high - 0.6)
    middle = (low + up) / 2 + rng.uniform(-0.5, 0.5) * (up - low - long) * 0.9
    if along_x:
        return [box(size, (middle, across, z))]
    return [box((size[1], size[0], size[2]), (across, middle, z))]


def _tint(rng: Rng) -> NDArray[np.float64]:
    """(3,) of mean 1: warm to cool white, at times a colour."""
    warmth = rng.uniform(-0.25, 0.45)
    tint = np.array([1 + warmth, 1.0, 1 - warmth])
    if rng.random() < 0.12:
        tint = 0.1 + rng.dirichlet([1, 1, 1])
    return tint / tint.mean()


def generate(seed: int, files: Sequence[Path] = ()) -> LitScene:
    """The rooms of a seed. files: meshes that may stand in them."""
    rng = np.random.default_rng([seed, 7])
    layout = plan(rng)
    parts = _walls(rng, layout)
    doors = [(x0 - _AROUND_DOOR, y0 - _AROUND_DOOR, x1 + _AROUND_DOOR, y1 + _AROUND_DOOR)
             for (x0, y0, x1, y1), _ in layout.doors]
    count = len(layout.rooms)
    lit = rng.random(count) < 0.85
    if count > 1 and rng.random() < 0.35 or not lit.any():  # light in one room alone
        lit = np.arange(count) == rng.integers(count)
    shining: list[Mesh] = []
    for number, (rectangles, high) in enumerate(layout.rooms):
        floor = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in rectangles)
        lamps = _lamps(rng, rectangles, high) if lit[number] else []
        # nothing stands where a lamp hangs
        taken = [*doors, *(_footprint([lamp]) for lamp in lamps if lamp[0][:, 2].min() < high - 0.15)]
        shining += lamps
        for _ in range(int(rng.integers(2, 5 + int(floor / 2)))):
            meshes, bulbs = _piece(rng, files)
            where = _stand(rng, rectangles, high, [*meshes, *bulbs], taken)
            if where is None:
                continue
            first = _finished(rng, meshes[0])
            tints = [first.colour, colour(rng), colour(rng)]
            pieces = [first] + [_finished(rng, m, 0.1, tints[int(rng.choice(3, p=[0.6, 0.25, 0.15]))])
                                for m in meshes[1:]]
            parts += [piece.placed(*where) for piece in pieces]
            if lit[number] and rng.random() < 0.8:
                shining += [place(bulb, where[0], about("z", where[1])) for bulb in bulbs]
            else:
                parts += [Part(bulb, np.full(3, 0.8)).placed(*where) for bulb in bulbs]
    floor = sum((x1 - x0) * (y1 - y0) for r, _ in layout.rooms for x0, y0, x1, y1 in r)
    flux = floor * np.exp(rng.uniform(0, np.log(10)))  # 1 to 10 W to a square metre of floor
    tint = _tint(rng)
    shares = np.sqrt([area(mesh) for mesh in shining]) * rng.uniform(0.3, 1, len(shining))  # small ones give less
    for mesh, share in zip(shining, shares / shares.sum(), strict=True):
        own = tint if rng.random() < 0.7 else _tint(rng)
        parts.append(Part(mesh, np.full(3, 0.6), share * flux / (np.pi * area(mesh)) * own))
    return assembled(parts)


def _quad(corners: Sequence[Sequence[float]]) -> Mesh:
    """Four corners as Cornell gives them: millimetres, x to the left, y up, z away."""
    x, y, z = np.array(corners, float).T / 1000
    return np.stack([0.556 - x, z, y], 1), np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def read(path: Path) -> LitScene:
    """A scene of an .npz as in ../shared/meshes/scenes: verts, faces, face_albedo, face_emission, and which axis is up.

    Turned so that Z is up. One that is larger than 100 is in millimetres.
    """
    with np.load(path, allow_pickle=False) as found:
        positions, up = found["verts"].astype(float), str(found["up"])
        triangles, albedo, emission = (found[key] for key in ("faces", "face_albedo", "face_emission"))
    if up == "y":
        positions = positions[:, [0, 2, 1]] * [-1, 1, 1]
    if np.ptp(positions, axis=0).max() > 100:
        positions = positions / 1000
    return LitScene(positions, triangles.astype(np.int32), np.clip(albedo.astype(float), 0, 1), emission.astype(float))


def cornell_box() -> LitScene:
    """The Cornell box from its published measurements (Cornell University Program of Computer Graphics, 1998, 2005).

    The corners as they are given, with the hole in the ceiling that the light fills; millimetres made metres, so it
    is about 0.55 m large, and turned so that Z is up and one looks in along +Y. The reflectances as RGB: white
    (0.725, 0.71, 0.68), red (0.63, 0.065, 0.05), green (0.14, 0.45, 0.091), the light (0.78) and its radiance
    (17, 12, 4), as McGuire's archive converts the published spectra. Open in front.
    """
    white, red, green = np.array([0.725, 0.71, 0.68]), np.array([0.63, 0.065, 0.05]), np.array([0.14, 0.45, 0.091])
    light, top = [(343, 227), (343, 332), (213, 332), (213, 227)], 548.8  # x and z
    rim = [(556.0, 0.0), (556, 559.2), (0, 559.2), (0, 0)]
    short = [(130, 65), (82, 225), (240, 272), (290, 114)]
    tall = [(423, 247), (265, 296), (314, 456), (472, 406)]
    quads: list[tuple[NDArray, list]] = [
        (white, [(552.8, 0, 0), (0, 0, 0), (0, 0, 559.2), (549.6, 0, 559.2)]),
        (white, [(549.6, 0, 559.2), (0, 0, 559.2), (0, top, 559.2), (556, top, 559.2)]),
        (green, [(0, 0, 559.2), (0, 0, 0), (0, top, 0), (0, top, 559.2)]),
        (red, [(552.8, 0, 0), (549.6, 0, 559.2), (556, top, 559.2), (556, top, 0)])]
    for k in range(4):  # the ceiling around the hole
        (a, b), (c, d) = (rim[k], rim[(k + 1) % 4]), (light[k], light[(k + 1) % 4])
        quads.append((white, [(a[0], top, a[1]), (b[0], top, b[1]), (d[0], top, d[1]), (c[0], top, c[1])]))
    for base, high in ((short, 165), (tall, 330)):
        quads.append((white, [(x, high, z) for x, z in base]))
        for k in range(4):
            (a, b), (c, d) = base[k], base[(k + 1) % 4]
            quads.append((white, [(c, 0, d), (c, high, d), (a, high, b), (a, 0, b)]))
    parts = [Part(_quad(corners), tint) for tint, corners in quads]
    parts.append(Part(_quad([(x, top, z) for x, z in light]), np.full(3, 0.78), np.array([17.0, 12, 4])))
    return assembled(parts)
