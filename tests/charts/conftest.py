# SPDX-License-Identifier: GPL-3.0-or-later
import pytest

from neural_gash_addon.backend import sky_bake


@pytest.fixture(autouse=True)
def few_scene_points(monkeypatch):
    """Meshes of some hundred vertices need no more, and trials bake hundreds of them."""
    monkeypatch.setattr(sky_bake, "POINTS", 256)
    monkeypatch.setattr(sky_bake, "DENSITY", 150)
