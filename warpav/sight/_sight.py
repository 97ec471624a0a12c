"""Sight: which cameras of a rig see which points, and how many of them see the same.

The computation is geometric: a point is seen if it projects into a camera's image and nothing occludes it. It involves
no detector and no minimum size in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from warpav.core.cores import available_cores
from warpav.raster.pane import Pane
from warpav.rig import Rig, RigCamera
from warpav.scene import DeviceScene
from warpav_kernels.raster import ground as kernels


@dataclass(frozen=True, eq=False)
class _Sight:
    """Which cameras have points in their images, and which of these see them past all that is in the way."""

    in_image: np.ndarray  # bool [camera, ...]
    seen: np.ndarray  # bool [camera, ...]

    @property
    def count(self) -> np.ndarray:
        """Number of cameras that see a point, int64 [...]."""
        return self.seen.sum(axis=0)


def sight(rig: Rig | Sequence[RigCamera], point_m: np.ndarray, scene: DeviceScene) -> _Sight:
    """What each camera sees of points of the ego frame [m], [..., 3], in a scene."""
    cameras = rig.cameras if isinstance(rig, Rig) else rig
    flat_m = point_m.reshape(-1, 3)
    in_image, seen = np.zeros((2, len(cameras), len(flat_m)), bool)
    for row, camera in enumerate(cameras):
        in_image[row] = is_in_image(camera, flat_m)
        asked = np.flatnonzero(in_image[row])
        share = free_shares(
            scene,
            camera.ego_from_camera[:3, 3],
            flat_m[asked],
            near_m=camera.model.near_m,
            behind_glass=camera.behind_glass,
        )
        seen[row, asked] = share == 1.0
    shape = len(cameras), *point_m.shape[:-1]
    return _Sight(in_image.reshape(shape), seen.reshape(shape))


def seen_by_any(rig: Rig, point_m: np.ndarray, scene: DeviceScene) -> np.ndarray:
    """As `sight`, whether some camera does, bool [...]; what one has seen, no other is asked for."""
    point = point_m.reshape(-1, 3)
    seen = np.zeros(len(point), bool)
    for camera in rig.cameras:
        seen[~seen] = sight([camera], point[~seen], scene).seen[0]
    return seen.reshape(point_m.shape[:-1])


def is_in_image(camera: RigCamera, point_m: np.ndarray) -> np.ndarray:
    """Whether points of the ego frame [m], [..., 3], have an image within the camera's image; bool [...]."""
    ego_from_camera = camera.ego_from_camera
    in_camera_m = (point_m - ego_from_camera[:3, 3]) @ ego_from_camera[:3, :3]
    with np.errstate(invalid="ignore"):
        point_px = camera.model.project(in_camera_m)
        is_inside = (point_px >= 0.0) & (point_px < [camera.model.width_px, camera.model.height_px])
    return np.asarray(is_inside.all(axis=-1))


def free_shares(
    scene: DeviceScene, start_m: np.ndarray, end_m: np.ndarray, *, near_m: float = 0.0, behind_glass: Pane | None = None
) -> np.ndarray:
    """Share of the line of sight from a point [3] to others [point, 3] that is free of occluders, float32 [point]."""
    raster = scene.raster.through(behind_glass)  # held while kernels read it
    device, count = raster.device, len(end_m)
    if count == 0:
        return np.zeros(0, np.float32)
    end = wp.array(np.asarray(end_m, np.float32), dtype=wp.vec3, device=device)
    share = wp.empty(count, dtype=float, device=device)
    mesh = raster.mesh.id  # built before the threads use it

    def launch(first: int) -> None:
        wp.launch(
            kernels.free_share_kernel,
            dim=min(chunk, count - first),
            inputs=[mesh, wp.vec3(*start_m), end, near_m, first],
            outputs=[share],
            device=device,
            record_tape=False,
        )

    chunk = count if device.is_cuda or count < 1000 else -(-count // available_cores())  # few: sooner alone
    firsts = range(0, count, chunk)
    list(map(launch, firsts) if len(firsts) == 1 else _threads(len(firsts)).map(launch, firsts))
    return share.numpy()


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count)


@dataclass(frozen=True)
class _Redundancy:
    """How often enough cameras see a road user."""

    radius_m: float
    cameras: int
    objects: int
    share: float | None


def probability_of_at_least(cameras: int, probability: np.ndarray) -> np.ndarray:
    """Probability that so many cameras or more, each by itself, detect each object, of [camera, object]."""
    probability = np.asarray(probability, np.float64)
    # of exactly 0, 1, ... cameras so far
    exactly = np.zeros((cameras + 1, probability.shape[1]))
    exactly[0] = 1.0
    for row in probability:
        # the last one is "that many or more"
        gain = exactly[:-1] * row
        exactly[:-1] -= gain
        exactly[1:] += gain
    return np.clip(exactly[-1], 0.0, 1.0)


def redundancy(
    sees: Sequence[np.ndarray], scenes: Sequence[DeviceScene], *, radius_m: float, cameras: int
) -> _Redundancy:
    """Share of the road users within a radius that enough cameras see, by flags or probabilities [camera, object]."""
    if not radius_m > 0.0 or cameras < 1:
        raise ValueError(f"radius_m must be positive and cameras at least 1, got {radius_m} and {cameras}")
    found = [np.zeros(0)]
    for seen, scene in zip(sees, scenes, strict=True):
        if seen.ndim != 2 or seen.shape[1] != scene.vehicle_count:
            raise ValueError(f"{scene.name}: expected [camera, {scene.vehicle_count}], got {seen.shape}")
        is_near = np.hypot(*scene.from_ego_m.T) <= radius_m
        found.append(probability_of_at_least(cameras, seen)[is_near])
    share = np.concatenate(found)
    return _Redundancy(radius_m, cameras, len(share), float(share.mean()) if len(share) else None)
