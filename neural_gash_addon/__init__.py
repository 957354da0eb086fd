# SPDX-License-Identifier: GPL-3.0-or-later
"""Neural GASh: bakes and previews precomputed radiance transfer."""


def _parts():
    """What registers, in order; imported late, so that the backend can be used without bpy."""
    from . import cli, ops, panels, properties
    from .scene import lighting, live, machine, staleness, viewport

    return machine, properties, ops, panels, live, lighting, viewport, staleness, cli


def register() -> None:
    """Register everything."""
    for part in _parts():
        part.register()


def unregister() -> None:
    """Unregister everything, in reverse."""
    for part in reversed(_parts()):
        part.unregister()
