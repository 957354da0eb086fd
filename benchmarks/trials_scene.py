# SPDX-License-Identifier: GPL-3.0-or-later
"""Trials of topology, light and time. Each gives the undisturbed cases and the disturbed ones."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from trial import (
    OPEN,
    ORDER,
    Arrays,
    Pairs,
    Scale,
    Undisturbed,
    Variant,
    against,
    box,
    each,
    flat,
    hosts,
    join,
    own,
    placed,
    rows_of,
    sequences,
    smooth,
    sphere,
    traced,
    turn,
)

from neural_gash_addon.backend import light
from neural_gash_addon.backend import spherical_harmonics as sh


def _jaws(degrees: float, pieces: int) -> Arrays:
    """Two plates that meet in an edge, so far open."""
    lower = box((1, 0.6, 0.08), pieces, (0.5, 0, -0.04))
    upper = box((1, 0.6, 0.08), pieces, (0.5, 0, 0.04))
    return join(lower, (upper[0] @ turn((0, 1, 0), -degrees).T, upper[1]))


def _pieces(scale: Scale) -> int:
    return max(3, round((scale.vertices / 12) ** 0.5))


def jaws(scale: Scale) -> Pairs:
    """Disjoint jaws closing on each other (figure 11 of the paper): what blocks is far along the surface, or not on it.

    Swept from open to shut.
    """
    def at(degrees: float) -> Variant:
        return own(f"{degrees:g}° open", flat(_jaws(degrees, _pieces(scale))), scale)

    return [([at(120)], [at(degrees) for degrees in (60, 30, 10, 3, 1, 0.1, 0)])]


def thin_plates(scale: Scale) -> Pairs:
    """Plates 1e-1 to 1e-5 of their size thick. They are convex: nothing may be shadowed, though the back is so near."""
    def at(thickness: float) -> Variant:
        mesh = flat(box((1, 1, thickness), _pieces(scale)))
        rows = rows_of(mesh, scale)
        return against(f"{thickness:g} thick", mesh, rows, sh.cosine_lobe(mesh.normals[rows], ORDER))

    return [([at(1.0)], [at(thickness) for thickness in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)])]


def holes(scale: Scale) -> Pairs:
    """A twentieth of the triangles gone, as in scans: light comes in, and points see the back of other faces."""
    def disturb(host: Undisturbed):
        kept = np.random.default_rng(5).random(len(host.geometry[1])) > 0.05
        yield own(f"{host.name}, with holes", smooth((host.geometry[0], host.geometry[1][kept])), scale)

    return each(scale, disturb)


def inside_out(scale: Scale) -> Pairs:
    """A second part whose faces are inside out: it blocks as before, and the first part must not notice."""
    def disturb(host: Undisturbed):
        other = host.geometry[0] * 0.5 + (0.8, 0, 0), host.geometry[1]
        right, wrong = (smooth(join(host.geometry, (other[0], faces))) for faces in (other[1], other[1][:, ::-1]))
        rows = rows_of(right, scale, among=len(host.geometry[0]))
        yield against(f"{host.name}, beside an inside-out part", wrong, rows, traced(right, rows))

    return each(scale, disturb)


def self_intersecting(scale: Scale) -> Pairs:
    """Two copies pushed through each other: kitbashed models are so, and some of their points are buried."""
    def disturb(host: Undisturbed):
        other = host.geometry[0] @ turn((0, 1, 0), 90).T + 0.01, host.geometry[1]
        yield own(f"{host.name}, twice", smooth(join(host.geometry, other)), scale)

    return each(scale, disturb)


def nested_shells(scale: Scale) -> Pairs:
    """The mesh in a closed ball: it is all dark, exactly, and the ball all in the open."""
    def disturb(host: Undisturbed):
        count = len(host.geometry[0])
        mesh = smooth(join(host.geometry, sphere(3, 1.5)))
        rows = np.concatenate([host.rows, np.arange(count, len(mesh.points), 8)])
        truth = sh.cosine_lobe(mesh.normals[rows], ORDER)
        truth[:len(host.rows)] = 0
        yield against(f"{host.name}, in a ball", mesh, rows, truth)

    return each(scale, disturb)


def duplicate_faces(scale: Scale) -> Pairs:
    """Every face twice: nothing changes, though each ray meets two."""
    return each(scale, lambda host: [
        host.same("faces twice", smooth((host.geometry[0], np.concatenate([host.geometry[1]] * 2))))])


def isolated_vertices(scale: Scale) -> Pairs:
    """Loose vertices far away: they have no faces, block nothing, and must not stretch what is measured by size."""
    def disturb(host: Undisturbed):
        loose = np.random.default_rng(6).normal(size=(50, 3)) * 100
        yield host.same("loose vertices", smooth((np.concatenate([host.geometry[0], loose]), host.geometry[1])))

    return each(scale, disturb)


def _lit(host: Undisturbed, label: str, lamp: NDArray) -> Variant:
    """Radiance under a light (K, 3), as a part of what the mesh would show without shadows, RMS."""
    whole = float(np.sqrt(np.square(sh.cosine_lobe(host.mesh.normals[host.rows], ORDER) @ lamp).sum(1).mean())) or 1.0

    def errors(found):
        return np.linalg.norm((found[0][host.rows] - host.truth) @ lamp, axis=1) / whole

    return Variant(f"{host.name}, {label}", [host.mesh], errors)


def _under(scale: Scale, lamps: dict[str, NDArray]) -> Pairs:
    """Each host under each light. Undisturbed is the error of transfer: what a light in all harmonics alike shows."""
    return each(scale, lambda host: [_lit(host, label, lamp) for label, lamp in lamps.items()])


def sun(scale: Scale) -> Pairs:
    """One bright sun: all of the light is in the highest bands, where errors and ringing are."""
    return _under(scale, {f"sun from {name}": light.sun(np.array(way) / np.linalg.norm(way), np.ones(3), ORDER)
                          for name, way in (("above", (0.2, 0, 1.0)), ("the side", (1.0, 0.3, 0.1)))})


def narrow_window(scale: Scale) -> Pairs:
    """Light from a window 10 degrees wide, low at one side of a dark room."""
    image = np.zeros((90, 180, 3))  # 2 degrees a texel, row 0 at the bottom
    image[50:55, 88:93] = 100.0
    return _under(scale, {"window": light.project_equirect(image, ORDER)})


def dark(scale: Scale) -> Pairs:
    """No light at all: no method may shine."""
    return _under(scale, {"dark": np.zeros((ORDER ** 2, 3))})


def constant(scale: Scale) -> Pairs:
    """A white sky everywhere: what is seen is ambient occlusion, one coefficient."""
    return _under(scale, {"constant": light.constant(np.ones(3), ORDER)})


def energy(scale: Scale) -> Pairs:
    """No point may show less than nothing of a white sky or more than all, nor be darker under a sun than it rings.

    The error is by how much it is, under the sun as a part of the brightest unshadowed point. Three bands cannot hold a
    sun: what they hold of it is less than nothing beside and behind it, and so is what points there show that are baked
    exactly. So a point may show as little as the darkest one does without shadows or in the reference; how little that
    is, is in the case's label.
    """
    lamp = light.sun(np.array([0.6, 0, 0.8]), np.ones(3), ORDER)

    def disturb(host: Undisturbed):
        open_sky = sh.cosine_lobe(host.mesh.normals[host.rows], ORDER)
        rings = min(float((open_sky @ lamp).min()), float((host.truth @ lamp).min()))
        whole = float((open_sky @ lamp).max())

        def white(found):
            share = found[0][host.rows, 0] / sh.normalisation(0, 0)
            return np.maximum(np.maximum(-share, share - 1), 0)

        def sunlit(found):
            return np.maximum(rings - (found[0][host.rows] @ lamp).min(1), 0) / whole

        yield Variant(f"{host.name}, white sky", [host.mesh], white)
        yield Variant(f"{host.name}, sun, as low as {rings / whole:.2%}", [host.mesh], sunlit)

    return each(scale, disturb)


def flicker(scale: Scale) -> Pairs:
    """Frames of a deforming mesh: what changes from one to the next beyond what truly does.

    Errors that stay where they are pass for the look of a surface; errors that come and go are seen as boiling, however
    small, and no frame by itself says which they are. The true change, RMS over points, is in the case's label: an
    error as large as that hides the motion of the shadows.

    The undisturbed case is the error of a frame by itself, so a method whose errors stay where they are has less than
    1, and one whose errors are new in each frame 1.4.
    """
    found: Pairs = []
    clips = [(path.stem.removeprefix("anim_"), np.load(path)) for path in sequences()]
    frames = [(name, clip["verts"], clip["faces"]) for name, clip in clips if scale.real]
    if not frames:  # a knot that sways
        positions, triangles = hosts(scale)[0][1]
        swaying = [positions + np.stack([0.1 * np.sin(n / 4) * positions[:, 2] ** 2, 0 * positions[:, 0],
                                         0 * positions[:, 0]], 1) for n in range(8)]
        frames = [("swaying knot", np.array(swaying), triangles)]
    for name, vertices, faces in frames:
        size = placed(vertices[0]), float(np.ptp(vertices[0], axis=0).max())
        starts = np.linspace(0, len(vertices) - 2, scale.pairs + 2).astype(int)[1:-1]
        for start in starts.tolist():
            pair = [smooth((vertices[frame] / size[1], faces)) for frame in (start, start + 1)]
            rows = rows_of(pair[0], scale)
            truths = [traced(mesh, rows) for mesh in pair]
            change = float(np.sqrt(np.square(truths[1] - truths[0]).sum(1).mean())) / OPEN

            def errors(baked, rows=rows, truths=truths):
                moved = baked[1][rows].astype(np.float64) - baked[0][rows] - (truths[1] - truths[0])
                return np.linalg.norm(moved, axis=1) / OPEN

            found.append(([against(f"{name} {start}", pair[0], rows, truths[0])],
                          [Variant(f"{name} {start} to {start + 1}, true change {change:.1%}", pair, errors)]))
    return found


TRIALS = {"topology": (jaws, thin_plates, holes, inside_out, self_intersecting, nested_shells, duplicate_faces,
                       isolated_vertices),
          "light": (sun, narrow_window, dark, constant, energy),
          "time": (flicker,)}
