# SPDX-License-Identifier: GPL-3.0-or-later
"""Made things: primitives, booleans, remeshes, hinged instruments, gears, vessels, springs.

Each function is a category of `meshes`: (rng, target number of vertices) -> mesh. They give shapes in
a coarse mesh where that is exact; the caller refines it to the target.
"""
from __future__ import annotations

import numpy as np

from . import blender
from .solids import (
    Mesh,
    about,
    ball,
    box,
    cylinder,
    merge,
    mirrored,
    noise,
    outward,
    place,
    prism,
    ripples,
    swept,
    to_size,
    torus,
    turned,
    volume,
)

Rng = np.random.Generator


def any_primitive(rng: Rng, size: float = 1.0) -> Mesh:
    """One of Blender's primitives in random proportions, about `size` large, about the origin."""
    kind = rng.choice(["cube", "uvsphere", "icosphere", "cylinder", "cone", "torus", "tube"])
    sections = int(rng.integers(6, 40))
    if kind == "cube":
        shape = blender.primitive("cube", size=1.2)
    elif kind == "uvsphere":
        # by hand: the order of Blender's vertices changes from process to process
        latitude = np.linspace(-np.pi / 2, np.pi / 2, max(sections // 2, 8) + 1)
        profile = 0.7 * np.stack([np.cos(latitude), np.sin(latitude)], 1)
        shape = turned(profile, max(sections, 12))
    elif kind == "icosphere":
        shape = blender.primitive("icosphere", subdivisions=int(rng.integers(1, 5)), radius=0.7)
    elif kind == "torus":
        shape = torus(0.6, rng.uniform(0.1, 0.4), max(sections, 16), int(rng.integers(8, 24)))
    elif kind == "tube":
        inner = rng.uniform(0.3, 0.6)
        shape = turned([(inner, -0.6), (0.7, -0.6), (0.7, 0.6), (inner, 0.6)], max(sections, 12), ring=True)
    else:
        shape = blender.primitive("cone", cap_ends=True, segments=sections, radius1=0.7, depth=1.2,
                                  radius2=0.7 if kind == "cylinder" else rng.uniform(0, 0.35))
    return place(outward(shape), scale=size * np.exp(rng.uniform(-0.45, 0.45, 3)))


def anywhere(rng: Rng, mesh: Mesh, spread: float) -> Mesh:
    """Turned at random and moved by up to `spread`."""
    turn = about("z", rng.uniform(0, 2 * np.pi)) * about("x", rng.uniform(0, np.pi)) * about("y", rng.uniform(0, np.pi))
    return place(mesh, rng.uniform(-spread, spread, 3), turn)


def primitive(rng: Rng, target: int) -> Mesh:
    """One primitive, tapered, twisted and bent; often with a second one or on a ground."""
    p, t = to_size(any_primitive(rng), target * 2 // 3)
    z = p[:, 2]
    taper, twist, bend = 1 + rng.uniform(-0.5, 0.5) * z, rng.uniform(-1.5, 1.5) * z, rng.uniform(-1, 1) * z
    c, s = np.cos(twist), np.sin(twist)
    x, y = taper * (c * p[:, 0] - s * p[:, 1]), taper * (s * p[:, 0] + c * p[:, 1])
    bent = np.stack([x + 0.5 * bend * z, y, z], 1)
    parts: list[Mesh] = [(bent, t)]
    if rng.random() < 0.5:
        parts.append(anywhere(rng, any_primitive(rng, rng.uniform(0.3, 0.8)), 0.9))
    if rng.random() < 0.6:
        parts.append(box((3, 3, 0.1), (0, 0, bent[:, 2].min() - 0.05 - rng.choice([0.0, 0.01, 0.2]))))
    return merge(parts)


def suzanne(rng: Rng, target: int) -> Mesh:
    """Blender's monkey, stretched and gently pushed about; sometimes with others or in a box."""
    p, t = blender.suzanne(0 if target < 1200 else 1 if target < 5000 else 2)
    field = ripples(rng, rng.uniform(0.8, 2.0))
    p = (p + rng.uniform(0, 0.12) * np.stack([noise(p, field), noise(p + 7, field), noise(p - 9, field)], 1))
    heads: list[Mesh] = [(p * np.exp(rng.uniform(-0.3, 0.3, 3)), t)]
    if target < 9000 and rng.random() < 0.3:
        heads.append(place(blender.suzanne(0), (rng.uniform(1.3, 2), rng.uniform(-0.5, 0.5), 0),
                           about("z", rng.uniform(0, 6.3)), rng.uniform(0.4, 0.9)))
    if rng.random() < 0.3:
        heads.append(box((4, 4, 0.1), (0, 0, -1.4)))
    return merge(heads)


def booleans(rng: Rng, target: int) -> Mesh:
    """Two to five primitives added, cut and intersected by the exact solver."""
    shape = place(any_primitive(rng, 1.4), turn=about("x", rng.uniform(0, 3)))
    for k in range(int(rng.integers(1, 5))):
        other = anywhere(rng, any_primitive(rng, rng.uniform(0.4, 1.1)), 0.6)
        operation = rng.choice([blender.DIFFERENCE, blender.DIFFERENCE, blender.UNION, blender.INTERSECT],
                               p=None if k else [0.5, 0.3, 0.2, 0.0])
        result = blender.boolean(shape, other, str(operation))
        if len(result[0]) > 30 and volume(result) > 0.1 * abs(volume(shape)):  # else little would be left
            shape = result
    return shape


def remesh(rng: Rng, target: int) -> Mesh:
    """A heap of primitives, or Suzanne with something in her, as one voxel-remeshed skin."""
    parts = [anywhere(rng, any_primitive(rng, rng.uniform(0.4, 1.1)), 0.7) for _ in range(int(rng.integers(2, 8)))]
    if rng.random() < 0.3:
        parts = [blender.suzanne(1), *parts[:2]]
    whole = merge(parts)
    size = float(np.ptp(whole[0], axis=0).max())
    trial = blender.voxel_remesh(whole, size / 30)
    return blender.voxel_remesh(whole, size / 30 * float(np.sqrt(len(trial[0]) / target)))


# --- instruments: two halves on a hinge, apart or touching ---

def _half(rng: Rng, jaw: tuple[float, float, float], shank: float, ring: float, curve: float) -> Mesh:
    """Half of scissors or pliers, hinged at the origin: the jaw along +y, the handle along -y.

    jaw: length, half width, half thickness. shank: length of the handle. ring: radius of the finger's
    loop, 0 for a plain grip. curve: how far the jaw bends upward.
    """
    length, width, thick = jaw
    s = np.linspace(0, 1, 24)
    spine = np.stack([0.25 * width * np.sin(np.pi * s), length * s, curve * s**2], 1)
    radii = np.stack([thick * (1 - 0.6 * s), np.maximum(width * (1 - s**1.5), 0.12 * width)], 1)
    blade = swept(spine, radii, 12, power=rng.uniform(2, 8), side=(1, 0, 0))
    h = np.linspace(0, 1, 28)
    out = shank * rng.uniform(0.12, 0.3)
    grip = np.stack([-out * np.sin(h * np.pi / 2) ** 2, -shank * h, 0 * h], 1)
    thickness = np.stack([thick * (1 - 0.2 * h), width * (0.9 - 0.35 * h) + (0.25 * width * np.sin(np.pi * h) ** 2
                                                                              if not ring else 0)], 1)
    parts = [blade, swept(grip, thickness, 12, power=rng.uniform(2, 5), side=(1, 0, 0))]
    if ring:
        loop = torus(ring, rng.uniform(0.16, 0.26) * ring, 32, 12)
        parts.append(place(loop, grip[-1] + [-0.3 * ring, -ring, 0], scale=(1, rng.uniform(1, 1.4), 1)))
    return merge(parts)


def _hinged(rng: Rng, half: Mesh, angle: float, lift: float, pin: float, height: float) -> Mesh:
    """A half and its mirror image, opened by `angle` and `lift` apart, and the pin through both."""
    parts = [place(half, (0, 0, lift / 2), about("z", -angle / 2)),
             place(mirrored(half), (0, 0, -lift / 2), about("z", angle / 2))]
    if rng.random() < 0.8:
        parts.append(place(cylinder(pin, height, 20), (0, 0, -height / 2)))
    return merge(parts)


def scissors(rng: Rng, target: int) -> Mesh:
    """Two thin blades, finger rings, open by up to 60 degrees."""
    thick = rng.uniform(0.03, 0.07)
    half = _half(rng, (rng.uniform(0.7, 2.0), rng.uniform(0.09, 0.16), thick), rng.uniform(0.9, 2.0),
                 rng.uniform(0.22, 0.34), rng.uniform(0, 0.4) * (rng.random() < 0.5))
    return _hinged(rng, half, rng.uniform(0.05, 1.0), 2.02 * thick, 0.07, 5 * thick)


def pliers(rng: Rng, target: int) -> Mesh:
    """Short thick jaws, grips that bulge, open by up to 40 degrees."""
    thick = rng.uniform(0.08, 0.16)
    half = _half(rng, (rng.uniform(0.4, 0.9), rng.uniform(0.13, 0.22), thick), rng.uniform(1.2, 1.8),
                 0.0, rng.uniform(0, 0.3) * (rng.random() < 0.3))
    return _hinged(rng, half, rng.uniform(0.05, 0.7), rng.uniform(0.3, 1.0) * thick, 0.12, 3 * thick)


def forceps(rng: Rng, target: int) -> Mesh:
    """Two springy arms joined at the back; tips straight, bent or ribbed, from touching to wide open."""
    s = np.linspace(0, 1, 70)
    gap, width, length = rng.uniform(0.05, 0.5), rng.uniform(0.05, 0.12), 3.0
    bow = rng.uniform(0.0, 0.25)
    bend = rng.uniform(0, 0.6) * (rng.random() < 0.4)
    x = 0.03 + gap * s + bow * np.sin(np.pi * s) * (1 - s)
    spine = np.stack([x, length * s, bend * np.maximum(s - 0.7, 0) ** 2 * 8], 1)
    ribs = rng.uniform(0, 0.25) * (np.abs(s - rng.uniform(0.4, 0.6)) < 0.14) * np.sin(110 * s)
    radii = np.stack([width * (1 - 0.8 * s**2) + 0.02, rng.uniform(0.02, 0.05) * (1 + ribs) * (1.2 - 0.6 * s)], 1)
    arm = swept(spine, radii, 14, power=rng.uniform(2, 6), side=(1, 0, 0))
    parts = [arm, mirrored(arm), box((0.16, 0.3, 2.2 * width), (0, -0.05, 0))]
    if rng.random() < 0.3:  # a cable, as of bipolar ones
        t = np.linspace(0, 1, 30)
        cable = np.stack([rng.uniform(-0.5, 0.5) * t**2, -0.15 - t, rng.uniform(-0.4, 0.4) * t**2], 1)
        parts.append(swept(cable, 0.05, 12))
    return merge(parts)


def gear(rng: Rng, target: int) -> Mesh:
    """Cogwheels, some with a hub and holes."""
    wheels = []
    for k in range(int(rng.integers(1, 4))):
        teeth = int(rng.integers(8, 32))
        a = np.linspace(0, 2 * np.pi, teeth * 8, endpoint=False)
        depth = rng.uniform(0.08, 0.25)
        r = 1 + depth * np.clip(2.5 * np.sin(a * teeth), -1, 1)
        height = rng.uniform(0.15, 0.6)
        wheel = prism(np.stack([r * np.cos(a), r * np.sin(a)], 1), height)
        holes = int(rng.integers(0, 6))
        for b in 2 * np.pi * np.arange(holes) / max(holes, 1):
            drill = place(cylinder(rng.uniform(0.1, 0.2), 2, 18), (0.5 * np.cos(b), 0.5 * np.sin(b), -1))
            wheel = blender.boolean(wheel, drill, blender.DIFFERENCE)
        parts = [wheel, place(cylinder(rng.uniform(0.12, 0.25), height + rng.uniform(0.1, 0.6), 24), (0, 0, -0.05))]
        wheels.append(place(merge(parts), (2.05 * k, 0, rng.uniform(-0.1, 0.1)), about("z", rng.uniform(0, 1))))
    return merge(wheels)


def vessel(rng: Rng, target: int) -> Mesh:
    """Bowls, vases and cups with a wall; a few with a handle, or something inside."""
    s = np.linspace(0, 1, 40)
    radius = 0.35 + rng.uniform(0, 0.9) * s + rng.uniform(-0.3, 0.5) * np.sin(np.pi * s * rng.uniform(0.7, 2))
    radius = np.maximum(radius, 0.15) * np.minimum(1, 0.3 + 6 * s)
    height, wall = rng.uniform(0.4, 2.5), rng.uniform(0.03, 0.12)
    outer = np.stack([radius, height * s], 1)
    along = np.gradient(outer, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    inner = (outer + wall * np.stack([-along[:, 1], along[:, 0]], 1))[::-1]
    inner[:, 0] = np.maximum(inner[:, 0], 0.02)
    outline = np.concatenate([[(0, 0)], outer, inner, [(0, wall)]])
    flutes = int(rng.integers(3, 12)) if rng.random() < 0.4 else 0
    p, t = turned(outline, int(rng.integers(24, 64)))
    swell = 1 + rng.uniform(0.03, 0.15) * np.cos(flutes * np.arctan2(p[:, 1], p[:, 0])) * bool(flutes)
    parts: list[Mesh] = [(p * np.stack([swell, swell, np.ones_like(swell)], 1), t)]
    if rng.random() < 0.4:
        parts.append(place(torus(0.25 * height, 0.06, 32, 12), (radius[20], 0, height / 2), about("x", np.pi / 2)))
    for _ in range(int(rng.integers(0, 5))):
        parts.append(place(ball(0.12 + 0.1 * rng.random(), 2), (*rng.uniform(-0.25, 0.25, 2), rng.uniform(0.2, 0.5))))
    return merge(parts)


def spring(rng: Rng, target: int) -> Mesh:
    """A coil, with or without a rod through it."""
    turns, radius = rng.integers(3, 10), rng.uniform(0.06, 0.2)
    pitch = 2 * radius * rng.uniform(1.1, 3)
    t = np.linspace(0, 2 * np.pi * turns, int(turns) * 28)
    wide = 1 + rng.uniform(-0.5, 0.5) * t / t[-1]
    coil = swept(np.stack([wide * np.cos(t), wide * np.sin(t), pitch * t / (2 * np.pi)], 1), radius, 12)
    rod = place(cylinder(rng.uniform(0.1, 0.35), turns * pitch + 1, 24), (0, 0, -0.5))
    return merge([coil, rod] if rng.random() < 0.6 else [coil])
