"""Rigs on other vehicles: every camera on the part of the body that its makers put it on, roof, sides or ends."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.rig._rig import Rig, RigCamera

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

LEAST_STAND_OFF_M = 0.03
"""What a camera's centre stands off the skin at least: half a small housing."""

_APART_M = 0.05
"""How far centres of cameras are apart at least: two small housings side by side."""

REACH_M = 0.5
"""How much farther than the nearest place of the body a camera may move where that frees its view."""

_MIRROR_SHARE = 0.012
"""Share of the skin that may lie beyond the sides of a body: mirrors have .0002 to .006, a side far more."""

_FAN_RAYS = 17
"""Rays across the middle row of the image that should miss the vehicle."""

_UP = np.array([[math.cos(k), math.sin(k), rise] for rise in (0.05, 0.2, 0.4, 0.7, 1.2, 3.0) for k in range(32)])
"""Directions above the horizon; of those of a flush camera the body hides .72 at most."""

_PLACE_COUNT = 100_000
"""Places that are tried all over a body: 2 cm apart on a car."""


@dataclass(frozen=True, eq=False)
class MovedRig:
    """A rig on a vehicle that it was not made for."""

    rig: Rig
    moved_m: np.ndarray
    blocked_share: np.ndarray


@dataclass(frozen=True)
class Body:
    """The box around a vehicle's body, in the ego frame [m]."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    @classmethod
    def of(cls, vehicle: Mesh) -> Body:
        """The box of a mesh in the ego frame; as in data sheets mirrors do not count (`_MIRROR_SHARE`)."""
        (rear_m, _, _), (front_m, _, high_m) = vehicle.bounds_m().astype(float)
        skin_m, _ = _skin(vehicle)
        right_m, left_m = np.quantile(skin_m[:, 1], [0.5 * _MIRROR_SHARE, 1.0 - 0.5 * _MIRROR_SHARE])
        return cls((rear_m, float(right_m), 0.0), (front_m, float(left_m), high_m))

    @classmethod
    def of_size(cls, length_m: float, width_m: float, height_m: float, *, wheelbase_m: float) -> Body:
        """The box of a vehicle by its data sheet; what overhangs is taken as equal in front and behind."""
        rear_m = -0.5 * (length_m - wheelbase_m)
        return cls((rear_m, -0.5 * width_m, 0.0), (rear_m + length_m, 0.5 * width_m, height_m))

    def carried_to(self, other: Body, position_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where places [place, 3] are on another body, shares of its box kept; and how far they stand out of it [m]."""
        low_m, high_m, other_low_m, other_high_m = map(np.asarray, (self.low_m, self.high_m, other.low_m, other.high_m))
        inside_m = np.clip(position_m, low_m, high_m)
        share = (inside_m - low_m) / (high_m - low_m)
        beyond_m = position_m - inside_m
        return other_low_m + share * (other_high_m - other_low_m) + beyond_m, np.linalg.norm(beyond_m, axis=1)


def put_on_body(rig: Rig, vehicle: Mesh, *, made_for: Body | None = None) -> MovedRig:
    """Put every camera of a rig on the skin of a vehicle, where it is on the body that it was made for.

    From its place there (`Body.carried_to`) to the nearest off the skin, as far off as it stood out of its own
    vehicle's box, at least `LEAST_STAND_OFF_M`; of the places up to `REACH_M` farther the one whose view the vehicle
    hides least. Directions, lenses and images stay. Cameras are placed in the rig's order, `_APART_M` apart.
    """
    caster = ray_caster(vehicle)
    skin_m, outward = _skin(vehicle)
    position_m = np.array([camera.position_m for camera in rig.cameras], np.float64)
    wanted_m, beyond_m = position_m, np.zeros(len(position_m))
    if made_for is not None:
        wanted_m, beyond_m = made_for.carried_to(Body.of(vehicle), position_m)
    cameras: list[RigCamera] = []
    shares = []
    for camera, middle_m, stand_off_m in zip(rig.cameras, wanted_m, beyond_m, strict=True):
        place_m = skin_m + max(stand_off_m, LEAST_STAND_OFF_M) * outward
        taken_m = np.array([other.position_m for other in cameras]).reshape(-1, 1, 3)
        is_free = (np.linalg.norm(place_m - taken_m, axis=2) >= _APART_M).all(axis=0)
        best_m, share = _freest(caster, camera, middle_m, place_m[is_free], outward[is_free])
        cameras.append(dataclasses.replace(camera, position_m=best_m))
        shares.append(share)
    found_m = np.array([camera.position_m for camera in cameras])
    return MovedRig(Rig(cameras), np.linalg.norm(found_m - wanted_m, axis=1), np.array(shares))


