"""The embedded traffic simulator: a seeded town street around the ego vehicle.

The recipe of a scene: a plan (`town_layout`), scenery on it (`houses`), vehicles on the plan's spawn slots
(`vehicle_shapes`), and a check by rays that the traffic can be seen from the ego vehicle's roof. Light is baked into
vertex colours. The same seed gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpav.geometry.mesh import Mesh
from warpav.scene.houses import SceneryBuilder
from warpav.scene.paint import PAINT_COLOURS, PAINT_SHARES
from warpav.scene.scene import Box, Scene, Sky, Vehicle
from warpav.scene.town_layout import SPAWN_REACH_M, Layout, Slot, town_layout
from warpav.scene.vehicle_shapes import VARIANT_COUNT, ego_glass, ego_mesh, vehicle_glass, vehicle_mesh

VISIBLE_COUNT_MIN, VISIBLE_COUNT_MAX = 5, 15
EYE_HEIGHT_M = 1.8  # traffic must be visible from here, above the middle of the ego vehicle
_TARGET_COUNT = (8, 12)  # vehicles per scene, upper end excluded
_CLEARANCE_M = 0.35  # between any two vehicles
_VISIBLE_SHARE_MIN = 0.04  # of a vehicle's vertices; about half of them face the eye
_VISIBILITY_SAMPLES = 200
_FILL_ROUNDS = 4
_SECTOR_COUNT = 8
# Beside the ego vehicle, where its own body hides much of them, only this share of the vehicles that could stand do.
_BESIDE_M, _BESIDE_LONG_M, _BESIDE_SHARE = 2.4, 4.0, 0.08
_LONG_KINDS = ("lorry", "bus")
_KIND_SHARES = (
    ("hatchback", 0.25),
    ("saloon", 0.18),
    ("estate", 0.14),
    ("suv", 0.17),
    ("van", 0.11),
    ("lorry", 0.08),
    ("bus", 0.07),
)
_SCALE_SPREAD = 0.03
_LATERAL_JITTER_M, _YAW_JITTER_RAD = 0.10, 0.020
_TOWN_STREAM = 0x70F3  # keeps the town's random numbers apart from other uses of the same seed


@dataclass(frozen=True)
class TownWorld:
    """A scene and what a simulator knows beyond it.

    Attributes:
        scene: The scene.
        ego_glass: Which triangles of the ego vehicle are window panes, bool [triangle].
        vehicle_glass: The same of every other vehicle.
    """

    scene: Scene
    ego_glass: np.ndarray
    vehicle_glass: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class _Placed:
    """A vehicle in the town frame: its mesh still in the vehicle frame, where it stands, its length and width."""

    kind: str
    variant: int
    mesh: Mesh
    size_m: np.ndarray
    x_m: float
    y_m: float
    yaw_rad: float


def ego_vehicle() -> Mesh:
    """The vehicle that carries the cameras, the same in every scene.

    Ego frame: x forward, y left, z up, metres; origin on the ground below the middle of the rear axle.
    """
    return ego_mesh()


def town_scene(seed: int) -> Scene:
    """A street scene around the ego vehicle with 5 to 15 visible vehicles.

    Args:
        seed: Any integer from 0; the same seed gives the same scene, byte for byte.

    Returns:
        The scene ``town_<seed>`` in the ego frame.

    Raises:
        ValueError: The seed is negative.
    """
    return town_world(seed).scene


def town_world(seed: int) -> TownWorld:
    """The scene of `town_scene` with what only a simulator knows; the same arguments and errors."""
    if seed < 0:
        raise ValueError(f"seed must be 0 or more, got {seed}")
    for attempt in range(16):
        world = _try_world(seed, attempt)
        if world is not None:
            return world
    raise RuntimeError(f"no scene with enough visible traffic for seed {seed}")


def _try_world(seed: int, attempt: int) -> TownWorld | None:
    rng = np.random.default_rng([_TOWN_STREAM, seed, attempt])
    layout = town_layout(rng)
    ego = ego_vehicle()
    ego_bounds = ego.bounds_m()
    # The ego vehicle's middle stands on its slot; the ego frame's origin is its rear axle.
    origin = np.array([layout.ego.x_m - ego_bounds[:, 0].mean(), layout.ego.y_m, 0.0])
    ego_placed = _Placed("ego", 0, ego, ego_bounds[1] - ego_bounds[0], layout.ego.x_m, layout.ego.y_m, 0.0)

    scenery = SceneryBuilder(rng)
    for rectangle in layout.asphalt_m:
        scenery.add_asphalt(rectangle)
    for marking in layout.markings:
        scenery.add_marking(marking)
    for block in layout.blocks:
        scenery.add_block(block)
    surroundings = scenery.finish()

    target = int(rng.integers(*_TARGET_COUNT))
    waiting = _ordered_slots(layout, rng)
    placed: list[_Placed] = []
    for _ in range(_FILL_ROUNDS):
        while waiting and len(placed) < target:
            candidate = _park(waiting.pop(0), rng)
            if not candidate or any(_nearer(candidate, other, _CLEARANCE_M) for other in (ego_placed, *placed)):
                continue
            beside_m = _BESIDE_LONG_M if candidate.kind in _LONG_KINDS else _BESIDE_M
            if not _nearer(candidate, ego_placed, beside_m) or rng.random() < _BESIDE_SHARE:
                placed.append(candidate)
        meshes = [_standing(one) for one in placed]
        eye = np.array([layout.ego.x_m, layout.ego.y_m, EYE_HEIGHT_M])
        blockers = [surroundings, ego.transformed(np.eye(3), origin)]
        share = visible_shares(eye, blockers, meshes)
        placed = [one for one, seen in zip(placed, share, strict=True) if seen >= _VISIBLE_SHARE_MIN]
        if len(placed) == len(meshes) and (len(placed) == target or not waiting):
            break
    if not VISIBLE_COUNT_MIN <= len(placed) <= VISIBLE_COUNT_MAX:
        return None

    for index, one in enumerate((ego_placed, *placed)):
        width = one.size_m[1] - 0.25  # without mirrors
        scenery.add_contact_shadow(np.array([one.x_m, one.y_m]), one.yaw_rad, one.size_m[0], width, index)
    vehicles = tuple(
        Vehicle(
            number,
            one.kind,
            _standing(one).transformed(np.eye(3), -origin),
            Box(np.array([one.x_m, one.y_m, 0.5 * one.size_m[2]]) - origin, one.size_m, one.yaw_rad),
        )
        for number, one in enumerate(placed, start=1)
    )
    environment = scenery.finish().transformed(np.eye(3), -origin)
    return TownWorld(
        Scene(f"town_{seed:04d}", environment, ego, vehicles, _sky(rng), f"town seed {seed}"),
        ego_glass(),
        tuple(vehicle_glass(one.kind, one.variant) for one in placed),
    )


def visible_shares(eye_m: np.ndarray, blockers: Sequence[Mesh], vehicles: Sequence[Mesh]) -> np.ndarray:
    """Share of each vehicle's vertices that can be seen from a point, 0..1, shape [vehicle].

    Args:
        eye_m: The point [m], shape [3].
        blockers: What else can hide a vehicle.
        vehicles: The vehicles, which hide one another and themselves.
    """
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    meshes = [*blockers, *vehicles]
    corners = np.concatenate([mesh.vertex_m[mesh.triangle] for mesh in meshes])
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.triangle) for mesh in meshes])
    caster = EmbreeScene()
    TriangleMesh(caster, corners)
    share = np.zeros(len(vehicles))
    for index, mesh in enumerate(vehicles):
        # Centres of triangles: a ray to a vertex may miss the surface by a rounding error.
        step = max(1, len(mesh.triangle) // _VISIBILITY_SAMPLES)
        target = mesh.vertex_m[mesh.triangle[::step]].mean(axis=1)
        direction = (target - eye_m).astype(np.float32)
        origin = np.broadcast_to(eye_m.astype(np.float32), direction.shape)
        hit = caster.run(np.ascontiguousarray(origin), direction, query="INTERSECT")
        share[index] = np.mean((hit >= 0) & (owner[np.maximum(hit, 0)] == len(blockers) + index))
    return share


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


def _park(slot: Slot, rng: np.random.Generator) -> _Placed | None:
    """A random vehicle on a slot, or None if the drawn one is too long for it."""
    kinds, shares = zip(*_KIND_SHARES, strict=True)
    kind = kinds[int(rng.choice(len(kinds), p=shares))]
    paint = PAINT_COLOURS[int(rng.choice(len(PAINT_COLOURS), p=PAINT_SHARES))] * rng.uniform(0.9, 1.1)
    scale = 1.0 + rng.uniform(-_SCALE_SPREAD, _SCALE_SPREAD, 3)
    variant = int(rng.integers(VARIANT_COUNT))
    mesh = vehicle_mesh(kind, paint, variant=variant, scale=scale)
    across = rng.uniform(-_LATERAL_JITTER_M, _LATERAL_JITTER_M)
    yaw = slot.yaw_rad + rng.uniform(-_YAW_JITTER_RAD, _YAW_JITTER_RAD)
    bounds = mesh.bounds_m().astype(np.float64)
    size = bounds[1] - bounds[0]
    if size[0] > slot.room_m or (slot.parked and kind in _LONG_KINDS):
        return None
    x, y = slot.x_m - np.sin(yaw) * across, slot.y_m + np.cos(yaw) * across
    return _Placed(kind, variant, mesh, size, float(x), float(y), float(np.arctan2(np.sin(yaw), np.cos(yaw))))


def _standing(placed: _Placed) -> Mesh:
    """The vehicle's mesh in the town frame."""
    c, s = np.cos(placed.yaw_rad), np.sin(placed.yaw_rad)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return placed.mesh.transformed(rotation, np.array([placed.x_m, placed.y_m, 0.0]))


def _nearer(one: _Placed, other: _Placed, gap_m: float) -> bool:
    """Whether two vehicles come nearer than a gap: no axis of either rectangle separates them by it."""
    offset = np.array([other.x_m - one.x_m, other.y_m - one.y_m])
    for yaw in (one.yaw_rad, other.yaw_rad):
        for axis in (np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])):
            reach = sum(
                0.5 * abs(axis @ direction) * extent
                for vehicle in (one, other)
                for direction, extent in (
                    (np.array([np.cos(vehicle.yaw_rad), np.sin(vehicle.yaw_rad)]), vehicle.size_m[0]),
                    (np.array([-np.sin(vehicle.yaw_rad), np.cos(vehicle.yaw_rad)]), vehicle.size_m[1]),
                )
            )
            if abs(axis @ offset) > reach + gap_m:
                return False
    return True


def _sky(rng: np.random.Generator) -> Sky:
    horizon = rng.uniform(0.80, 0.92) * np.array([0.97, 0.99, 1.0])
    zenith = rng.uniform(0.50, 0.72) * np.array([0.72, 0.92, 1.22])
    return Sky(*(np.round(255.0 * np.minimum(colour, 1.0)).astype(np.uint8) for colour in (horizon, zenith)))
