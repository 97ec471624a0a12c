"""Ground coverage of a rig: where around the vehicle a person of a given height is seen, and by how many cameras.

The computation is geometric: a point is seen if it projects into a camera's image and nothing occludes it. It involves
no detector and no minimum size in pixels.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import warp as wp

from warpav.core.cores import available_cores
from warpav.core.warp_setup import checked_device
from warpav.raster.pane import Pane
from warpav.rig.rig import Rig, RigCamera
from warpav.scene.device_scene import DeviceScene
from warpav.scene.scene import Scene
from warpav_kernels.evaluation import ground as kernels

HEIGHTS_M = (1.1, 1.7)
"""Top of a child's and of an adult's head above the ground [m]."""

PATCH_M = 0.05
"""Of a patch of the ground itself: so high above it that the ground does not hide it [m]."""

RADIUS_M = 25.0
CELL_M = 0.5
STEP_M = 0.3
"""Surfaces up to this height above the lowest surface count as ground [m]: kerbs, but no walls or benches."""


def coverage(
    rig: Rig,
    scene: Scene,
    *,
    heights_m: Sequence[float] = HEIGHTS_M,
    radius_m: float = RADIUS_M,
    cell_m: float = CELL_M,
    device: str = "cpu",
) -> Coverage:
    """Where around the vehicle the cameras of a rig see a person, with occlusion by everything in the scene.

    Args:
        rig: Cameras of any lens.
        scene: The street, the traffic, and the vehicle that carries the rig (`Scene.around` puts another there).
        heights_m: Heights of the persons above the ground [m], at least one, positive.
        radius_m: Radius around the ego vehicle's centre [m], positive.
        cell_m: Size of a ground cell [m], positive.
        device: Warp device.

    Raises:
        InputError: The device is not there.
        ValueError: A size or a height is not positive.
    """
    packed = DeviceScene.pack(scene, device=checked_device(device))
    return Ground.around(packed, radius_m=radius_m, cell_m=cell_m).coverage(rig.cameras, heights_m=heights_m)


_HIGHEST_M, _GRADE_MAX = 0.6, 0.08  # maximum height of the ground at the vehicle, and its increase per metre: slopes
_DEPTH_M = 30.0  # maximum depth of a downhill street
_ENVIRONMENT = 0


@dataclass(frozen=True)
class Ground:
    """Ground cells around the vehicle, and where a person can stand.

    Attributes:
        ground_m: Height of the ground in the ego frame [m], float32 [row, column]; NaN where there is none and outside
            of the circle.
        headroom_m: Distance up to the next surface [m], float32 [row, column]; infinite under the open sky, 0 inside
            houses and where a child cannot walk to from the vehicle, such as courtyards.
    """

    scene: DeviceScene
    x_m: np.ndarray
    y_m: np.ndarray
    ground_m: np.ndarray
    headroom_m: np.ndarray
    cell_m: float
    radius_m: float

    @classmethod
    def around(cls, scene: DeviceScene, *, radius_m: float = RADIUS_M, cell_m: float = CELL_M) -> Ground:
        """The ground around the ego vehicle of a scene."""
        if not (radius_m > 0.0 and cell_m > 0.0):
            raise ValueError(f"radius_m and cell_m must be positive, got {radius_m} and {cell_m}")
        raster = scene.raster  # held while kernels read it
        low_m, high_m = raster.layer_bounds_world_m.numpy()[raster.foreground_layer]
        centre_m = 0.5 * (low_m + high_m)[:2].astype(np.float64)
        steps = np.arange(-int(radius_m / cell_m), int(radius_m / cell_m) + 1)
        x_m, y_m = centre_m[0] + cell_m * steps, centre_m[1] + cell_m * steps
        position_m = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1)
        distance_m = np.linalg.norm(position_m - centre_m, axis=-1)
        device, count = raster.device, distance_m.size
        ground_m = wp.empty(count, dtype=float, device=device)
        headroom_m = wp.empty(count, dtype=float, device=device)
        highest_m = (_HIGHEST_M + _GRADE_MAX * distance_m).astype(np.float32)
        wp.launch(
            kernels.ground_kernel,
            dim=count,
            inputs=[
                raster.mesh.id,
                _ENVIRONMENT,
                wp.array(position_m.reshape(-1, 2).astype(np.float32), dtype=wp.vec2, device=device),
                -_DEPTH_M,
                wp.array(highest_m.ravel(), dtype=float, device=device),
                STEP_M,
            ],
            outputs=[ground_m, headroom_m],
            device=device,
            record_tape=False,
        )
        is_inside = distance_m <= radius_m
        height_m = np.where(is_inside, ground_m.numpy().reshape(distance_m.shape), np.float32(np.nan))
        room_m = np.where(is_inside, headroom_m.numpy().reshape(distance_m.shape), np.float32(0.0))
        beside_ego = (np.abs(position_m - centre_m) <= 0.5 * (high_m - low_m)[:2] + 2.0 * cell_m).all(axis=-1)
        room_m[~_reached_from(beside_ego, room_m >= min(HEIGHTS_M))] = 0.0
        return cls(scene, x_m, y_m, height_m, room_m, cell_m, radius_m)

    def is_open(self, height_m: float) -> np.ndarray:
        """Where a person of a height can stand; bool [row, column]."""
        return np.isfinite(self.ground_m) & (self.headroom_m >= height_m)

    def coverage(self, cameras: Sequence[RigCamera], *, heights_m: Sequence[float] = HEIGHTS_M) -> Coverage:
        """Compute which cameras see a person in each cell.

        Args:
            cameras: The cameras, of any lens.
            heights_m: Heights above the ground [m], at least one, positive.

        Raises:
            ValueError: There is no height, or one is not positive.
        """
        if not heights_m or not all(height_m > 0.0 for height_m in heights_m):
            raise ValueError(f"heights_m must be positive, got {tuple(heights_m)}")
        is_open = np.stack([self.is_open(height_m) for height_m in heights_m])
        height, row, column, point_m = self.points_m(is_open, heights_m)
        is_seen = np.zeros((len(cameras), *is_open.shape), bool)
        for camera, seen in zip(cameras, is_seen, strict=True):
            seen[height, row, column] = self.is_seen(camera, point_m)
        return Coverage(self, tuple(heights_m), is_open, is_seen)

    def points_m(
        self, is_open: np.ndarray, heights_m: Sequence[float]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Head positions of all persons that can stand in the cells.

        Args:
            is_open: Where a person of a height can stand, bool [height, row, column].

        Returns:
            Index of the height, row and column, int64 [point] each, and the points in the ego frame [m], [point, 3].
        """
        height, row, column = np.nonzero(is_open)
        top_m = self.ground_m[row, column] + np.asarray(heights_m)[height]
        return height, row, column, np.stack([self.x_m[row], self.y_m[column], top_m], axis=-1)

    def is_seen(self, camera: RigCamera, point_m: np.ndarray) -> np.ndarray:
        """Whether a camera sees points of the ego frame [m], [point, 3]; bool [point]."""
        return sees(self.scene, camera, point_m)


