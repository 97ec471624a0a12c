"""Outlines: of what a camera sees, as frustum, sector, arcs and ground, and of meshes seen along an axis."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warpav.raster.beams import Beams
    from warpav.raster.camera import CameraModel
    from warpav.raster.mesh import Mesh
    from warpav.rig import RigCamera

_ARC_STEPS = 1440
_BISECTIONS = 30
_RIM_STEP_RAD = math.radians(5.0)
_TOWARDS_MIDDLE = np.linspace(0.0, 1.0, 512, endpoint=False)


def image_corners(model: CameraModel, *, depth_m: float) -> np.ndarray:
    """Corners of the image in camera coordinates at a depth as the lens counts it [m], [4, 3], clockwise from top left.

    Where a corner sees nothing, as beyond a fisheye's circle, it is the nearest point on the line to the middle.
    """
    width, height = float(model.width_px), float(model.height_px)
    corner_px = ([0.0, 0.0], [width, 0.0], [width, height], [0.0, height])
    return depth_m * np.stack([_outermost_ray(model, corner) for corner in corner_px])


def _outermost_ray(model: CameraModel, start_px: list[float]) -> np.ndarray:
    middle_px = 0.5 * np.array([model.width_px, model.height_px])
    ray = model.rays(start_px + _TOWARDS_MIDDLE[:, None] * (middle_px - start_px))
    seen = np.isfinite(ray[:, 0])
    return ray[seen.argmax()] if seen.any() else np.array([0.0, 0.0, 1.0])


def beam_lines(beams: Beams, *, depth_m: float, elevation_rad: Sequence[float] = ()) -> np.ndarray:
    """Where the beams of a LiDAR or radar with some elevations are at a depth [m], from right to left.

    Without elevations those of the lowest and the highest beam; [elevation, azimuth, 3] in camera coordinates.
    """
    azimuth = np.linspace(*beams.azimuth_rad, 2 + math.ceil(beams.sector_rad / _RIM_STEP_RAD))
    up = np.array(elevation_rad or beams.elevation_rad[:: len(beams.elevation_rad) - 1])[:, None]
    right, ahead = -np.cos(up) * np.sin(azimuth), np.cos(up) * np.cos(azimuth)
    return depth_m * np.stack([right, np.broadcast_to(-np.sin(up), right.shape), ahead], axis=-1)


def view_edges(model: CameraModel, *, depth_m: float) -> list[np.ndarray]:
    """The edges of what a camera, LiDAR or radar sees up to a depth [m], lines [point, 3] in camera coordinates."""
    if model.beams is None:
        rims = image_corners(model, depth_m=depth_m)[None, [0, 1, 2, 3, 0]]
        ends = rims[0, :4]
    else:
        rims = beam_lines(model.beams, depth_m=depth_m)
        ends = rims[:0, 0] if model.beams.is_all_round else rims[:, [0, -1]].reshape(-1, 3)
    return [*(np.stack([np.zeros(3), end]) for end in ends), *rims]


def frustum_points(camera: RigCamera, *, depth_m: float) -> np.ndarray:
    """The camera's centre and the four corners of its image at a depth [m], in the ego frame, [5, 3]."""
    ego_from_camera = np.asarray(camera.ego_from_camera, dtype=np.float64)
    point_camera_m = np.vstack([np.zeros(3), image_corners(camera.model, depth_m=depth_m)])
    return point_camera_m @ ego_from_camera[:3, :3].T + ego_from_camera[:3, 3]


def bearing_sector_rad(camera: RigCamera) -> tuple[float, float]:
    """Bearings between which the camera sees, along the middle row of its image [rad]."""
    rotation = np.asarray(camera.ego_from_camera, dtype=np.float64)[:3, :3]
    width, row = float(camera.model.width_px), 0.5 * camera.model.height_px
    ray = np.stack([_outermost_ray(camera.model, [column, row]) for column in (0.0, 0.5 * width, width)]) @ rotation.T
    left, middle, right = np.arctan2(ray[:, 1], ray[:, 0])
    turn = 2.0 * math.pi
    return float(middle - (middle - right) % turn), float(middle + (left - middle) % turn)


def sector_polygon_m(camera: RigCamera, *, radius_m: float) -> np.ndarray:
    """The camera's sector on the ground [m]: its position, then an arc around it counter-clockwise, [point, 2]."""
    right_rad, left_rad = bearing_sector_rad(camera)
    bearing = np.linspace(right_rad, left_rad, 2 + math.ceil((left_rad - right_rad) / math.radians(2.0)))
    centre = np.asarray(camera.position_m, dtype=np.float64)[:2]
    return np.vstack([centre, centre + radius_m * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)])


