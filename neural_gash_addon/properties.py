# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings that a person edits, on the scene: `scene.neural_gash`."""
from __future__ import annotations

import math
from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from .backend.atlas import MAX_SIDE, MIN_SIDE
from .backend.bounce import MAX_BOUNCES
from .backend.estimator import MAX_RAYS
from .backend.lobes import GGX, PHONG
from .backend.methods import METHODS, MIN_ORDER, MIN_TOLERANCE
from .backend.spherical_harmonics import MAX_ORDER
from .scene import live
from .scene.lighting import HDRI, SKY, SUNS, WORLD, apply_light, follow_light, show_gloss
from .scene.read import SELF, VISIBLE
from .scene.viewport import follow_viewport
from .scene.views import COEFFICIENT, LIT, OCCLUSION

RAYS, TOLERANCE, COLLECTION = "RAYS", "TOLERANCE", "COLLECTION"
AUTOMATIC, VERTICES, TEXTURE = "AUTOMATIC", "VERTICES", "TEXTURE"
CHEAPEST, PATHS, NETWORK = "CHEAPEST", "PATHS", "NETWORK"
RESOLUTION, DENSITY, FIT = "RESOLUTION", "DENSITY", "FIT"


def _light_changed(settings: NeuralGashSettings, _context: bpy.types.Context) -> None:
    """A light slider moved: only the light constants of the previews change."""
    apply_light(settings.id_data)


def _source_changed(settings: NeuralGashSettings, _context: bpy.types.Context) -> None:
    """Light from elsewhere: take it at once."""
    follow_light(settings.id_data)


def _file_changed(settings: NeuralGashSettings, _context: bpy.types.Context) -> None:
    """Another image file."""
    if settings.light_source == HDRI:
        follow_light(settings.id_data)


def _gloss_changed(settings: NeuralGashSettings, _context: bpy.types.Context) -> None:
    """Glossy previews instead of dull ones, or the other way round."""
    show_gloss(settings.id_data)


def _view_changed(settings: NeuralGashSettings, _context: bpy.types.Context) -> None:
    """The previews show something else: another light; glossy ones become dull, for what a bake holds is dull."""
    if settings.gloss:
        show_gloss(settings.id_data)
    else:
        apply_light(settings.id_data)


def _viewport_changed(settings: NeuralGashSettings, _context: bpy.types.Context) -> None:
    """The rotation is the viewport's from now on, or no longer."""
    if settings.with_viewport:
        follow_viewport(settings.id_data, anew=True)


def _live_changed(settings: NeuralGashSettings, _context: bpy.types.Context) -> None:
    """Live was switched, or its budget changed."""
    if settings.live:
        live.start(settings.id_data)
    else:
        live.forget()


