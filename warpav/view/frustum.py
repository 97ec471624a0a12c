"""What a camera sees, as plain geometry: its frustum, its sector of bearings, arcs of what it sees, and the ground."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warpav.raster.camera import CameraModel
    from warpav.rig.rig import RigCamera


_ARC_STEPS = 1440
_BISECTIONS = 30
_TOWARDS_MIDDLE = np.linspace(0.0, 1.0, 512, endpoint=False)


def image_corners(model: CameraModel, *, depth_m: float) -> np.ndarray:
    """Corners of the image in camera coordinates, at ``depth_m`` [m] as the lens counts depth.

    That is along the optical axis for pinhole and Brown-Conrady lenses, else along the ray. Where a corner sees
    nothing, as beyond a fisheye's circle, it is the nearest point on the line to the middle that does.

    Returns:
        Float64, shape [4, 3]: top left, top right, bottom right, bottom left.
    """
    width, height = float(model.width_px), float(model.height_px)
    return depth_m * np.stack(
        [_outermost_ray(model, corner) for corner in ([0.0, 0.0], [width, 0.0], [width, height], [0.0, height])]
    )


def _outermost_ray(model: CameraModel, start_px: list[float]) -> np.ndarray:
    """The first ray on the line from a point of the image to its middle."""
    middle_px = 0.5 * np.array([model.width_px, model.height_px])
    ray = model.rays(start_px + _TOWARDS_MIDDLE[:, None] * (middle_px - start_px))
    seen = np.isfinite(ray[:, 0])
    return ray[seen.argmax()] if seen.any() else np.array([0.0, 0.0, 1.0])


def frustum_points(camera: RigCamera, *, depth_m: float) -> np.ndarray:
    """The camera's centre and the four corners of its image at ``depth_m`` [m], in the ego frame.

    Returns:
        Float64, shape [5, 3]: centre, then the corners in the order of `image_corners`.
    """
    ego_from_camera = np.asarray(camera.ego_from_camera, dtype=np.float64)
    point_camera_m = np.vstack([np.zeros(3), image_corners(camera.model, depth_m=depth_m)])
    return point_camera_m @ ego_from_camera[:3, :3].T + ego_from_camera[:3, 3]


def bearing_sector_rad(camera: RigCamera) -> tuple[float, float]:
    """Bearings between which the camera sees, along the middle row of its image [rad]."""
    rotation = np.asarray(camera.ego_from_camera, dtype=np.float64)[:3, :3]
    width, row = float(camera.model.width_px), 0.5 * camera.model.height_px
    ray = np.stack([_outermost_ray(camera.model, [column, row]) for column in (0.0, 0.5 * width, width)]) @ rotation.T
    left, middle, right = np.arctan2(ray[:, 1], ray[:, 0])
    return (
        float(middle - (middle - right) % (2.0 * math.pi)),
        float(middle + (left - middle) % (2.0 * math.pi)),
    )


def sector_polygon_m(camera: RigCamera, *, radius_m: float, step_rad: float = math.radians(2.0)) -> np.ndarray:
    """Outline of the camera's sector on the ground [m]: its position and an arc of ``radius_m`` around it.

    Returns:
        Float64, shape [point, 2], counter-clockwise, the camera's own position first.
    """
    right_rad, left_rad = bearing_sector_rad(camera)
    bearing = np.linspace(right_rad, left_rad, 2 + math.ceil((left_rad - right_rad) / step_rad))
    centre = np.asarray(camera.position_m, dtype=np.float64)[:2]
    arc = centre + radius_m * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    return np.vstack([centre, arc])


def is_seen(camera: RigCamera, direction_ego: np.ndarray) -> np.ndarray:
    """Whether directions in the ego frame, [..., 3], have an image within the camera's image; bool [...].

    It holds for every lens, turned as the camera is; nothing stands in the way.
    """
    model = camera.model
    place_px = model.project(np.asarray(direction_ego, np.float64) @ camera.ego_from_camera[:3, :3])
    with np.errstate(invalid="ignore"):
        return np.asarray(((place_px >= 0.0) & (place_px <= [model.width_px, model.height_px])).all(axis=-1))


def seen_arcs_rad(camera: RigCamera, first: np.ndarray, second: np.ndarray) -> list[tuple[float, float]]:
    """Which directions of a plane the camera sees.

    Args:
        first: Direction of angle 0 in the ego frame, unit length, shape [3].

    Returns:
        First and last angle of every arc [rad], the first in [-pi, pi), the last larger; (-pi, pi) where the camera
        sees all round. Arcs and gaps below a quarter of a degree may be missed.
    """
    basis = np.stack([first, second])

    def sees(angle_rad: np.ndarray) -> np.ndarray:
        return is_seen(camera, np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1) @ basis)

    step_rad = 2.0 * math.pi / _ARC_STEPS
    start_rad = -math.pi + (np.arange(_ARC_STEPS) + 0.5) * step_rad
    seen = sees(start_rad)
    if seen.all():
        return [(-math.pi, math.pi)]
    edge = np.flatnonzero(seen != np.roll(seen, -1))  # between this sample and the next
    low_rad, high_rad = start_rad[edge], start_rad[edge] + step_rad
    for _ in range(_BISECTIONS):
        middle_rad = 0.5 * (low_rad + high_rad)
        is_as_low = sees(middle_rad) == seen[edge]
        low_rad, high_rad = np.where(is_as_low, middle_rad, low_rad), np.where(is_as_low, high_rad, middle_rad)
    begins, ends = low_rad[~seen[edge]], low_rad[seen[edge]]
    begins = (begins + math.pi) % (2.0 * math.pi) - math.pi
    return sorted((float(begin), float(begin + ((ends - begin) % (2.0 * math.pi)).min())) for begin in begins)


def seen_ground_m(camera: RigCamera, *, reach_m: float, step_rad: float = math.radians(0.5)) -> list[np.ndarray]:
    """Level ground that the camera sees, from the nearest to the farthest point by azimuth; nothing stands in the way.

    Returns:
        Closed outlines [m], float64 [point, 2], one for each run of azimuths; empty where it sees no ground.
    """
    height_m = float(camera.position_m[2])
    if height_m <= 0.0:
        return []
    count = math.ceil(2.0 * math.pi / step_rad)
    azimuth_rad = (np.arange(count) + 0.5) * 2.0 * math.pi / count
    down_rad = np.linspace(math.atan2(height_m, reach_m), 0.5 * math.pi, math.ceil(0.5 * math.pi / step_rad))
    across = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
    direction = np.concatenate(
        [
            np.cos(down_rad)[None, :, None] * across[:, None],
            np.broadcast_to(-np.sin(down_rad)[None, :, None], (count, len(down_rad), 1)),
        ],
        axis=-1,
    )
    seen = is_seen(camera, direction)
    has_any = np.asarray(seen.any(axis=1))
    distance_m = height_m / np.tan(down_rad)
    far_m = distance_m[seen.argmax(axis=1)]
    near_m = distance_m[len(down_rad) - 1 - seen[:, ::-1].argmax(axis=1)]
    centre_m = camera.position_m[:2]
    far, near = (centre_m + each[:, None] * across for each in (far_m, near_m))
    if has_any.all():
        order = np.append(np.arange(count), 0)
        return [np.vstack([far[order], near[order][::-1]])]
    if not has_any.any():
        return []
    order = np.roll(np.arange(count), -int(np.flatnonzero(~has_any)[0]))  # begins where it sees none
    runs = np.split(order, np.flatnonzero(np.diff(has_any[order].astype(int))) + 1)
    return [np.vstack([far[run], near[run][::-1]]) for run in runs if has_any[run[0]]]
