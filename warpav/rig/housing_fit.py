"""Where in a zone a module's housing has room: it must not go into the body, or not deeper than the zone allows."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.rig.module import Housing, Module
from warpav.rig.mount_surface import MountSurface
from warpav.rig.zone import Zone

STEP_RAD = math.radians(5.0)
"""Between the directions in which a housing is tried; between them it reaches .1 % farther at most."""

_ROUNDING_M = 1e-3


def with_room(
    module: Module, zone: Zone, surface: MountSurface, *, pitch_rad: tuple[float, float] = (0.0, 0.0)
) -> tuple[Zone, MountSurface] | float:
    """A zone and its surface as a module may stand there; or the stand-off that it would need, beyond the greatest [m].

    The least stand-off is raised until the housing has room in half of the zone, whichever way it points; where it has
    none then, as the body bulges, the zone carries no camera. A zone outside that sets no ``recess_m`` stays: its
    housings may be let in.
    """
    if not zone.is_behind_glass and zone.recess_m is None:
        return zone, surface
    outwards = 1.0 if zone.is_behind_glass else -1.0
    depth_m, reach_m = _housing_reach_m(module.housing, zone, outwards * zone.axes[2], pitch_rad=pitch_rad)
    assert surface.is_mountable is not None
    # how far the skin comes nearer within reach of the housing
    height_m = -outwards * surface.height_m.astype(np.float64)
    needed_m = depth_m + _highest_within(height_m, reach_m / surface.cell_m) - height_m
    needed_m -= 0.0 if zone.is_behind_glass else zone.recess_m or 0.0
    low_m, high_m = zone.stand_off_m
    inside = surface.is_mountable
    if not (needed_m[inside] <= high_m).any():
        return float(needed_m[inside].min())
    least_m = float(np.clip(np.median(needed_m[inside]), low_m, high_m))
    kept = inside & (needed_m <= least_m + _ROUNDING_M)
    return replace(zone, stand_off_m=(least_m, high_m)), replace(surface, is_mountable=kept)


def _housing_reach_m(
    housing: Housing, zone: Zone, direction: np.ndarray, *, pitch_rad: tuple[float, float]
) -> tuple[float, float]:
    """How far a housing reaches along a unit vector [3] and across it at most, however it points in a zone [m]."""
    half_m = 0.5 * np.asarray(housing.size_m)
    corner_m = np.array([np.multiply(signs, half_m) for signs in itertools.product((-1.0, 1.0), repeat=3)])
    corner_m = (corner_m + housing.offset_m) @ FLU_FROM_RDF.T
    yaws, pitches, rolls = (
        _steps(pair)
        for pair in (
            zone.yaw_range_rad or (-math.pi, math.pi),
            zone.pitch_rad or pitch_rad,
            zone.roll_rad or (0.0, 0.0),
        )
    )
    along, across = [], []
    for angles in itertools.product(yaws, pitches, rolls):
        turned_m = corner_m @ rotation_from_yaw_pitch_roll(*angles).T
        there = turned_m @ direction
        along.append(there.max())
        across.append(np.linalg.norm(turned_m - there[:, None] * direction, axis=1).max())
    return float(max(along)), float(max(across))


def _steps(pair: tuple[float, float]) -> np.ndarray:
    return np.linspace(*pair, 1 + math.ceil((pair[1] - pair[0]) / STEP_RAD))


def _highest_within(height_m: np.ndarray, cells: float) -> np.ndarray:
    """The greatest height of the cells of which some part is within so many cells of each, [row, column]."""
    from scipy import ndimage

    cells += math.sqrt(0.5)
    reach = math.ceil(cells)
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return ndimage.maximum_filter(height_m, footprint=np.hypot(i, j) <= cells + 1e-9, mode="nearest")
