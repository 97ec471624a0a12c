"""What a camera sees, as plain geometry: its frustum and its sector of bearings."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warpav.raster.camera import CameraModel
    from warpav.rig.rig import RigCamera


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
    """Bearings between which the camera sees, along the middle row of its image [rad].

    Returns:
        Right edge and left edge in the ego frame, counter-clockwise from the first to the second; the second is the
        larger one and may exceed pi.
    """
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
