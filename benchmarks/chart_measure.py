# SPDX-License-Identifier: GPL-3.0-or-later
"""What is on the chart, and its measurement: one block of rows for each mesh and sweep, kept as soon as it is done."""
from __future__ import annotations

import csv
import json
import subprocess
import time
from collections.abc import Generator, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ambient import cycles_openness
from memory import Watch
from meshes import FOLDER, named
from numpy.typing import NDArray
from peers import Open3D, Trimesh
from table import machine
from textures import surface_of, texels_of

from neural_gash_addon.backend import compare, methods, texture
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.compare import Bake, Measurement, Setting
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.exchange import atomic
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.progress import scaled
from neural_gash_addon.backend.record import BakeRecord
from neural_gash_addon.backend.texels import Surface
from neural_gash_addon.backend.unwrap import unwrap
from neural_gash_addon.backend.workers import default_threads

ORDER = 3
RAYS = (2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
FEW = (2, 8, 32, 64, 128, 512)   # of the sweeps that only show what one thing changes
PEER_RAYS = (4, 16, 64, 256)
SAMPLE = 4096                    # points of a mesh, or all, at which errors are measured
REFERENCE_SEED, SEED, ROUNDS = 77, 0, 3
SIDE = 256                       # texels of a texture
SWEEPS = "base", "peers", "threads", "orders", "texture"
PEERS = {"trimesh": Trimesh, "open3d": Open3D}
CYCLES = "cycles-ao"
COLUMNS = ("points", "method", "order", "rays", "threads", "target", "seconds", "least", "most", "ratio", "runs", "srr",
           "rel_l2", "openness", "relit_mean", "relit_worst", "claimed", "memory_mb", "note", "tolerance")


@dataclass(frozen=True)
class Case:
    """A mesh, and what is swept on it."""

    mesh: str       # stem of a file of ../shared/meshes/validation, or 'knot' and a number of vertices
    category: str   # the manifest's, or 'scale'
    sweep: str      # 'base', 'peers', 'threads', 'orders', 'texture', or 'scale'
    quick: bool = False

    @property
    def key(self) -> str:
        """What the block is known by."""
        return f"{self.sweep} {self.mesh}"


def full_cases() -> list[Case]:
    """The full run: every sweep on the smallest, the median and the largest mesh of each category; and the knot."""
    by_category: dict[str, list[tuple[int, str]]] = {}
    if (FOLDER / "MANIFEST.csv").is_file():
        with (FOLDER / "MANIFEST.csv").open(newline="") as file:
            for row in csv.DictReader(file):
                path = Path(row["file"])
                if path.parent.name == "validation":
                    by_category.setdefault(row["category"], []).append((int(row["verts"]), path.stem))
    cases = []
    for category, found in sorted(by_category.items()):
        ordered = [stem for _, stem in sorted(found)]
        middle = ordered[len(ordered) // 2]
        cases += [Case(stem, category, sweep) for stem in dict.fromkeys((ordered[0], middle, ordered[-1]))
                  for sweep in SWEEPS]
    if not cases:
        cases = [Case("knot 8800", "procedural", sweep) for sweep in SWEEPS]
    return cases + [Case(f"knot {size}", "scale", "scale") for size in (1_000, 10_000, 100_000, 1_000_000)]


def quick_cases() -> list[Case]:
    """Each sweep on a small knot."""
    return [Case(f"knot {size}", category, sweep, quick=True) for size, category, sweep in (
        (400, "procedural", "base"), (1000, "procedural", "base"), (400, "procedural", "peers"),
        (400, "procedural", "threads"), (400, "procedural", "orders"), (400, "procedural", "texture"),
        (1000, "scale", "scale"))]


def _settings(case: Case, points: int) -> list[Setting]:
    """What a case measures, each once."""
    threads = default_threads()
    rays: tuple[int, ...] = FEW if case.sweep in ("threads", "orders", "texture") else RAYS
    if case.sweep == "peers":
        rays = (2, 8, 32, 64, 128)
    if case.sweep == "scale":  # a million points take as long as there is time for
        rays = tuple(count for count in RAYS if count * points <= 1.3e8)
    tolerances = compare.TOLERANCES if case.sweep in ("base", "scale") else compare.TOLERANCES[1:4]
    if case.quick:
        rays, tolerances = tuple(count for count in rays if count in (2, 16, 64)), tolerances[1:3]
    found = []
    threads = 1 if case.sweep == "threads" else threads
    for order in ((2, 4, 5) if case.sweep == "orders" else (ORDER,)):
        found += [*compare.settings_of(order, rays, threads, tolerances), compare.baseline(order, threads)]
    if case.sweep == "peers":
        samples = PEER_RAYS[:2] if case.quick else PEER_RAYS
        found += [Setting(peer, ORDER, count, threads=threads) for peer in (*PEERS, CYCLES) for count in samples]
    return list(dict.fromkeys(found))


def _with_peers(mesh: TriangleMesh, ours: Bake) -> Bake:
    """Peers are baked as their users would, everything that they build included."""
    def bake(setting: Setting, seed: int) -> Generator[float, None, tuple[NDArray, BakeRecord | None]]:
        if setting.method in methods.METHODS:
            return (yield from ours(setting, seed))
        yield 0.0
        assert setting.rays is not None
        try:
            if setting.method == CYCLES:
                found = cycles_openness(mesh)(setting.rays, seed)[:, None] * sh.normalisation(0, 0)
            else:
                found = PEERS[setting.method](mesh, setting.order).transfer(setting.rays, seed)
        except (ImportError, OSError) as error:
            raise UserError(f"not measured: {error}") from error
        return found, None

    return bake


class _Watched:
    """A bake whose memory is watched in the first run of each setting."""

    def __init__(self, bake: Bake) -> None:
        self._bake = bake
        self.peaks: dict[Setting, float] = {}  # MB over what was there before: the mesh, and a surface's UVs

    def __call__(self, setting: Setting, seed: int) -> Generator[float, None, tuple[NDArray, BakeRecord | None]]:
        running = self._bake(setting, seed)
        return running if setting in self.peaks else self._watched(setting, running, Watch())

    def _watched(self, setting: Setting, running: Generator[float, None, tuple[NDArray, BakeRecord | None]],
                 watch: Watch) -> Generator[float, None, tuple[NDArray, BakeRecord | None]]:
        found = yield from running
        self.peaks[setting] = watch.peak()
        return found


def _warm_peers(settings: Sequence[Setting]) -> None:
    """Run each peer once on a small knot, so that no time has its import."""
    bake = _with_peers(named("knot 100"), compare.vertex_bake(named("knot 100")))
    for name in (*PEERS, CYCLES):
        with suppress(UserError):
            methods.run(bake(next(setting for setting in settings if setting.method == name), 0))


def missing(cases: Iterable[Case], blocks: Iterable[dict[str, Any]]) -> list[tuple[Case, frozenset[str]]]:
    """What is still to be measured of each case: methods of the table; all, if there is nothing of it."""
    there = {(block["key"], row[COLUMNS.index("method")]) for block in blocks for row in block["rows"]}
    found = [(case, frozenset(name for name in methods.METHODS if (case.key, name) not in there)) for case in cases]
    return [(case, names) for case, names in found if names]


def without(blocks: Iterable[dict[str, Any]], method: str) -> list[dict[str, Any]]:
    """The blocks but for the rows of a method."""
    kept = [{**block, "rows": [row for row in block["rows"] if row[COLUMNS.index("method")] != method]}
            for block in blocks]
    return [block for block in kept if block["rows"]]


def _unwrapped(surface: Surface, side: int) -> tuple[NDArray, int]:
    """UVs in a texture of so many texels a side; of many charts in one twice as large, or four times."""
    try:
        return methods.run(unwrap(surface, side=side)).uv, side
    except UserError:  # they do not fit
        if side >= 4 * SIDE:
            raise
        return _unwrapped(surface, 2 * side)


def measure(case: Case, lights: list[NDArray], only: frozenset[str] = frozenset(methods.METHODS)
            ) -> Generator[float, None, dict[str, Any]]:
    """A block: where it was measured, and its rows in the order of COLUMNS.

    only: methods of the table. If that is not all, the others and the peers are there already; the plain bake is run
    beside them for the ratio, and its rows are left out.
    """
    mesh = named(case.mesh)
    note = ""
    bake = compare.vertex_bake(mesh)
    points = mesh
    if case.sweep == "texture":
        surface, side = surface_of(mesh), 64 if case.quick else SIDE
        began = time.perf_counter()
        uv, side = _unwrapped(surface, side)
        note = f"{side} texels a side, unwrap {time.perf_counter() - began:.2f} s"
        points = texels_of(surface, uv, side)

        def bake(setting: Setting, seed: int) -> Generator[float, None, tuple[NDArray, BakeRecord | None]]:
            found = yield from texture.bake(surface, setting.method, setting.order, uv=uv, side=side,
                                            rays=setting.rays, tolerance=setting.tolerance, seed=seed,
                                            threads=setting.threads)
            return sh.padded(np.concatenate(found.coefficients), sh.coefficient_count(setting.order)), found.record
    settings = _settings(case, len(points.points))
    whole_table = only == frozenset(methods.METHODS)
    if not whole_table:
        settings = [setting for setting in settings if setting.method in only
                    or setting == compare.baseline(setting.order, setting.threads)]
    sees = methods.METHODS["embree"].sees
    assert sees is not None
    scene = sees(points, ())
    rows = compare.sample(len(points.points), 400 if case.quick else SAMPLE, REFERENCE_SEED)
    orders = sorted({setting.order for setting in settings})
    out: list[dict[str, Any]] = []
    for number, order in enumerate(orders):
        own = [setting for setting in settings if setting.order == order]
        start, share = number / len(orders), 1 / len(orders)
        truth = yield from scaled(compare.reference(points, order, rows, seed=REFERENCE_SEED, scene=scene),
                                   start, 0.3 * share)
        whole = bake
        if case.sweep == "peers" and whole_table:
            whole = _with_peers(mesh, bake)
            _warm_peers(own)
        watched = _Watched(whole)
        rounds = 1 if case.quick or len(mesh.points) > 500_000 else ROUNDS
        found = yield from scaled(compare.compare(watched, own, truth, lights, rounds, SEED),
                                   start + 0.3 * share, 0.7 * share)
        out += [_row(case, len(points.points), m, note, watched.peaks.get(m.setting))
                for m in found if whole_table or m.setting.method in only]
        if whole_table:
            out.append({"points": len(points.points), "method": "reference", "order": order,
                        "rays": compare.REFERENCE_RAYS, **truth.floor(lights)})
    return {"key": case.key, "mesh": case.mesh, "category": case.category, "sweep": case.sweep, **about(),
            "rows": [[_short(row.get(column)) for column in COLUMNS] for row in out]}


def _row(case: Case, points: int, found: Measurement, note: str, peak: float | None) -> dict[str, Any]:
    setting = found.setting
    figures = {name: getattr(found, name) for name in
               ("ratio", "srr", "rel_l2", "openness", "relit_mean", "relit_worst", "claimed")}
    return {"points": points, "method": setting.method, "order": setting.order, "rays": setting.rays,
            "tolerance": setting.tolerance, "threads": setting.threads,
            "target": "texture" if case.sweep == "texture" else "vertices",
            "seconds": found.median, "least": min(found.seconds, default=None),
            "most": max(found.seconds, default=None), "runs": len(found.seconds), "note": found.refused or note,
            "memory_mb": peak,
            **figures}


def _short(value: Any) -> Any:
    """Four digits, and null for what is not a number."""
    if isinstance(value, float):
        return float(f"{value:.4g}") if np.isfinite(value) else None
    return value


def about() -> dict[str, Any]:
    """Where a block comes from."""
    root = Path(__file__).resolve().parents[1]

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False).stdout.strip()

    changed = "+" if git("status", "--porcelain", "--untracked-files=no") else ""
    return {"machine": machine(default_threads()), "commit": git("rev-parse", "--short", "HEAD") + changed,
            "seeds": {"reference": REFERENCE_SEED, "first": SEED}}


def load(path: Path) -> list[dict[str, Any]]:
    """The blocks that are there; what a column that is new in COLUMNS had is not known."""
    if not path.is_file():
        return []
    found = json.loads(path.read_text())
    for block in found["blocks"]:
        if not {"key", "mesh", "category", "sweep"} <= set(block):
            raise ValueError("a block does not say what it is of")
        rows = [dict(zip(found["columns"], row, strict=True)) for row in block["rows"]]
        block["rows"] = [[row.get(column) for column in COLUMNS] for row in rows]
    return found["blocks"]


def save(path: Path, blocks: Iterable[dict[str, Any]]) -> None:
    """Write all blocks, one row a line; nothing is lost where this is interrupted."""
    parts = []
    for block in blocks:
        head = json.dumps({key: value for key, value in block.items() if key != "rows"})
        parts.append(head[:-1] + ', "rows": [\n' + ",\n".join(json.dumps(row) for row in block["rows"]) + "]}")
    with atomic(path) as draft:
        draft.write_text('{"columns": ' + json.dumps(COLUMNS) + ',\n"blocks": [\n' + ",\n".join(parts) + "]}\n")


def rows_of(blocks: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """All rows with their block's mesh, category and sweep; numbers that are not there are NaN.

    Methods that were measured later than the others, on a machine that was as busy as it was then, have the seconds
    that their ratio to the plain bake beside them says: so many times what that took beside the others.
    """
    blocks, found = list(blocks), []
    plain: dict[tuple[str, int, int], float] = {}
    for block in blocks:
        for row in (dict(zip(COLUMNS, values, strict=True)) for values in block["rows"]):
            if (row["method"], row["rays"]) == ("embree", compare.BASELINE_RAYS) and row["seconds"] is not None:
                plain[block["key"], row["order"], row["threads"]] = row["seconds"]
    for block in blocks:
        later = "embree" not in {values[COLUMNS.index("method")] for values in block["rows"]}
        for values in block["rows"]:
            row = dict(zip(COLUMNS, values, strict=True))
            beside = plain.get((block["key"], row["order"], row["threads"]))
            if later and row["ratio"] is not None and beside is not None:
                row["seconds"] = row["ratio"] * beside
            for name in ("seconds", "ratio", "srr", "rel_l2", "openness", "relit_mean", "relit_worst"):
                row[name] = float("nan") if row[name] is None else row[name]
            found.append({**row, "mesh": block["mesh"], "category": block["category"], "sweep": block["sweep"]})
    return found
