"""The embedded town as a simulator: rays through its meshes, window panes transparent for colour and depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpav.core.cache import fingerprint
from warpav.raster.mesh import merge
from warpav.scene._scene import Box, triangle_caster
from warpav.scene.capture._capture import (
    EGO_INSTANCE,
    ENVIRONMENT_INSTANCE,
    CapturedImage,
    CapturedVehicle,
    CaptureView,
    Simulator,
    SpawnPoint,
)
from warpav.scene.town._town import TownWorld, town_world
from warpav.scene.town._vehicle_shapes import ego_glass

_PANE_OPACITY = 0.6  # share of a pixel's colour that a window pane gives; the rest is what lies behind it
_INSIDE_SHADE = 0.3  # surfaces seen from inside a vehicle are this bright
_MAX_PANES = 8
_PAST_PANE_M = 1e-4
_VEHICLE_TAG = 14  # CARLA's semantic tag of cars; the other two channels hold the instance id


class TownSimulator(Simulator):
    """The procedural town of `town_scene`; seed, vehicles and instance ids are the same as there.

    Spawn points are the poses of the scene's vehicles, each for its own vehicle. Colours have one sample
    per pixel, are unlit and interpolated between vertices.
    """

    def __init__(self) -> None:
        self.name, self.source, self.world = "", "", fingerprint("town", code=(__name__,))
        self._world: TownWorld | None = None
        self._spawned: set[int] = set()
        self._caster: _Caster | None = None

    def begin(self, seed: int) -> Box:
        self._world = town_world(seed)
        self.name, self.source = self._world.scene.name, self._world.scene.source
        self._spawned, self._caster = set(), None
        low, high = self._world.scene.ego.bounds_m().astype(np.float64)
        return Box(0.5 * (low + high), high - low, 0.0)

    def spawn_points(self, radius_m: float) -> Sequence[SpawnPoint]:
        """As in `Simulator`; the order is that of the instance ids, nearness plays no part."""
        return [
            SpawnPoint(vehicle.box.center_m * [1.0, 1.0, 0.0], vehicle.box.yaw_rad)
            for vehicle in self._begun().scene.vehicles
            if np.hypot(*vehicle.box.center_m[:2]) <= radius_m
        ]

    def spawn(self, point: SpawnPoint) -> CapturedVehicle | None:
        """As in `Simulator`; None if the point is occupied or not a spawn point."""
        for vehicle in self._begun().scene.vehicles:
            offset_m = vehicle.box.center_m[:2] - point.position_m[:2]
            if np.hypot(*offset_m) < 1e-6 and vehicle.instance_id not in self._spawned:
                self._spawned.add(vehicle.instance_id)
                self._caster = None
                low, high = vehicle.instance_id % 256, vehicle.instance_id // 256
                return CapturedVehicle(
                    vehicle.instance_id,
                    vehicle.category,
                    vehicle.box,
                    point.position_m,
                    point.yaw_rad,
                    np.array([_VEHICLE_TAG, low, high], np.uint8),
                    vehicle.velocity_ego_m_s,
                )
        return None

    def remove(self, vehicle: CapturedVehicle) -> None:
        self._spawned.discard(vehicle.instance_id)
        self._caster = None

    def capture(self, view: CaptureView) -> CapturedImage:
        if self._caster is None:
            self._caster = _Caster(self._begun(), self._spawned)
        return self._caster.capture(view)

    def _begun(self) -> TownWorld:
        if self._world is None:
            raise RuntimeError("begin(seed) comes first")
        return self._world


class _Caster:
    """All surfaces of a situation, ready for rays."""

    def __init__(self, world: TownWorld, spawned: set[int]) -> None:
        scene = world.scene
        there = [k for k, vehicle in enumerate(scene.vehicles) if vehicle.instance_id in spawned]
        around = merge([scene.environment, *(other.mesh for other in scene.others)])
        meshes = [around, scene.ego, *(scene.vehicles[k].mesh for k in there)]
        counts = [len(mesh.triangle) for mesh in meshes]
        whole = merge(meshes)
        self._corner_rgb = whole.vertex_rgb[whole.triangle].astype(np.float32)
        self._instance = np.repeat(
            np.array([ENVIRONMENT_INSTANCE, EGO_INSTANCE, *(scene.vehicles[k].instance_id for k in there)], np.uint16),
            counts,
        )
        self._is_pane = np.concatenate(
            [np.zeros(counts[0], bool), ego_glass(), *(world.vehicle_glass[k] for k in there)]
        )
        self._sky = scene.sky
        self._embree = triangle_caster(whole.vertex_m[whole.triangle])

    def capture(self, view: CaptureView) -> CapturedImage:
        # rays have z = 1 along the optical axis, so distances along them are depths
        height, width = view.model.height_px, view.model.width_px
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        ray = view.model.rays(np.stack([column, row], axis=-1)).reshape(-1, 3)
        direction = (ray @ view.ego_from_camera[:3, :3].T).astype(np.float32)
        origin = np.broadcast_to(view.ego_from_camera[:3, 3].astype(np.float32), direction.shape).copy()
        count = len(direction)
        rgb, through = np.zeros((count, 3), np.float32), np.ones(count, np.float32)
        depth_m = np.full(count, np.inf, np.float32)
        instance = np.zeros(count, np.uint16)
        passed_m = np.zeros(count, np.float32)
        waiting = np.arange(count)
        for layer in range(_MAX_PANES):
            hit = self._embree.run(origin[waiting], direction[waiting], output=True)
            triangle = hit["primID"]
            seen = triangle >= 0
            sky = waiting[~seen]
            up = direction[sky, 2] / np.linalg.norm(direction[sky], axis=1)
            share = self._sky.zenith_share(up)[:, None]
            sky_rgb = (1.0 - share) * self._sky.horizon_rgb + share * self._sky.zenith_rgb
            rgb[sky] += through[sky, None] * sky_rgb
            waiting, triangle = waiting[seen], triangle[seen]
            u, v, distance = (hit[name][seen] for name in ("u", "v", "tfar"))
            a, b, c = np.moveaxis(self._corner_rgb[triangle], 1, 0)
            colour = (1.0 - u - v)[:, None] * a + u[:, None] * b + v[:, None] * c
            is_inside = np.einsum("ij,ij->i", hit["Ng"][seen], direction[waiting]) > 0.0
            colour[is_inside & (self._instance[triangle] != ENVIRONMENT_INSTANCE)] *= _INSIDE_SHADE
            if layer == 0:
                instance[waiting] = self._instance[triangle]
            passed_m[waiting] += distance
            pane = self._is_pane[triangle] & (layer < _MAX_PANES - 1)
            opacity = through[waiting] * np.where(pane, np.float32(_PANE_OPACITY), np.float32(1.0))
            rgb[waiting] += opacity[:, None] * colour
            depth_m[waiting[~pane]] = passed_m[waiting[~pane]]
            waiting = waiting[pane]
            if not len(waiting):
                break
            through[waiting] *= 1.0 - _PANE_OPACITY
            passed_m[waiting] += _PAST_PANE_M
            origin[waiting] = view.ego_from_camera[:3, 3] + passed_m[waiting, None] * direction[waiting]
        return CapturedImage(
            view,
            np.round(rgb).astype(np.uint8).reshape(height, width, 3),
            depth_m.reshape(height, width),
            instance.reshape(height, width),
        )
