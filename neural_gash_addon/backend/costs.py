# SPDX-License-Identifier: GPL-3.0-or-later
"""What methods take over what a plan expects: calibrated once on a machine, and again where that proves wrong.

A pilot says what a ray costs here and now. What a method costs besides is in `plan`, in rays and seconds of the machine
that they were found on, for meshes as they mostly are. Where another's processor, or the number of its threads, makes
that more or less, a method takes a multiple of what is expected: so many times what it takes on that machine, with one
mesh, or one that is dense. These factors are kept in a file, if there is one (`keep_in`); without, all are 1.
"""
from __future__ import annotations

import json
import logging
import os
import platform
from collections.abc import Generator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .exchange import atomic
from .geometry import TriangleMesh
from .pilot import DENSE, Pilot, look, looking
from .plan import Candidate, Plan, Way, tried
from .progress import clocked, scaled
from .raycast import Occluders
from .workers import workers

VERSION = 4          # raised whenever the constants of `plan` are others, or what is measured
_SMALL, _LARGE = 1 << 13, 80_000  # points that are baked: so many before the first mesh that is dense
_TOLERANCES, _ORDER = (0.1, 0.2), 3  # of either
_LOOKS, _RUNS = 9, (5, 3)  # of a pilot, whose median counts; of a method, the least: other work makes it only longer
_ALIKE = ("embree",)  # on dense meshes, where it would take longest to be measured, as on others
# Over what is expected, on these meshes, where the constants of `plan` are from, with one thread.
_THERE = {"embree": 1.02, "hybrid": 1.02}, {"hybrid": 0.98, "sparse": 0.78}
_USUAL = 0.95        # of what `plan` says bakes take, in the median of many meshes
# A bake that takes so many times what is expected, or less than the reciprocal, is off, mostly by its mesh. So many in
# a row, all too long or all too short, are by the machine; twice as many each time that it was calibrated again.
_WRONG, _IN_A_ROW, _MOST_AGAIN = 1.5, 5, 20
_MOST = 16.0         # factor, and its reciprocal
_LONG = 0.02         # seconds: of less, the clock and other work are too much
_LOGGER = logging.getLogger(__name__)


@dataclass
class _Known:
    """Of this machine, with some number of threads."""

    calibrated: list[int] = field(default_factory=list)  # sizes
    factors: dict[str, float] = field(default_factory=dict)  # of methods,
    dense: dict[str, float] = field(default_factory=dict)    # and on dense meshes, where threads have more work
    off: int = 0      # bakes in a row that took too long; below 0: that took too short
    again: int = 0    # times that it was calibrated anew

    def __post_init__(self) -> None:
        if not (isinstance(self.calibrated, list) and type(self.off) is type(self.again) is int
                and 0 <= self.again <= _MOST_AGAIN
                and all(1 / _MOST <= factor <= _MOST for of in (self.factors, self.dense) for factor in of.values())):
            raise ValueError("numbers out of range")


_file: Path | None = None
_known: dict[int, _Known] = {}  # by the number of threads


def keep_in(file: Path | None) -> None:
    """Calibrate this machine and keep that in a file, which need not be there yet; with None neither any longer."""
    global _file
    _file = file
    _known.clear()
    try:
        _known.update({int(threads): _Known(**known) for threads, known in _read().get(_machine(), {}).items()})
    except (AttributeError, TypeError, ValueError):
        _LOGGER.warning("'%s' is damaged; this machine will be calibrated anew.", file)
        _known.clear()


def factors(threads: int, points: int = 0) -> dict[str, float]:
    """What is known of this machine with so many threads: what methods take over what is expected; of others, 1.

    points: of a mesh.
    """
    known = _known.get(threads, _Known())
    return {**known.factors, **(known.dense if points >= DENSE else {})}


def ways(candidates: Mapping[str, Candidate], threads: int, points: int) -> Generator[float, None, dict[str, Way]]:
    """What each candidate could do, whose plans take what they do on this machine.

    Where that is not known yet, a mesh is baked by each method that traces: half a second, once a machine and number of
    threads, and a second more before the first mesh of many points. Yields 0, many times.

    points: of the mesh that is to be baked.
    """
    if _file is not None:
        known = _known.setdefault(threads, _Known())
        for size in (_SMALL, _LARGE) if points >= DENSE else (_SMALL,):
            if size not in known.calibrated:
                found = yield from scaled(_measured(candidates, threads, size), 0, 0)
                of = known.dense if size == _LARGE else known.factors
                of.update({name: min(max(factor, 1 / _MOST), _MOST) for name, factor in found.items()})
                known.calibrated.append(size)
                _write()
    here = factors(threads, points)
    return {name: _here(each.ways, _USUAL * here.get(name, 1.0)) for name, each in candidates.items() if each.ways}


