# SPDX-License-Identifier: GPL-3.0-or-later
"""Labels for the light that bounces: `python -m training.bounce_labels`, after `make data`.

One .npz a scene in training/cache/bounces/: a labelled mesh in colours, often on a floor and among walls that have
colours too; what its scene points trace, twice; and what bounces bring to some of its vertices by the project's own
tracer, from a solution of its own, held-out scenes twice, so that the noise of the truth can be taken out.
"""
from __future__ import annotations

import argparse
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neural_gash_addon.backend import sky_bake
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.bounce import MAX_BOUNCES, PATCHES, Bounces
from neural_gash_addon.backend.exchange import write_npz
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.patches import Patches
from neural_gash_addon.backend.progress import run
from neural_gash_addon.backend.raycast import Geometry, Occluders

from . import data, labels

VERSION = 1          # raised whenever the same mesh gets another scene, or other labels
QUERIES, RAYS, HELD_RAYS = 2048, 512, 1024
MESHES = 120         # at most
LOOKS = 2            # traces of the scene points, each with rays of its own
MOST_POINTS = 40_000
MOST_PATCHES = 30_000  # of a scene: long thin triangles make many, which take minutes
HELD_OUT = 0.2       # of the meshes, by name; those of `training.sky` are among them
_INPUT, _TRUTH = 0, 100   # seeds of the solutions
ARRAYS = ("places", "normals", "blocked", "bounced", "queries", "query_normals", "truth")


@dataclass(frozen=True, eq=False)
class Scene:
    """A mesh in colours, and what stands around it."""

    mesh: TriangleMesh
    around: list[Geometry]
    albedo: NDArray[np.float64]  # (F, 3) of all triangles, the mesh's first
    bounces: int                 # at most

    @property
    def parts(self) -> list[Geometry]:
        """All that there is."""
        return [(self.mesh.positions, self.mesh.triangles), *self.around]


class Outcome(NamedTuple):
    """How a job went; `data.outcomes` wants its job."""

    job: tuple[Path, int]
    bounced: float  # mean of what bounces bring, of a white sky


def scene_of(path: Path) -> Scene:
    """The scene of a labelled mesh."""
    found = labels.load(path)
    return dressed(TriangleMesh.from_triangles(found.positions, found.triangles), found.name)


def dressed(mesh: TriangleMesh, name: str) -> Scene:
    """A mesh, its box about the origin and its longest side 1, in colours and surroundings drawn by its name."""
    rng = np.random.default_rng(list(hashlib.sha256(f"{VERSION}:{name}".encode()).digest()[:8]))
    centres = mesh.positions[mesh.triangles].mean(1)
    cells = rng.uniform(-0.5, 0.5, (rng.integers(1, 7), 3))
    colours = np.stack([colour(rng) for _ in cells])
    albedo = [colours[np.square(centres[:, None] - cells).sum(2).argmin(1)]]
    around: list[Geometry] = []
    low, high = mesh.positions.min(0), mesh.positions.max(0)
    walls = rng.choice([0, 1, 2, 3], p=[0.35, 0.3, 0.2, 0.15])  # the first is a floor
    axes = [2, *rng.permutation(2)]
    for axis in axes[:walls]:
        side = rng.integers(2) if axis != 2 else 0
        gap, reach = rng.choice([1e-3, rng.uniform(0, 0.3)]), rng.uniform(0.6, 2)
        across = [a for a in range(3) if a != axis]
        corners = np.zeros((4, 3))
        corners[:, axis] = high[axis] + gap if side else low[axis] - gap
        corners[:, across] = reach * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        around.append((corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)))
        albedo.append(np.tile(colour(rng), (2, 1)))
    return Scene(mesh, around, np.concatenate(albedo), int(rng.choice([1, 2, MAX_BOUNCES], p=[0.2, 0.2, 0.6])))


def colour(rng: np.random.Generator) -> NDArray[np.float64]:
    """(3,) an albedo: from grey to saturated, from dark to nearly white."""
    return rng.uniform(0.2, 0.95) * (1 - rng.uniform(0, 1) * rng.permuted([0.0, rng.uniform(), 1.0]))


def some(mesh: TriangleMesh, count: int, seed: int) -> TriangleMesh:
    """Some of the points of a mesh that have a normal, by lot."""
    rows = np.flatnonzero(np.any(mesh.normals != 0, axis=1))
    rows = np.random.default_rng(seed).permutation(rows)[:count]
    return replace(mesh, points=mesh.points[rows], normals=mesh.normals[rows], clearance=mesh.clearance[rows])


def solved(scene: Scene, occluders: Occluders, seed: int) -> Bounces:
    """Its bounces, on one thread."""
    found = Bounces(scene.parts, scene.albedo, occluders, sh.MAX_ORDER, seed, 1, PATCHES)
    run(found.solve(scene.bounces))
    return found


def work(job: tuple[Path, int], path: Path) -> Outcome:
    """Label one scene, its truths so many; nothing where it is cut into too many patches."""
    scene = scene_of(job[0])
    if Patches(scene.parts, PATCHES).count > MOST_PATCHES:
        return Outcome(job, 0.0)
    occluders = Occluders(scene.parts, scene.mesh.resolution)
    points = sky_bake.on_surface(scene.mesh, sky_bake.POINTS, 0)
    blocked = [sky_bake.split(run(sky_bake.traced(points, occluders, sh.MAX_ORDER, sky_bake.RAYS, seed, 1)),
                              points.normals) for seed in range(LOOKS)]
    solution = solved(scene, occluders, _INPUT)
    bounced = [run(solution.gather(points, sky_bake.BOUNCE_RAYS, seed)) for seed in range(LOOKS)]
    asked = some(scene.mesh, QUERIES, 1)
    truth = [run(solved(scene, occluders, _TRUTH + number).gather(asked, RAYS if job[1] == 1 else HELD_RAYS))
             for number in range(job[1])]
    write_npz(path, places=sky_bake.in_scale(points.points, occluders), normals=points.normals.astype(np.float32),
              blocked=np.stack(blocked), bounced=np.stack(bounced),
              queries=sky_bake.in_scale(asked.points, occluders), query_normals=asked.normals.astype(np.float32),
              truth=np.stack(truth))
    return Outcome(job, float((4 * np.pi) ** 0.5 * truth[0][:, 0].mean()))


def jobs(meshes: Path = data.CACHE, most: int = MESHES) -> list[tuple[tuple[Path, int], Path, bool]]:
    """What to label, the file, and whether it is held out; of labelled meshes by lot, always the same."""
    paths = [path for path in sorted(meshes.glob("*.npz")) if data.is_whole(path) and data._points(path) <= MOST_POINTS]
    paths = [paths[i] for i in np.random.default_rng(0).permutation(len(paths))]
    out = []
    for path in paths[:most]:
        held = data.is_held_out(path.stem.rpartition("-")[0], HELD_OUT)
        out.append(((path, 2 if held else 1), meshes / "bounces" / f"{path.stem}-{VERSION}.npz", held))
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=int, default=MESHES, help="at most, of the cache")
    parser.add_argument("--workers", type=int, default=0, help="processes; 0: this one")
    options = parser.parse_args(arguments)
    (data.CACHE / "bounces").mkdir(parents=True, exist_ok=True)
    missing = [(job, path) for job, path, _ in jobs(most=options.meshes) if not data.is_whole(path, ARRAYS)]
    for number, outcome in enumerate(data.outcomes(work, missing, options.workers)):
        print(f"{number + 1}/{len(missing)} {outcome.job[0].stem}: {outcome.bounced:.3f}", flush=True)


if __name__ == "__main__":
    main()
