# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendered animations show no stale frame: each is compared with a still of a bake that was made at its frame."""
from __future__ import annotations

import logging

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from neural_gash_addon.scene import attributes, preview, rendered  # noqa: E402

FRAMES = (2, 6, 10)
SIDE = 24


@pytest.fixture
def eye(tmp_path):
    """eye.render(name): what a camera above sees, written to a file; eye.pixels(name) reads it."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    camera.location = (0, 0, 4)
    scene.collection.objects.link(camera)
    scene.camera, scene.render.engine, scene.cycles.samples = camera, "CYCLES", 1
    scene.render.resolution_x = scene.render.resolution_y = SIDE
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.neural_gash.light_source = "SKY"

    class Eye:
        def render(self, name, **what):
            scene.render.filepath = str(tmp_path / name)
            bpy.ops.render.render(**what)

        def pixels(self, name):
            image = bpy.data.images.load(str(tmp_path / name))
            values = np.empty(SIDE * SIDE * 4, np.float32)
            image.pixels.foreach_get(values)
            bpy.data.images.remove(image)
            return values

        def moving(self):
            """The pictures of the animation, rendered while the window stays at frame 1."""
            scene.frame_start, scene.frame_end, scene.frame_step = FRAMES[0], FRAMES[-1], FRAMES[1] - FRAMES[0]
            scene.frame_set(1)
            self.render("moving", animation=True)
            return [self.pixels(f"moving{frame:04}.exr") for frame in FRAMES]

        def still(self):
            """The current frame, of the bake as it is."""
            self.render("still.exr", write_still=True)
            found = self.pixels("still.exr")
            (tmp_path / "still.exr").unlink()
            return found

        def compare(self, moving, bake=True):
            """Each picture is like the still of its frame, of a bake that is made there or of the one that is."""
            for frame, picture in zip(FRAMES, moving, strict=True):
                scene.frame_set(frame)
                if bake:
                    bpy.ops.neural_gash.bake()
                np.testing.assert_allclose(picture, self.still(), atol=2e-3)
    return Eye()


def _drive(obj):
    """The shape key by a driver, which turns with the frames."""
    key = obj.data.shape_keys
    key.animation_data_clear()
    curve = key.key_blocks["Up"].driver_add("value")
    curve.driver.expression = "(frame - 1) / 9"


def _twist(obj):
    """A modifier of the object instead of the shape key."""
    obj.shape_key_clear()
    twist = obj.modifiers.new("Twist", "SIMPLE_DEFORM")
    twist.deform_method, twist.deform_axis = "TWIST", "X"
    for frame, angle in ((1, 0.0), (10, 2.5)):
        twist.angle = angle
        twist.keyframe_insert("angle", frame=frame)


def _sun():
    """Light from one side, which shows how an object is turned."""
    scene = bpy.context.scene
    scene.neural_gash.light_source = "SUNS"
    lamp = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    lamp.rotation_euler, lamp.data.energy = (0.6, 0.3, 0), 3
    scene.collection.objects.link(lamp)
    bpy.ops.neural_gash.read_light()


def _key(obj, path, *values):
    """A property with these values in frames 1 and 10; frame 1 is shown."""
    for frame, value in zip((1, 10), values, strict=True):
        setattr(obj, path, value)
        obj.keyframe_insert(path, frame=frame)
    bpy.context.scene.frame_set(1)


def _turn(obj):
    """Turned from frame to frame, in the light of a sun."""
    _sun()
    _key(obj, "rotation_euler", (0, 0, 0), (2, 0, 0))


def _parent(obj):
    """As `_turn`, by what it is parented to."""
    obj.parent = bpy.data.objects.new("Parent", None)
    bpy.context.scene.collection.objects.link(obj.parent)
    _turn(obj.parent)


def _hidden(obj):
    """Hidden in the frame that the window shows."""
    obj.animation_data_clear()
    obj.hide_render = True
    obj.keyframe_insert("hide_render", frame=1)
    obj.hide_render = False
    obj.keyframe_insert("hide_render", frame=2)
    bpy.context.scene.frame_set(1)


def _instance(obj):
    """In the scene as an instance of its collection only."""
    scene = bpy.context.scene
    empty = bpy.data.objects.new("Instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", bpy.data.collections.new("Kept")
    empty.instance_collection.objects.link(obj)
    scene.collection.objects.unlink(obj)
    scene.collection.objects.link(empty)


def _all(obj):
    """An armature and a driver on top of the keyed shape."""
    rig = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    bone = rig.data.edit_bones.new("Bone")
    bone.head, bone.tail = (-0.2, 0, 0), (-1, 0, 0)
    bpy.ops.object.mode_set(mode="OBJECT")
    obj.vertex_groups.new(name="Bone").add([v.index for v in obj.data.vertices if v.co.x < -0.2], 1.0, "REPLACE")
    obj.modifiers.new("Rig", "ARMATURE").object = rig
    pose = rig.pose.bones["Bone"]
    pose.rotation_mode = "XYZ"
    for frame, angle in ((1, 0.0), (10, -1.0)):
        pose.rotation_euler.z = pose.rotation_euler.x = angle
        pose.keyframe_insert("rotation_euler", frame=frame)
    curve = obj.driver_add("scale", 1)
    curve.driver.expression = "1 - frame / 40"
    bpy.context.view_layer.objects.active = obj
    bpy.context.scene.frame_set(1)
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


@pytest.mark.parametrize("how", ["live", "sequence"])
@pytest.mark.parametrize("animate", [None, _drive, _twist, _all], ids=["keyed", "driven", "modifier", "all"])
def test_a_render_of_the_animation_shows_no_stale_frame(wing, settings, tmp_path, eye, animate, how):
    if animate:
        animate(wing)
    scene = bpy.context.scene
    scene.frame_end = 10
    if how == "live":
        settings.live = True
    else:
        settings.sequence_folder = str(tmp_path)
        bpy.ops.neural_gash.bake_sequence()
    moving = eye.moving()
    settings.live = False
    eye.compare(moving)
    assert np.abs(moving[0] - moving[2]).max() > 0.1


@pytest.mark.parametrize("how", ["live", "sequence"])
@pytest.mark.parametrize("change", [_turn, _parent, _hidden, _instance])
def test_what_the_window_shows_is_not_what_is_rendered(wing, settings, tmp_path, eye, change, how):
    """Where the object stands, and whether it is there, is what the render's own dependency graph says."""
    scene = bpy.context.scene
    scene.frame_end = 10
    if change is not _instance:  # of which a sequence cannot be baked any more
        change(wing)
    if how == "sequence":
        settings.sequence_folder = str(tmp_path)
        bpy.ops.neural_gash.bake_sequence()
    settings.live = how == "live"
    if change is _instance:
        change(wing)
    before = [(slot.link, slot.material) for slot in wing.material_slots]
    moving = eye.moving()
    assert [(slot.link, slot.material) for slot in wing.material_slots] == before
    settings.live = False
    if change is _instance:
        scene.collection.objects.link(wing)
        scene.collection.objects.unlink(bpy.data.objects["Instance"])
    wing.select_set(True)
    bpy.context.view_layer.objects.active = wing
    eye.compare(moving)
    assert np.abs(moving[0] - moving[2]).max() > 0.1