def _is_seen(camera: RigCamera, direction_ego: np.ndarray) -> np.ndarray:
    """Whether directions in the ego frame, [..., 3], have an image within the camera's; nothing stands in the way."""
    model = camera.model
    place_px = model.project(np.asarray(direction_ego, np.float64) @ camera.ego_from_camera[:3, :3])
    with np.errstate(invalid="ignore"):
        return np.asarray(((place_px >= 0.0) & (place_px <= [model.width_px, model.height_px])).all(axis=-1))


def seen_arcs_rad(camera: RigCamera, first: np.ndarray, second: np.ndarray) -> list[tuple[float, float]]:
    """Which directions of a plane the camera sees; the first of its axes in the ego frame is angle 0.

    First and last angle of every arc [rad], the first in [-pi, pi), the last larger; (-pi, pi) where the camera sees
    all round. Arcs and gaps below a quarter of a degree may be missed.
    """
    basis = np.stack([first, second])

    def sees(angle_rad: np.ndarray) -> np.ndarray:
        return _is_seen(camera, np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1) @ basis)

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
    """Outlines of the level ground that the camera sees [m], one for each run of azimuths; see `fan_outlines_m`."""
    height_m = float(camera.position_m[2])
    if height_m <= 0.0:
        return []
    count = math.ceil(2.0 * math.pi / step_rad)
    azimuth_rad = (np.arange(count) + 0.5) * 2.0 * math.pi / count
    down_rad = np.linspace(math.atan2(height_m, reach_m), 0.5 * math.pi, math.ceil(0.5 * math.pi / step_rad))
    azimuth, down = np.meshgrid(azimuth_rad, down_rad, indexing="ij")
    level = np.cos(down)
    seen = _is_seen(camera, np.stack([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(down)], axis=-1))
    distance_m = height_m / np.tan(down_rad)
    range_m = np.stack([distance_m[len(down_rad) - 1 - seen[:, ::-1].argmax(axis=1)], distance_m[seen.argmax(axis=1)]])
    range_m[:, ~seen.any(axis=1)] = np.nan
    return fan_outlines_m(camera.position_m[:2], azimuth_rad, range_m.T)


def fan_outlines_m(centre_m: np.ndarray, azimuth_rad: np.ndarray, range_m: np.ndarray) -> list[np.ndarray]:
    """Outlines [point, 2] of what lies between the nearest and farthest ranges [azimuth, 2] around a place [m].

    One for each run of azimuths that have any; azimuths go all round.
    """
    across = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
    near, far = (centre_m + range_m[:, end, None] * across for end in (0, 1))
    has_any = np.isfinite(range_m[:, 0])
    if has_any.all():
        order = np.append(np.arange(len(near)), 0)
        return [np.vstack([far[order], near[order][::-1]])]
    if not has_any.any():
        return []
    order = np.roll(np.arange(len(near)), -int(np.flatnonzero(~has_any)[0]))  # begins where there is nothing
    runs = np.split(order, np.flatnonzero(np.diff(has_any[order].astype(int))) + 1)
    return [np.vstack([far[run], near[run][::-1]]) for run in runs if has_any[run[0]]]


STEP_M = 0.002
"""Between the lines of the raster in which an outline is found [m]; lines may be off by about as much."""

_GRID_MAX = 12_000  # steps along a side: of a larger mesh they are longer
_SUBSTEP_BITS = 6


def silhouette_m(mesh: Mesh, right: np.ndarray, up: np.ndarray, *, hole_m2: float = 0.01) -> list[np.ndarray]:
    """What a mesh covers seen from afar, as lines [point, 2] around it and around its holes, the largest first.

    Right and up are the directions of the picture, unit length [3]. Lines are within two of `STEP_M` of the mesh.
    """
    import cv2

    place_m = mesh.vertex_m.astype(np.float64) @ np.stack([right, up], axis=1)
    low_m, high_m = place_m.min(axis=0), place_m.max(axis=0)
    step_m = max(STEP_M, float((high_m - low_m).max()) / _GRID_MAX)
    columns, rows = (math.ceil(each) + 3 for each in (high_m - low_m) / step_m)
    covered = np.zeros((rows, columns), np.uint8)
    corner = np.round(((place_m - low_m) / step_m + 1.0) * 2**_SUBSTEP_BITS).astype(np.int32)[mesh.triangle]
    for each in corner:
        cv2.fillConvexPoly(covered, each, 1, lineType=cv2.LINE_8, shift=_SUBSTEP_BITS)
    lines, _ = cv2.findContours(covered, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    lines = [line for line in lines if cv2.contourArea(line) * step_m**2 >= hole_m2]
    lines.sort(key=cv2.contourArea, reverse=True)
    simple = (cv2.approxPolyDP(line, 1.0, True)[:, 0] for line in lines)
    return [low_m + (line - 1.0) * step_m for line in simple if len(line) > 2]
