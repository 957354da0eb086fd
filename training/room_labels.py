# SPDX-License-Identifier: GPL-3.0-or-later
"""Rooms with the light in them, to train on, made once and kept: `python -m training.room_labels --rooms 220`.

One .npz a room (see `label`) in training/cache/rooms/, which git ignores. A run that was stopped goes on where it
was; a file made with other settings, or by another version of the generator, has another name. Light straight from
emitters and light that was reflected are apart: the former has hardly any noise, so the paths are spent on the latter.
Rooms to train on have fewer than those to validate with: their noise is as good as more rooms are useful, and it is
written beside them.
"""
from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from neural_gash_addon.backend import irradiance, methods, sampling
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.exchange import write_npz
from neural_gash_addon.backend.lit_points import REFLECTED, lit_points
from neural_gash_addon.backend.lit_scene import LitScene
from neural_gash_addon.backend.raycast import Occluders

from . import data, rooms

VERSION = 4            # raised whenever the same job gives other labels
CACHE = data.CACHE / "rooms"
TRAIN, VALIDATION, EVALUATION = "train", "validation", "evaluation"
TRAIN_RAYS, VALIDATION_RAYS = 1024, 2048  # for reflected light
DIRECT_RAYS = 256      # for light straight from emitters
QUERIES = 2048
LOOKS = 4              # independent ones at the light of the scene points, so that their noise is not learned by heart
ORDER = 5              # bands of reflected light by direction
KEYS = ("scene_points", "point_direct", "point_indirect", "point_shape", "queries", "direct", "direct_noise",
        "indirect", "indirect_noise", "shape", "shape_noise", "seed", "split")
_FIRST = {TRAIN: 0, VALIDATION: 1_000_000, EVALUATION: 2_000_000}  # seeds: no room is in two of them
CORNELL = -1           # instead of a seed
_SCENES = 2_900_000    # number of the first scene of a file, likewise
_SIGHT = 0.02          # metres that a visible point sees, at least, in some of _WAYS directions
_WAYS = 16
_SEEING = 2            # of them at least: one in a slit may just graze along it


@dataclass(frozen=True)
class Job:
    """A room to label: of a seed, the Cornell box or a scene in a file."""

    seed: int
    split: str
    rays: int
    points: int | None = None     # of the scene; by its surfaces where it is None
    queries: int = QUERIES
    files: tuple[Path, ...] = ()  # of meshes that may stand in it
    source: Path | None = None    # the file of a scene that is not generated

    def file_name(self) -> str:
        """The split, the seed and a digest of all that the labels depend on."""
        parts = [VERSION, rooms.VERSION, self.seed, self.split, self.rays, self.points, self.queries,
                 [path.name for path in self.files], *([self.source.name] if self.source else [])]
        return f"{self.split}-{self.seed:07d}-{hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]}.npz"


class Outcome(NamedTuple):
    """How a job went."""

    job: Job
    seconds: float
    problem: str  # empty where it went well


def jobs(count: int, split: str, rays: int, points: int | None = None, queries: int = QUERIES,
         files: Sequence[Path] = ()) -> list[Job]:
    """The first rooms of a split."""
    first = _FIRST[split]
    return [Job(seed, split, rays, points, queries, tuple(files)) for seed in range(first, first + count)]


def evaluation(count: int, folder: Path | None, rays: int, points: int | None = None, queries: int = QUERIES
               ) -> list[Job]:
    """The Cornell box, the first rooms of the split, and the scenes of a folder, see `rooms.read`."""
    sources = sorted(folder.glob("*.npz")) if folder else []
    return [Job(CORNELL, EVALUATION, rays, points, queries), *jobs(count, EVALUATION, rays, points, queries),
            *(Job(_SCENES + number, EVALUATION, rays, points, queries, source=source)
              for number, source in enumerate(sources))]


def scene_of(job: Job) -> LitScene:
    """The scene of a job. Raises UserError where a file holds none."""
    if job.source is not None:
        return rooms.read(job.source)
    return rooms.cornell_box() if job.seed == CORNELL else rooms.generate(job.seed, job.files)


