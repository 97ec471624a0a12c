"""Rigs that need no search: around the highest point, at the roof's edge, at random, and those of known vehicles."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from warpav.optimisation._constraints import Constraints
from warpav.optimisation._mount import MOUNT_POSE_SIZE, X_M, Y_M, YAW_RAD, CameraMount
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig import MovedRig, Rig, blocked_shares, ray_caster

TOP_M = 0.25  # how far below the highest point the top of a vehicle may reach [m]


def highest_mount_pose(constraints: Constraints, camera_count: int) -> np.ndarray:
    """Cameras around the highest point (of their zones), evenly turned, the first forward, float64 [camera, 7].

    They stand on the smallest circle that keeps neighbours apart, each on the side that it faces.
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
    """Cameras at the edge of the top, evenly turned, the first forward, each where it ends, float64 [camera, 7].

    The top is what is at most `TOP_M` below the highest point, in the same zone.
    """
    surface = constraints.surface
    pose = np.zeros((camera_count, MOUNT_POSE_SIZE))
    pose[:, YAW_RAD] = 2.0 * math.pi * np.arange(camera_count) / camera_count
    place = surface.place_m[surface.inside]
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
    """Cameras at random places that satisfy the constraints, turned as the segregation says, float64 [camera, 7]."""
    pose = np.zeros((len(yaw_rad), MOUNT_POSE_SIZE))
    pose[:, YAW_RAD] = (np.asarray(yaw_rad) + math.pi) % (2.0 * math.pi) - math.pi
    pose[:, [X_M, Y_M]] = constraints.random_place(len(yaw_rad), rng)
    return pose


_PLACE_STEP_M = 0.05  # distance between the places that are tried, on the mount surface


def move_to_vehicle(
    rig: Rig, mount: CameraMount, ego: Mesh, *, constraints: Constraints, image: CameraModel | None = None
) -> MovedRig:
    """Put every camera of a rig, one after the other, on the nearest place on a vehicle that keeps its direction free.

    Both vehicles' frames are laid over each other. A direction is free if the middle row of the image does not meet
    the vehicle; where that is so nowhere, the place with the least hidden view is taken.
    """
    caster = ray_caster(ego)
    # camera centres all over where they may stand [m], float64 [place, 3]
    low_m, high_m = mount.surface.bounds_m
    count = np.maximum(np.ceil((high_m - low_m) / _PLACE_STEP_M).astype(int) + 1, 2)
    x_m, y_m = (np.linspace(low, high, n) for low, high, n in zip(low_m, high_m, count, strict=True))
    plane_m = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1).reshape(-1, 2)
    plane_m = plane_m[constraints.contains(plane_m)]
    place_m = mount.surface.point_m(plane_m, mount.surface.height_at_m(plane_m) + mount.height_offset_m)
    is_taken = np.zeros(len(place_m), bool)
    cameras, moved_m, blocked_share = [], [], []
    for camera in rig.cameras:
        if is_taken.all():
            raise constraints.do_not_fit(len(rig.cameras))
        share = blocked_shares(caster, camera, place_m)
        distance_m = np.linalg.norm(place_m - camera.position_m, axis=1)
        # the free places first, of these the nearest
        share[is_taken] = np.inf
        best = np.lexsort((distance_m, share))[0]
        model = camera.model
        if image is not None:
            model = dataclasses.replace(model.resized(image.width_px, image.height_px), near_m=image.near_m)
        cameras.append(dataclasses.replace(camera, position_m=place_m[best], model=model))
        moved_m.append(distance_m[best])
        blocked_share.append(share[best])
        is_taken |= np.linalg.norm(place_m - place_m[best], axis=1) < constraints.min_spacing_m
    return MovedRig(Rig(cameras), np.array(moved_m), np.array(blocked_share))
