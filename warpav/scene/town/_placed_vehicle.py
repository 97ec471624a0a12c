"""Vehicles of the town: drawn at random, placed in lanes or bays, how fast all move; and which the roof can see.

In lanes queues wait at lines, and traffic is free elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from warpav.raster.mesh import Mesh, merge
from warpav.scene._scene import triangle_caster
from warpav.scene.town._paint import drawn_paint
from warpav.scene.town._street_life import RoadUser
from warpav.scene.town._surface_builder import StreetGround
from warpav.scene.town._town_layout import Footprint, Lane, Layout
from warpav.scene.town._vehicle_shapes import VARIANT_COUNT, body_width_m, vehicle_mesh, vehicle_size_m

LONG_KINDS = ("lorry", "bus")
_SCALE_SPREAD = 0.03
Exchange = Callable[[int, str, Mesh, np.ndarray], Mesh]
"""What may put another mesh in the place of a vehicle's own.

It takes the number of the vehicle in its scene, from 1, its kind, its own mesh in the vehicle frame, and its length,
width without mirrors and height [m], [3]; it returns a mesh in the vehicle frame of this size, or the own one.
"""


@dataclass(frozen=True, eq=False)
class DrawnVehicle:
    """A random vehicle, nowhere yet."""

    kind: str  # as `vehicle_mesh` takes it
    variant: int  # as `vehicle_mesh` takes it
    paint: np.ndarray  # linear albedo, shape [3]
    scale: np.ndarray  # factors along x, y, z, shape [3]

    @property
    def size_m(self) -> np.ndarray:
        """Length, width with mirrors, height [m], shape [3]."""
        return vehicle_size_m(self.kind, self.variant) * self.scale

    def mesh(self, *, coarse: bool = False) -> Mesh:
        return vehicle_mesh(self.kind, self.paint, variant=self.variant, scale=self.scale, coarse=coarse)


def drawn_vehicle(kind_shares: Mapping[str, float], rng: np.random.Generator) -> DrawnVehicle:
    """A vehicle of one of these kinds, by their shares, which add up to 1."""
    kind = list(kind_shares)[int(rng.choice(len(kind_shares), p=list(kind_shares.values())))]
    paint = drawn_paint(kind, rng)
    scale = 1.0 + rng.uniform(-_SCALE_SPREAD, _SCALE_SPREAD, 3)
    return DrawnVehicle(kind, int(rng.integers(VARIANT_COUNT)), paint, scale)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedVehicle(RoadUser):
    """A vehicle in the town frame: its mesh in the vehicle frame, and where it stands."""

    variant: int  # as `vehicle_mesh` takes it
    mesh: Mesh  # in the vehicle frame
    size_m: np.ndarray  # length, width with mirrors, height [m], shape [3]

    def exchanged(self, exchange: Exchange | None, number: int) -> PlacedVehicle:
        """The vehicle with the mesh that an exchange gives it, as the vehicle of this number; None: its own."""
        if exchange is None:
            return self
        kind, variant = self.category, self.variant
        width_m = self.size_m[1] * body_width_m(kind, variant) / vehicle_size_m(kind, variant)[1]
        low_m, high_m = self.mesh.bounds_m().astype(np.float64)  # a coarse mesh is a little shorter
        found = exchange(number, kind, self.mesh, np.array([high_m[0] - low_m[0], width_m, high_m[2]]))
        if found is self.mesh:
            return self
        middle_m = np.array([0.5 * (low_m[0] + high_m[0]), 0.0, 0.0])
        return replace(self, mesh=found.transformed(np.eye(3), middle_m))

    def standing(self, ground: StreetGround) -> Mesh:
        place = self.footprint
        return self.mesh.transformed(*ground.stand(place.x_m, place.y_m, place.yaw_rad, self.size_m))


_SAMPLES = 200  # rays to a mesh


class Sight:
    """Everything that can hide something, ready for rays."""

    def __init__(self, blockers: Sequence[Mesh], targets: Sequence[Mesh], samples: int = _SAMPLES) -> None:
        """Everything, in one frame; so many rays go to each target."""
        meshes = [*blockers, *targets]
        whole = merge(meshes)
        self._owner = np.repeat(np.arange(len(meshes)), [len(mesh.triangle) for mesh in meshes])
        self._first = len(blockers)
        # Centres of triangles: a ray to a vertex may miss the surface by a rounding error.
        self._point_m = [
            mesh.vertex_m[mesh.triangle[:: max(1, len(mesh.triangle) // samples)]].mean(axis=1) for mesh in targets
        ]
        self._caster = triangle_caster(whole.vertex_m[whole.triangle])

    def shares(self, eye_m: np.ndarray, some: np.ndarray | None = None) -> np.ndarray:
        """Share of triangles whose middle can be seen from a point, [3], of each target or of some by number."""
        some = np.arange(len(self._point_m)) if some is None else some
        if not len(some):
            return np.zeros(0)
        point = [self._point_m[k] for k in some]
        count = np.array([len(each) for each in point])
        direction = np.ascontiguousarray((np.concatenate(point) - eye_m).astype(np.float32))
        origin = np.ascontiguousarray(np.broadcast_to(eye_m.astype(np.float32), direction.shape))
        hit = self._caster.run(origin, direction, query="INTERSECT")
        row = np.repeat(np.arange(len(count)), count)
        is_seen = (hit >= 0) & (self._owner[np.maximum(hit, 0)] == self._first + some[row])
        return np.bincount(row, is_seen, minlength=len(count)) / count


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
    drawn: list[DrawnVehicle] = []

    def length_of() -> float:
        drawn.append(draw())
        return float(drawn[-1].size_m[0])

    for middle_m, length_m in lane_positions(lane, length_of, rng):
        left_m = float(rng.uniform(-_LATERAL_JITTER_M, _LATERAL_JITTER_M))
        yaw = lane.yaw_rad + float(rng.uniform(-_YAW_JITTER_RAD, _YAW_JITTER_RAD))
        yield drawn[-1], Footprint.at(lane.at(middle_m, left_m), yaw, (length_m, drawn[-1].size_m[1]))


_HEADWAY_S = 1.5  # time in which a driver reaches what is ahead in its lane now, at least
_STREET_KM_H = (30.0, 50.0)
_CAR_PARK_KM_H = (5.0, 15.0)
_CYCLIST_M_S = (4.0, 6.0)
_PEDESTRIAN_M_S = (1.1, 1.7)
_M_S_PER_KM_H = 1.0 / 3.6
_STOP_LINE_M = 1.1  # from the edge of the street with priority


def velocities_m_s(
    users: Sequence[RoadUser], obstacles: Sequence[Footprint], rng: np.random.Generator, *, in_car_park: bool = False
) -> np.ndarray:
    """Random velocities over ground in the town frame [m/s], float64 [user, 2]."""
    limit_m_s = np.multiply(_CAR_PARK_KM_H if in_car_park else _STREET_KM_H, _M_S_PER_KM_H)
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
            near = np.flatnonzero(far_m <= _HEADWAY_S * speed_m_s)
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
            speed_m_s = min(speed_m_s, way_m / _HEADWAY_S)
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
