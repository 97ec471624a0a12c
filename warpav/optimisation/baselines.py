"""Rigs that need no search: around the highest point, and at random places."""

from __future__ import annotations

import math

import numpy as np

from warpav.optimisation.constraints import Constraints
from warpav.optimisation.mount import MOUNT_POSE_SIZE, X_M, Y_M, YAW_RAD

TOP_M = 0.25
"""How far below the highest point the top of a vehicle may reach [m]."""


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


def edge_mount_pose(constraints: Constraints, camera_count: int) -> np.ndarray:
    """Cameras at the edge of the top of the mount surface, evenly turned, each where the top ends in front of it.

    A flush camera in the middle of a roof sees little but the roof; at the edge it sees the ground below. The top is
    what is at most `TOP_M` below the highest point, in the same zone. The first camera faces forward.

    Args:
        constraints: As of `highest_mount_pose`.
        camera_count: Likewise.

    Returns:
        Mount poses, float64 [camera, 7].

    Raises:
        InputError: The cameras do not fit.
    """
    surface = constraints.surface
    pose = np.zeros((camera_count, MOUNT_POSE_SIZE))
    pose[:, YAW_RAD] = 2.0 * math.pi * np.arange(camera_count) / camera_count
    is_mountable = np.ones(surface.height_m.shape, bool) if surface.is_mountable is None else surface.is_mountable
    place = surface.origin_m + surface.cell_m * np.argwhere(is_mountable)
    if surface.zones:
        place = place[surface.zone_at(place) == surface.zone_at(surface.highest_point_m()[None, :2])]
    point = surface.point_m(place, surface.height_at_m(place))
    is_top = point[:, 2] >= point[:, 2].max() - TOP_M
    place, from_middle = place[is_top], point[is_top, :2] - point[is_top, :2].mean(axis=0)
    for camera, yaw in enumerate(pose[:, YAW_RAD]):
        ahead = from_middle @ np.array([math.cos(yaw), math.sin(yaw)])
        aside = np.abs(from_middle @ np.array([-math.sin(yaw), math.cos(yaw)]))
        pose[camera, [X_M, Y_M]] = place[np.where(ahead >= ahead.max() - surface.cell_m, aside, np.inf).argmin()]
    pose[:, [X_M, Y_M]] = constraints.project(pose[:, [X_M, Y_M]])
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
