"""Rigs that need no search: around the highest point, and at random places."""

from __future__ import annotations

import math

import numpy as np

from warpav.optimisation.constraints import Constraints
from warpav.optimisation.mount import MOUNT_POSE_SIZE, X_M, Y_M, YAW_RAD


def highest_mount_pose(constraints: Constraints, camera_count: int) -> np.ndarray:
    """Cameras around the highest point of the mount surface, evenly turned, the first facing forward.

    They stand on the smallest circle that keeps neighbours apart, each on the side that it faces. Modules stand so
    around the highest point of their zones.

    Args:
        constraints: Where the cameras may stand, and how close.
        camera_count: Number of cameras.

    Returns:
        Mount poses, float64 [camera, 7].

    Raises:
        InputError: The cameras do not fit.
    """
    pose = np.zeros((camera_count, MOUNT_POSE_SIZE))
    pose[:, YAW_RAD] = 2.0 * math.pi * np.arange(camera_count) / camera_count
    radius_m = 0.5 * constraints.min_spacing_m / math.sin(math.pi / camera_count) if camera_count > 1 else 0.0
    outward = np.stack([np.cos(pose[:, YAW_RAD]), np.sin(pose[:, YAW_RAD])], axis=1)
    modules = np.full(camera_count, -1) if constraints.module is None else constraints.module
    highest_m = {int(module): constraints.surface.highest_point_m(int(module))[:2] for module in np.unique(modules)}
    place = np.array([highest_m[int(module)] for module in modules]) + radius_m * outward
    pose[:, [X_M, Y_M]] = constraints.project(place)
    return pose


def random_mount_pose(constraints: Constraints, yaw_rad: np.ndarray, *, rng: np.random.Generator) -> np.ndarray:
    """Cameras at random places that satisfy the constraints, each turned as the segregation says.

    Args:
        constraints: Where the cameras may stand.
        yaw_rad: Yaw of every camera [rad], [camera].
        rng: Random numbers.

    Returns:
        Mount poses, float64 [camera, 7].

    Raises:
        InputError: The cameras do not fit.
    """
    pose = np.zeros((len(yaw_rad), MOUNT_POSE_SIZE))
    pose[:, YAW_RAD] = (np.asarray(yaw_rad) + math.pi) % (2.0 * math.pi) - math.pi
    pose[:, [X_M, Y_M]] = constraints.random_place(len(yaw_rad), rng)
    return pose