def ray_caster(vehicle: Mesh) -> EmbreeScene:
    """The triangles of a vehicle, to cast rays at."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    caster = EmbreeScene()
    TriangleMesh(caster, vehicle.vertex_m[vehicle.triangle])
    return caster


def first_hit(caster: EmbreeScene, vehicle: Mesh, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Where a ray, its origin [m] and its direction, [2, 3], meets a vehicle first, and the normal there against it.

    None where it misses; both [3]. The caster is that of `ray_caster`.
    """
    origin_m, direction = (np.asarray(each, np.float32)[None] for each in ray)
    found = caster.run(origin_m, direction, output=True)
    [triangle], [length] = found["primID"], found["tfar"]
    if triangle < 0:
        return None
    a, b, c = vehicle.vertex_m[vehicle.triangle[triangle]].astype(np.float64)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal) * -np.copysign(1.0, normal @ direction[0])
    return np.asarray(ray[0] + float(length) * ray[1], np.float64), normal


def blocked_shares(caster: EmbreeScene, camera: RigCamera, place_m: np.ndarray) -> np.ndarray:
    """Share of the rays of a camera's middle row that meet the vehicle, from places [place, 3]; [place]."""
    model = camera.model
    column_px = (np.arange(_FAN_RAYS) + 0.5) / _FAN_RAYS * model.width_px
    ray = model.rays(np.c_[column_px, np.full(_FAN_RAYS, 0.5 * model.height_px)])
    ray = ray[np.isfinite(ray).all(axis=1)] @ camera.ego_from_camera[:3, :3].T
    is_hit = _are_hit(caster, np.repeat(place_m, len(ray), axis=0), np.tile(ray, (len(place_m), 1)))
    return is_hit.reshape(len(place_m), -1).mean(axis=1)


def _freest(
    caster: EmbreeScene, camera: RigCamera, middle_m: np.ndarray, place_m: np.ndarray, outward: np.ndarray
) -> tuple[np.ndarray, float]:
    """The place with the least hidden view near the one that is nearest to ``middle_m``, and its hidden share."""
    # in the open alone: a ray along the normal meets nothing, as it would in a cabin
    place_m = place_m[~_are_hit(caster, place_m, outward)]
    distance_m = np.linalg.norm(place_m - middle_m, axis=1)
    near = np.flatnonzero(distance_m <= distance_m.min() + REACH_M)
    near = near[np.argsort(distance_m[near], kind="stable")]
    for some in np.array_split(near, max(len(near) // 500, 1)):
        share = blocked_shares(caster, camera, place_m[some])
        if not share.all():
            best = int(np.argmin(share > 0.0))
            return place_m[some[best]], 0.0
    share = blocked_shares(caster, camera, place_m[near])
    best = int(np.argmin(share))
    return place_m[near[best]], float(share[best])


def _are_hit(caster: EmbreeScene, origin_m: np.ndarray, direction: np.ndarray) -> np.ndarray:
    origin_m, direction = (np.ascontiguousarray(each, np.float32) for each in (origin_m, direction))
    return np.asarray(caster.run(origin_m, direction, query="OCCLUDED")) >= 0


def are_inside(vehicle: Mesh, point_m: Sequence[np.ndarray]) -> np.ndarray:
    """Which points are in a body: none of their ways upwards is open, bool [point]."""
    caster = ray_caster(vehicle)
    return np.array([_are_hit(caster, np.tile(each_m, (len(_UP), 1)), _UP).all() for each_m in point_m])


def skin_distance_m(vehicle: Mesh, point_m: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """How far the skin is from points along their normals, up to `REACH_M` [m]; both [point, 3], returns [point]."""
    origin_m, direction = np.asarray(point_m + REACH_M * normal, np.float32), np.asarray(-normal, np.float32)
    found = ray_caster(vehicle).run(origin_m, direction, query="DISTANCE")
    return np.minimum(np.abs(np.asarray(found, np.float64) - REACH_M), REACH_M)


def _skin(vehicle: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over a mesh, [point, 3], with unit normals to either side but those that look down."""
    rng = np.random.default_rng(0)
    corner = vehicle.vertex_m.astype(np.float64)[vehicle.triangle]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    doubled_area = np.linalg.norm(normal, axis=1)
    chosen = np.searchsorted(np.cumsum(doubled_area), rng.random(_PLACE_COUNT) * doubled_area.sum(), side="right")
    chosen = chosen.clip(max=len(corner) - 1)
    share = rng.random((_PLACE_COUNT, 2))
    beyond = share.sum(axis=1) > 1.0
    share[beyond] = 1.0 - share[beyond]
    start, u, v = corner[chosen, 0], corner[chosen, 1], corner[chosen, 2]
    point_m = start + share[:, :1] * (u - start) + share[:, 1:] * (v - start)
    unit = normal[chosen] / np.maximum(doubled_area[chosen], 1e-300)[:, None]
    both_m, both = np.concatenate([point_m, point_m]), np.concatenate([unit, -unit])
    is_up = both[:, 2] > -0.5
    return both_m[is_up], both[is_up]