def _here(way: Way, factor: float) -> Way:
    """The same, whose plans take so many times what they would."""
    def found(*seen: Any) -> list[Plan]:
        return [replace(plan, seconds=plan.seconds * factor) for plan in way(*seen)]
    return found


def learn(plan: Plan, threads: int, taken: float) -> None:
    """That a plan took so many seconds. Where that goes on to be far from what is expected, the next one calibrates.

    All methods anew, and not the factor of that which was off: a busy machine is slower in all, and choices hang on how
    they compare.
    """
    if plan.method not in factors(threads, DENSE) or not plan.seconds or max(plan.seconds, taken) < _LONG:
        return
    known, ratio = _known[threads], taken / plan.seconds
    side = (ratio > _WRONG) - (ratio < 1 / _WRONG)
    before, known.off = known.off, known.off + side if side * known.off > 0 else side
    if abs(known.off) >= _IN_A_ROW << known.again:
        _known[threads] = _Known(again=min(known.again + 1, _MOST_AGAIN))
    if known.off != before:
        _write()


def _measured(candidates: Mapping[str, Candidate], threads: int, size: int) -> Generator[float, None, dict[str, float]]:
    """What methods that are ways to bake a mesh of so many points take, over what is expected; the least of some runs.

    In turns, so that what else goes on meets all of them.
    """
    dense, mesh = size == _LARGE, _bumpy(size)
    tolerance = _TOLERANCES[dense]
    scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
    found: dict[str, float] = {}
    with workers(threads, looking(size, tolerance)) as pool:
        pilots: list[Pilot] = []
        for seed in range(_LOOKS):
            pilots.append((yield from look(mesh, scene, _ORDER, tolerance, seed, pool, threads)))
    pilot = sorted(pilots, key=lambda each: each.ray)[_LOOKS // 2]
    pilot = yield from tried(mesh, scene, _ORDER, pilot, tolerance, 0, threads)
    wanted = {name: plans[0] for name, candidate in candidates.items() if candidate.traces and candidate.ways
              and not (dense and name in _ALIKE) and (plans := candidate.ways(pilot, size, tolerance, ""))}
    for seed in range(_RUNS[dense]):
        for name, plan in wanted.items():
            _, taken = yield from clocked(candidates[name].bake(
                mesh, _ORDER, rays=plan.rays, tolerance=plan.tolerance, occluders=(), seed=seed, threads=threads,
                scene=scene, pilot=pilot))
            factor = taken / plan.seconds / _THERE[dense].get(name, 1.0)
            found[name] = min(factor, found.get(name, factor))
    return found


def _bumpy(size: int) -> TriangleMesh:
    """A torus with bumps, of about so many points: a quarter of its light is blocked."""
    across = int((size / 3) ** 0.5)
    along = size // across
    a, b = np.meshgrid(np.arange(along) * 2 * np.pi / along, np.arange(across) * 2 * np.pi / across, indexing="ij")
    radius = 0.4 * (1 + 0.3 * np.sin(7 * a) * np.sin(3 * b))
    out = 1 + radius * np.cos(b)
    positions = np.stack([out * np.cos(a), out * np.sin(a), radius * np.sin(b)], 2).reshape(-1, 3)
    rows, columns = np.arange(along)[:, None], np.arange(across)
    corners = [((rows + i) % along * across + (columns + j) % across).ravel() for i, j in
               ((0, 0), (1, 0), (1, 1), (0, 1))]
    triangles = np.concatenate([np.stack([corners[0], corners[1], corners[2]], 1),
                                np.stack([corners[0], corners[2], corners[3]], 1)])
    return TriangleMesh.from_triangles(positions, triangles)


def _machine() -> str:
    """What tells this machine from another that has the same home folder."""
    return f"{platform.node()}, {platform.machine()}, {os.cpu_count()} processors"


def _read() -> dict[str, dict]:
    """What the file has, by machine; nothing where there is none, or of another version."""
    if _file is None:
        return {}
    try:
        content = json.loads(_file.read_text(encoding="utf-8"))
        return dict(content["machines"]) if content["version"] == VERSION else {}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        _LOGGER.warning("'%s' cannot be read; this machine will be calibrated anew.", _file)
        return {}


def _write() -> None:
    """Keep it; where that fails, it is known until Blender is closed."""
    file = _file
    if file is None:  # the add-on was switched off meanwhile
        return
    machines = {**_read(), _machine(): {str(threads): asdict(known) for threads, known in _known.items()}}
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic(file) as draft:
            draft.write_text(json.dumps({"version": VERSION, "machines": machines}, indent=2), encoding="utf-8")
    except OSError as error:
        _LOGGER.warning("What bakes take on this machine cannot be kept in '%s': %s.", file, error)
