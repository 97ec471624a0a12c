"""The embedded traffic simulator: a seeded town street around the ego vehicle.

The recipe of a scene: a plan (`town_layout`) on level or sloping ground (`ground`), scenery on it (`houses`), furniture
and road works (`street_life`), vehicles on the plan's spawn slots (`vehicle_shapes`), a check by rays that the traffic
can be seen from the ego vehicle's roof, people (`street_life`), and how fast everybody moves (`motion`). Light is baked
into vertex colours. The same seed gives the same bytes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warpav.raster.mesh import Mesh, merge
from warpav.scene._scene import Scene, Sky, Vehicle
from warpav.scene.town._houses import SceneryBuilder
from warpav.scene.town._placed_vehicle import (
    LONG_KINDS,
    Exchange,
    PlacedVehicle,
    Sight,
    drawn_vehicle,
    stop_lines,
    velocities_m_s,
)
from warpav.scene.town._street_life import Person, RoadUser, furnish, people, upright_box
from warpav.scene.town._surface_builder import StreetGround
from warpav.scene.town._town_layout import SPAWN_REACH_M, Footprint, Layout, Slot, town_layout
from warpav.scene.town._vehicle_shapes import ego_mesh, vehicle_glass

_VISIBLE_COUNT_MIN, _VISIBLE_COUNT_MAX = 5, 15
EYE_HEIGHT_M = 1.8  # traffic must be visible from here, above the centre of the ego vehicle
_TARGET_COUNT = (8, 12)  # vehicles per scene, upper end excluded
_CLEARANCE_M = 0.35  # between any two vehicles
_VISIBLE_SHARE_MIN = 0.04  # of a vehicle's vertices; about half of them face the eye
_BARELY_SEEN_SHARE = 0.16  # people keep out of the way where less of a vehicle can be seen
_FILL_ROUNDS = 4
_SECTOR_COUNT = 8
# Beside the ego vehicle, where its own body hides much of them, only this share of the vehicles that could stand do.
_BESIDE_M, _BESIDE_LONG_M, _BESIDE_SHARE = 2.4, 4.0, 0.08
_KIND_SHARES = {"hatchback": 0.25, "saloon": 0.18, "estate": 0.14, "suv": 0.17, "van": 0.11, "lorry": 0.08, "bus": 0.07}
_LATERAL_JITTER_M, _YAW_JITTER_RAD = 0.10, 0.020
_GRADE_SHARE = 0.4  # of the streets are on a grade
_GRADE_MIN, _GRADE_MAX = 0.02, 0.06
_TOWN_STREAM = 0x70F3  # keeps the town's random numbers apart from other uses of the same seed


class TownWorld(NamedTuple):
    """A scene, and which triangles of every vehicle but the ego vehicle are window panes, bool [triangle]."""

    scene: Scene
    vehicle_glass: tuple[np.ndarray, ...]


def ego_vehicle() -> Mesh:
    """The vehicle that carries the cameras, in its own frame, the same in every scene."""
    return ego_mesh()


def town_scene(seed: int, exchange: Exchange | None = None) -> Scene:
    """A street scene around the ego vehicle with 5 to 15 visible vehicles."""
    return town_world(seed, exchange).scene


def town_world(seed: int, exchange: Exchange | None = None) -> TownWorld:
    """The scene of `town_scene` with what only a simulator knows: `TownWorld.vehicle_glass` without an exchange."""
    if seed < 0:
        raise ValueError(f"seed must be 0 or more, got {seed}")
    for attempt in range(16):
        world = _try_world(seed, attempt, exchange)
        if world is not None:
            return world
    raise RuntimeError(f"no scene with enough visible traffic for seed {seed}")


def _try_world(seed: int, attempt: int, exchange: Exchange | None) -> TownWorld | None:
    rng = np.random.default_rng([_TOWN_STREAM, seed, attempt])
    life_rng = np.random.default_rng([_TOWN_STREAM, seed, attempt, 1])
    layout = town_layout(rng)
    ground = _ground(layout, life_rng)
    ego = ego_vehicle()
    low, high = ego.bounds_m().astype(np.float64)
    # The ego vehicle's centre stands on its slot, on level ground; the ego frame's origin is its rear axle.
    origin = np.array([layout.ego.x_m - 0.5 * (low[0] + high[0]), layout.ego.y_m, 0.0])
    ego_place = Footprint.at(layout.ego_m, 0.0, high - low)

    furnishing = furnish(layout, life_rng, ground)
    scenery = SceneryBuilder(rng, ground)
    scenery.add_plan(layout, furnishing.markings)
    surroundings = [scenery.finish(), *furnishing.meshes, ego.transformed(np.eye(3), origin)]
    eye = np.array([*layout.ego_m, EYE_HEIGHT_M])

    target = int(rng.integers(*_TARGET_COUNT))
    waiting = _ordered_slots(layout, rng)
    taken = (ego_place, *furnishing.footprints)
    placed: list[PlacedVehicle] = []
    share = np.zeros(0)
    for _ in range(_FILL_ROUNDS):
        while waiting and len(placed) < target:
            candidate = _park(waiting.pop(0), rng)
            occupied = (*taken, *(one.footprint for one in placed))
            if not candidate or any(candidate.footprint.nearer(other, _CLEARANCE_M) for other in occupied):
                continue
            beside_m = _BESIDE_LONG_M if candidate.category in LONG_KINDS else _BESIDE_M
            if not candidate.footprint.nearer(ego_place, beside_m) or rng.random() < _BESIDE_SHARE:
                placed.append(candidate)
        count = len(placed)
        share = Sight(surroundings, [one.standing(ground) for one in placed]).shares(eye)
        placed = [one for one, seen in zip(placed, share, strict=True) if seen >= _VISIBLE_SHARE_MIN]
        share = share[share >= _VISIBLE_SHARE_MIN]
        if len(placed) == count and (len(placed) == target or not waiting):
            break
    if not _VISIBLE_COUNT_MIN <= len(placed) <= _VISIBLE_COUNT_MAX:
        return None

    placed = [one.exchanged(exchange, number) for number, one in enumerate(placed, start=1)]
    persons = people(layout, life_rng, ground, (*taken, *(one.footprint for one in placed)))
    barely_seen = [one.footprint for one, seen in zip(placed, share, strict=True) if seen < _BARELY_SEEN_SHARE]
    persons = [person for person in persons if not any(_hides(eye, person.footprint, one) for one in barely_seen)]
    ego_user = RoadUser(category="ego", footprint=ego_place, heading_rad=layout.ego.yaw_rad)
    moving = [ego_user, *placed, *persons]
    for index, one in enumerate(moving):
        scenery.add_shadow(one.footprint, index, one.pavement_share if isinstance(one, Person) else None)
    velocity = velocities_m_s(
        moving,
        [*furnishing.footprints, *stop_lines(layout)],
        np.random.default_rng([_TOWN_STREAM, seed, attempt, 2]),
        in_car_park=layout.template == "car_park",
    )
    users = []
    for number, one in enumerate([*placed, *persons], start=1):
        mesh = one.standing(ground).transformed(np.eye(3), -origin)
        box = upright_box(mesh, one.footprint.yaw_rad)
        users.append(Vehicle(number, one.category, mesh, box, velocity[number] - velocity[0]))
    environment = merge([scenery.finish(), *furnishing.meshes]).transformed(np.eye(3), -origin)
    name, source = f"town_{seed:04d}", f"town seed {seed}"
    vehicles, others = tuple(users[: len(placed)]), tuple(users[len(placed) :])
    return TownWorld(
        Scene(name, environment, ego, vehicles, drawn_sky(rng), source, others),
        tuple(vehicle_glass(one.category, one.variant) for one in placed),
    )


def _ground(layout: Layout, rng: np.random.Generator) -> StreetGround:
    """Level ground, or a crest, a dip or a hill; car parks are level."""
    ahead, behind = rng.uniform(_GRADE_MIN, _GRADE_MAX, 2) * rng.choice([-1.0, 1.0], 2)
    if rng.random() >= _GRADE_SHARE or layout.template == "car_park":
        return StreetGround()
    return StreetGround(layout.ego.x_m, float(ahead), float(behind))


def _hides(eye_m: np.ndarray, one: Footprint, other: Footprint) -> bool:
    """Whether something on the ground may hide part of something else, seen from a point."""
    offset = [footprint.centre_m - eye_m[:2] for footprint in (one, other)]
    distance = [float(np.hypot(*each)) for each in offset]
    bearing = np.arctan2(offset[0][0] * offset[1][1] - offset[0][1] * offset[1][0], offset[0] @ offset[1])
    reach = sum(
        np.arctan(0.5 * np.hypot(footprint.length_m, footprint.width_m) / max(far, 1e-6))
        for footprint, far in zip((one, other), distance, strict=True)
    )
    return bool(distance[0] < distance[1] and abs(bearing) < reach)


def _ordered_slots(layout: Layout, rng: np.random.Generator) -> list[Slot]:
    """Slots near the ego vehicle in an order that goes round it: one of each sector in turn."""
    sectors: list[list[Slot]] = [[] for _ in range(_SECTOR_COUNT)]
    for slot in layout.slots:
        x, y = slot.x_m - layout.ego.x_m, slot.y_m - layout.ego.y_m
        if np.hypot(x, y) <= SPAWN_REACH_M:
            sectors[int((np.arctan2(y, x) / (2.0 * np.pi) + 1.0 + 0.5 / _SECTOR_COUNT) * _SECTOR_COUNT)
                    % _SECTOR_COUNT].append(slot)  # fmt: skip
    shuffled = [[sector[index] for index in rng.permutation(len(sector))] for sector in sectors]
    order: list[Slot] = []
    while any(shuffled):
        for index in rng.permutation(_SECTOR_COUNT):
            if shuffled[index]:
                order.append(shuffled[index].pop())
    return order


def _park(slot: Slot, rng: np.random.Generator) -> PlacedVehicle | None:
    """A random vehicle on a slot, or None if the drawn one is too long for it."""
    drawn = drawn_vehicle(_KIND_SHARES, rng)
    mesh = drawn.mesh()
    across = rng.uniform(-_LATERAL_JITTER_M, _LATERAL_JITTER_M)
    yaw = slot.yaw_rad + rng.uniform(-_YAW_JITTER_RAD, _YAW_JITTER_RAD)
    bounds = mesh.bounds_m().astype(np.float64)
    size = bounds[1] - bounds[0]
    if size[0] > slot.room_m or (slot.parked and drawn.kind in LONG_KINDS):
        return None
    centre = np.array([slot.x_m - np.sin(yaw) * across, slot.y_m + np.cos(yaw) * across])
    return PlacedVehicle(
        category=drawn.kind,
        footprint=Footprint.at(centre, yaw, size),
        heading_rad=None if slot.parked else slot.yaw_rad,
        variant=drawn.variant,
        mesh=mesh,
        size_m=size,
    )


def drawn_sky(rng: np.random.Generator) -> Sky:
    horizon = rng.uniform(0.80, 0.92) * np.array([0.97, 0.99, 1.0])
    zenith = rng.uniform(0.50, 0.72) * np.array([0.72, 0.92, 1.22])
    return Sky(*(np.round(255.0 * np.minimum(colour, 1.0)).astype(np.uint8) for colour in (horizon, zenith)))
