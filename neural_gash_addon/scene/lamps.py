# SPDX-License-Identifier: GPL-3.0-or-later
"""A Blender scene as what reflects and emits in it: meshes, emissive materials, area and point lamps."""
from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import bmesh
import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import UserError
from ..backend.lit_scene import LitScene
from ..backend.pictures import Picture
from .albedo import Finish, Images, by_material, socket_pictures, triangle_finish
from .emission import emits_alone, emitters, number, plain, radiance
from .evaluation import evaluated, shown_objects
from .frames import Array, as_array
from .mesh_arrays import outward, to_world
from .shaders import surface_socket
from .solids import instances, solid_arrays
from .world import lamp_energy

_SIDES = 64    # of the polygon that a round lamp is
_LEAST = 1e-4  # radius of a point lamp, as a part of the scene's extent: any light comes from somewhere
_SAME = 1e-5   # places are compared to this part of the scene's extent, and numbers of finish and emission
_QUAD = np.array([(-0.5, -0.5, 0), (-0.5, 0.5, 0), (0.5, 0.5, 0), (0.5, -0.5, 0)])  # counter-clockwise from below


@dataclass(frozen=True, eq=False)
class _Part:
    """A mesh or a lamp, in world axes."""

    positions: Array               # (V, 3)
    triangles: NDArray[np.int32]   # (F, 3) from their front
    albedo: Array                  # (F, 3)
    emission: Array                # (F, 3) radiance
    pictures: Sequence[Picture] = ()


class LitScenes:
    """`read_lamps` of several objects as they stand now, read once for all that are shown."""

    def __init__(self, depsgraph: bpy.types.Depsgraph) -> None:
        self._depsgraph = depsgraph
        self._known: dict[int, tuple[LitScene, str, str]] = {}  # session uid of an object that is hidden, 0: all others

    def of(self, obj: bpy.types.Object) -> tuple[LitScene, str, str]:
        """As `read_lamps`."""
        uid = 0 if _is_shown(obj, self._depsgraph) else obj.session_uid
        if uid not in self._known:
            self._known[uid] = read_lamps(obj, self._depsgraph)
        return self._known[uid]


