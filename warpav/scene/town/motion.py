"""How fast everybody in a town moves: speeds alone, which change nothing of what a scene looks like.

Who drives in a lane follows it, at 30 to 50 km/h where it is free, in a car park at 5 to 15 km/h. Whatever is in the
lane ahead, and the line in front of a street with priority, slows drivers and cyclists down to what takes `HEADWAY_S`
to get there: so queues are slow, and at constant speeds nobody drives into what is ahead in its lane before that. What
is parked stands, and people walk and cycle in the direction that they face.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from warpav.scene.town.street_life import Footprint
from warpav.scene.town.town_layout import Layout

HEADWAY_S = 1.5
"""Time in which a driver reaches what is ahead in its lane now, at least."""
STREET_KM_H = (30.0, 50.0)
CAR_PARK_KM_H = (5.0, 15.0)
CYCLIST_M_S = (4.0, 6.0)
PEDESTRIAN_M_S = (1.1, 1.7)
_M_S_PER_KM_H = 1.0 / 3.6
_STOP_LINE_M = 1.1  # from the edge of the street with priority


@dataclass(frozen=True)
class RoadUser:
    """Somebody who may move."""

    category: str  # as `warpav.scene.scene.Vehicle` has it
    footprint: Footprint  # where, in the town frame
    heading_rad: float | None  # direction of the lane, or of somebody on foot; None: parked
    # Lowest and highest speed where nothing is in the way [m/s]; None: that of the category and the street.
    free_m_s: tuple[float, float] | None = None


def velocities_m_s(
    users: Sequence[RoadUser], obstacles: Sequence[Footprint], layout: Layout, rng: np.random.Generator
) -> np.ndarray:
    """Random velocities over ground in the town frame [m/s], float64 [user, 2]."""
    limit_m_s = np.multiply(CAR_PARK_KM_H if layout.template == "car_park" else STREET_KM_H, _M_S_PER_KM_H)
    things = [*(user.footprint for user in users), *obstacles, *_stop_lines(layout)]
    centre_m = np.array([(thing.x_m, thing.y_m) for thing in things])
    radius_m = np.array([0.5 * np.hypot(thing.length_m, thing.width_m) for thing in things])
    velocity = np.zeros((len(users), 2))
    for k, user in enumerate(users):
        usual = {"pedestrian": PEDESTRIAN_M_S, "cyclist": CYCLIST_M_S}.get(user.category, limit_m_s)
        low, high = user.free_m_s or usual
        speed_m_s = rng.uniform(low, high)
        if user.heading_rad is None:
            continue
        if user.category != "pedestrian":
            # what it reaches later than that does not slow it down
            far_m = np.hypot(*(centre_m - centre_m[k]).T) - radius_m - radius_m[k]
            near = np.flatnonzero(far_m <= HEADWAY_S * speed_m_s)
            way_m = _way_m(user.footprint, user.heading_rad, (things[j] for j in near if j != k))
            speed_m_s = min(speed_m_s, way_m / HEADWAY_S)
        velocity[k] = speed_m_s * np.array([np.cos(user.heading_rad), np.sin(user.heading_rad)])
    return velocity


def _way_m(one: Footprint, heading_rad: float, others: Iterable[Footprint]) -> float:
    """Free way ahead of a rectangle as it moves in a direction [m], inf if nothing is in its way."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    way_m = np.inf
    for other in others:
        corner_m = other.corners_m() - [one.x_m, one.y_m]
        along_m, across_m = corner_m @ [c, s], corner_m @ [-s, c]
        is_beside = across_m.min() > 0.5 * one.width_m or across_m.max() < -0.5 * one.width_m
        if not is_beside and along_m.mean() > 0.0:
            way_m = min(way_m, max(along_m.min() - 0.5 * one.length_m, 0.0))
    return way_m


def _stop_lines(layout: Layout) -> list[Footprint]:
    """Where side streets end at the main street."""
    (_, low, _, high), *sides = layout.asphalt_m
    return [
        Footprint(
            0.5 * (west + east), low - _STOP_LINE_M if south < low else high + _STOP_LINE_M, 0.0, east - west, 0.4
        )
        for west, south, east, _ in sides
    ]
