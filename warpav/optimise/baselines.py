"""Rigs that need no search: around the highest point, and at random places."""

from __future__ import annotations

import math

import numpy as np

from warpav.objective.constraints import cameras_do_not_fit, min_camera_distance_m, project_to_constraints
from warpav.objective.mount import MOUNT_POSE_SIZE, X_M, Y_M, YAW_RAD, CameraMount

RANDOM_TRIES = 1000


def highest_mount_pose(mount: CameraMount, camera_count: int, *, min_spacing_m: float) -> np.ndarray:
    """Cameras around the highest point of the mount surface, evenly turned, the first facing forward.

    They stand on the smallest circle that keeps neighbours ``min_spacing_m`` apart, each on the side that it faces.

    Returns:
        Mount poses, float64 [camera, 5].

    Raises:
        InputError: The cameras do not fit.
    """
    pose = np.zeros((camera_count, MOUNT_POSE_SIZE))
    pose[:, YAW_RAD] = 2.0 * math.pi * np.arange(camera_count) / camera_count
    radius_m = 0.5 * min_spacing_m / math.sin(math.pi / camera_count) if camera_count > 1 else 0.0
    outward = np.stack([np.cos(pose[:, YAW_RAD]), np.sin(pose[:, YAW_RAD])], axis=1)
    place = mount.surface.highest_point_m()[:2] + radius_m * outward
    pose[:, [X_M, Y_M]] = project_to_constraints(place, mount.surface, min_spacing_m=min_spacing_m)
    return pose


def random_mount_pose(
    mount: CameraMount, yaw_rad: np.ndarray, *, min_spacing_m: float, rng: np.random.Generator
) -> np.ndarray:
    """Cameras at random places that satisfy the constraints, each turned as the segregation says.

    Args:
        mount: Where the cameras may stand.
        yaw_rad: Yaw of every camera [rad], [camera].
        min_spacing_m: Least distance between two camera centres [m].
        rng: Random numbers.

    Returns:
        Mount poses, float64 [camera, 5].

    Raises:
        InputError: The cameras do not fit.
    """
    low_m, high_m = mount.surface.bounds_m
    pose = np.zeros((len(yaw_rad), MOUNT_POSE_SIZE))
    pose[:, YAW_RAD] = (np.asarray(yaw_rad) + math.pi) % (2.0 * math.pi) - math.pi
    for _ in range(RANDOM_TRIES):
        place = rng.uniform(low_m, high_m, size=(len(yaw_rad), 2))
        if min_camera_distance_m(np.c_[place, mount.surface.height_at_m(place)]) >= min_spacing_m:
            pose[:, [X_M, Y_M]] = place
            return pose
    raise cameras_do_not_fit(len(yaw_rad), mount.surface, min_spacing_m)
