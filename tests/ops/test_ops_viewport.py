# SPDX-License-Identifier: GPL-3.0-or-later
"""The viewport's HDRI rotation turns the light of the previews. Blender's message bus itself is tried in a window."""
from __future__ import annotations

import pytest

bpy = pytest.importorskip("bpy")

from neural_gash_addon.scene import viewport  # noqa: E402


@pytest.fixture
def shading(settings):
    """Of the first 3D viewport of a window."""
    bpy.ops.wm.read_factory_settings()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                return area.spaces.active.shading
    pytest.skip("this Blender has no window in background")


def test_it_is_followed_where_it_is_asked_for(shading):
    settings = bpy.context.scene.neural_gash
    settings.light_rotation = 0.3
    shading.studiolight_rotate_z = 0.5
    viewport._on_turned()
    assert settings.light_rotation == pytest.approx(0.3)
    settings.with_viewport = True
    assert settings.light_rotation == pytest.approx(-0.5)
    shading.studiolight_rotate_z = -1.25
    viewport._on_turned()
    assert settings.light_rotation == pytest.approx(1.25)


def test_a_slider_moved_since_stays_until_the_viewport_is_turned(shading):
    settings = bpy.context.scene.neural_gash
    settings.with_viewport = True
    settings.light_rotation = 1.0
    viewport._on_turned()  # of another viewport
    assert settings.light_rotation == pytest.approx(1.0)
    shading.studiolight_rotate_z = 0.25
    viewport._on_turned()
    assert settings.light_rotation == pytest.approx(-0.25)
