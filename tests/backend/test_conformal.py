# SPDX-License-Identifier: GPL-3.0-or-later
"""The oracle is kingdon, and the table product is the slow twin of the closed forms."""
import itertools
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kingdon import Algebra

from neural_gash_addon.backend import conformal

ONE, E1, E2, E3, E4, E5 = np.eye(32)[:6]
INFINITY, ORIGIN = E4 + E5, 0.5 * (E5 - E4)
POLE = np.array([0.0, -1.0, 0.0])
ANGLES = [0.0, 1e-45, 1e-40, 1e-29, 1e-19, 1e-12, 1e-8, 1e-6, 3e-4, 1e-3, 1e-2, 0.1, 1.0]  # from the pole


def vector(v: np.ndarray) -> np.ndarray:
    """(..., 3) as multivectors."""
    return v @ np.eye(32)[1:4]


def point(p: np.ndarray) -> np.ndarray:
    """(..., 3) as conformal points."""
    return vector(p) + 0.5 * np.sum(p * p, -1, keepdims=True) * INFINITY + ORIGIN


def near_pole(angle: float, count: int = 24) -> np.ndarray:
    """A circle of normals at an angle from -e_y."""
    phi = np.arange(count) * 2 * np.pi / count
    return np.stack([np.sin(angle) * np.cos(phi), np.full(count, -np.cos(angle)), np.sin(angle) * np.sin(phi)], 1)


