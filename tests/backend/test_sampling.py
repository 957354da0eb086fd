# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np
from scipy.stats import qmc

from neural_gash_addon.backend import sampling


def test_sobol_agrees_with_scipy():
    ours = np.sort(sampling.sobol2(256) / 2**32, axis=0)
    theirs = np.sort(qmc.Sobol(2, scramble=False).random(256), axis=0)
    np.testing.assert_array_equal(ours, theirs)
    assert np.isclose(qmc.discrepancy(sampling.sobol2(256) / 2**32),
                      qmc.discrepancy(qmc.Sobol(2, scramble=False).random(256)))


def test_scrambled_runs_are_nets_and_differ():
    seeds = np.random.default_rng(0).integers(0, 2**32, (4, 1, 2), dtype=np.uint32)
    points = sampling.owen_scramble(sampling.sobol2(256)[None], seeds)
    for run in (points[:, :64], points[:, 64:128], points[:, 128:]):
        m = int(np.log2(run.shape[1]))
        for a in range(m + 1):  # every elementary box of area 2**-m holds one point
            x = (run[..., 0].astype(np.uint64) >> np.uint64(32 - a))
            y = (run[..., 1].astype(np.uint64) >> np.uint64(32 - (m - a)))
            boxes = x * np.uint64(1 << (m - a)) + y
            assert all(len(np.unique(b)) == run.shape[1] for b in boxes)
    assert not np.array_equal(points[0], points[1])


def test_hemisphere_is_cosine_distributed():
    d = sampling.hemisphere_sets(16, 1024, 3)
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1, atol=1e-12)
    assert (d[..., 2] > 0).all()
    np.testing.assert_allclose(d.mean((0, 1)), [0, 0, 2 / 3], atol=2e-3)  # E[cos] under cos/pi
    np.testing.assert_allclose((d[..., 2] ** 2).mean(), 0.5, atol=1e-3)


def test_frames_are_rotations_onto_the_normals_at_the_poles_too():
    n = np.random.default_rng(1).normal(size=(1000, 3))
    n[:4] = [[0, 0, 1], [0, 0, -1], [1e-9, 0, -1], [0, -1e-12, 1]]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    f = sampling.frames(n, np.linspace(0, 20, 1000))
    np.testing.assert_allclose(f.transpose(0, 2, 1) @ f, np.broadcast_to(np.eye(3), f.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(f), 1)
    np.testing.assert_array_equal(f[:, :, 2], n)
