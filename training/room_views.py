# SPDX-License-Identifier: GPL-3.0-or-later
"""What a camera in a room sees, as points to ask for their light: `python -m training.room_views --seeds 3 9`.

Writes out/rooms.png: each room as it looks on the left, its irradiance alone on the right, path traced.
"""
from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neural_gash_addon.backend import irradiance, methods
from neural_gash_addon.backend.geometry import unit
from neural_gash_addon.backend.lit_scene import LitScene
from neural_gash_addon.backend.raycast import Occluders

from . import room_labels, rooms

FIELD = 75.0       # degrees across a picture, of a camera in a room
CORNELL = np.array([0.278, -0.8, 0.273]), np.array([0.278, 0.0, 0.273]), 39.3  # as published: from, towards, field
_CANDIDATES = 200  # of places for a camera
_CLEAR = 0.3       # metres around it

Camera = tuple[NDArray[np.float64], NDArray[np.float64], float]


@dataclass(frozen=True, eq=False)
class View:
    """The pixels of a picture, row 0 at the top, and the n of them in which there is something."""

    width: int
    height: int
    pixels: NDArray[np.int64]     # (n,) row * width + column
    queries: NDArray[np.float32]  # (n, 9) position, unit normal of the side that is seen, albedo
    emission: NDArray[np.float32]  # (n, 3) radiance of their own

    def image(self, values: NDArray) -> NDArray[np.float32]:
        """(height, width, 3) with the values (n, 3) of the pixels, black elsewhere."""
        out = np.zeros((self.height * self.width, 3), np.float32)
        out[self.pixels] = values
        return out.reshape(self.height, self.width, 3)

    def radiance(self, light: NDArray) -> NDArray[np.float32]:
        """(height, width, 3) as a camera has it, under the irradiance (n, 3) of the pixels."""
        return self.image(self.queries[:, 6:] * light / np.pi + self.emission)


def view(scene: LitScene, eye: NDArray, target: NDArray, field: float, width: int, height: int, occluders: Occluders
         ) -> View:
    """What is seen from a place (3,) towards another (3,), Z up; field: degrees from left to right."""
    forwards = unit(np.subtract(target, eye))
    right = unit(np.cross(forwards, [0.0, 0, 1]))
    across = np.tan(np.radians(field) / 2)
    x, y = np.meshgrid((np.arange(width) + 0.5) / width * 2 - 1, 1 - (np.arange(height) + 0.5) / height * 2)
    ways = unit(forwards + across * (x[..., None] * right + height / width * y[..., None] * np.cross(right, forwards))
                ).reshape(-1, 3)
    eyes = np.tile(np.asarray(eye, float), (len(ways), 1))
    hits = occluders.hits(occluders.origins(eyes, np.zeros_like(eyes)), ways.astype(np.float32))
    corners = scene.corners[hits.faces]
    places = np.stack([1 - hits.u - hits.v, hits.u, hits.v], 1)
    points = (corners * places[:, :, None]).sum(1)
    normals = scene.normals[hits.faces] * np.where(hits.front, 1, -1)[:, None]
    queries = np.concatenate([points, normals, scene.albedo_at(hits.faces, hits.u, hits.v)], 1)
    emission = scene.emission[hits.faces]
    if scene.front_only is not None:
        emission = np.where((hits.front | ~scene.front_only[hits.faces])[:, None], emission, 0)
    return View(width, height, hits.rays, queries.astype(np.float32), emission.astype(np.float32))


def camera(scene: LitScene, seed: int, occluders: Occluders) -> Camera:
    """A place in a closed room at the height of eyes, clear of things, and where it sees far, to look at; FIELD."""
    rng = np.random.default_rng([seed, 10])
    seen = room_labels.visible_points(scene, _CANDIDATES, seed, occluders).astype(float)
    offsets = seen[:, 3:6] * rng.uniform(0.3, 3.0, (len(seen), 1))
    places = seen[:, :3] + offsets
    free = occluders.blocked(occluders.origins(seen[:, :3], seen[:, 3:6]), offsets.astype(np.float32),
                             np.full(len(seen), occluders.scale, np.float32)) != 0
    low, high = seen[:, 2].min(), seen[:, 2].max()
    good = places[free & (np.abs(places[:, 2] - low - 0.65 * (high - low)) < 0.15 * (high - low))]
    angles = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles), np.full(32, -0.15)], 1)
    best, found = -1.0, (seen[0, :3], seen[1, :3], FIELD)
    for place in good:
        hits = occluders.hits(occluders.origins(np.tile(place, (32, 1)), np.zeros((32, 3))), around.astype(np.float32))
        if len(hits.rays) < 32:
            continue
        corners = scene.corners[hits.faces]
        met = (corners * np.stack([1 - hits.u - hits.v, hits.u, hits.v], 1)[:, :, None]).sum(1)
        far = np.linalg.norm(met - place, axis=1)
        wide = sum(np.roll(far, k) for k in (-3, -2, -1, 0, 1, 2, 3))
        if far.min() > _CLEAR and wide.max() > best:
            best, found = float(wide.max()), (place, met[int(wide.argmax())], FIELD)
    return found


def shown(image: NDArray) -> NDArray[np.float64]:
    """Linear values as they are to be looked at: exposed by their median, bright ones compressed, sRGB's gamma."""
    lit = image[image.max(-1) > 0]
    scaled = image / (2.5 * float(np.median(lit.mean(-1))) if len(lit) else 1.0)
    return np.clip(1.25 * scaled / (1 + scaled), 0, 1) ** (1 / 2.2)


def picture(scene: LitScene, where: Camera, width: int, height: int, rays: int, occluders: Occluders
            ) -> tuple[NDArray, NDArray]:
    """What a camera sees of a scene, and its irradiance: (height, width, 3) each; four points a pixel."""
    seen = view(scene, *where, 2 * width, 2 * height, occluders)
    light = methods.run(irradiance.irradiance(scene, seen.queries[:, :3], seen.queries[:, 3:6], rays,
                                              occluders=occluders)).values
    both = seen.radiance(light), seen.image(light)
    return both[0].reshape(height, 2, width, 2, 3).mean((1, 3)), both[1].reshape(height, 2, width, 2, 3).mean((1, 3))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    from matplotlib.image import imsave

    parser = argparse.ArgumentParser(prog="python -m training.room_views", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1_000_000, 1_000_001], help="rooms; -1: Cornell's")
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--rays", type=int, default=256, help="paths from each of four points a pixel")
    parser.add_argument("--out", type=Path, default=Path("out/rooms.png"))
    options = parser.parse_args(arguments)
    rows = []
    for seed in options.seeds:
        scene = rooms.cornell_box() if seed < 0 else rooms.generate(seed)
        occluders = scene.occluders()
        where = CORNELL if seed < 0 else camera(scene, seed, occluders)
        size = options.width, options.width * 3 // 4
        rows.append(np.concatenate([shown(image) for image in picture(scene, where, *size, options.rays, occluders)],
                                   axis=1))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    imsave(options.out, np.concatenate(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