def random_surface(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    n = rng.normal(size=(count, 3))
    return rng.normal(size=(count, 3)), n / np.linalg.norm(n, axis=1, keepdims=True)


coordinates = st.floats(-10, 10, allow_subnormal=False)
points = st.tuples(coordinates, coordinates, coordinates).map(np.array)
# the whole sphere, with a weight on the pole and on what lies beside it
normals = st.one_of(
    points.filter(lambda v: np.linalg.norm(v) > 1e-3).map(lambda v: v / np.linalg.norm(v)),
    st.tuples(st.sampled_from(ANGLES), st.integers(0, 23)).map(lambda a: near_pole(a[0])[a[1]]),
    st.sampled_from([np.array(v, dtype=float) for v in itertools.product((-1, 0, 1), repeat=3) if np.dot(v, v) == 1]))
surfaces = st.tuples(points, normals)


# The algebra

def test_table_product_is_kingdons():
    algebra = Algebra(4, 1)
    names = ["e" + "".join(map(str, blade)) for blade in conformal.BLADES]
    rng = np.random.default_rng(1)
    for _ in range(5):
        a, b = rng.normal(size=(2, 32))
        ka, kb = (algebra.multivector(dict(zip(names, v, strict=True))) for v in (a, b))
        for ours, theirs in [(conformal.multiply(a, b), ka * kb), (conformal.reverse(a), ~ka),
                             (conformal.sandwich(a, b), ka * kb * ~ka)]:
            np.testing.assert_allclose(ours, [getattr(theirs, name) for name in names], atol=1e-10)


def test_product_is_associative_and_has_the_metric():
    a, b, c = np.random.default_rng(2).normal(size=(3, 7, 32))
    np.testing.assert_allclose(conformal.multiply(conformal.multiply(a, b), c),
                               conformal.multiply(a, conformal.multiply(b, c)), atol=1e-10)
    for e, square in zip((E1, E2, E3, E4, E5, INFINITY, ORIGIN), (1, 1, 1, 1, -1, 0, 0), strict=True):
        np.testing.assert_array_equal(conformal.multiply(e, e), square * ONE)
    assert (0.5 * (conformal.multiply(INFINITY, ORIGIN) + conformal.multiply(ORIGIN, INFINITY)))[0] == -1


def test_product_broadcasts():
    a, b = np.random.default_rng(3).normal(size=(2, 4, 32))
    grid = conformal.multiply(a[:, None], b[None])
    assert grid.shape == (4, 4, 32)
    np.testing.assert_array_equal(grid[1, 2], conformal.multiply(a[1], b[2]))


# The motor

def test_motor_is_the_papers():
    """Equations (4) and (5), multiplied by kingdon."""
    algebra = Algebra(4, 1)
    for p, n in zip(*random_surface(20), strict=True):
        half = (n + [0, 1, 0]) / np.linalg.norm(n + [0, 1, 0])
        rotor = algebra.multivector(e=half[1], e12=half[0], e23=-half[2])
        infinity = algebra.multivector(e4=1.0, e5=1.0)
        translator = 1 - 0.5 * (algebra.multivector(e1=p[0], e2=p[1], e3=p[2]) * infinity)
        product = translator * rotor
        expected = [getattr(product, "e" + "".join(map(str, blade))) for blade in conformal.BLADES]
        np.testing.assert_allclose(conformal.motor(p, n), expected, atol=1e-14)


@given(surfaces)
def test_motor_carries_origin_to_point_and_up_to_normal(surface):
    p, n = surface
    m = conformal.motor(p, n)
    np.testing.assert_allclose(conformal.sandwich(m, ORIGIN), point(p), atol=1e-11)
    # the line through the origin along e_y becomes the line through p along n, as n . p = 0 does for n at p
    line = conformal.sandwich(m, E2)
    np.testing.assert_allclose(line, vector(n) + np.dot(n, p) * INFINITY, atol=1e-12)


@given(surfaces)
def test_motor_and_encoding_have_unit_norm_and_reverse_is_inverse(surface):
    for m in (conformal.motor(*surface), conformal.encode(*surface)):
        np.testing.assert_allclose(conformal.multiply(m, conformal.reverse(m)), ONE, atol=1e-12)
        np.testing.assert_allclose(conformal.multiply(conformal.reverse(m), m), ONE, atol=1e-12)


@given(surfaces, surfaces, points)
@settings(max_examples=50)
def test_motors_compose(first, second, p):
    a, b = conformal.motor(*first), conformal.motor(*second)
    both = conformal.multiply(a, b)
    moved = first[0] + conformal.frames(a) @ (second[0] + conformal.frames(b) @ p)
    np.testing.assert_allclose(conformal.sandwich(both, point(p)), point(moved), atol=1e-9)
    np.testing.assert_allclose(conformal.frames(both), conformal.frames(a) @ conformal.frames(b), atol=1e-13)
    np.testing.assert_allclose(conformal.multiply(both, conformal.reverse(both)), ONE, atol=1e-11)


@given(surfaces)
def test_frames_are_the_sandwich(surface):
    m = conformal.multiply(conformal.motor(*surface), conformal.motor(np.ones(3), np.array([0.6, 0.0, 0.8])))
    for turned in (m, conformal.motor(*surface)):
        rotor = turned * np.array([not {4, 5} & set(blade) for blade in conformal.BLADES])
        columns = [conformal.sandwich(rotor, e)[1:4] for e in (E1, E2, E3)]
        np.testing.assert_allclose(conformal.frames(turned), np.stack(columns, 1), atol=1e-14)
        assert np.isclose(np.linalg.det(conformal.frames(turned)), 1)


def test_motor_takes_any_length_and_a_zero_normal_as_up():
    p, n = random_surface(50)
    np.testing.assert_allclose(conformal.motor(p, 1e-3 * n), conformal.motor(p, n), atol=1e-14)
    np.testing.assert_array_equal(conformal.motor(p, 0 * n), conformal.motor(p, 0 * n + [0, 1, 0]))


def test_compact_keeps_everything():
    p, n = random_surface(30)
    products = conformal.multiply(conformal.motor(p, n), conformal.motor(p[::-1], n[::-1]))
    for m in (conformal.motor(p, n), conformal.encode(p, n), products):
        c = conformal.compact(m)
        assert c.shape == (30, 8)
        full = c[:, :4] @ np.eye(32)[[0, 6, 7, 10]]
        for i, v in enumerate((E1, E2, E3, conformal.multiply(E1, conformal.multiply(E2, E3)))):
            full += c[:, 4 + i, None] * conformal.multiply(v, INFINITY)
        np.testing.assert_allclose(full, m, atol=1e-14)


# The pole

@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("angle", ANGLES)
def test_motor_is_accurate_up_to_the_pole(angle, dtype):
    tolerance = 8 * np.finfo(dtype).eps
    n = near_pole(angle).astype(dtype)
    m = conformal.motor(np.ones_like(n), n)
    assert m.dtype == dtype and np.isfinite(m).all()
    frames = conformal.frames(m)
    np.testing.assert_allclose(frames[:, :, 1], n, atol=tolerance)
    np.testing.assert_allclose(frames[:, :, 1] - POLE, n - POLE, atol=tolerance)
    np.testing.assert_allclose(np.swapaxes(frames, 1, 2) @ frames, np.broadcast_to(np.eye(3), (24, 3, 3)),
                               atol=tolerance)
    # the components themselves, not only that they are some unit motor; s is the angle from the pole, pi - t
    x, y, z = n.astype(float).T
    c, s, phi = conformal.compact(m), np.arctan2(np.hypot(x, z), -y), np.arctan2(z, x)
    off = s > 1e-30  # nearer counts as the pole
    np.testing.assert_allclose(c[off, 0], np.sin(s / 2)[off], rtol=tolerance)
    np.testing.assert_allclose(c[off, 1], (np.cos(s / 2) * np.cos(phi))[off], atol=tolerance)
    np.testing.assert_allclose(c[off, 3], (-np.cos(s / 2) * np.sin(phi))[off], atol=tolerance)


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_motor_at_the_pole_is_a_stated_one(zero):
    n = np.array([zero, -1, zero], dtype=np.float32)
    np.testing.assert_array_equal(conformal.compact(conformal.motor(np.zeros_like(n), n)), [0, 1, 0, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(conformal.frames(conformal.motor(np.zeros_like(n), n)), np.diag([-1, -1, 1]))


def test_the_motor_must_jump_at_the_pole():
    """Why there is `encode`: opposite sides of the pole, as near as can be, have opposite motors."""
    sides = conformal.motor(np.zeros((24, 3)), near_pole(1e-9))
    np.testing.assert_allclose(sides[:12], -sides[12:], atol=1e-8)


@given(surfaces)
def test_encoding_is_translator_rotor_rotor(surface):
    p, n = surface
    rotor = conformal.motor(np.zeros(3), n)
    np.testing.assert_allclose(conformal.encode(p, n), conformal.multiply(conformal.motor(p, n), rotor), atol=1e-12)
    np.testing.assert_allclose(conformal.sandwich(conformal.encode(p, n), ORIGIN), point(p), atol=1e-11)


@given(points, normals, normals)
def test_encoding_moves_as_far_as_the_normal(p, n, other):
    """So it is continuous, has no pole, and no two normals share one."""
    step = np.linalg.norm(n - other)
    change = conformal.encode(p, n) - conformal.encode(p, other)
    assert np.isclose(np.linalg.norm(change[[0, 6, 7, 10]]), step, atol=1e-14)
    # each of the four numbers of -1/2 p (n - n') e_y stands twice
    assert np.isclose(np.linalg.norm(change[[8, 9, 11, 12, 13, 14, 26, 27]]),
                      np.linalg.norm(p) * step / np.sqrt(2), atol=1e-12)


def test_predictions_do_not_jump_in_sweeps_through_the_pole_and_every_direction():
    """A network, random and steep, along great circles through both poles and through e_x, e_z and the diagonals."""
    rng = np.random.default_rng(7)
    first, last = rng.normal(size=(32, 64)), rng.normal(size=(64, 9))
    t = np.linspace(0, 2 * np.pi, 3601)  # steps of 0.1 degree; the pole is at 1800
    p = np.array([0.3, -0.8, 0.5], dtype=np.float32)
    for phi in np.arange(16) * np.pi / 16:
        n = np.stack([np.sin(t) * np.cos(phi), np.cos(t), np.sin(t) * np.sin(phi)], 1).astype(np.float32)
        n[1800] = POLE
        out = np.tanh(conformal.encode(np.broadcast_to(p, n.shape), n) @ first) @ last
        assert np.isfinite(out).all()
        steps = np.linalg.norm(np.diff(out, axis=0), axis=1)
        neighbours = np.maximum(np.roll(steps, 3), np.roll(steps, -3))  # the circle is closed
        assert (steps < 1.5 * neighbours + 1e-3).all()
        at_pole = steps[1798:1802]
        assert at_pole.max() < 1.2 * steps[[1790, 1795, 1804, 1809]].max()


def test_predictions_agree_from_every_side_of_the_pole():
    for angle in (1e-3, 1e-5, 1e-7, 0.0):
        n = near_pole(angle).astype(np.float32)
        p = np.broadcast_to(np.float32([0.3, -0.8, 0.5]), n.shape)
        difference = conformal.encode(p, n) - conformal.encode(p[:1], POLE.astype(np.float32)[None])
        assert np.abs(difference).max() <= angle * 1.01


# Arrays, devices, directions

@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_torch_equals_numpy(dtype):
    torch = pytest.importorskip("torch", reason="torch is optional: networks need it, the rest does not")
    p, n = random_surface(200)
    n[:len(ANGLES)] = [near_pole(a)[5] for a in ANGLES]
    n[-1] = 0
    p, n = p.astype(dtype), n.astype(dtype)
    tp, tn = torch.from_numpy(p), torch.from_numpy(n)
    m, tm = conformal.motor(p, n), conformal.motor(tp, tn)
    pairs = [(m, tm), (conformal.encode(p, n), conformal.encode(tp, tn)),
             (conformal.compact(m), conformal.compact(tm)), (conformal.frames(m), conformal.frames(tm)),
             (conformal.sandwich(m, m[::-1]), conformal.sandwich(tm, tm.flip(0)))]
    for ours, theirs in pairs:
        assert isinstance(theirs, torch.Tensor) and theirs.dtype == getattr(torch, dtype)
        assert ours.dtype == dtype
        np.testing.assert_allclose(theirs.numpy(), ours, atol=32 * np.finfo(dtype).eps)


def test_torch_stays_on_the_device_and_differentiates():
    torch = pytest.importorskip("torch", reason="torch is optional: networks need it, the rest does not")
    # the meta device computes shapes only, and refuses to mix with tensors of another device
    for device in ["meta", "cuda"] if torch.cuda.is_available() else ["meta"]:
        p = torch.ones(4, 5, 3, device=device)
        m = conformal.multiply(conformal.motor(p, p), conformal.encode(p, p))
        assert conformal.frames(m).shape == (4, 5, 3, 3) and conformal.frames(m).device.type == device
        assert conformal.compact(conformal.reverse(m)).device.type == device
    n = torch.tensor([[0.0, -1.0, 0.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: conformal.encode(torch.ones_like(v), v), n)


def test_importing_does_not_import_torch():
    code = "import sys, neural_gash_addon.backend.conformal; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_wrong_input_is_refused():
    with pytest.raises(ValueError, match="must both be"):
        conformal.motor(np.zeros((4, 3)), np.zeros((5, 3)))
    with pytest.raises(ValueError, match="must both be"):
        conformal.encode(np.zeros((4, 2)), np.zeros((4, 2)))
    with pytest.raises(TypeError, match="not list"):
        conformal.motor([0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    assert conformal.motor(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0, 32)


def test_hemisphere_directions_are_cosine_weighted():
    d = conformal.hemisphere_directions()
    assert d.shape == (25, 3) and d[:, 1].min() > 0.14
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1)
    # moments of the density cos/pi: mean (0, 2/3, 0), second moments 1/4, 1/2, 1/4
    np.testing.assert_allclose(d.mean(0), [0, 2 / 3, 0], atol=0.02)
    np.testing.assert_allclose(d.T @ d / 25, np.diag([0.25, 0.5, 0.25]), atol=0.02)
    nearest = np.sort(d @ d.T, axis=1)[:, -2]
    assert np.degrees(np.arccos(nearest)).min() > 15