def _is_shown(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bool:
    """Whether `instances` lists an object."""
    return obj.session_uid in shown_objects(depsgraph)


def read_lamps(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> tuple[LitScene, str, str]:
    """All that lights an object, itself included: what the viewport shows and a render would, in world axes.

    Emissive meshes emit on both sides, area lamps on their front, point lamps from a sphere of their radius; lamps have
    no body. Their units are Cycles', whatever the scene's unit scale is: strengths are of Blender's own units.

    Returns:
        The scene, a text that tells it from others, and what is left out, in a sentence ('' where nothing is).
    Raises:
        UserError: a lamp or a material has a strength, colour or place that nothing can be computed from.
    """
    images: Images = {}
    unread: dict[str, None] = {}

    def finishing(solid: bpy.types.Object, mesh: bpy.types.Mesh, corners: NDArray[np.int32]) -> Finish:
        finish, pictures = triangle_finish(solid, mesh, corners, images)
        emission, alone, names = _emission(solid, mesh, corners, images)
        unread.update(dict.fromkeys(names))
        finish[alone, :3] = 0
        return np.concatenate([finish, emission], axis=1), pictures

    solids = list(instances(depsgraph, finishing=finishing))
    if not _is_shown(obj, depsgraph):
        with evaluated(obj, depsgraph) as copy:
            own = solid_arrays(copy, finishing)
            if own is not None:
                solids.append((*own, as_array(copy.matrix_world)))
    meshes = [_Part(to_world(local, matrix), outward(triangles, matrix), np.clip(finish[:, :3], 0, 1), finish[:, 7:],
                    [replace(picture, uv=outward(picture.uv, matrix)) for picture in pictures])
              for local, triangles, (finish, pictures), matrix in solids]
    if not meshes:
        raise UserError(f"'{obj.name}' has no faces, so there is nothing to light.")
    extent = float(np.ptp(np.concatenate([part.positions for part in meshes]), axis=0).max()) or 1.0
    lamps, notice = _lamps(depsgraph, _LEAST * extent)
    if unread:
        notice.append(f"Nodes make the emission of '{next(iter(unread))}', which counts as the value of the socket "
                      "that they feed.")
    return _joined(meshes, lamps), _key([*meshes, *lamps], _SAME * extent), " ".join(notice)


def _emission(obj: bpy.types.Object, mesh: bpy.types.Mesh, corners: NDArray[np.int32], known: Images
              ) -> tuple[NDArray[np.float64], NDArray[np.bool_], list[str]]:
    """Radiance (F, 3) of the triangles with these face corners (F, 3), of images their mean over each.

    Args:
        obj, mesh, corners, known: as `albedo.triangle_finish`.
    Returns:
        It; which of them (F,) only emit, and reflect nothing; and the materials whose emission other nodes make, which
        counts as the value of the socket that they feed.
    """
    out, alone, unread = np.zeros((len(corners), 3)), np.zeros(len(corners), bool), []
    for material, here in by_material(obj, mesh):
        found = emitters(surface_socket(material))
        for colour, strength, part in found:
            channels = np.arange(3)
            pictures = socket_pictures(colour, mesh, corners[here], known, channels, channels, np.ones(3), np.zeros(3))
            shown = _means(pictures[0]) if pictures else number(colour)
            out[here] += part * number(strength)[0] * shown
            if material is not None and not (plain(strength) and (pictures or plain(colour))):
                unread.append(material.name)
        alone[here] = emits_alone(material)
    return out, alone, unread


def _means(picture: Picture) -> Array:
    """(f, 3) of an image over each of its triangles, also where it is brighter than 1, which no albedo is."""
    brightest = max(1.0, float(picture.pixels.max()))
    return brightest * replace(picture, gain=picture.gain / brightest).lookups().mean(1)


def _joined(meshes: list[_Part], lamps: list[_Part]) -> LitScene:
    """One scene of all, the lamps at its end."""
    parts = [*meshes, *lamps]
    sizes = [len(part.triangles) for part in parts]
    vertices, rows = (np.cumsum([0, *counts]) for counts in ([len(part.positions) for part in parts], sizes))
    bodiless = sum(sizes[len(meshes):])
    return LitScene(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.triangles + first for part, first in zip(parts, vertices, strict=False)]).astype(np.int32),
        np.concatenate([part.albedo for part in parts]), np.concatenate([part.emission for part in parts]),
        [replace(picture, triangles=row + picture.triangles) for part, row in zip(parts, rows, strict=False)
         for picture in part.pictures],
        np.arange(rows[-1]) >= rows[-1] - bodiless, bodiless)


def _key(parts: list[_Part], grain: float) -> str:
    """What tells a scene from others, in whatever order Blender lists it. grain: of its places, metres."""
    entries = []
    for part in parts:
        places = np.rint(part.positions / grain) + 0.0  # no -0
        digest = hashlib.blake2b(places.tobytes() + part.triangles.tobytes(), digest_size=16)
        for values in (part.albedo, part.emission, *(p.lookups()[..., p.columns < 3] for p in part.pictures)):
            size = float(np.abs(values).max(initial=0.0)) or 1.0
            digest.update(f"{size:.5g}".encode() + (np.rint(values / (_SAME * size)) + 0.0).tobytes())
        entries.append(digest.digest())
    return hashlib.blake2b(b"".join(sorted(entries)), digest_size=16).hexdigest()


def _lamps(depsgraph: bpy.types.Depsgraph, least: float) -> tuple[list[_Part], list[str]]:
    """The area and point lamps of a scene, and sentences on what is left out. least: radius of point lamps, metres."""
    parts: list[_Part] = []
    left, narrow = {"SPOT": 0, "SUN": 0}, False
    for lamp, matrix in _shown_lamps(depsgraph):
        data = lamp.data
        if data.type in left:
            left[data.type] += 1
            continue
        energy = _energy(lamp)
        if not np.isfinite(matrix).all():
            raise UserError(f"The lamp '{lamp.name}' has a location, rotation or scale that is infinite or not a "
                            "number.")
        if data.type == "AREA":
            narrow = narrow or data.spread < np.pi - 1e-3
            found = _area(data, matrix)
        else:
            found = _point(data, matrix, least)
        if found is None:
            continue
        positions, triangles, per_watt = found
        parts.append(_Part(positions, triangles, np.zeros((len(triangles), 3)),
                           np.tile(per_watt * energy, (len(triangles), 1))))
    notice = []
    if left["SPOT"]:
        notice.append(f"{left['SPOT']} spot lamp{'s are' if left['SPOT'] > 1 else ' is'} left out.")
    if left["SUN"]:
        notice.append("Sun lamps count as light of the sky, not as lamps.")
    if narrow:
        notice.append("Area lamps with a smaller spread shine as if they had one of 180 degrees.")
    return parts, notice


