# SPDX-License-Identifier: GPL-3.0-or-later
"""Whole glossy pictures from five bands beside Mitsuba 3's, by Phong exponent: `python benchmarks/gloss_scenes.py`.

Three scenes are made here; the two from the folder of meshes are left out where that is not.
Mitsuba's scalar variant runs everywhere and takes some 40 minutes on two cores; with a new LLVM
on the machine (14 and 15 are too old), `--variant llvm_ad_rgb --samples 256` takes ten.
"""
from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import mitsuba as mi
import numpy as np
from gloss_error import EXPONENTS, ORDER, head, outward, sky, torus
from meshes import FOLDER, knot
from numpy.typing import NDArray
from pictures import Camera, PathTraced, Seen, compare

from neural_gash_addon.backend import embree_bake, gloss, methods
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.raycast import Geometry

SIZE = 200, 150
SHOWN, SHOWN_EXPONENT = ("knot", "head", "armory"), 20
_MORE = 9       # bands, to see how fast what is cut off falls
_PER_SIDE = 3   # points seen in a pixel are twice the square of this
_RAYS = 512     # of a point, for its transfer


def on_floor(geometry: Geometry, half: float) -> Geometry:
    """The geometry standing on a square floor that is 2 * `half` wide."""
    positions, triangles = geometry
    z, n = positions[:, 2].min(), len(positions)
    x, y = positions.mean(0)[:2]
    floor = [(x - half, y - half, z), (x + half, y - half, z), (x + half, y + half, z), (x - half, y + half, z)]
    return np.concatenate([positions, floor]), np.concatenate([triangles, [(n, n + 1, n + 2), (n, n + 2, n + 3)]])


def read(name: str) -> Geometry:
    """A scene of the folder of meshes, Z up."""
    with np.load(FOLDER / "scenes" / f"scene_{name}.npz") as file:
        positions, triangles = file["verts"].astype(float), file["faces"]
        if str(file["up"]) == "y":
            positions = positions[:, [0, 2, 1]] * [1, -1, 1] / 100
    return positions, triangles


def scenes() -> dict[str, tuple[Geometry, Camera]]:
    """Name -> what there is, and who looks."""
    found = {
        "torus": (on_floor(outward(torus()), 3), Camera((2.5, -3.5, 3.0), (0, 0, -0.2), 38, *SIZE)),
        "knot": (on_floor(outward(knot(8800)), 6), Camera((4.5, -8.5, 7.5), (0, 0, -0.4), 38, *SIZE)),
        "head": (on_floor(outward(head()), 4), Camera((1.2, -4.6, 1.2), (0, -0.2, -0.15), 40, *SIZE))}
    if (FOLDER / "scenes").is_dir():
        found["Cornell box"] = read("cornell_box"), Camera((2.78, 8.0, 2.73), (2.78, 0, 2.73), 46, *SIZE)
        found["armory"] = read("kaykit_armory"), Camera((3.9, -4.2, 2.6), (-0.3, 0.3, 0.8), 42, *SIZE)
    return found


def measure(name: str, geometry: Geometry, camera: Camera, samples: int) -> tuple[list[str], NDArray]:
    """Rows of the table, and a strip of pictures (H, 3 W, 3): NumPy, Mitsuba, the difference about grey."""
    light = sky()
    eyes = [Seen(geometry, camera, _PER_SIDE, seed) for seed in (0, 1)]
    products: dict[str, list[NDArray]] = {"shadowed": [], "more": [], "open": []}
    for seed, eye in enumerate(eyes):
        wide = methods.run(embree_bake.bake(eye.mesh, _MORE, rays=_RAYS, tolerance=None, occluders=(), seed=seed,
                                            threads=None)).coefficients
        products["shadowed"].append(gloss.transferred(wide[:, :ORDER ** 2], light))
        products["more"].append(gloss.transferred(wide, light))
        products["open"].append(gloss.transferred(sh.cosine_lobe(eye.mesh.normals, ORDER), light))
    rows, strip = [], np.zeros(0)
    with tempfile.TemporaryDirectory() as folder:
        traced = PathTraced(mi, geometry, camera, light, Path(folder))
        for exponent in EXPONENTS:
            (first, full), (second, also) = (traced.picture(exponent, samples, seed) for seed in (1, 2))
            truth = np.stack([first, second])
            where = full & also & eyes[0].covered & eyes[1].covered
            pictures = {how: np.stack([eye.picture(product, exponent) for eye, product in zip(eyes, both, strict=True)])
                        for how, both in products.items()}
            error, bands, noise = compare(pictures["shadowed"], truth, where)
            more, none = (compare(pictures[how], truth, where)[1] for how in ("more", "open"))
            rows.append(f"| {name} | {exponent} | {error:.1%} | {bands:.1%} | {noise:.1%} | {more:.1%} | {none:.1%} |")
            print(rows[-1], f"{where.mean():.0%} of the picture", file=sys.stderr)
            if exponent == SHOWN_EXPONENT:
                ours, theirs = pictures["shadowed"].mean(0), truth.mean(0)
                white = np.quantile(theirs[where].max(1), 0.98)
                strip = np.concatenate([ours / white, theirs / white,
                                        np.where(where[..., None], 0.2 + (ours - theirs) / white, 0.2)], 1)
    return rows, strip


def main() -> None:
    """Print the table; write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=64, help="of a pixel, in each half of the reference")
    parser.add_argument("--variant", default="scalar_rgb", help="of Mitsuba")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the picture")
    args = parser.parse_args()
    mi.set_variant(args.variant)
    strips, table = [], []
    for name, (geometry, camera) in scenes().items():
        rows, strip = measure(name, geometry, camera, args.samples)
        table += rows
        strips += [strip] * (name in SHOWN)
    print("\n| scene | Phong exponent | error | of it band limit | of it noise | 9 bands | no shadows |")
    print("|---|---|---|---|---|---|---|")
    print("\n".join(table))
    args.out.mkdir(parents=True, exist_ok=True)
    shown = np.clip(np.concatenate(strips), 0, 1).astype(np.float32)
    mi.util.write_bitmap(str(args.out / "gloss_scenes.png"), shown, write_async=False)


if __name__ == "__main__":
    main()
