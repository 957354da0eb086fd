# SPDX-License-Identifier: GPL-3.0-or-later
"""The light of a scene as SH coefficients: its World and its sun lamps, or an image file."""
from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler
from numpy.typing import NDArray

from ..backend import light as sh_light
from ..backend import spherical_harmonics as sh
from ..backend.errors import UserError
from .evaluation import shown_objects

Array = NDArray[np.float64]

_BRIGHTEST = 1e24  # beyond, products with the strength leave float32, as which shaders have them
_projected: dict[tuple, Array] = {}  # of the World's image as last read, by what tells it from others


def world_light(scene: bpy.types.Scene, order: int, depsgraph: bpy.types.Depsgraph | None = None) -> Array:
    """Light (K, 3) from the World and the visible sun lamps of a scene, in world axes.

    The World is an equirectangular environment texture with its mapping's rotation and the
    background's strength, or a plain colour; without a World there is none of it.

    Args:
        depsgraph: of the scene, evaluated, where a handler has one; else the view layer's, brought up to date.
    Raises:
        UserError: the World is made of something else, or its image cannot be read.
    """
    depsgraph = depsgraph or current_depsgraph(scene)
    total = _background(scene.world and scene.world.evaluated_get(depsgraph), order)
    return checked(total + suns_light(depsgraph, order))


def current_depsgraph(scene: bpy.types.Scene) -> bpy.types.Depsgraph:
    """The dependency graph of the view layer that is looked at, brought up to date."""
    layer = bpy.context.view_layer if bpy.context.scene == scene else scene.view_layers[0]
    layer.update()
    return layer.depsgraph


def suns_light(depsgraph: bpy.types.Depsgraph, order: int) -> Array:
    """Light (K, 3) of the visible sun lamps alone."""
    total = sh_light.constant(np.zeros(3), order)
    for direction, irradiance in _suns(depsgraph):
        total += sh_light.sun(direction, irradiance, order)
    return total


def checked(light: Array) -> Array:
    """The light. Raises UserError where it is infinite or not a number."""
    if not np.abs(light).max() < _BRIGHTEST:  # also where it is not a number
        raise UserError("The World or a sun lamp has a strength or colour that is infinite or not a number.")
    return light


def file_light(path: Path, order: int) -> Array:
    """Light (K, 3) of an equirectangular image file. Raises UserError where it cannot be read."""
    if not path.is_file():
        raise UserError(f"There is no HDRI file '{path}'.")
    try:
        image = bpy.data.images.load(str(path.absolute()))
    except RuntimeError as error:
        reason = str(error).strip().removeprefix("Error: ").rstrip(".")
        raise UserError(f"The HDRI '{path}' cannot be read: {reason}.") from error
    try:
        return sh_light.project_equirect(linear_pixels(image), order)
    finally:
        bpy.data.images.remove(image)


def rotated_light(light: NDArray, rotation: float, strength: float = 1.0) -> Array:
    """The light (K, 3) turned about +Z by `rotation` radians, counter-clockwise from above, and scaled."""
    cosine, sine = math.cos(rotation), math.sin(rotation)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    return strength * sh.rotate(light, turn)


