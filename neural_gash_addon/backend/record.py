# SPDX-License-Identifier: GPL-3.0-or-later
"""The metadata that every bake carries, so that it can be decoded years later from itself alone."""
from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from .errors import UserError
from .geometry import CORNER, POINT, TEXEL
from .spherical_harmonics import MAX_ORDER

SCHEMA = 1
VERSION = "0.1.0"
BASIS = "real orthonormal SH, no Condon-Shortley phase, k = l*(l+1)+m; radiance = albedo * (T . L)"
LAMPS_BASIS = "; and + albedo * E / pi, E the irradiance from lamps, W/m^2, linear RGB"  # of bakes that have it
_DAMAGED = "The record of this bake is damaged; bake again."
# what JSON may hold for each kind of field
_KINDS: dict[str, tuple[type, ...]] = {
    "str": (str,), "int": (int,), "bool": (bool,), "float": (int, float), "float | None": (int, float, type(None)),
    "tuple[float, ...]": (list,)}
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class BakeRecord:
    """What was baked, how, and how well."""

    method: str
    order: int
    points: int
    domain: str                       # 'POINT' or 'CORNER'
    rays: int                         # that the coefficients are made of
    seed: int
    seconds: float                    # arrays to coefficients, wall clock
    error_estimate: float | None      # rel L2, measured; None: nothing was sampled, or it is dark
    probe_rays: int = 0               # traced besides, to measure the error and set the tolerance's scale
    tolerance: float | None = None    # rel L2 that was asked for; None: a ray count was
    occluders: str = "SELF"           # 'SELF', 'VISIBLE', a collection's name, or a JSON list of objects
    fingerprint: str = ""             # of the shape and its occluders
    frame: tuple[float, ...] = IDENTITY  # (9,) row-major rotation of the object at bake time
    target: str = "vertices"          # or 'texture'
    side: int = 0                     # texels a side of a texture
    uv_map: str = ""                  # whose coordinates the texture has
    single_faces: int = 0             # that lie alone in it, as xatlas could not chart them with their neighbours
    bounces: int = 0                  # of diffuse interreflection that were computed
    colours: int = 1                  # transfer is (N, K), or (N, K, 3) where light bounced off colours
    between_error: float | None = None  # rel L2 inside faces of what vertices say, measured where it was planned,
    between_missed: bool = False      # and whether that is too much
    plan: str = ""                    # why so, where it was planned: one sentence for each choice
    lamps: str = ""                   # what tells the lamps, and all that they light, from others; '': none baked
    lamps_rays: int = 0               # paths that their irradiance is made of
    lamps_error: float | None = None  # rel L2 of the irradiance, measured
    lamps_notice: str = ""            # what a person should know of them
    lamps_order: int = 1              # bands of their light by direction, for gloss; 1: irradiance alone
    basis: str = BASIS
    version: str = VERSION
    schema: int = SCHEMA

    @property
    def terms(self) -> int:
        """How many numbers each point has."""
        return self.order ** 2 * self.colours

    @property
    def rays_per_point(self) -> float:
        """Mean number of rays a point took."""
        return self.rays / max(self.points, 1)

    @property
    def numbers(self) -> int:
        """How many numbers each point has, irradiance included."""
        return self.terms + (3 * self.lamps_order ** 2 if self.lamps else 0)

    def also(self, sentence: str) -> BakeRecord:
        """The same, with one sentence more (unless it is '') of why, if it was planned."""
        return replace(self, plan=f"{self.plan} {sentence}") if self.plan and sentence else self

    def to_json(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self), sort_keys=True)

    @staticmethod
    def from_json(text: str) -> BakeRecord:
        """The record in `text`. Raises UserError where it is unreadable or of a newer schema."""
        try:
            data = json.loads(text)
            schema = int(data["schema"])
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise UserError("The record of this bake is unreadable; bake again.") from error
        if schema > SCHEMA:
            raise UserError(f"This bake was made by a newer Neural GASh ({data.get('version', 'unknown')}); "
                            "update the add-on to use it.")
        known = {f.name: f.type for f in fields(BakeRecord)}
        values = {key: value for key, value in data.items() if key in known}
        if not all(isinstance(value, _KINDS[str(known[key])]) for key, value in values.items()):
            raise UserError(_DAMAGED)
        try:
            record = BakeRecord(**values)
            frame = np.array(record.frame, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise UserError(_DAMAGED) from error
        if (frame.shape != (9,) or not np.allclose(frame.reshape(3, 3) @ frame.reshape(3, 3).T, np.eye(3), atol=1e-3)
                or not 1 <= record.order <= MAX_ORDER or record.domain not in (POINT, CORNER, TEXEL)
                or record.colours not in (1, 3) or not 1 <= record.lamps_order <= MAX_ORDER):
            raise UserError(_DAMAGED)
        object.__setattr__(record, "frame", tuple(frame.tolist()))
        return record
