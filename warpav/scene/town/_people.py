"""People on foot, on bicycles and on motorcycles: closed shells of limbs, torso, head and clothes.

Frame: x forward, y left, z up, metres; the origin lies on the ground below the person or the bicycle's centre. A person
is 1.75 m tall before it is scaled.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from warpav.raster.mesh import Mesh
from warpav.scene.town._paint import Material, painted_mesh, sky_share
from warpav.scene.town._surface_builder import Point, Surface, SurfaceBuilder

_THIGH_M, _SHIN_M = 0.435, 0.425
_UPPER_ARM_M, _FOREARM_M = 0.29, 0.26
_WHEEL_RADIUS_M, _WHEEL_SEGMENTS = 0.335, 13
_REAR_HUB, _FRONT_HUB = (-0.53, 0.0, _WHEEL_RADIUS_M), (0.53, 0.0, _WHEEL_RADIUS_M)
_CRANK, _SADDLE, _HEAD_TUBE = (-0.09, 0.0, 0.30), (-0.25, 0.0, 0.90), (0.38, 0.0, 0.84)


def _add_rod(builder: SurfaceBuilder, start: Point, end: Point, radius: float, material: int) -> None:
    builder.add_tube([start, end], radius, material, sides=4, cap=0.0)


def _add_ball(builder: SurfaceBuilder, centre: Point, radii: Point, material: int, *, sides: int = 7) -> None:
    """An upright ellipsoid."""
    polar = np.radians([145.0, 100.0, 60.0, 28.0])
    ring = np.array(centre) + np.array([0.0, 0.0, 1.0]) * radii[2] * np.cos(polar)[:, None]
    radius = np.sin(polar)[:, None] * np.array(radii[:2])
    builder.add_tube(ring, radius, material, sides=sides, cap=0.35)


def _knee(hip: Point, ankle: Point) -> Point:
    """Where a leg bends, forwards, between hip and ankle."""
    hip_m, ankle_m = np.array(hip), np.array(ankle)
    span = ankle_m - hip_m
    distance = min(float(np.linalg.norm(span)), 0.999 * (_THIGH_M + _SHIN_M))
    along = (distance**2 + _THIGH_M**2 - _SHIN_M**2) / (2.0 * distance)
    forward = np.cross(np.array([0.0, -1.0, 0.0]), span)
    forward /= -np.linalg.norm(forward) if forward[0] < 0.0 else np.linalg.norm(forward)
    knee = hip_m + span / np.linalg.norm(span) * along + forward * np.sqrt(max(_THIGH_M**2 - along**2, 0.0))
    return (float(knee[0]), float(knee[1]), float(knee[2]))


def _add_leg(builder: SurfaceBuilder, hip: Point, ankle: Point, foot_pitch_rad: float) -> None:
    builder.add_tube((hip, _knee(hip, ankle), ankle), (0.088, 0.062, 0.046), Material.LEGWEAR, sides=6)
    along = np.array([np.cos(foot_pitch_rad), 0.0, -np.sin(foot_pitch_rad)])
    down = np.array([np.sin(foot_pitch_rad), 0.0, np.cos(foot_pitch_rad)])
    sole = np.array(ankle) - 0.045 * down
    path = sole + np.array([-0.055, 0.03, 0.13, 0.17])[:, None] * along
    radius = np.array([[0.042, 0.036], [0.046, 0.042], [0.034, 0.045], [0.026, 0.034]])
    builder.add_tube(path - np.array([[0.0], [0.0], [0.010], [0.018]]) * down, radius, Material.SHOE, sides=5)


def _add_arm(builder: SurfaceBuilder, shoulder: Point, elbow: Point, wrist: Point) -> None:
    builder.add_tube((shoulder, elbow, wrist), (0.058, 0.046, 0.036), Material.TOP, sides=6)
    reach = np.array(wrist) - np.array(elbow)
    reach /= np.linalg.norm(reach)
    hand = np.array(wrist) + np.array([0.01, 0.06, 0.10])[:, None] * reach
    builder.add_tube(hand, np.array([[0.030, 0.026], [0.042, 0.028], [0.026, 0.020]]), Material.SKIN, sides=4)


def _add_head(builder: SurfaceBuilder, centre: Point, *, helmet: bool) -> None:
    x, y, z = centre
    _add_rod(builder, (x - 0.03, y, z - 0.20), (x - 0.01, y, z - 0.06), 0.052, Material.SKIN)
    _add_ball(builder, centre, (0.098, 0.078, 0.122), Material.SKIN)
    if helmet:
        _add_ball(builder, (x - 0.012, y, z + 0.055), (0.132, 0.100, 0.092), Material.HELMET)
    else:
        _add_ball(builder, (x - 0.027, y, z + 0.028), (0.096, 0.086, 0.108), Material.HAIR)


def _pedestrian_surface(builder: SurfaceBuilder, variant: int) -> Surface:
    stands, coat = variant == 2, variant == 3
    mirror = -1.0 if variant in (1, 4) else 1.0  # which leg leads
    stride, hip_z = (0.02, 0.915) if stands else (0.27, 0.885)
    for side in (-1.0, 1.0):
        leads = side * mirror > 0.0
        hip = (0.0, 0.085 * side, hip_z)
        if leads or stands:
            _add_leg(builder, hip, (stride * mirror * side, 0.085 * side, 0.095), -0.12 if not stands else 0.0)
        else:
            _add_leg(builder, hip, (-stride, 0.085 * side, 0.155), 0.55)
        swing = 0.02 if stands else (-0.42 if leads else 0.36)
        shoulder = (0.0, 0.172 * side, 1.395)
        elbow = np.array(shoulder) + _UPPER_ARM_M * np.array([np.sin(swing), 0.14 * side, -np.cos(swing)])
        bend = swing + 0.35
        wrist = elbow + _FOREARM_M * np.array([np.sin(bend), -0.02 * side, -np.cos(bend)])
        _add_arm(builder, shoulder, tuple(elbow.tolist()), tuple(wrist.tolist()))
    # Height, depth, half width: from the hem (of a coat, or of a jacket) to the neck.
    hem = ((0.60, 0.165, 0.205), (0.78, 0.150, 0.185)) if coat else ((0.79, 0.075, 0.110), (0.85, 0.118, 0.155))
    rows = np.array(
        [*hem, (0.95, 0.122, 0.168), (1.06, 0.108, 0.148), (1.22, 0.128, 0.172), (1.36, 0.118, 0.194),
         (1.43, 0.095, 0.178), (1.475, 0.062, 0.080)]
    )  # fmt: skip
    lean = 0.0 if stands else 0.03
    centre = np.stack([lean * (rows[:, 0] - 0.9), 0.0 * rows[:, 0], rows[:, 0]], axis=1)
    material = np.full(len(rows) + 1, Material.TOP)
    if not coat:
        material[:3] = Material.LEGWEAR
    builder.add_tube(centre, rows[:, 1:], material, sides=10, cap=0.2)
    _add_head(builder, (0.03 if not stands else 0.01, 0.0, 1.625), helmet=False)
    if variant == 4:
        bag = np.array([(-0.20, 0.0, 0.98), (-0.215, 0.0, 1.08), (-0.205, 0.0, 1.30), (-0.17, 0.0, 1.42)])
        radius = np.array([[0.06, 0.12], [0.095, 0.15], [0.085, 0.145], [0.05, 0.10]])
        builder.add_tube(bag, radius, Material.BAG, sides=8, cap=0.3)
    if variant == 5:
        builder.add_box((-0.16, -0.315, 0.46), (0.20, -0.225, 0.76), Material.BAG)
    return builder.finish()


def _tyre(hub: Point, wheel_radius: float, tyre_radius: float) -> np.ndarray:
    """A ring about a y axis, as a grid of points."""
    around = np.linspace(0.0, 2.0 * np.pi, _WHEEL_SEGMENTS + 1)[:, None]
    around[-1] = 0.0
    section = np.linspace(0.0, 2.0 * np.pi, 4)[None, :]
    section[0, -1] = 0.0
    radius = wheel_radius - tyre_radius + tyre_radius * np.cos(section)
    y = tyre_radius * np.sin(section) + 0.0 * around
    return np.stack([hub[0] + radius * np.cos(around), y, hub[2] + radius * np.sin(around)], axis=-1)


def _add_bicycle(builder: SurfaceBuilder, bar: Point) -> None:
    for hub in (_REAR_HUB, _FRONT_HUB):
        builder.add_grid(_tyre(hub, _WHEEL_RADIUS_M, 0.024), Material.TYRE)
    for start, end, radius in (
        (_CRANK, _SADDLE, 0.020),
        (_CRANK, _HEAD_TUBE, 0.024),
        ((-0.215, 0.0, 0.78), _HEAD_TUBE, 0.020),
        (_CRANK, _REAR_HUB, 0.015),
        (bar, _FRONT_HUB, 0.019),
    ):
        _add_rod(builder, start, end, radius, Material.PAINT)
    x, _, z = bar
    _add_rod(builder, (x, -0.28, z), (x, 0.28, z), 0.016, Material.DARK)
    builder.add_box((_SADDLE[0] - 0.14, -0.07, _SADDLE[2]), (_SADDLE[0] + 0.12, 0.07, _SADDLE[2] + 0.05), Material.DARK)
    builder.add_box((_CRANK[0] - 0.19, -0.15, 0.285), (_CRANK[0] + 0.19, 0.15, 0.315), Material.DARK)
    builder.add_box((-0.60, -0.035, 0.66), (-0.56, 0.035, 0.72), Material.TAIL_LAMP)


def _cyclist_surface(builder: SurfaceBuilder, variant: int) -> Surface:
    upright = variant == 0
    bar = (0.33, 0.0, 1.05) if upright else (0.36, 0.0, 0.98)
    _add_bicycle(builder, bar)
    hip = np.array([-0.23, 0.0, 0.97])
    shoulder = np.array([0.02, 0.0, 1.46]) if upright else np.array([0.12, 0.0, 1.38])
    for side in (-1.0, 1.0):
        ankle = (_CRANK[0] + 0.17 * side - 0.04, 0.115 * side, 0.40)
        _add_leg(builder, (float(hip[0]), 0.085 * side, float(hip[2])), ankle, 0.12)
        joint = (float(shoulder[0]), 0.172 * side, float(shoulder[2]) - 0.045)
        wrist = (bar[0] - 0.07, 0.235 * side, bar[2] + 0.045)
        elbow = (0.5 * (joint[0] + wrist[0]) - 0.03, 0.275 * side, 0.5 * (joint[2] + wrist[2]) - 0.06)
        _add_arm(builder, joint, elbow, wrist)
    share = np.array([-0.16, 0.02, 0.25, 0.55, 0.85, 1.0, 1.07])[:, None]
    radius = np.array([[0.08, 0.12], [0.125, 0.165], [0.110, 0.150], [0.125, 0.170], [0.112, 0.182], [0.085, 0.145],
                       [0.055, 0.07]])  # fmt: skip
    material = np.full(len(radius) + 1, Material.TOP)
    material[:2] = Material.LEGWEAR
    builder.add_tube(hip + share * (shoulder - hip), radius, material, sides=8, cap=0.2)
    head = (float(shoulder[0]) + 0.07, 0.0, float(shoulder[2]) + 0.185)
    _add_head(builder, head, helmet=upright)
    return builder.finish()


def _add_motorcycle(builder: SurfaceBuilder, bar: Point, *, scooter: bool) -> None:
    radius, tyre = (0.25, 0.055) if scooter else (0.30, 0.06)
    rear, front = (-0.62, 0.0, radius), (0.70, 0.0, radius)
    for hub in (rear, front):
        builder.add_grid(_tyre(hub, radius, tyre)[::-1], Material.TYRE)
        x, _, z = hub
        builder.add_tube([(x, -0.07, z), (x, 0.07, z)], 0.6 * radius, Material.RIM, sides=10)
    crown = (bar[0] + 0.08, 0.0, bar[2] - 0.06)
    for side in (-0.075, 0.075):
        _add_rod(builder, (crown[0], side, crown[2]), (front[0], side, front[2]), 0.026, Material.METAL)
    x, _, z = bar
    _add_rod(builder, (x, -0.34, z), (x, 0.34, z), 0.018, Material.DARK)
    builder.add_ellipsoid_pair((x + 0.12, 0.36, z + 0.13), (0.03, 0.07, 0.05), Material.BLACK_PLASTIC)
    for side in (-1.0, 1.0):
        _add_rod(builder, (x, 0.30 * side, z), (x + 0.11, 0.34 * side, z + 0.11), 0.010, Material.DARK)
    lamp = (crown[0] + 0.06, 0.0, crown[2] - 0.04)
    builder.add_tube([lamp, (lamp[0] + 0.09, 0.0, lamp[2])], 0.085, Material.HEADLAMP, sides=8)
    builder.add_box((-0.68, -0.13, 0.70), (0.02, 0.13, 0.79), Material.DARK)  # the seat
    builder.add_box((-0.98, -0.09, 0.50), (-0.94, 0.09, 0.62), Material.REAR_PLATE)
    builder.add_box((-0.97, -0.11, 0.64), (-0.92, 0.11, 0.71), Material.TAIL_LAMP)
    tail = np.array([(-0.95, 0.0, 0.64), (-0.55, 0.0, 0.60), (-0.10, 0.0, 0.56 if scooter else 0.62)])
    builder.add_tube(tail, np.array([[0.07, 0.10], [0.15, 0.17], [0.16, 0.17]]), Material.PAINT, sides=8, cap=0.2)
    if scooter:
        builder.add_box((-0.25, -0.20, 0.24), (0.42, 0.20, 0.32), Material.PAINT)
        shield = np.array([(0.44, 0.0, 0.26), (0.47, 0.0, 0.60), (crown[0] - 0.02, 0.0, crown[2])])
        builder.add_tube(shield, np.array([[0.06, 0.21], [0.07, 0.23], [0.07, 0.14]]), Material.PAINT, sides=8, cap=0.2)
        builder.add_tube([(-0.62, -0.13, 0.32), (-0.62, 0.13, 0.32)], 0.20, Material.DARK, sides=8)
        return
    tank = np.array([(-0.12, 0.0, 0.78), (0.10, 0.0, 0.82), (0.34, 0.0, 0.84), (0.46, 0.0, 0.80)])
    builder.add_tube(tank, np.array([[0.06, 0.09], [0.13, 0.16], [0.12, 0.15], [0.05, 0.07]]), Material.PAINT, sides=8)
    builder.add_box((-0.22, -0.13, 0.24), (0.26, 0.13, 0.70), Material.CARGO_FRAME)  # the engine
    _add_rod(builder, (0.30, -0.16, 0.30), (-0.70, -0.18, 0.36), 0.045, Material.CHROME)
    builder.add_box((-0.62, -0.06, 0.27), (-0.18, 0.06, 0.36), Material.DARK)
    guard = np.array([(front[0] - 0.22, 0.0, 0.55), (front[0], 0.0, 0.64), (front[0] + 0.20, 0.0, 0.56)])
    builder.add_tube(guard, np.array([[0.02, 0.06], [0.025, 0.07], [0.02, 0.06]]), Material.PAINT, sides=6)


def _motorcyclist_surface(builder: SurfaceBuilder, variant: int) -> Surface:
    scooter = variant == 1
    bar = (0.36, 0.0, 1.02) if scooter else (0.34, 0.0, 1.04)
    _add_motorcycle(builder, bar, scooter=scooter)
    hip = np.array([-0.28, 0.0, 0.86])
    shoulder = np.array([-0.16, 0.0, 1.37]) if scooter else np.array([-0.06, 0.0, 1.35])
    for side in (-1.0, 1.0):
        ankle = (0.20, 0.11 * side, 0.39) if scooter else (-0.02, 0.19 * side, 0.33)
        _add_leg(builder, (float(hip[0]), 0.10 * side, float(hip[2])), ankle, 0.05)
        joint = (float(shoulder[0]), 0.182 * side, float(shoulder[2]) - 0.045)
        wrist = (bar[0] - 0.07, 0.27 * side, bar[2] + 0.045)
        elbow = (0.5 * (joint[0] + wrist[0]) - 0.03, 0.30 * side, 0.5 * (joint[2] + wrist[2]) - 0.07)
        _add_arm(builder, joint, elbow, wrist)
    share = np.array([-0.14, 0.02, 0.25, 0.55, 0.85, 1.0, 1.07])[:, None]
    radius = np.array([[0.09, 0.14], [0.135, 0.175], [0.120, 0.160], [0.130, 0.180], [0.118, 0.190], [0.09, 0.150],
                       [0.055, 0.07]])  # fmt: skip
    material = np.full(len(radius) + 1, Material.TOP)
    material[:2] = Material.LEGWEAR
    builder.add_tube(hip + share * (shoulder - hip), radius, material, sides=8, cap=0.2)
    head = (float(shoulder[0]) + 0.05, 0.0, float(shoulder[2]) + 0.19)
    _add_rod(
        builder, (head[0] - 0.03, 0.0, head[2] - 0.20), (head[0] - 0.01, 0.0, head[2] - 0.06), 0.052, Material.SKIN
    )
    _add_ball(builder, (head[0] - 0.01, 0.0, head[2] + 0.02), (0.145, 0.120, 0.155), Material.HELMET)
    builder.add_box((head[0] + 0.06, -0.085, head[2] - 0.03), (head[0] + 0.13, 0.085, head[2] + 0.05), Material.GLASS)
    return builder.finish()


_SURFACES = {
    "pedestrian": (_pedestrian_surface, 6),  # two steps, standing, a coat, a rucksack, a hand bag
    "cyclist": (_cyclist_surface, 2),  # upright with a helmet, and leaning forward
    "motorcyclist": (_motorcyclist_surface, 2),  # on a motorcycle, and on a scooter
}


class _CoarseBuilder(SurfaceBuilder):
    """Tubes with about half of their sides, for people far away."""

    def add_tube(
        self, centre_m: ArrayLike, radius_m: ArrayLike, material: np.ndarray | int, *, sides: int, cap: float = 0.45
    ) -> None:
        super().add_tube(centre_m, radius_m, material, sides=max(3, sides // 2 + 1), cap=cap)


@cache
def _baked(category: str, variant: int, coarse: bool) -> tuple[Surface, np.ndarray]:
    surface = _SURFACES[category][0](_CoarseBuilder() if coarse else SurfaceBuilder(), variant)
    surface = replace(surface, vertex_m=surface.vertex_m - [0.0, 0.0, surface.vertex_m[:, 2].min()])
    return surface, sky_share(surface)


# Linear albedos.
_SKIN_COLOURS = np.array([(0.62, 0.38, 0.27), (0.50, 0.28, 0.18), (0.27, 0.13, 0.075), (0.14, 0.065, 0.038)])
_HAIR_COLOURS = np.array([(0.020, 0.014, 0.010), (0.07, 0.035, 0.016), (0.26, 0.16, 0.06), (0.30, 0.30, 0.30)])
_TOP_COLOURS = np.array(
    [(0.03, 0.035, 0.05), (0.42, 0.04, 0.04), (0.05, 0.10, 0.30), (0.60, 0.60, 0.58), (0.06, 0.16, 0.08),
     (0.55, 0.36, 0.05), (0.24, 0.25, 0.27), (0.32, 0.10, 0.22), (0.14, 0.30, 0.38)]
)  # fmt: skip
_LEGWEAR_COLOURS = np.array([(0.025, 0.026, 0.032), (0.045, 0.075, 0.16), (0.16, 0.14, 0.11), (0.09, 0.09, 0.095)])
_HELMET_COLOURS = np.array([(0.75, 0.75, 0.75), (0.04, 0.04, 0.045), (0.55, 0.05, 0.04)])


def person_mesh(
    category: str, rng: np.random.Generator, *, height_m: float | None = None, coarse: bool = False
) -> Mesh:
    """A random person with the light baked in."""
    if category not in _SURFACES:
        raise ValueError(f"no person {category!r}; categories: {', '.join(_SURFACES)}")
    variant = int(rng.integers(_SURFACES[category][1]))
    surface, sky = _baked(category, variant, coarse)

    def drawn(colours: np.ndarray) -> np.ndarray:
        return colours[int(rng.integers(len(colours)))] * rng.uniform(0.85, 1.15)

    albedo = {
        Material.SKIN: drawn(_SKIN_COLOURS),
        Material.HAIR: drawn(_HAIR_COLOURS),
        Material.TOP: drawn(_TOP_COLOURS),
        Material.LEGWEAR: drawn(_LEGWEAR_COLOURS),
        Material.BAG: drawn(_TOP_COLOURS) * 0.6,
        Material.HELMET: drawn(_HELMET_COLOURS),
        Material.PAINT: drawn(_TOP_COLOURS),
    }
    tall = rng.uniform(0.92, 1.08)
    wide = tall * rng.uniform(0.95, 1.12)
    if category == "pedestrian" and rng.random() < 1.0 / 7.0:
        tall, wide = 0.72 * tall, 0.76 * wide
    if category != "pedestrian":
        tall, wide = 0.97 + 0.4 * (tall - 1.0), 1.0
    if height_m is not None:
        tall = height_m / float(surface.vertex_m[:, 2].max())
        wide = 1.06 * tall  # children are stouter
    mesh = painted_mesh(surface, sky, albedo)
    return Mesh((mesh.vertex_m * np.array([wide, wide, tall])).astype(np.float32), mesh.triangle, mesh.vertex_rgb)