def _background(world: bpy.types.World | None, order: int) -> Array:
    """Light (K, 3) of a World."""
    if world is None:
        return sh_light.constant(np.zeros(3), order)
    if not (bpy.app.version >= (5, 0, 0) or world.use_nodes) or world.node_tree is None:
        return sh_light.constant(np.array(world.color), order)
    output = next((o for o in map(world.node_tree.get_output_node, ("ALL", "CYCLES", "EEVEE")) if o), None)
    node = _source(output.inputs["Surface"]) if output else None
    if node is None:
        return sh_light.constant(np.zeros(3), order)
    if node.type != "BACKGROUND":
        raise UserError(f"The World '{world.name}' ends in a '{node.bl_label}' node; "
                        "a single Background node can be read as light.")
    if node.inputs["Strength"].is_linked:
        raise UserError(f"The Background strength of the World '{world.name}' comes from other nodes; "
                        "set it to a number to read it as light.")
    strength = node.inputs["Strength"].default_value
    colour = _source(node.inputs["Color"])
    if colour is None:
        return sh_light.constant(strength * np.array(node.inputs["Color"].default_value[:3]), order)
    if colour.type == "RGB":
        return sh_light.constant(strength * np.array(colour.outputs[0].default_value[:3]), order)
    if colour.type != "TEX_ENVIRONMENT":
        raise UserError(f"The colour of the World '{world.name}' comes from a '{colour.bl_label}' node; "
                        "an Environment Texture or a plain colour can be read as light.")
    if colour.projection != "EQUIRECTANGULAR":
        raise UserError(f"The Environment Texture of the World '{world.name}' is a mirror ball; "
                        "only equirectangular images can be read as light.")
    rotation = _mapping(world.name, colour)
    if colour.image is None:
        raise UserError(f"The Environment Texture of the World '{world.name}' has no image.")
    try:
        light = _image_light(colour.image.original, order)
    except UserError as error:
        raise UserError(f"The World '{world.name}' cannot be read as light: {error}") from error
    return strength * sh.rotate(light, rotation)


def _image_light(image: bpy.types.Image, order: int) -> Array:
    """Light (K, 3) of an image as it lies. Kept, as reading one takes a tenth of a second or more."""
    key = (image.session_uid, order, image.filepath, image.source, tuple(image.size), image.alpha_mode,
           image.colorspace_settings.name)
    if key not in _projected:
        light = sh_light.project_equirect(linear_pixels(image), order)
        _projected.clear()
        _projected[key] = light
    return _projected[key]


def forget_image(image: bpy.types.Image | None = None) -> None:
    """Read an image anew when it is next wanted, as its pixels may have changed; None: whichever is kept."""
    if image is None or any(key[0] == image.session_uid for key in _projected):
        _projected.clear()


def _source(socket: bpy.types.NodeSocket) -> bpy.types.Node | None:
    """The node of `feeding`."""
    output = feeding(socket)
    return output.node if output else None


def feeding(socket: bpy.types.NodeSocket) -> bpy.types.NodeSocket | None:
    """The output that feeds an input, through reroutes and muted nodes' passes; None where nothing does."""
    while socket.is_linked:
        link = socket.links[0]
        node = link.from_node
        if link.is_muted:
            return None
        if node.type == "REROUTE":
            socket = node.inputs[0]
        elif node.mute:
            passes = [p.from_socket for p in node.internal_links if p.to_socket == link.from_socket]
            if not passes:
                return None
            socket = passes[0]
        else:
            return link.from_socket
    return None


def _mapping(world: str, texture: bpy.types.Node) -> Array:
    """Rotation (3, 3) that takes the image's light to the world's: inverse of the lookup's.

    Blender looks the image up at A d for a direction d, with A the mapping's rotation (inverted for
    the type Texture).
    """
    node = _source(texture.inputs["Vector"])
    if node is None or _is_direction(node, texture.inputs["Vector"]):
        return np.eye(3)
    if node.type != "MAPPING" or not _is_direction(_source(node.inputs["Vector"]), node.inputs["Vector"]):
        raise UserError(f"The Environment Texture of the World '{world}' is not mapped by Generated "
                        "coordinates through at most a Mapping node, so its light cannot be read.")
    if any(node.inputs[name].is_linked for name in ("Location", "Rotation", "Scale") if name in node.inputs):
        raise UserError(f"The Mapping of the World '{world}' comes from other nodes; "
                        "set its rotation to numbers to read it as light.")
    scale = np.array(node.inputs["Scale"].default_value)
    uneven = np.ptp(scale) > 1e-6 * np.abs(scale).max() or scale[0] <= 0
    moved = node.vector_type in ("POINT", "TEXTURE") and any(node.inputs["Location"].default_value)
    if uneven or moved:
        raise UserError(f"The Mapping of the World '{world}' moves or unevenly scales its image; "
                        "only its rotation can be read as light.")
    matrix = np.array(Euler(node.inputs["Rotation"].default_value).to_matrix(), dtype=np.float64)
    lookup = matrix.T if node.vector_type == "TEXTURE" else matrix
    left, _, right = np.linalg.svd(lookup.T)  # float32 rounding off
    return left @ right


