"""The embedded traffic simulator: a seeded town street around the ego vehicle.

The recipe of a scene: a plan (`town_layout`) on level or sloping ground (`ground`), scenery on it (`houses`), furniture
and road works (`street_life`), vehicles on the plan's spawn slots (`vehicle_shapes`), a check by rays that the traffic
can be seen from the ego vehicle's roof, people (`street_life`), and how fast everybody moves (`motion`). Light is baked
into vertex colours. The same seed gives the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warpav.raster.mesh import Mesh, merge
from warpav.scene.scene import Scene, Sky, Vehicle
from warpav.scene.town.houses import SceneryBuilder
from warpav.scene.town.lanes import RoadUser, velocities_m_s
from warpav.scene.town.placed_vehicle import LONG_KINDS, Exchange, PlacedVehicle, drawn_vehicle, visible_shares
from warpav.scene.town.street_life import Footprint, furnish, people, upright_box
from warpav.scene.town.surface_builder import StreetGround
from warpav.scene.town.town_layout import SPAWN_REACH_M, Layout, Slot, town_layout
from warpav.scene.town.vehicle_shapes import ego_glass, ego_mesh, vehicle_glass

VISIBLE_COUNT_MIN, VISIBLE_COUNT_MAX = 5, 15
EYE_HEIGHT_M = 1.8  # traffic must be visible from here, above the centre of the ego vehicle
_TARGET_COUNT = (8, 12)  # vehicles per scene, upper end excluded
_CLEARANCE_M = 0.35  # between any two vehicles
_VISIBLE_SHARE_MIN = 0.04  # of a vehicle's vertices; about half of them face the eye
_BARELY_SEEN_SHARE = 0.16  # people keep out of the way where less of a vehicle can be seen
_FILL_ROUNDS = 4
_SECTOR_COUNT = 8
# Beside the ego vehicle, where its own body hides much of them, only this share of the vehicles that could stand do.
_BESIDE_M, _BESIDE_LONG_M, _BESIDE_SHARE = 2.4, 4.0, 0.08
_KIND_SHARES = {
    "hatchback": 0.25,
    "saloon": 0.18,
    "estate": 0.14,
    "suv": 0.17,
    "van": 0.11,
    "lorry": 0.08,
    "bus": 0.07,
}
_LATERAL_JITTER_M, _YAW_JITTER_RAD = 0.10, 0.020
_GRADE_SHARE = 0.4  # of the streets are on a grade
_GRADE_MIN, _GRADE_MAX = 0.02, 0.06
_TOWN_STREAM = 0x70F3  # keeps the town's random numbers apart from other uses of the same seed


@dataclass(frozen=True)
class TownWorld:
    """A scene and what a simulator knows beyond it."""

    scene: Scene  # the scene
    ego_glass: np.ndarray  # which triangles of the ego vehicle are window panes, bool [triangle]
    vehicle_glass: tuple[np.ndarray, ...]  # the same of every other vehicle


def ego_vehicle() -> Mesh:
    """The vehicle that carries the cameras, the same in every scene.

    Ego frame: x forward, y left, z up, metres; origin on the ground below the centre of the rear axle.
    """
    return ego_mesh()


def town_scene(seed: int, exchange: Exchange | None = None) -> Scene:
    """A street scene around the ego vehicle with 5 to 15 visible vehicles."""
    return _world(seed, exchange).scene


def town_world(seed: int) -> TownWorld:
    """The scene of `town_scene` with what only a simulator knows; the same errors."""
    return _world(seed, None)


def _world(seed: int, exchange: Exchange | None) -> TownWorld:
    """The world, in which `TownWorld.vehicle_glass` knows nothing of an exchange."""
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
    ego_footprint = Footprint(layout.ego.x_m, layout.ego.y_m, 0.0, high[0] - low[0], high[1] - low[1])

    furnishing = furnish(layout, life_rng, ground)
    scenery = SceneryBuilder(rng, ground)
    for rectangle in layout.asphalt_m:
        scenery.add_asphalt(rectangle)
    for marking in (*layout.markings, *furnishing.markings):
        scenery.add_marking(marking)
    for block in layout.blocks:
        scenery.add_block(block)
    surroundings = [scenery.finish(), *furnishing.meshes, ego.transformed(np.eye(3), origin)]
    eye = np.array([layout.ego.x_m, layout.ego.y_m, EYE_HEIGHT_M])

    target = int(rng.integers(*_TARGET_COUNT))
    waiting = _ordered_slots(layout, rng)
    taken = (ego_footprint, *furnishing.footprints)
    placed: list[PlacedVehicle] = []
    share = np.zeros(0)
    for _ in range(_FILL_ROUNDS):
        while waiting and len(placed) < target:
            candidate = _park(waiting.pop(0), rng)
            occupied = (*taken, *(one.footprint for one in placed))
            if not candidate or any(candidate.footprint.nearer(other, _CLEARANCE_M) for other in occupied):
                continue
            beside_m = _BESIDE_LONG_M if candidate.kind in LONG_KINDS else _BESIDE_M
            if not candidate.footprint.nearer(ego_footprint, beside_m) or rng.random() < _BESIDE_SHARE:
                placed.append(candidate)
        count = len(placed)
        share = visible_shares(eye, surroundings, [one.standing(ground) for one in placed])
        placed = [one for one, seen in zip(placed, share, strict=True) if seen >= _VISIBLE_SHARE_MIN]
        share = share[share >= _VISIBLE_SHARE_MIN]
        if len(placed) == count and (len(placed) == target or not waiting):
            break
    if not VISIBLE_COUNT_MIN <= len(placed) <= VISIBLE_COUNT_MAX:
        return None

    placed = [one.exchanged(exchange, number) for number, one in enumerate(placed, start=1)]
    meshes = [one.standing(ground) for one in placed]
    persons = people(layout, life_rng, ground, (*taken, *(one.footprint for one in placed)), layout.slots)
    barely_seen = [one.footprint for one, seen in zip(placed, share, strict=True) if seen < _BARELY_SEEN_SHARE]
    persons = [person for person in persons if not any(_hides(eye, person.footprint, one) for one in barely_seen)]
    for index, one in enumerate((ego_footprint, *(one.footprint for one in placed))):
        width = one.width_m - 0.25  # without mirrors
        scenery.add_contact_shadow(np.array([one.x_m, one.y_m]), one.yaw_rad, one.length_m, width, index)
    for index, person in enumerate(persons, start=len(placed) + 1):
        place = person.footprint
        size = (place.length_m, place.width_m)
        scenery.add_foot_shadow(np.array([place.x_m, place.y_m]), place.yaw_rad, size, index, person.pavement_share)
    vehicles = []
    for number, (one, mesh) in enumerate(zip(placed, meshes, strict=True), start=1):
        in_ego_frame = mesh.transformed(np.eye(3), -origin)
        vehicles.append(Vehicle(number, one.kind, in_ego_frame, upright_box(in_ego_frame, one.footprint.yaw_rad)))
    others = [person.road_user(number, origin) for number, person in enumerate(persons, start=len(placed) + 1)]
    motion_rng = np.random.default_rng([_TOWN_STREAM, seed, attempt, 2])
    moving = [
        RoadUser("ego", ego_footprint, layout.ego.yaw_rad),
        *(RoadUser(one.kind, one.footprint, one.lane_yaw_rad) for one in placed),
        *(RoadUser(person.category, person.footprint, person.footprint.yaw_rad) for person in persons),
    ]
    velocity = velocities_m_s(moving, furnishing.footprints, layout, motion_rng)
    users = tuple(
        replace(user, velocity_ego_m_s=each)
        for user, each in zip([*vehicles, *others], velocity[1:] - velocity[0], strict=True)
    )
    environment = merge([scenery.finish(), *furnishing.meshes]).transformed(np.eye(3), -origin)
    name, source = f"town_{seed:04d}", f"town seed {seed}"
    return TownWorld(
        Scene(name, environment, ego, users[: len(vehicles)], drawn_sky(rng), source, users[len(vehicles) :]),
        ego_glass(),
        tuple(vehicle_glass(one.kind, one.variant) for one in placed),
    )


def _ground(layout: Layout, rng: np.random.Generator) -> StreetGround:
    """Level ground, or a crest, a dip or a hill; car parks are level."""
    ahead, behind = rng.uniform(_GRADE_MIN, _GRADE_MAX, 2) * rng.choice([-1.0, 1.0], 2)
    if rng.random() >= _GRADE_SHARE or layout.template == "car_park":
        return StreetGround()
    return StreetGround(layout.ego.x_m, float(ahead), float(behind))


def _hides(eye_m: np.ndarray, one: Footprint, other: Footprint) -> bool:
    """Whether something on the ground may hide part of something else, seen from a point."""
    offset = [np.array([footprint.x_m - eye_m[0], footprint.y_m - eye_m[1]]) for footprint in (one, other)]
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
    x, y = slot.x_m - np.sin(yaw) * across, slot.y_m + np.cos(yaw) * across
    yaw = float(np.arctan2(np.sin(yaw), np.cos(yaw)))
    footprint = Footprint(float(x), float(y), yaw, float(size[0]), float(size[1]))
    return PlacedVehicle(drawn.kind, drawn.variant, mesh, size, footprint, None if slot.parked else slot.yaw_rad)


def drawn_sky(rng: np.random.Generator) -> Sky:
    """A random overcast or blue sky."""
    horizon = rng.uniform(0.80, 0.92) * np.array([0.97, 0.99, 1.0])
    zenith = rng.uniform(0.50, 0.72) * np.array([0.72, 0.92, 1.22])
    return Sky(*(np.round(255.0 * np.minimum(colour, 1.0)).astype(np.uint8) for colour in (horizon, zenith)))
