# SPDX-License-Identifier: GPL-3.0-or-later
"""Labelled meshes for training, made once and kept: `python -m training.data --count 2000 --seed 1 --rays 1024`.

One .npz a mesh (see `labels.Sample`) in training/cache/, which git ignores. A run that was stopped goes on
where it was; a file made with other settings, or by another version of the generator, has another name.
"""
from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import multiprocessing
import os
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import trimesh
from tqdm import tqdm

from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.exchange import write_npz

from . import labels, meshes
from .solids import Mesh, weld

Made = TypeVar("Made")
CACHE = Path(__file__).resolve().parent / "cache"
SUFFIXES = (".ply", ".obj", ".stl")
MOTOR_FRAMES = "training.labels:motor_frames"
_SERIAL = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # one thread in each process
# what trimesh raises at files that are missing, damaged or something else
_UNREADABLE = (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError, NotImplementedError)


@dataclass(frozen=True)
class Job:
    """A mesh to label: of a seed, or of a file."""

    name: str
    seed: int                    # of the mesh, if generated, and of the rays
    rays: int
    frames: str = MOTOR_FRAMES   # module:function, see `labels.Frames`
    source: Path | None = None   # the file, if it is not generated

    def file_name(self) -> str:
        """The name of the mesh and a digest of all that its labels depend on."""
        mesh = meshes.VERSION if self.source is None else hashlib.sha256(self.source.read_bytes()).hexdigest()
        parts = {"labels": labels.VERSION, "rays": self.rays, "frames": self.frames, "seed": self.seed, "mesh": mesh}
        digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
        return f"{self.name}-{digest[:12]}.npz"


class Outcome(NamedTuple):
    """How a job went."""

    job: Job
    points: int
    making: float    # seconds to generate or read the mesh
    labelling: float  # seconds to label and write it
    problem: str     # empty where it went well


def generated(count: int, seed: int, rays: int, frames: str = MOTOR_FRAMES) -> list[Job]:
    """Jobs of `count` generated meshes; another seed gives others."""
    first = seed * 1_000_000  # room for a million meshes a seed
    return [Job(f"{meshes.category_of(s)}-{s:09d}", s, rays, frames) for s in range(first, first + count)]


def of_folder(folder: Path, rays: int, frames: str = MOTOR_FRAMES) -> list[Job]:
    """Jobs of the meshes in a folder, by name. Raises UserError where there is none."""
    found = sorted(p for p in folder.glob("*") if p.suffix.lower() in SUFFIXES)
    if not found:
        raise UserError(f"There is no {', '.join(SUFFIXES)} in '{folder}'.")
    return [Job(p.stem, 0, rays, frames, p) for p in found]


def read(path: Path) -> Mesh:
    """A mesh of a file, its corners welded: .stl has no vertices, .obj splits them at seams. Raises UserError."""
    try:
        found: Any = trimesh.load(path, process=False, force="mesh")
        mesh = np.asarray(found.vertices, dtype=np.float64), np.asarray(found.faces, dtype=np.int32)
        whole = len(mesh[1]) > 0 and bool(np.isfinite(mesh[0]).all())
    except _UNREADABLE as error:
        raise UserError(f"'{path}' cannot be read as a mesh ({error}).") from error
    if not whole:
        raise UserError(f"'{path}' has no faces, or coordinates that are not finite.")
    return weld(mesh)


def work(job: Job, path: Path) -> Outcome:
    """Make, label and write one mesh. A fault of the mesh is told of, not raised."""
    began = time.perf_counter()
    try:
        if job.source is None:
            category, positions, triangles, crease = meshes.generate(job.seed)
        else:
            category, crease = "file", None
            positions, triangles = read(job.source)
        made = time.perf_counter()
        module, function = job.frames.split(":")
        sample = labels.label(positions, triangles, crease, name=job.name, category=category, rays=job.rays,
                              seed=job.seed, frames=getattr(importlib.import_module(module), function))
    except (UserError, RuntimeError) as error:
        return Outcome(job, 0, time.perf_counter() - began, 0.0, str(error))
    write_npz(path, **{key: np.asarray(getattr(sample, key)) for key in (*labels.ARRAYS, *labels.TEXTS)})
    return Outcome(job, len(sample.positions), made - began, time.perf_counter() - made, "")