def test_a_shadow_that_is_hidden_in_some_frames(wing, settings, make, eye):
    """Its own hiding is animated; it is hidden in the frame that the window shows."""
    lid = make([(-1, -1, -0.3), (1, -1, -0.3), (1, 1, -0.3), (-1, 1, -0.3)], [(3, 2, 1, 0)], "Lid")
    lid.rotation_euler, lid.location = (0.9, 0, 0), (0, 1.2, 0.9)
    settings.occluders = "VISIBLE"
    lid.select_set(False)
    wing.select_set(True)
    bpy.context.view_layer.objects.active = wing
    _hidden(lid)
    bpy.ops.neural_gash.bake()
    settings.live = True
    moving = eye.moving()
    settings.live = False
    eye.compare(moving)


def test_a_preview_that_turns_is_lit_as_it_stands_in_each_rendered_frame(wing, settings, eye):
    """Without Live, and also where the light changes."""
    wing.shape_key_clear()
    bpy.ops.neural_gash.bake()
    _turn(wing)
    _key(bpy.data.objects["Sun"].data, "energy", 1.0, 3.0)
    moving = eye.moving()
    eye.compare(moving, bake=False)
    assert np.abs(moving[0] - moving[2]).max() > 0.1


def test_a_sun_that_is_hidden_in_the_frame_that_the_window_shows(wing, settings, eye):
    _sun()
    _hidden(bpy.data.objects["Sun"])
    moving = eye.moving()
    eye.compare(moving, bake=False)
    assert moving[0].reshape(-1, 4)[:, :3].max() > 0.1


