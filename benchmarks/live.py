# SPDX-License-Identifier: GPL-3.0-or-later
"""How well bakes follow deforming meshes: `python benchmarks/live.py [--budgets 33 16] [--runs 3]`.

Every sequence of ../shared/meshes/animated is played in Blender by a Mesh Cache modifier, with Live on, frame by frame.
For each, in milliseconds a frame (median over frames, then of the runs): Blender's own evaluation; the check whether
the bake still fits; reading what moved; the bake; writing; and Blender's evaluation of the mesh that was written to.
Drawing is not in it. Beside it, in the same run: a plain Embree bake of the frame with as many rays as give a smaller
error. Errors are SRR against 1024 rays, in every fourth frame (median and worst). Flicker: how much more a frame
differs from the next than the reference does, over the error of a frame by itself: 0 for errors that stay where they
are, 1.4 for errors that are new in each frame.
"""
from __future__ import annotations

import argparse
import struct
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import bpy
import numpy as np
from tqdm import tqdm
from trial import sequences

import neural_gash_addon
from neural_gash_addon.backend import methods
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.raycast import Occluders
from neural_gash_addon.scene import live
from neural_gash_addon.scene.attributes import read_transfer
from neural_gash_addon.scene.read import read_object

STAGES = ("evaluate", "fits?", "read", "bake", "write", "evaluate")


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--budgets", type=int, nargs="+", default=[33])
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()
    print("| sequence | vertices | budget | plan | " + " | ".join(STAGES)
          + " | all | frames/s | SRR | worst | flicker | Embree, no worse |")
    print("| --- |" + " ---: |" * 14)
    for path in tqdm(sequences(), file=sys.stderr):
        clip = np.load(path)
        for budget in arguments.budgets:
            with tempfile.TemporaryDirectory() as folder:
                print(_line(path.stem.removeprefix("anim_"), clip["verts"], clip["faces"], budget, arguments.runs,
                            Path(folder)), flush=True)
    return 0


def _line(name: str, frames: np.ndarray, faces: np.ndarray, budget: int, runs: int, folder: Path) -> str:
    """One row of the table."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    neural_gash_addon.register()
    try:
        obj = _object(frames, faces, folder / "clip.pc2")
        scene = bpy.context.scene
        bpy.ops.neural_gash.bake()
        found = []
        for _ in range(runs):
            scene.frame_set(1)
            with live.suspended():
                scene.neural_gash.live, scene.neural_gash.live_budget = True, budget / 1000
                live.start(scene)
                times, stored = _play(obj, len(frames))
            found.append(np.median(times, 0))
        stages = np.median(found, 0)
        plan = live._followers[obj.session_uid].plan
        errors, flicker, against = _errors(obj, stored)
        whole = stages.sum()
        return (f"| {name} | {frames.shape[1]:,} | {budget} | {plan.rays or 'gnn'} rays at {plan.points:,} | "
                + " | ".join(f"{1000 * t:.1f}" for t in stages)
                + f" | {1000 * whole:.0f} | {1 / whole:.0f} | {np.median(errors):.3f} | {max(errors):.3f} "
                f"| {flicker:.2f} | {against} |")
    finally:
        neural_gash_addon.unregister()


def _object(frames: np.ndarray, faces: np.ndarray, path: Path) -> bpy.types.Object:
    """The mesh, moved by a cache file of the format PC2."""
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, frames.shape[1], 0.0, 1.0, len(frames))
    path.write_bytes(head + np.ascontiguousarray(frames, "<f4").tobytes())
    data = bpy.data.meshes.new("Clip")
    data.from_pydata(frames[0].tolist(), [], faces.tolist())
    data.shade_smooth()
    obj = bpy.data.objects.new("Clip", data)
    bpy.context.scene.collection.objects.link(obj)
    cache = obj.modifiers.new("Cache", "MESH_CACHE")
    cache.cache_format, cache.filepath, cache.frame_start = "PC2", str(path), 1
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    bpy.context.scene.frame_set(1)
    return obj


def _play(obj: bpy.types.Object, count: int) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Seconds of each stage (frames, stages), and what was stored in each frame."""
    scene, clock = bpy.context.scene, _Clock()
    times, stored = [], {}
    for frame in range(2, count + 1):
        clock.begin()
        scene.frame_set(frame)
        clock.lap()
        live._suspended = False
        with clock.around(live, "fingerprint"), clock.around(live, "write_transfer"), \
                clock.around(live.Deforming, "read"), clock.around(live.Live, "bake"):
            live.follow(scene, bpy.context.evaluated_depsgraph_get())
        live._suspended = True
        clock.lap()
        bpy.context.view_layer.update()
        clock.lap()
        evaluate, _, again = clock.laps
        inside = (clock.spent[name] for name in ("fingerprint", "read", "bake", "write_transfer"))
        times.append([evaluate, *inside, again])
        stored[frame] = read_transfer(obj)[0]
    return np.array(times), stored


class _Clock:
    """Seconds between laps, and inside functions."""

    def begin(self) -> None:
        self.laps: list[float] = []
        self.spent: dict[str, float] = {}
        self._at = time.perf_counter()

    def lap(self) -> None:
        now = time.perf_counter()
        self.laps.append(now - self._at)
        self._at = now

    def around(self, owner: object, name: str):
        """While this is entered, calls of a function of that name are timed."""
        from unittest.mock import patch
        real = getattr(owner, name)

        def timed(*arguments, **keywords):
            began = time.perf_counter()
            try:
                return real(*arguments, **keywords)
            finally:
                self.spent[name] = self.spent.get(name, 0.0) + time.perf_counter() - began
        return patch.object(owner, name, timed)


def _errors(obj: bpy.types.Object, stored: dict[int, np.ndarray]) -> tuple[list[float], float, str]:
    """SRR of some frames, the flicker, and what a plain bake that is no worse takes."""
    scene = bpy.context.scene
    errors, changes, noises = [], 0.0, 0.0
    before = None
    text = ""
    for frame in sorted(stored):
        if frame % 4 not in (2, 3):
            before = None
            continue
        scene.frame_set(frame)
        mesh = read_object(obj, bpy.context.evaluated_depsgraph_get()).mesh
        truth = methods.run(methods.bake(mesh, "embree", 3, rays=1024, seed=frame)).coefficients
        error = stored[frame] - truth
        shadow = np.square(sh.cosine_lobe(mesh.normals, 3) - truth).sum()
        if before is not None:
            changes += float(np.square(error - before).sum())
            noises += float(np.square(error).sum() + np.square(before).sum()) / 2
        if frame % 4 == 2:
            errors.append(float(np.square(error).sum() / shadow))
        if not text and len(errors) > 1:
            text = _plain(mesh, truth, float(shadow), float(np.median(errors)))
        before = error
    return errors, (changes / max(noises, 1e-30)) ** 0.5, text


def _plain(mesh, truth: np.ndarray, shadow: float, target: float) -> str:
    """Milliseconds of the plain bake with the fewest rays, a power of two, whose SRR is no larger."""
    for rays in (4, 8, 16, 32, 64, 128):
        took = []
        for _ in range(3):
            began = time.perf_counter()
            scene = Occluders([(mesh.positions, mesh.triangles)], mesh.resolution)
            found = methods.run(methods.bake(mesh, "embree", 3, rays=rays, scene=scene)).coefficients
            took.append(time.perf_counter() - began)
        if float(np.square(found - truth).sum()) <= target * shadow:
            break
    return f"{rays} rays: {1000 * float(np.median(took)):.0f} ms"


if __name__ == "__main__":
    raise SystemExit(main())
