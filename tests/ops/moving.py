# SPDX-License-Identifier: GPL-3.0-or-later
"""What the tests of Live and of sequences ask and do. Blender is imported within, as in `lit`."""
from __future__ import annotations


def stored(obj):
    """(E, K) as the attributes have it."""
    from neural_gash_addon.scene import attributes
    return attributes.read_transfer(obj)[0]


def truth(obj, settings):
    """(N, K) of the object as it stands."""
    import bpy

    from neural_gash_addon.backend import methods
    from neural_gash_addon.scene import read
    mesh = read.read_object(obj, bpy.context.evaluated_depsgraph_get()).mesh
    return methods.run(methods.bake(mesh, settings.method, settings.order, **settings.tracing())).coefficients


def select(*objects):
    """And the first of them active."""
    import bpy
    for obj in objects:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = objects[0]


def bake(*objects):
    """As the button does."""
    import bpy
    select(*objects)
    assert bpy.ops.neural_gash.bake() == {"FINISHED"}


def quiet(capfd):
    """Nothing was raised where nobody hears it."""
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err, out + err
