"""Wheels: a tyre, a rim with five spokes, turned about the axle."""

from __future__ import annotations

import numpy as np

from warpav.scene.town.paint import Material
from warpav.scene.town.surface_builder import SurfaceBuilder

_SEGMENTS = 15
_SPOKES = 5
# (radius over tyre radius, y offset [m] from the tyre's outer face), from the hub outwards and round to the inside.
_PROFILE = ((0.0, -0.022), (0.20, -0.022), (0.62, -0.040), (0.70, -0.010), (0.92, 0.0), (1.0, -0.030), (1.0, -1.0),
            (0.0, -1.0))  # fmt: skip
_COARSE_PROFILE, _COARSE_SEGMENTS = ((0.0, -0.022), (0.68, -0.015), (1.0, -0.010), (1.0, -1.0), (0.0, -1.0)), 8
_WIDTH_SHARE = 0.66  # tyre width over tyre radius


def add_wheel_pair(
    builder: SurfaceBuilder,
    x_m: float,
    outer_face_m: float,
    radius_m: float,
    *,
    twin: bool,
    coarse: bool = False,
) -> None:
    """Add the wheels of one axle."""
    width = _WIDTH_SHARE * radius_m * (2.0 if twin else 1.0)
    profile = np.array(_COARSE_PROFILE if coarse else _PROFILE)
    profile[:, 0] *= radius_m
    profile[-2:, 1] = -width
    if coarse:
        rows = np.array([Material.RIM, Material.TYRE, Material.TYRE, Material.TYRE])
        builder.add_lathe_pair((x_m, outer_face_m, radius_m), profile, np.tile(rows[:, None], _COARSE_SEGMENTS))
        return
    segment = np.arange(_SEGMENTS)
    per_spoke = _SEGMENTS // _SPOKES
    spoke = np.where(segment % per_spoke < per_spoke - 1, Material.RIM, Material.DARK)
    rim = np.full(_SEGMENTS, Material.RIM)
    tyre = np.full(_SEGMENTS, Material.TYRE)
    builder.add_lathe_pair((x_m, outer_face_m, radius_m), profile, np.stack([rim, spoke, rim, tyre, tyre, tyre, tyre]))