def visible_points(scene: LitScene, count: int, seed: int, occluders: Occluders) -> NDArray[np.float32]:
    """Points spread at random by area over what can be seen: (count, 9) position, unit normal, albedo.

    A point is seen where some of its rays go on a little and then meet a front: not sealed between things that touch,
    not within a solid, nor outside of the walls. Fewer where hardly any is.
    """
    rng = np.random.default_rng([seed, 9])
    cumulative = np.cumsum(scene.areas)
    found, total = [], 0
    for _ in range(8):
        faces, u, v = sampling.on_triangles(cumulative, rng.random((2, count)))
        corners = scene.corners[faces]
        points = (corners * np.stack([1 - u - v, u, v], 1)[:, :, None]).sum(1)
        normals = scene.normals[faces]
        local = sampling.hemisphere_sets(1, _WAYS, seed)[0]
        frames = sampling.frames(normals, rng.uniform(0, 2 * np.pi, count))
        ways = np.einsum("nij,rj->nri", frames, local).astype(np.float32).reshape(-1, 3)
        origins = occluders.origins(points, normals).repeat(_WAYS, axis=0)
        near = occluders.blocked(origins, ways, np.full(len(ways), _SIGHT * occluders.scale, np.float32)) == 0
        hits = occluders.hits(origins, ways)
        met = np.zeros(len(ways), bool)
        met[hits.rays[hits.front]] = True
        seen = (met & ~near).reshape(count, _WAYS).sum(1) >= _SEEING
        found.append(np.concatenate([points, normals, scene.albedo_at(faces, u, v)], 1)[seen].astype(np.float32))
        total += len(found[-1])
        if total >= count:
            break
    return np.concatenate(found)[:count]


def label(scene: LitScene, *, seed: int, split: str, rays: int, points: int | None = None, queries: int = QUERIES,
          threads: int | None = 1) -> dict[str, NDArray]:
    """A scene as the network wants it, by KEYS. Metres, linear RGB, W/m^2.

    Returns:
        scene_points (M, 12) position, unit normal, albedo, emission (radiance), so ordered that its first points are a
        good sample too, and the light there as `lit_points` has it: point_direct (M, 3), point_indirect (LOOKS, M, 3),
        point_shape (LOOKS, M, K, 3), float16; queries (N, 9) as scene_points, without emission; direct, indirect (N, 3)
        irradiance straight from emitters and reflected, and direct_noise, indirect_noise (N, 3), their standard errors;
        shape (N, K, 3) of ORDER, reflected light by direction (`irradiance.Irradiance`), and shape_noise (N, ORDER, 3),
        the root of the sum of its squared standard errors in each band; seed; split. All else float32.
    """
    number, occluders = abs(seed), scene.occluders()
    asked = visible_points(scene, queries, number, occluders)

    def traced(at: NDArray, normals: NDArray, paths: int, straight: bool, look: int) -> irradiance.Irradiance:
        return methods.run(irradiance.irradiance(
            scene, at, normals, paths, depth=1 if straight else irradiance.DEPTH, straight=straight,
            seed=number + look * 10_000_000, threads=threads, occluders=occluders, order=0 if straight else ORDER))

    lit = methods.run(lit_points(scene, occluders, points, seed=number, threads=threads, order=ORDER))
    others = [traced(lit.places, lit.normals, REFLECTED, False, look) for look in range(1, LOOKS)]
    direct = traced(asked[:, :3], asked[:, 3:6], DIRECT_RAYS, True, LOOKS)
    indirect = traced(asked[:, :3], asked[:, 3:6], rays, False, LOOKS)
    return {"scene_points": np.concatenate([lit.places, lit.normals, lit.albedo, lit.emission], 1),
            "point_direct": lit.direct,
            "point_indirect": np.stack([lit.indirect, *(other.values for other in others)]),
            "point_shape": np.stack([lit.shape, *(other.shape for other in others)]).astype(np.float16),
            "queries": asked, "direct": direct.values, "direct_noise": direct.error, "indirect": indirect.values,
            "indirect_noise": indirect.error, "shape": indirect.shape,
            "shape_noise": np.sqrt(np.add.reduceat(np.square(indirect.shape_error), np.arange(ORDER) ** 2, axis=1)),
            "seed": np.array(seed), "split": np.array(split)}