def _energy(lamp: bpy.types.Object) -> Array:
    """Watts (3,) of an evaluated lamp, with what its nodes emit, if it has any. UserError where they are no watts."""
    data = lamp.data
    energy = lamp_energy(data)
    if getattr(data, "use_nodes", False) and data.node_tree is not None:
        output = next((o for o in map(data.node_tree.get_output_node, ("ALL", "CYCLES", "EEVEE")) if o), None)
        energy = energy * radiance(emitters(output and output.inputs["Surface"]))
    if not (np.isfinite(energy).all() and energy.min() >= 0):
        raise UserError(f"The lamp '{lamp.name}' has a strength or colour that is negative, infinite or not a number.")
    return energy


def _shown_lamps(depsgraph: bpy.types.Depsgraph) -> Iterator[tuple[bpy.types.Object, Array]]:
    """The lamps and their instances that renders show, and that light diffuse surfaces; and their world matrices."""
    shown = shown_objects(depsgraph)
    for instance in depsgraph.object_instances:
        lamp = instance.object
        if lamp.type != "LIGHT" or not instance.show_self:
            continue
        owner = (instance.parent if instance.is_instance else lamp).original
        portal = getattr(getattr(lamp.data, "cycles", None), "is_portal", False) and lamp.data.type == "AREA"
        if owner.session_uid in shown and not lamp.hide_render and lamp.visible_diffuse and not portal:
            yield lamp, as_array(instance.matrix_world)


def _area(data: bpy.types.AreaLight, matrix: Array) -> tuple[Array, NDArray[np.int32], float] | None:
    """An area lamp that shines along its -Z, and its radiance for each watt; None where it is scaled to nothing."""
    sizes = np.array([data.size, data.size_y if data.shape in ("RECTANGLE", "ELLIPSE") else data.size, 1])
    local, area = _QUAD, 1.0
    if data.shape in ("DISK", "ELLIPSE"):
        angle, area = 2 * np.pi / _SIDES * np.arange(_SIDES), np.pi / 4
        radius = np.sqrt(area / (0.5 * _SIDES * np.sin(2 * np.pi / _SIDES)))  # of a polygon as large as the disk
        local = radius * np.stack([np.cos(angle), -np.sin(angle), 0 * angle], 1)
    index = np.arange(1, len(local) - 1)
    triangles = np.stack([0 * index, index, index + 1], 1).astype(np.int32)
    area *= float(np.linalg.norm(np.cross(matrix[:3, 0], matrix[:3, 1])) * sizes[0] * sizes[1])
    if not area > 0:
        return None
    positions = (local * sizes) @ matrix[:3, :3].T + matrix[:3, 3]
    # its watts are spread over its area as it stands scaled; or else over a square metre
    return positions, outward(triangles, matrix), 1 / (np.pi * (area if getattr(data, "normalize", True) else 1.0))


def _point(data: bpy.types.PointLight, matrix: Array, least: float) -> tuple[Array, NDArray[np.int32], float]:
    """A point lamp as a small sphere, and its radiance for each watt, so that it sends as much to all sides."""
    edit = bmesh.new()
    try:
        bmesh.ops.create_icosphere(edit, subdivisions=3, radius=max(data.shadow_soft_size, least))
        edit.verts.index_update()
        positions = np.array([vertex.co for vertex in edit.verts], np.float64)
        triangles = np.array([[vertex.index for vertex in face.verts] for face in edit.faces], np.int32)
    finally:
        edit.free()
    edges = positions[triangles[:, 1:]] - positions[triangles[:, :1]]
    area = 0.5 * float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum())
    watts = 1.0
    if not getattr(data, "normalize", True):  # then it is pi times the radiance; or the intensity, where it has no size
        watts = 4 * np.pi * data.shadow_soft_size ** 2 if data.shadow_soft_size > 0 else 4.0
    return positions + matrix[:3, 3], triangles, watts / (np.pi * area)
