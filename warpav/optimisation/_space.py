"""All rigs that a search may try."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warpav.optimisation._baselines import random_mount_pose
from warpav.optimisation._constraints import Constraints
from warpav.optimisation._mount import HEIGHT_DELTA_M, MOUNT_POSE_SIZE, X_M, Y_M, YAW_RAD, CameraMount


@dataclass(frozen=True, eq=False)
class SearchSpace:
    """All rigs that a search may try, as the unit cube of the numbers that are free: those with ``low < high``."""

    mount: CameraMount  # where the cameras may stand
    constraints: Constraints  # what the rigs must satisfy
    low: np.ndarray  # least mount pose of every camera, float64 [camera, 7]; x and y are the mount surface's
    high: np.ndarray  # greatest mount pose of every camera, likewise

    @classmethod
    def over(
        cls,
        mount: CameraMount,
        camera_count: int,
        *,
        constraints: Constraints,
        yaw_rad: np.ndarray | None = None,
        yaw_reach_rad: float = math.pi,
    ) -> SearchSpace:
        """Cameras anywhere on the mount surface, as configured but for what is free. ``yaw_rad`` [camera]."""
        low = np.zeros((camera_count, MOUNT_POSE_SIZE))
        high = np.zeros((camera_count, MOUNT_POSE_SIZE))
        low[:, [X_M, Y_M]], high[:, [X_M, Y_M]] = mount.surface.bounds_m
        for camera, module in enumerate([] if constraints.module is None else constraints.module):
            low[camera, [X_M, Y_M]], high[camera, [X_M, Y_M]] = mount.surface.bounds_of(int(module))
        middle = 2.0 * math.pi * np.arange(camera_count) / camera_count if yaw_rad is None else np.asarray(yaw_rad)
        low[:, YAW_RAD], high[:, YAW_RAD] = middle - yaw_reach_rad, middle + yaw_reach_rad
        has_ends = np.isfinite(mount.low)
        has_ends[YAW_RAD] = False
        low[:, has_ends], high[:, has_ends] = mount.low[has_ends], mount.high[has_ends]
        if mount.frozen is not None:
            is_frozen = mount.frozen.is_frozen
            low[is_frozen] = high[is_frozen] = mount.frozen.mount_pose[is_frozen]
        return cls(mount, constraints, low, high)

    @property
    def camera_count(self) -> int:
        return len(self.low)

    @property
    def is_frozen(self) -> np.ndarray:
        """Which cameras stay as they are, bool [camera]."""
        frozen = self.mount.frozen
        return np.zeros(self.camera_count, bool) if frozen is None else frozen.is_frozen

    @cached_property
    def free(self) -> np.ndarray:
        """Which numbers are searched, bool [camera, 7]."""
        return self.high > self.low

    @cached_property
    def goes_round(self) -> np.ndarray:
        """Which free numbers are yaws without ends, bool [free]."""
        is_yaw = np.zeros_like(self.free)
        is_yaw[:, YAW_RAD] = self.high[:, YAW_RAD] - self.low[:, YAW_RAD] >= 2.0 * math.pi - 1e-9
        return is_yaw[self.free]

    @property
    def size(self) -> int:
        return int(np.count_nonzero(self.free))

    def pose_of(self, unit: np.ndarray) -> np.ndarray:
        """The feasible rig nearest to a point of the unit cube, float32 [camera, 7]. ``unit`` [free]."""
        pose = self.low.copy()
        inside = np.where(self.goes_round, np.mod(unit, 1.0), np.clip(unit, 0.0, 1.0))
        pose[self.free] += inside * (self.high - self.low)[self.free]
        return self.feasible(pose)

    def unit_of(self, mount_pose: np.ndarray) -> np.ndarray:
        """The point of the unit cube of a rig, float64 [free]."""
        free = self.free
        unit = (np.asarray(mount_pose, np.float64)[free] - self.low[free]) / (self.high - self.low)[free]
        return np.where(self.goes_round, np.mod(unit, 1.0), unit)

    def feasible(self, mount_pose: np.ndarray) -> np.ndarray:
        """The nearest rig that satisfies all constraints, its yaws in -pi..pi, float32 [camera, 7]."""
        pose = np.array(mount_pose, np.float64)
        height_delta_m = self.mount.within(pose.astype(np.float32))[:, HEIGHT_DELTA_M]
        pose[:, [X_M, Y_M]] = self.constraints.project(pose[:, [X_M, Y_M]], height_delta_m)
        pose[:, YAW_RAD] = (pose[:, YAW_RAD] + math.pi) % (2.0 * math.pi) - math.pi
        return self.mount.within(pose.astype(np.float32))

    def violation_m(self, mount_pose: np.ndarray) -> float:
        """By how much a rig breaks the constraints [m]; exactly 0 if it does not."""
        return self.constraints.violation_m(self.mount.rig(mount_pose))

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """A feasible rig, uniform among them, float64 [camera, 7]; places as `random_mount_pose` draws them."""
        middle_rad = 0.5 * (self.low + self.high)[:, YAW_RAD]
        pose = random_mount_pose(self.constraints, middle_rad, rng=rng)
        others, fixed = self.free.copy(), ~self.free
        others[:, [X_M, Y_M]] = False
        fixed[:, [X_M, Y_M, YAW_RAD]] = False
        pose[others] = rng.uniform(self.low[others], self.high[others])
        pose[fixed] = self.low[fixed]
        return pose

    def in_order(self, mount_pose: np.ndarray) -> np.ndarray:
        """The same rig with its cameras in the order of the ranges of yaw, as they answer for vehicles there.

        Frozen ones keep their places. The sum of the squared angles to the middles of the ranges is smallest.
        """
        from scipy.optimize import linear_sum_assignment

        pose, movable = np.array(mount_pose), np.flatnonzero(~self.is_frozen)
        middle_rad = 0.5 * (self.low + self.high)[movable, YAW_RAD]
        difference = middle_rad[:, None] - pose[None, movable, YAW_RAD]
        _, order = linear_sum_assignment(np.angle(np.exp(1j * difference)) ** 2)
        pose[movable] = pose[movable[order]]
        return pose