def work(job: Job, path: Path) -> Outcome:
    """Make, label and write one room. What is wrong with it is told of, not raised."""
    began = time.perf_counter()
    try:
        found = label(scene_of(job), seed=job.seed, split=job.split, rays=job.rays, points=job.points,
                      queries=job.queries)
    except UserError as error:
        return Outcome(job, time.perf_counter() - began, str(error))
    write_npz(path, **found)
    return Outcome(job, time.perf_counter() - began, "")


def prepare(wanted: Sequence[Job], cache: Path = CACHE, workers: int = 2, quiet: bool = False
            ) -> tuple[list[Path], list[Outcome]]:
    """Label what is not labelled yet, in the order of the jobs.

    Args:
        cache: folder of the files, made where it is not there. workers: processes; 0 works in this one.
    Returns:
        The files of all jobs that went well, in their order; and the outcomes of those that were done now.
    """
    cache.mkdir(parents=True, exist_ok=True)
    paths = [cache / job.file_name() for job in wanted]
    missing = [(job, path) for job, path in zip(wanted, paths, strict=True) if not data.is_whole(path, KEYS)]
    done: list[Outcome] = []
    rays, began = 0, time.perf_counter()
    with tqdm(total=len(wanted), initial=len(wanted) - len(missing), unit="room", disable=quiet, smoothing=0.1) as bar:
        for outcome in data.outcomes(work, missing, workers):
            done.append(outcome)
            if outcome.problem:
                bar.write(f"room {outcome.job.seed}: {outcome.problem}", file=sys.stderr)
            else:
                rays += outcome.job.rays * outcome.job.queries
            bar.set_postfix_str(f"{rays / (time.perf_counter() - began):,.0f} paths/s", refresh=False)
            bar.update()
    failed = {id(outcome.job) for outcome in done if outcome.problem}
    return [path for job, path in zip(wanted, paths, strict=True) if id(job) not in failed], done


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. 1 where a room could not be labelled."""
    parser = argparse.ArgumentParser(prog="python -m training.room_labels", description=__doc__)
    parser.add_argument("--rooms", type=int, default=220, help="to train on")
    parser.add_argument("--validation", type=int, default=16, help="rooms to validate with")
    parser.add_argument("--evaluation", type=int, default=8, help="rooms to evaluate with, beside the Cornell box")
    parser.add_argument("--rays", type=int, default=TRAIN_RAYS, help="from each point of a room to train on")
    parser.add_argument("--validation-rays", type=int, default=VALIDATION_RAYS)
    parser.add_argument("--points", type=int, help="scene points of a room, instead of by its surfaces")
    parser.add_argument("--queries", type=int, default=QUERIES, help="points of a room at which the light is known")
    parser.add_argument("--meshes", type=Path, help="folder of meshes that may stand in the rooms")
    parser.add_argument("--scenes", type=Path, help="folder of scenes to evaluate with, beside the Cornell box")
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--workers", type=int, default=2, help="processes")
    options = parser.parse_args(arguments)
    files = sorted(p for p in options.meshes.glob("*") if p.suffix in data.SUFFIXES) if options.meshes else []
    wanted = [*jobs(options.rooms, TRAIN, options.rays, options.points, options.queries, files),
              *jobs(options.validation, VALIDATION, options.validation_rays, options.points, options.queries, files),
              *evaluation(options.evaluation, options.scenes, options.validation_rays, options.points, options.queries)]
    paths, done = prepare(wanted, options.cache, options.workers)
    if done:
        seconds = sum(outcome.seconds for outcome in done)
        print(f"{len(done)} rooms, a process labelled one in {seconds / len(done):.1f} s")
    print(f"{len(paths)} of {len(wanted)} are in {options.cache}")
    return int(len(paths) < len(wanted))


if __name__ == "__main__":
    sys.exit(main())
