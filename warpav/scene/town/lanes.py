"""Lanes, and who drives in them: queues at lines where drivers wait, free traffic elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from warpav.scene.town.placed_vehicle import DrawnVehicle
from warpav.scene.town.street_life import RoadUser
from warpav.scene.town.town_layout import Footprint, Lane, Layout

_QUEUE_GAP_M = (1.2, 3.0)
_LINE_GAP_M = (0.4, 1.4)
_LATERAL_JITTER_M, _YAW_JITTER_RAD = 0.18, 0.012


def lane_positions(
    lane: Lane, length_of: Callable[[], float], rng: np.random.Generator
) -> Iterator[tuple[float, float]]:
    """Middles and lengths of what stands in a lane, from its end back to its start; nothing overlaps."""
    lines = sorted(lane.lines_m)
    front_limit = lane.length_m + float(rng.uniform(0.0, lane.gap_m[0] + lane.gap_m[1]))
    waiting = 0
    while True:
        length = length_of()
        if waiting > 0:
            front = front_limit - float(rng.uniform(*_QUEUE_GAP_M))
            waiting -= 1
        else:
            front = front_limit - lane.gap_m[0] - float(rng.exponential(lane.gap_m[1]))
        if lines and front - length < lines[-1]:
            # whoever would stand on the line, or comes next behind it, is the first to wait
            line = lines.pop()
            queue = int(rng.poisson(lane.queue))
            if queue == 0:
                front_limit = line + lane.gap_m[0]
                continue
            front, waiting = line - float(rng.uniform(*_LINE_GAP_M)), queue - 1
        rear = front - length
        if rear < 0.0:
            return
        front_limit = rear
        if front <= lane.length_m and not any(rear < high and front > low for low, high in lane.closed_m):
            yield 0.5 * (front + rear), length


def lane_vehicles(
    lane: Lane, draw: Callable[[], DrawnVehicle], rng: np.random.Generator
) -> Iterator[tuple[DrawnVehicle, Footprint]]:
    """Vehicles and where they drive; see `lane_positions`."""
    drawn: list[DrawnVehicle] = []

    def length_of() -> float:
        drawn.append(draw())
        return float(drawn[-1].size_m[0])

    for middle_m, length_m in lane_positions(lane, length_of, rng):
        left_m = float(rng.uniform(-_LATERAL_JITTER_M, _LATERAL_JITTER_M))
        yaw = lane.yaw_rad + float(rng.uniform(-_YAW_JITTER_RAD, _YAW_JITTER_RAD))
        yield drawn[-1], Footprint.at(lane.at(middle_m, left_m), yaw, (length_m, drawn[-1].size_m[1]))


HEADWAY_S = 1.5  # time in which a driver reaches what is ahead in its lane now, at least
STREET_KM_H = (30.0, 50.0)
_CAR_PARK_KM_H = (5.0, 15.0)
_CYCLIST_M_S = (4.0, 6.0)
_PEDESTRIAN_M_S = (1.1, 1.7)
_M_S_PER_KM_H = 1.0 / 3.6
_STOP_LINE_M = 1.1  # from the edge of the street with priority


def velocities_m_s(
    users: Sequence[RoadUser], obstacles: Sequence[Footprint], rng: np.random.Generator, *, in_car_park: bool = False
) -> np.ndarray:
    """Random velocities over ground in the town frame [m/s], float64 [user, 2]."""
    limit_m_s = np.multiply(_CAR_PARK_KM_H if in_car_park else STREET_KM_H, _M_S_PER_KM_H)
    things = [*(user.footprint for user in users), *obstacles]
    centre_m = np.array([(thing.x_m, thing.y_m) for thing in things])
    radius_m = np.array([thing.radius_m for thing in things])
    velocity = np.zeros((len(users), 2))
    for k, user in enumerate(users):
        usual = {"pedestrian": _PEDESTRIAN_M_S, "cyclist": _CYCLIST_M_S}.get(user.category, limit_m_s)
        low, high = user.free_m_s or usual
        speed_m_s = rng.uniform(low, high)
        if user.heading_rad is None:
            continue
        if user.category != "pedestrian":
            # what it reaches later than that does not slow it down
            far_m = np.hypot(*(centre_m - centre_m[k]).T) - radius_m - radius_m[k]
            near = np.flatnonzero(far_m <= HEADWAY_S * speed_m_s)
            # free way ahead of the rectangle as it moves in a direction
            c, s = np.cos(user.heading_rad), np.sin(user.heading_rad)
            way_m = np.inf
            for other in (things[j] for j in near if j != k):
                corner_m = other.corners_m() - [user.footprint.x_m, user.footprint.y_m]
                along_m, across_m = corner_m @ [c, s], corner_m @ [-s, c]
                is_beside = (
                    across_m.min() > 0.5 * user.footprint.width_m or across_m.max() < -0.5 * user.footprint.width_m
                )
                if not is_beside and along_m.mean() > 0.0:
                    way_m = min(way_m, max(along_m.min() - 0.5 * user.footprint.length_m, 0.0))
            speed_m_s = min(speed_m_s, way_m / HEADWAY_S)
        velocity[k] = speed_m_s * np.array([np.cos(user.heading_rad), np.sin(user.heading_rad)])
    return velocity


def stop_lines(layout: Layout) -> list[Footprint]:
    """Where side streets end at the main street."""
    (_, low, _, high), *sides = layout.asphalt_m
    return [
        Footprint(
            0.5 * (west + east), low - _STOP_LINE_M if south < low else high + _STOP_LINE_M, 0.0, east - west, 0.4
        )
        for west, south, east, _ in sides
    ]