def is_whole(path: Path, keys: Sequence[str] = (*labels.ARRAYS, *labels.TEXTS)) -> bool:
    """Whether a file was written to its end: what a zip holds is listed there."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {f"{key}.npy" for key in keys} <= set(archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return False


def prepare(jobs: Sequence[Job], cache: Path = CACHE, workers: int = 2, quiet: bool = False
            ) -> tuple[list[Path], list[Outcome]]:
    """Label what is not labelled yet.

    Args:
        jobs: what. cache: folder of the files, made where it is not there.
        workers: processes; 0 works in this one. quiet: without the progress bar.
    Returns:
        The files of all jobs that went well, in their order; and the outcomes of those that were done now.
    """
    cache.mkdir(parents=True, exist_ok=True)
    paths = [cache / job.file_name() for job in jobs]
    missing = [(job, path) for job, path in zip(jobs, paths, strict=True) if not is_whole(path)]
    done: list[Outcome] = []
    points, began = 0, time.perf_counter()
    with tqdm(total=len(jobs), initial=len(jobs) - len(missing), unit="mesh", disable=quiet, smoothing=0.1) as bar:
        for outcome in outcomes(work, missing, workers):
            done.append(outcome)
            points += outcome.points
            bar.set_postfix_str(f"{points / (time.perf_counter() - began):,.0f} points/s", refresh=False)
            bar.update()
            if outcome.problem:
                bar.write(f"{outcome.job.name}: {outcome.problem}", file=sys.stderr)
    failed = {id(outcome.job) for outcome in done if outcome.problem}
    return [path for job, path in zip(jobs, paths, strict=True) if id(job) not in failed], done


def outcomes(work: Callable[..., Any], missing: Sequence[tuple[Any, Path]], workers: int) -> Iterator[Any]:
    """What `work(job, path)` gives, as it comes, in processes or (0) in this one. Closing drops what has not begun.

    An outcome names its job in `job`.
    """
    if not workers or not missing:
        yield from (work(job, path) for job, path in missing)
        return
    # spawned, because Blender and Embree have threads that a fork would lose
    context = multiprocessing.get_context("spawn")
    with _serial(), ProcessPoolExecutor(workers, context, _forget_blender) as pool:
        futures = {pool.submit(work, job, path): job for job, path in missing}
        try:
            for future in as_completed(futures):
                outcome = future.result()
                yield outcome._replace(job=futures[future])  # the very job, not its copy from the process
        finally:
            pool.shutdown(cancel_futures=True)


def _forget_blender() -> None:
    """In a new process: it got the search path of its parent, and if Blender was there, folders that hide `bpy`."""
    sys.path[:] = [p for p in sys.path if not (Path(p) / "bpy" / "__init__.py").is_file()]  # the module is a library


@contextmanager
def _serial() -> Iterator[None]:
    """Processes started meanwhile use one thread each: libraries read this as they start."""
    before = {name: os.environ.get(name) for name in _SERIAL}
    os.environ.update(dict.fromkeys(_SERIAL, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def is_held_out(name: str, fraction: float, seed: int = 0) -> bool:
    """Whether a mesh is kept from training. By its name alone, so more meshes do not change what was decided."""
    digest = hashlib.sha256(f"{seed}:{name}".encode()).digest()
    return int.from_bytes(digest[:8], "big") < fraction * 2**64


def split(paths: Sequence[Path], fraction: float, seed: int = 0) -> tuple[list[Path], list[Path]]:
    """Files to train on and files held out, by mesh: about `fraction` of them, whatever their labels."""
    held = [is_held_out(path.stem.rpartition("-")[0], fraction, seed) for path in paths]
    return ([p for p, out in zip(paths, held, strict=True) if not out],
            [p for p, out in zip(paths, held, strict=True) if out])


def sources(make: Callable[[Path], Made], cache: Path, most: int, most_points: int, fraction: float
            ) -> list[list[Made]]:
    """Meshes to train on and meshes held out, each made of its file; empty lists where there are none.

    Args:
        most: files to take of all that are in the cache, which ones by lot, always the same.
        most_points: of a mesh; larger ones are passed over.
    """
    paths = [path for path in sorted(cache.glob("*.npz")) if is_whole(path)]
    paths = [paths[i] for i in np.random.default_rng(0).permutation(len(paths))[:most]]
    return [[make(path) for path in part if _points(path) <= most_points] for part in split(paths, fraction)]


def _points(path: Path) -> int:
    with np.load(path) as found:
        return len(found["normals"])


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. 1 where a mesh could not be labelled."""
    parser = argparse.ArgumentParser(prog="python -m training.data", description=__doc__)
    parser.add_argument("--count", type=int, default=0, help="generated meshes")
    parser.add_argument("--seed", type=int, default=0, help="which ones")
    parser.add_argument("--folder", type=Path, action="append", default=[], help="meshes of one's own")
    parser.add_argument("--rays", type=int, default=1024, help="for each point's transfer")
    parser.add_argument("--frames", default=MOTOR_FRAMES, help="module:function for the frames of the directions")
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--workers", type=int, default=2, help="processes")
    options = parser.parse_args(arguments)
    try:
        jobs = generated(options.count, options.seed, options.rays, options.frames)
        for folder in options.folder:
            jobs += of_folder(folder, options.rays, options.frames)
    except UserError as error:
        parser.error(str(error))
    paths, done = prepare(jobs, options.cache, options.workers)
    good = [outcome for outcome in done if not outcome.problem]
    if good:
        points = sum(o.points for o in good)
        making, labelling = sum(o.making for o in good), sum(o.labelling for o in good)
        print(f"{len(good)} meshes, {points / len(good):,.0f} points each; a process made one in "
              f"{making / len(good):.2f} s and labelled {points / labelling:,.0f} points a second")
    print(f"{len(paths)} of {len(jobs)} are in {options.cache}")
    return int(len(paths) < len(jobs))


if __name__ == "__main__":
    sys.exit(main())
