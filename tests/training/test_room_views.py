# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras in rooms: what they see, and that pictures of it have things where they are."""
import numpy as np
import pytest

from neural_gash_addon.backend import irradiance
from training import room_views, rooms


def test_a_camera_stands_free_in_a_room_and_sees_its_walls():
    for seed in (0, 3, 10):
        scene = rooms.generate(seed)
        occluders = scene.occluders()
        eye, target, field = room_views.camera(scene, seed, occluders)
        seen = room_views.view(scene, eye, target, field, 24, 18, occluders)
        assert len(seen.pixels) == 24 * 18                                  # the room is closed
        away = seen.queries[:, :3] - eye
        assert np.linalg.norm(away, axis=1).min() > 0.05 and np.linalg.norm(away, axis=1).max() > 1.5
        assert ((away * seen.queries[:, 3:6]).sum(1) < 0).all()             # the sides that are seen
        low, high = scene.positions.min(0), scene.positions.max(0)
        assert ((eye > low) & (eye < high)).all()


def test_what_stands_on_the_left_is_seen_on_the_left():
    scene = rooms.cornell_box()
    occluders = scene.occluders()
    seen = room_views.view(scene, *room_views.CORNELL, 40, 40, occluders)
    albedo = seen.image(seen.queries[:, 6:])
    red, green = albedo[..., 0] > 3 * albedo[..., 2], albedo[..., 1] > 2 * albedo[..., 0]
    rows, columns = np.nonzero(red)
    assert red.sum() > 50 and columns.max() < 12
    assert green.sum() > 50 and np.nonzero(green)[1].min() > 27
    light = seen.image(seen.emission)[..., 0] > 0
    assert np.nonzero(light)[0].max() < 8 and np.nonzero(light)[1].mean() == pytest.approx(19.5, abs=2)
    positions = seen.image(seen.queries[:, :3])
    assert positions[38, 20, 2] < positions[2, 20, 2]                        # row 0 is at the top
    # a quarter of a pixel's width off the axis, at the depth of the back wall
    middle = positions[19:21, 19:21].mean((0, 1))
    assert middle[[0, 2]] == pytest.approx([0.278, 0.273], abs=2e-3)


def test_a_picture_is_albedo_times_light_and_what_shines_itself():
    scene = rooms.cornell_box()
    occluders = scene.occluders()
    seen, light = room_views.picture(scene, room_views.CORNELL, 20, 20, irradiance.BATCHES, occluders)
    assert seen.shape == light.shape == (20, 20, 3) and np.isfinite(seen).all()
    # the light is a part of its pixels, and none of the irradiance
    assert seen.max() > 4 and light.max() < 17 * np.pi
    wall = light[8:12, 9:11]
    assert (wall > 0).all() and (seen[8:12, 9:11] < wall / np.pi + 1e-6).all()
    assert room_views.shown(seen).min() >= 0 and room_views.shown(seen).max() <= 1
    assert not room_views.shown(np.zeros((2, 2, 3))).any()


def test_the_command(tmp_path):
    out = tmp_path / "deep" / "room.png"
    assert room_views.main(["--seeds", "3", "-1", "--width", "8", "--rays", "8", "--out", str(out)]) == 0
    from matplotlib.image import imread
    assert imread(out).shape[:2] == (12, 16)