def test_bounces_are_followed_in_rendered_frames(wing, settings, eye):
    wing.data.materials.clear()
    wing.data.materials.append(bpy.data.materials.new("Red"))
    wing.data.materials[0].diffuse_color = (0.9, 0.1, 0.1, 1)
    settings.bounces = 2
    bpy.ops.neural_gash.bake()
    settings.live = True
    assert attributes.read_record(wing).colours == 1  # nothing sees another surface: the first frame has another group
    moving = eye.moving()
    settings.live = False
    eye.compare(moving)
    direct = moving[2].copy()
    settings.bounces = 0
    bpy.ops.neural_gash.bake()
    assert np.abs(direct - eye.still()).max() > 0.02


@pytest.mark.parametrize("why", ["texture", "topology", "sequence that ends", "sequence that is gone"])
def test_where_it_cannot_follow_own_materials_are_rendered(wing, settings, tmp_path, eye, caplog, why):
    """And said; the preview is back when the render is over."""
    scene = bpy.context.scene
    settings.live = not why.startswith("sequence")
    if why == "texture":
        settings.target, settings.side = "TEXTURE", 32
        bpy.ops.neural_gash.bake()
    elif why == "topology":
        more = wing.modifiers.new("More", "SUBSURF")
        more.levels = more.render_levels = 1
        more.show_viewport = more.show_render = False
        for path in ("show_viewport", "show_render"):
            more.keyframe_insert(path, frame=1)
        more.show_viewport = more.show_render = True
        for path in ("show_viewport", "show_render"):
            more.keyframe_insert(path, frame=6)
        scene.frame_set(1)
    else:
        scene.frame_end = 2
        settings.sequence_folder = str(tmp_path)
        bpy.ops.neural_gash.bake_sequence()
    slots = [(slot.link, slot.material) for slot in wing.material_slots]
    if why.endswith("gone"):
        (tmp_path / "Wing.prtseq").unlink()
    with caplog.at_level(logging.WARNING):
        moving = eye.moving()
    said = [record.message for record in caplog.records if "own materials are rendered" in record.message]
    first = {"texture": 2, "topology": 6, "sequence that ends": 6, "sequence that is gone": 2}[why]
    assert [line.split(":")[0] for line in said] == [f"Frame {first}"] and "'Wing'" in said[0]
    assert preview.is_on(wing) and not rendered._aside
    assert [(slot.link, preview.is_preview(slot.material)) for slot in wing.material_slots] == [
        (link, True) for link, _ in slots]
    preview.preview_off(wing)
    settings.live = False
    own = []
    for frame in FRAMES:
        scene.frame_set(frame)
        own.append(eye.still())
    for frame, picture, plain in zip(FRAMES, moving, own, strict=True):
        assert np.allclose(picture, plain, atol=2e-3) == (frame >= first)


def test_saved_in_the_midst_of_a_render(wing, settings, tmp_path, eye):
    """The file has the preview, and the frames after it are still the object's own."""
    settings.live, settings.target, settings.side = True, "TEXTURE", 32
    bpy.ops.neural_gash.bake()
    plain = eye.moving()
    saved = str(tmp_path / "saved.blend")

    def save(*_):
        bpy.ops.wm.save_as_mainfile(filepath=saved, copy=True)
    bpy.app.handlers.render_post.append(save)
    try:
        moving = eye.moving()
    finally:
        bpy.app.handlers.render_post.remove(save)
    np.testing.assert_allclose(moving, plain, atol=2e-3)
    assert preview.is_on(wing)
    bpy.ops.wm.open_mainfile(filepath=saved)
    assert preview.is_on(bpy.data.objects["Wing"]) and not rendered._aside


def test_a_stale_bake_that_nothing_follows_is_rendered_as_it_is(wing, settings, eye, caplog):
    with caplog.at_level(logging.WARNING):
        moving = eye.moving()
    assert not caplog.records and preview.is_on(wing) and moving[2].any()
