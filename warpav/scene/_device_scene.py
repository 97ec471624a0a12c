"""A traffic scene on a device: its meshes as the rasteriser takes them, and what they are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warpav.core.cache import digest
from warpav.raster.mesh import Mesh
from warpav.raster.scene import Scene as RasterScene
from warpav.scene._scene import ROAD_USERS, Scene

# What images of object indices say, see `object_index_of`.
EGO = 1
FIRST_VEHICLE = 2

# arrays of which the others follow
_SEEN = ("vertex_world_m", "triangle", "triangle_body", "vertex_rgb", "background_rgb", "occluder_count",
         "has_foreground", "layer_body")  # fmt: skip


def object_index_of(object_id: np.ndarray) -> np.ndarray:
    """The rasteriser's ids as indices: nothing -1, the environment 0, the ego vehicle 1, vehicle k 2 + k; int32."""
    nothing_or_vehicle = np.where(object_id < 0, -1, object_id + FIRST_VEHICLE)
    return np.where(object_id < -1, -2 - object_id, nothing_or_vehicle).astype(np.int32)


@dataclass(frozen=True)
class UprightBoxes:
    """Boxes with a vertical axis, one for every layer of a scene, on its device."""

    centre_ego_m: wp.array  # centres [m], vec3 [layer]
    half_size_m: wp.array  # half of length, width and height [m], vec3 [layer]
    along: wp.array  # unit vectors along the length in ego x and y, vec2 [layer]


