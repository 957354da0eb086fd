# SPDX-License-Identifier: GPL-3.0-or-later
"""How many bands of light by direction a glossy lobe can show, in generated rooms.

`python benchmarks/radiance_order.py`. What a lobe reflects has sum_k (a_l c_k)^2 as its squares over all directions,
a_l the lobe's attenuation (GGX) and c_k traced to ORDER bands, without the paths' noise. Printed is the share of it
that is beyond order 3 and order 5.
"""
from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from neural_gash_addon.backend import irradiance, lobes, methods
from training import rooms
from training.room_labels import visible_points

SEEDS = (2_000_000, 2_000_001, 2_000_002, 2_000_003)  # of the split evaluation
ORDER, PATHS, POINTS = 12, 4096, 200
ROUGHNESS = (0.3, 0.4, 0.6, 0.8)


def main() -> None:
    """Print a table."""
    energy = {"straight": np.zeros(ORDER), "reflected": np.zeros(ORDER)}
    for seed in SEEDS:
        scene = rooms.generate(seed)
        occluders = scene.occluders()
        asked = visible_points(scene, POINTS, seed, occluders)
        for name, how in (("straight", {"depth": 1}), ("reflected", {"straight": False})):
            found = methods.run(irradiance.irradiance(scene, asked[:, :3], asked[:, 3:6], PATHS, threads=1, order=ORDER,
                                                      occluders=occluders, **how))
            one = np.square(found.shape).sum((0, 2)), np.square(found.shape_error).sum((0, 2))
            energy[name] += np.add.reduceat((one[0] - one[1]) / one[0][0], np.arange(ORDER) ** 2)
    print("| light | roughness | beyond order 3 | beyond order 5 |\n|---|---|---|---|")
    for name, bands in energy.items():
        for roughness in ROUGHNESS:
            shown = bands.clip(0) * lobes.ggx_attenuation(roughness, ORDER) ** 2
            beyond = (f"{shown[order:].sum() / shown.sum():.3f}" for order in (3, 5))
            print(f"| {name} | {roughness} | {' | '.join(beyond)} |")
        print(name, "energy of bands over that of band 0:", np.round(bands / bands[0], 3).tolist())


if __name__ == "__main__":
    main()