class NeuralGashSettings(bpy.types.PropertyGroup):
    """Settings of the next bake, and the light of the previews."""

    method: EnumProperty(  # type: ignore[valid-type]
        name="Method", description="How the transfer is computed", default="auto",
        items=[(m.name, m.label, m.description) for m in METHODS.values()])
    order: IntProperty(  # type: ignore[valid-type]
        name="Order", default=3, min=MIN_ORDER, max=MAX_ORDER,
        description="Bands of spherical harmonics: more give crisper shadows and take more memory "
                    "(order n stores n x n numbers for each point). With Automatic and a tolerance it is the most: "
                    "bands that would not be seen are left out")
    quality: EnumProperty(  # type: ignore[valid-type]
        name="Quality", description="What decides how long to trace", default=TOLERANCE,
        items=[(TOLERANCE, "Tolerance", "Trace until the error is as small as asked for, and no longer"),
               (RAYS, "Rays", "Trace the same number of rays from every point")])
    tolerance: FloatProperty(  # type: ignore[valid-type]
        name="Tolerance", subtype="FACTOR", default=0.02, min=MIN_TOLERANCE, max=1.0, soft_min=0.002, soft_max=0.2,
        precision=4,
        description="Error to reach, as a part of the whole: 0.02 is 2 percent. Half of it takes about two and "
                    "a half times as long")
    rays: IntProperty(  # type: ignore[valid-type]
        name="Rays per Point", default=256, min=1, max=16 * MAX_RAYS, soft_max=MAX_RAYS,
        description="Rays to trace from every point")
    occluders: EnumProperty(  # type: ignore[valid-type]
        name="Occluders", description="What casts shadows on the object", default=SELF,
        items=[(SELF, "Itself", "The object shadows itself, and objects that are baked together shadow each other"),
               (VISIBLE, "Visible Objects", "Everything visible in the viewport and in renders casts shadows"),
               (COLLECTION, "Collection", "The objects of a collection cast shadows")])
    collection: PointerProperty(  # type: ignore[valid-type]
        name="Collection", description="Whose objects cast shadows", type=bpy.types.Collection)
    bounces: IntProperty(  # type: ignore[valid-type]
        name="Bounces", default=0, min=0, max=MAX_BOUNCES, soft_max=8,
        description="How often light may bounce from surface to surface, in their colours, at most: it stops by itself "
                    "where more would not be seen. 0: light comes from the sky alone")
    lamps: BoolProperty(  # type: ignore[valid-type]
        name="Lamps", default=False,
        description="Bake the light of lamps and of materials that emit, too, with what all surfaces reflect of it in "
                    "their colours. It is of everything that is visible, as it stands; spot lamps are left out")
    lamps_by: EnumProperty(  # type: ignore[valid-type]
        name="Lamps by", description="How the light of lamps is found", default=CHEAPEST,
        items=[(CHEAPEST, "Automatic", "The network where it keeps to the tolerance and paths would take much longer, "
                "else paths"),
               (PATHS, "Path Tracing", "Paths from every point, as many as the tolerance asks for"),
               (NETWORK, "Network (PyTorch)", "Direct light is traced; what surfaces reflect is traced at some "
                "thousand points, and a network says from them what it is anywhere. For rooms of up to 15 m")])
    target: EnumProperty(  # type: ignore[valid-type]
        name="Target", description="Where the bake is kept", default=VERTICES,
        items=[(AUTOMATIC, "Automatic", "Vertices; where the method is Automatic, too, and vertices would miss shadows "
                "inside faces by more than the tolerance, a texture as large as these need. Sequences, and all while "
                "Live is on, stay at the vertices"),
               (VERTICES, "Vertices", "Numbers at the vertices: quick, and enough for dense meshes"),
               (TEXTURE, "Texture", "Images with a UV map of their own: fine shadows on large faces, and normal maps")])
    sizing: EnumProperty(  # type: ignore[valid-type]
        name="Size", description="What decides the size of the texture", default=RESOLUTION,
        items=[(RESOLUTION, "Resolution", "A number of texels a side"),
               (DENSITY, "Density", "A number of texels a metre; the texture is as large as that takes"),
               (FIT, "Fit", "As large as the shadows on the object need for the tolerance; this is measured")])
    side: IntProperty(  # type: ignore[valid-type]
        name="Resolution", default=1024, min=MIN_SIDE, max=MAX_SIDE, subtype="PIXEL",
        description="Width and height of the texture in texels")
    texels_per_metre: FloatProperty(  # type: ignore[valid-type]
        name="Texels per Metre", default=100.0, min=0.001, soft_max=10000.0,
        description="Texels along a metre of the surface")
    padding: IntProperty(  # type: ignore[valid-type]
        name="Padding", default=2, min=1, max=64, subtype="PIXEL",
        description="Texels around each part of the UV map; more keeps them apart also from afar")
    uv_map: StringProperty(  # type: ignore[valid-type]
        name="UV Map", default="",
        description="A UV map of the mesh to bake to, in which no faces overlap; leave empty to have one made")
    share: BoolProperty(  # type: ignore[valid-type]
        name="Share One Texture", default=False,
        description="Objects that are baked together get one texture for all; else each gets its own")
    half: BoolProperty(  # type: ignore[valid-type]
        name="16 Bits", default=False,
        description="Store half as much for each texel, exact to a thousandth; 32 bits keep every digit")
    texture_folder: StringProperty(  # type: ignore[valid-type]
        name="Folder", default="", subtype="DIR_PATH", options={"PATH_SUPPORTS_BLEND_RELATIVE"},
        description="Where to write the textures as OpenEXR files; leave empty to pack them into the .blend file")
    light_source: EnumProperty(  # type: ignore[valid-type]
        name="From", description="Where the light of the previews is taken from", default=WORLD,
        update=_source_changed,
        items=[(WORLD, "World", "The World of the scene and its sun lamps; previews follow their changes"),
               (HDRI, "Image File", "An equirectangular image, and no lamps; the World of the scene stays as it is"),
               (SUNS, "Sun Lamps", "The sun lamps of the scene alone; previews follow their changes"),
               (SKY, "Sky Colour", "An even sky of one colour, also from below")])
    hdri: StringProperty(  # type: ignore[valid-type]
        name="File", default="", subtype="FILE_PATH", options={"PATH_SUPPORTS_BLEND_RELATIVE"}, update=_file_changed,
        description="Equirectangular image that lights the previews, as an .exr or .hdr")
    sky: FloatVectorProperty(  # type: ignore[valid-type]
        name="Colour", default=(1.0, 1.0, 1.0), size=3, subtype="COLOR", min=0.0, max=1e9, soft_max=1.0,
        update=_source_changed, description="Radiance of the even sky")
    light_rotation: FloatProperty(  # type: ignore[valid-type]
        name="Rotation", default=0.0, subtype="ANGLE", soft_min=-math.pi, soft_max=math.pi,
        description="Turn the light of the previews about the vertical axis", update=_light_changed)
    with_viewport: BoolProperty(  # type: ignore[valid-type]
        name="Turn with Viewport", default=False, update=_viewport_changed,
        description="Turn the light of the previews with the rotation of the HDRI in Material Preview, which is in the "
                    "viewport's shading options")
    light_strength: FloatProperty(  # type: ignore[valid-type]
        name="Strength", default=1.0, min=0.0, max=1e9, soft_max=10.0,
        description="Brighten or dim the light of the previews", update=_light_changed)
    lamps_strength: FloatProperty(  # type: ignore[valid-type]
        name="Lamps", default=1.0, min=0.0, max=1e9, soft_max=10.0, update=_light_changed,
        description="Brighten or dim the lamps that were baked, beside the other light; 0 switches them off")
    gloss: BoolProperty(  # type: ignore[valid-type]
        name="Glossy", default=False, update=_gloss_changed,
        description="Show what the materials mirror of the light, by their roughness, on objects baked to textures "
                    "without bounces")
    lobe: EnumProperty(  # type: ignore[valid-type]
        name="Lobe", description="How materials spread what they mirror, by their roughness", default=GGX,
        update=_gloss_changed,
        items=[(GGX, "GGX", "Microfacets: a bright middle and wide tails, as in Blender's own shaders"),
               (PHONG, "Phong", "A power of the cosine, (1/roughness^4 - 1)/2: as wide, without the tails")])
    view: EnumProperty(  # type: ignore[valid-type]
        name="View", description="What the previews show", default=LIT, update=_view_changed,
        items=[(LIT, "Lit", "The materials under the light, as they shall be seen"),
               (OCCLUSION, "Ambient Occlusion", "The bake under an even white sky, without the materials' colours: "
                                                "white is open to all of it, black to nothing"),
               (COEFFICIENT, "Coefficient", "One number of the bake, without the materials' colours: red where it is "
                                            "positive, blue where it is negative, black where it is zero")])
    coefficient: IntProperty(  # type: ignore[valid-type]
        name="Coefficient", default=0, min=0, max=MAX_ORDER ** 2 - 1, update=_view_changed,
        description="Which number of each point to show: l x (l + 1) + m of band l, counted from 0; 0 is the ambient "
                    "occlusion")
    live: BoolProperty(  # type: ignore[valid-type]
        name="Live", default=False, update=_live_changed,
        description="Bakes to vertices follow their objects while these are posed or animated; frames that are "
                    "rendered are baked as the settings have it")
    live_budget: FloatProperty(  # type: ignore[valid-type]
        name="Time", subtype="TIME_ABSOLUTE", default=0.033, min=0.001, max=10.0, soft_min=0.01, soft_max=0.2, step=0.1,
        update=_live_changed,
        description="Time that an update of a live bake may take: 33 ms is 30 frames a second. More gives better "
                    "shadows; what there is time for is measured when Live is switched on")
    sequence_folder: StringProperty(  # type: ignore[valid-type]
        name="Folder", default="", subtype="DIR_PATH", options={"PATH_SUPPORTS_BLEND_RELATIVE"},
        description="Where to write the bake of an animation, one file for each object; leave empty to write it beside "
                    "the .blend file")
    soften: BoolProperty(  # type: ignore[valid-type]
        name="Reduce Ringing", default=False, update=_light_changed,
        description="Damp the dark and bright rings that a small bright light leaves at low orders; "
                    "this also softens the light a little")

    def tracing(self) -> dict[str, Any]:
        """What the method wants to know of how long to trace: `rays`, `tolerance`, or nothing."""
        if not METHODS[self.method].traces:
            return {}
        return {"rays": self.rays} if self.quality == RAYS else {"tolerance": self.tolerance}

    def target_note(self) -> str:
        """Why the target Automatic means vertices, whatever the mesh; '' where it does not, or is not chosen."""
        if self.target != AUTOMATIC:
            return ""
        if not METHODS[self.method].plans:
            return "Vertices, as only the method Automatic chooses a target."
        if self.quality == RAYS:
            return "Vertices, as there is no tolerance to choose a target by."
        return "Vertices, as Live is on, and follows no textures." if self.live else ""

    def lobe_shown(self) -> str:
        """The lobe of glossy previews; '' where they are dull."""
        return self.lobe if self.gloss and self.view == LIT else ""

    def occluder_mode(self) -> str:
        """'SELF', 'VISIBLE' or the name of the collection; '' where a collection is wanted and none is chosen."""
        if self.occluders != COLLECTION:
            return self.occluders
        return self.collection.name if self.collection else ""


def register() -> None:
    """Make the settings available on every scene."""
    bpy.utils.register_class(NeuralGashSettings)
    bpy.types.Scene.neural_gash = PointerProperty(type=NeuralGashSettings)


def unregister() -> None:
    """Remove them."""
    del bpy.types.Scene.neural_gash
    bpy.utils.unregister_class(NeuralGashSettings)