@dataclass(frozen=True, eq=False)
class DeviceScene:
    """A traffic scene on a device.

    To the rasteriser its vehicles are the objects, the environment is an occluder, and the ego vehicle the foreground;
    its world frame is the ego frame. Road users among the scene's others are part of the environment.
    """

    name: str  # the scene's name
    raster: RasterScene  # the meshes: vehicle k is object k, the environment occluder 0, the ego vehicle occluder 1
    category: tuple[str, ...]  # what every vehicle is, [vehicle]
    road_user_index: np.ndarray  # the kind of every vehicle, index into `ROAD_USERS`, int32 [vehicle]
    # Centre of every vehicle's box as seen from the centre of the ego vehicle: forward and left [m], float64 [vehicle,
    # 2].
    from_ego_m: np.ndarray
    # When every vehicle's box meets that of the ego vehicle, seen from above, if both keep their velocities [s]: 0
    # where they overlap, inf where they never meet, NaN where the velocity is unknown, float64 [vehicle].
    time_to_collision_s: np.ndarray

    @property
    def vehicle_count(self) -> int:
        """Number of vehicles, at least 0."""
        return self.raster.object_count

    @cached_property
    def ego_bounds_m(self) -> np.ndarray:
        """Lowest and highest corner of the ego vehicle in its frame [m], float32 [2, 3]."""
        return self.raster.layer_bounds_world_m.numpy()[self.raster.foreground_layer]

    @property
    def place_ego_m(self) -> np.ndarray:
        """Centre of every vehicle's box in the ego frame: x and y [m], float64 [vehicle, 2]."""
        return self.from_ego_m + np.asarray(self.ego_bounds_m, np.float64)[:, :2].mean(axis=0)

    @property
    def distance_m(self) -> np.ndarray:
        """Horizontal distance of every vehicle's box's centre from the ego frame's origin [m], float64 [vehicle]."""
        return np.hypot(*self.place_ego_m.T)

    @cached_property
    def kind(self) -> wp.array:
        """`road_user_index` on the device, int [vehicle]."""
        return wp.array(self.road_user_index, dtype=int, device=self.raster.device)

    @cached_property
    def upright_box(self) -> UprightBoxes:
        """The smallest upright box around every vehicle, and around the ego vehicle; computed on first use."""
        import cv2

        triangles, device = self.raster.triangles, self.raster.device
        vertex_ego_m = triangles.vertex_world_m.numpy()
        triangle, body = triangles.triangle.numpy(), triangles.triangle_body.numpy()  # sorted by body
        centre, half_size, along = [], [], []
        for index in self.raster.layer_body.numpy():
            first, end = np.searchsorted(body, [index, index + 1])
            point_m = vertex_ego_m[np.unique(triangle[first:end])]
            middle_xy, (length, width), turn_deg = cv2.minAreaRect(np.ascontiguousarray(point_m[:, :2]))
            low_m, high_m = point_m[:, 2].min(), point_m[:, 2].max()
            centre.append([*middle_xy, 0.5 * (low_m + high_m)])
            half_size.append([0.5 * length, 0.5 * width, 0.5 * (high_m - low_m)])
            along.append([np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))])
        return UprightBoxes(
            wp.array(np.reshape(centre, (-1, 3)), dtype=wp.vec3, device=device),
            wp.array(np.reshape(half_size, (-1, 3)), dtype=wp.vec3, device=device),
            wp.array(np.reshape(along, (-1, 2)), dtype=wp.vec2, device=device),
        )

    def carrying(self, mesh: Mesh | None) -> DeviceScene:
        """The scene with one more mesh on the ego vehicle, in the ego frame [m]; without one the scene itself."""
        if mesh is None:
            return self
        scene = DeviceScene(
            self.name,
            self.raster.carrying(mesh),
            self.category,
            self.road_user_index,
            self.from_ego_m,
            self.time_to_collision_s,
        )
        scene.__dict__["upright_box"] = self.upright_box
        return scene

    @cached_property
    def fingerprint(self) -> str:
        """Hash of what can be seen in the scene: its meshes, which body is what, colours and background."""
        arrays = self.raster.arrays()
        return digest(*(part for name in _SEEN for part in (name, arrays[name].shape, arrays[name].tobytes())))

    def arrays(self) -> dict[str, np.ndarray]:
        """All that the scene is, on the host, for `of_arrays`."""
        return {
            **self.raster.arrays(),
            "name": np.array(self.name),
            "category": np.array(self.category, str),
            "road_user_index": self.road_user_index,
            "from_ego_m": self.from_ego_m,
            "time_to_collision_s": self.time_to_collision_s,
            **{f"box_{name}": array.numpy() for name, array in vars(self.upright_box).items()},
        }

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray], *, device: str = "cpu") -> DeviceScene:
        """The scene that `arrays` told of, on ``device``."""
        scene = cls(
            str(arrays["name"]),
            RasterScene.of_arrays(arrays, device=device),
            tuple(str(name) for name in arrays["category"]),
            arrays["road_user_index"],
            arrays["from_ego_m"],
            arrays["time_to_collision_s"],
        )
        scene.__dict__["upright_box"] = boxes_of_arrays(arrays, device=device)
        return scene

    def __reduce__(self) -> tuple[Any, ...]:
        """As it travels to another process: the arrays, and the device by its name."""
        return _unpacked, (self.arrays(), str(self.raster.device))

    @classmethod
    def pack(cls, scene: Scene, *, device: str = "cpu") -> DeviceScene:
        """The scene on ``device``."""
        environment = scene.surroundings()
        for name, mesh in (
            *((f"{other.category} {other.instance_id}", other.mesh) for other in scene.others),
            ("environment", environment),
            ("ego", scene.ego),
            *((f"vehicle {vehicle.instance_id}", vehicle.mesh) for vehicle in scene.vehicles),
        ):
            mesh.check(f"{scene.name}: {name}")
        low_m, high_m = scene.ego.bounds_m()[:, :2].astype(np.float64)
        return cls(
            name=scene.name,
            raster=RasterScene(
                {str(k): vehicle.mesh for k, vehicle in enumerate(scene.vehicles)},
                occluders=[environment],
                foreground=scene.ego,
                background_rgb=np.stack([scene.sky.horizon_rgb, scene.sky.zenith_rgb]),
                device=device,
            ),
            category=tuple(vehicle.category for vehicle in scene.vehicles),
            road_user_index=np.array([ROAD_USERS.index(user.road_user) for user in scene.vehicles], np.int32),
            from_ego_m=np.array([vehicle.box.center_m[:2] for vehicle in scene.vehicles]).reshape(-1, 2)
            - scene.ego.bounds_m()[:, :2].mean(axis=0),
            time_to_collision_s=np.array(
                [
                    math.nan
                    if vehicle.velocity_ego_m_s is None
                    else vehicle.box.time_to_meet_s(low_m, high_m, vehicle.velocity_ego_m_s)
                    for vehicle in scene.vehicles
                ]
            ),
        )


def boxes_of_arrays(arrays: Mapping[str, np.ndarray] | np.ndarray, *, device: str) -> UprightBoxes:
    """The boxes that `DeviceScene.arrays` told of, on a device."""
    kinds = {"centre_ego_m": wp.vec3, "half_size_m": wp.vec3, "along": wp.vec2}
    return UprightBoxes(
        **{name: wp.array(arrays[f"box_{name}"], dtype=kind, device=device) for name, kind in kinds.items()}
    )


def _unpacked(arrays: Mapping[str, np.ndarray], device: str) -> DeviceScene:
    return DeviceScene.of_arrays(arrays, device=device)