def is_in_image(camera: RigCamera, point_m: np.ndarray) -> np.ndarray:
    """Whether points of the ego frame [m], [..., 3], have an image within the camera's image; bool [...]."""
    ego_from_camera = camera.ego_from_camera
    in_camera_m = (point_m - ego_from_camera[:3, 3]) @ ego_from_camera[:3, :3]
    with np.errstate(invalid="ignore"):
        point_px = camera.model.project(in_camera_m)
        is_inside = (point_px >= 0.0) & (point_px < [camera.model.width_px, camera.model.height_px])
    return np.asarray(is_inside.all(axis=-1))


def sees(scene: DeviceScene, camera: RigCamera, point_m: np.ndarray) -> np.ndarray:
    """Whether a camera sees points of the ego frame [m], [point, 3]: in its image, with nothing before them."""
    is_seen = is_in_image(camera, point_m)
    asked = np.flatnonzero(is_seen)
    share = free_shares(
        scene,
        camera.ego_from_camera[:3, 3],
        point_m[asked],
        near_m=camera.model.near_m,
        behind_glass=camera.behind_glass,
    )
    is_seen[asked] = share == 1.0
    return is_seen


def free_shares(
    scene: DeviceScene,
    start_m: np.ndarray,
    end_m: np.ndarray,
    *,
    near_m: float = 0.0,
    behind_glass: Pane | None = None,
) -> np.ndarray:
    """Share of the line of sight from one point to others that is free of occluders.

    Args:
        start_m: Start point in the ego frame [m], [3].
        end_m: End points in the ego frame [m], [point, 3].
    """
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

    threads = 1 if device.is_cuda else available_cores()
    chunk = -(-count // threads)
    list(_threads(threads).map(launch, range(0, count, chunk)))
    return share.numpy()


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count)


