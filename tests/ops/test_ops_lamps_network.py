# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps by the light-transport embedding, through the Bake operator."""
from __future__ import annotations

import numpy as np
import pytest

from .conftest import CUBE
from .lit import area, attribute, bake, paint, record

bpy = pytest.importorskip("bpy")


@pytest.fixture
def room(floor, make):
    """The floor within a closed box of two colours, under an area lamp."""
    box = make([(x, y, z) for z in (-0.01, 2) for y in (-1.01, 1.01) for x in (-1.01, 1.01)], CUBE[1], "Box")
    paint(box, (0.7, 0.3, 0.2))
    box.select_set(False)
    area(energy=20, location=(0.3, 0, 1.9), size=0.4)
    bpy.context.view_layer.objects.active = floor
    floor.select_set(True)
    return floor


@pytest.mark.parametrize("target", ["VERTICES", "TEXTURE"])
def test_the_network_is_like_tracing_and_encodes_a_scene_once(room, settings, monkeypatch, target):
    pytest.importorskip("torch", reason="the network needs torch")
    from neural_gash_addon.backend import embedding_bake
    from neural_gash_addon.scene.attributes import read_record
    from neural_gash_addon.scene.images import bake_images

    def baked():
        bake()
        if target == "VERTICES":
            return attribute(room)
        image = bake_images(room.data, read_record(room))[-1]
        values = np.empty(32 * 32 * 4, np.float32)
        image.pixels.foreach_get(values)
        return values.reshape(-1, 4)[:, :3]

    calls, real = [], embedding_bake.encoded
    monkeypatch.setattr(embedding_bake, "encoded", lambda *a, **k: calls.append(1) or real(*a, **k))
    settings.target, settings.side = target, 32
    truth = baked()
    assert not calls
    settings.lamps_by = "NETWORK"
    found = baked()
    assert calls == [1]
    assert 0 < np.linalg.norm(found - truth) < 0.12 * np.linalg.norm(truth)
    told = record(room)
    assert told.lamps_error > 0.02 and "above the tolerance" in told.lamps_notice
    settings.tolerance = 0.5
    bake()
    assert not record(room).lamps_notice


def test_a_room_that_the_network_does_not_know_is_refused(room, settings, refused):
    pytest.importorskip("torch", reason="the network needs torch")
    settings.lamps_by = "NETWORK"
    bpy.data.objects["Box"].scale = (12, 1, 1)
    bpy.context.view_layer.update()
    assert "24.2 m long" in refused(bpy.ops.neural_gash.bake)
    assert "_prt_lamps" not in room.data.attributes