def _is_direction(node: bpy.types.Node | None, socket: bpy.types.NodeSocket) -> bool:
    """Whether `node` feeds `socket` the direction that is looked at."""
    while node is not None and socket.links[0].from_node != node:  # past reroutes
        socket = socket.links[0].from_node.inputs[0]
    return node is not None and node.type == "TEX_COORD" and socket.links[0].from_socket.name == "Generated"


def linear_pixels(image: bpy.types.Image) -> NDArray[np.float32]:
    """(H, W, C) scene-linear pixels of an image, row 0 at the bottom.

    Raises:
        UserError: it is no single image, cannot be loaded, or is in a colour space that is not read.
    """
    if image.source not in ("FILE", "GENERATED"):
        raise UserError(f"The image '{image.name}' is a {image.source.lower()}; "
                        "only single images can be read as light.")
    width, height = image.size  # loads the file where it is not yet
    if not image.pixels or not width or not height:
        raise UserError(f"The image '{image.name}' cannot be loaded from '{bpy.path.abspath(image.filepath)}'.")
    pixels = np.empty((height, width, image.channels), np.float32)
    image.pixels.foreach_get(pixels.ravel())
    space = image.colorspace_settings
    if image.channels == 4 and not image.is_float and image.alpha_mode == "STRAIGHT" and not space.is_data:
        pixels[..., :3] *= pixels[..., 3:]  # before decoding, as Cycles does
    if image.channels < 3:  # grey, with or without alpha
        pixels = np.repeat(pixels[..., :1], 3, axis=2)
    if image.is_float or space.is_data or space.name in ("Linear", "Linear Rec.709"):
        return pixels  # float images come in scene-linear, whatever they were stored in
    if space.name != "sRGB":
        raise UserError(f"The image '{image.name}' is in the colour space "
                        f"'{space.name}'; sRGB, linear and float images can be read as light.")
    return np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4)


def _suns(depsgraph: bpy.types.Depsgraph) -> list[tuple[Array, Array]]:
    """(direction to it (3,), irradiance (3,) W/m^2 on a facing plane) of each visible sun lamp."""
    suns: list[tuple[Array, Array]] = []
    if not any(lamp.type == "SUN" for lamp in bpy.data.lights):
        return suns  # a scene may have very many instances
    shown = shown_objects(depsgraph)
    for instance in depsgraph.object_instances:
        lamp = instance.object
        if lamp.type != "LIGHT" or lamp.data.type != "SUN":
            continue
        owner = (instance.parent if instance.is_instance else lamp).original
        if owner.session_uid not in shown or lamp.hide_render or not instance.show_self:
            continue
        direction = np.array(instance.matrix_world, dtype=np.float64)[:3, 2]
        length = np.linalg.norm(direction)
        if np.isfinite(length) and length > 0:
            suns.append((direction / length, _irradiance(lamp.data)))
    return suns


def _irradiance(sun: bpy.types.SunLight) -> Array:
    """Irradiance (3,) of a sun lamp on a plane that faces it; its nodes, if any, are not read."""
    irradiance = lamp_energy(sun)
    if not getattr(sun, "normalize", True):                # then the energy is a radiance
        irradiance *= math.pi * math.sin(sun.angle / 2) ** 2
    return irradiance


def lamp_energy(lamp: bpy.types.Light) -> Array:
    """Colour times strength (3,) of a lamp, in the unit that its type has it in."""
    energy = np.array(lamp.color, dtype=np.float64) * lamp.energy
    energy *= 2.0 ** getattr(lamp, "exposure", 0.0)     # from 4.5 on
    if getattr(lamp, "use_temperature", False):         # from 4.5 on
        energy *= np.array(lamp.temperature_color, dtype=np.float64)
    return energy