def _reached_from(start: np.ndarray, is_open: np.ndarray) -> np.ndarray:
    """Open cells connected with the open start cells; bool [row, column]."""
    import cv2

    _, part = cv2.connectedComponents(is_open.astype(np.uint8), connectivity=8)
    return np.isin(part, np.setdiff1d(part[start], [0]))


@dataclass(frozen=True)
class Coverage:
    """Which cameras see a person in each ground cell.

    Attributes:
        is_open: Where a person of a height can stand, bool [height, row, column].
        is_seen: Whether a camera sees the person's head, bool [camera, height, row, column]; False where nobody can
            stand.
    """

    ground: Ground
    heights_m: tuple[float, ...]
    is_open: np.ndarray
    is_seen: np.ndarray

    def with_camera(self, index: int, camera: RigCamera) -> Coverage:
        """The coverage with one camera replaced; the results of the other cameras are reused."""
        height, row, column, point_m = self.ground.points_m(self.is_open, self.heights_m)
        is_seen = self.is_seen.copy()
        is_seen[index, height, row, column] = self.ground.is_seen(camera, point_m)
        return Coverage(self.ground, self.heights_m, self.is_open, is_seen)

    @cached_property
    def count(self) -> np.ndarray:
        """Number of cameras that see a cell, int64 [height, row, column]; -1 where nobody can stand."""
        return np.where(self.is_open, self.is_seen.sum(axis=0), -1)

    @property
    def covered_share(self) -> np.ndarray:
        """Share of the open cells that some camera sees, float64 [height]; NaN without open cells."""
        return self._share(self.count > 0)

    @property
    def blind_area_m2(self) -> np.ndarray:
        """Area of the ground where no camera sees a person of a height [m^2], float64 [height]."""
        return (self.count == 0).sum(axis=(1, 2)) * self.ground.cell_m**2

    def share_seen_by(self, cameras: int, *, radius_m: float) -> np.ndarray:
        """Share of the open cells near the vehicle that so many cameras see, or more."""
        return self._share(self.count >= cameras, self._distance_m < radius_m)

    def covered_share_by_distance(self, edges_m: Sequence[float]) -> np.ndarray:
        """`covered_share` in rings around the ego vehicle's centre.

        Returns:
            float64 [height, ring]; NaN where nobody can stand in a ring.
        """
        distance_m = self._distance_m
        rings = [
            self._share(self.count > 0, (low <= distance_m) & (distance_m < high))
            for low, high in itertools.pairwise(edges_m)
        ]
        return np.stack(rings, axis=1)

    @property
    def _distance_m(self) -> np.ndarray:
        """Of every cell from the ego vehicle's centre [m], float64 [row, column]."""
        ground = self.ground
        centre_m = 0.5 * (ground.x_m[0] + ground.x_m[-1]), 0.5 * (ground.y_m[0] + ground.y_m[-1])
        return np.hypot(ground.x_m[:, None] - centre_m[0], ground.y_m[None] - centre_m[1])

    def _share(self, flag: np.ndarray, within: np.ndarray | None = None) -> np.ndarray:
        is_open = self.is_open if within is None else self.is_open & within
        total = is_open.sum(axis=(1, 2))
        return np.where(total > 0, (flag & is_open).sum(axis=(1, 2)) / np.maximum(total, 1), np.nan)
