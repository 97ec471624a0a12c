"""Cameras of all kinds, seen through windows of their images: what a detection probability for any camera is fitted on.

It depends on what reaches the network: pixels, shares, borders, colours. So a window cut out of a camera's image is as
good as the whole image, as far as the objects in it go, and costs a small render and a small input: it is a camera
itself, with the same focal length and another principal point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.rig import MountSurface, RigCamera

RECIPE = 2
"""Number of this mixture: who changes what is drawn raises it, and all fits for any camera are fitted again."""

_WINDOWS_PX = ((256, 256, 24), (512, 384, 8), (960, 544, 5), (1600, 896, 1))
"""Width, height and number a scene of the windows for networks that take images of any size."""
_ASPECTS = (1.0, 4.0 / 3.0, 16.0 / 9.0)
_WIDEST_IMAGE_PX = 2048
_PIXELS_PER_SCENE = 7e6
_VIEWS_PER_SCENE = 24

_PINHOLE_FOV_DEG = (40.0, 130.0)
_FISHEYE_FOV_DEG = (100.0, 200.0)
_FISHEYE_SHARE = 0.25
_PITCH_DEG = (-15.0, 40.0)
_LEVEL_SHARE = 0.3
_ROOF_SHARE = 0.5
_ROOF_OFFSET_M = (0.05, 2.0)
_BODY_HEIGHT_M = (0.3, 3.0)
_BODY_STANDOFF_M = 0.02
_BODY_YAW_DEG = 75.0
_TRIES = 8


@runtime_checkable
class ScalingDetector(Protocol):
    """A detector that tells how it scales images, so that one fit can serve all cameras."""

    def input_size_px(self, height_px: int, width_px: int) -> tuple[int, int]: ...

    def network_scale(self, height_px: int, width_px: int) -> tuple[float, float]: ...


@dataclass(frozen=True)
class Window:
    """Images of one size that a detector is tried on."""

    width_px: int  # their width [px]
    height_px: int  # their height [px]
    count: int  # how many of them in every scene
    is_cut: bool  # whether they are cut out of larger images; else they are whole ones


def windows_of(detector: ScalingDetector) -> tuple[Window, ...]:
    """The images that a detector is tried on, small ones that its network receives pixel by pixel.

    Windows of images up to `_WIDEST_IMAGE_PX` for networks of any size; else whole images as wide as the network's own.
    """
    if all(detector.network_scale(height, width) == (1.0, 1.0) for width, height, _ in _WINDOWS_PX):
        return tuple(Window(*window, is_cut=True) for window in _WINDOWS_PX)
    rows, columns = detector.input_size_px(256, 256)
    count = max(1, round(min(_VIEWS_PER_SCENE, _PIXELS_PER_SCENE / (rows * columns)) / len(_ASPECTS)))
    return tuple(Window(columns, max(8, round(columns / aspect)), count, is_cut=False) for aspect in _ASPECTS)


def mixed_camera(
    rng: np.random.Generator,
    window: Window,
    *,
    surface: MountSurface,
    ego_bounds_m: np.ndarray,
    object_ego_m: np.ndarray,
    near_m: float,
    name: str = "camera",
) -> RigCamera:
    """A camera of any lens, field of view and size, anywhere on a vehicle, seen through a window of its image.

    Half of them are on roof and bonnet, up to 2 m above, half on the flanks, front and rear. A window that is cut out
    shows an object, if the camera sees any.
    """
    for tries_left in range(_TRIES, -1, -1):
        is_fisheye = rng.random() < _FISHEYE_SHARE
        fov_rad = math.radians(rng.uniform(*(_FISHEYE_FOV_DEG if is_fisheye else _PINHOLE_FOV_DEG)))
        width_px, height_px = window.width_px, window.height_px
        if window.is_cut:
            width_px = round(math.exp(rng.uniform(math.log(width_px), math.log(_WIDEST_IMAGE_PX))))
            height_px = max(height_px, round(width_px / rng.choice(_ASPECTS)))
        model = CameraModel(width_px, height_px, fov_rad, near_m, Lens.FISHEYE if is_fisheye else Lens.PINHOLE)
        camera = _any_place(rng, surface, ego_bounds_m, model, name)
        if not window.is_cut:
            return camera
        place_px = model.project((object_ego_m - camera.position_m) @ camera.ego_from_camera[:3, :3])
        size_px = np.array([model.width_px, model.height_px], np.float64)
        inside = place_px[((place_px >= 0.0) & (place_px <= size_px)).all(axis=1)]
        if len(inside) == 0 and tries_left > 0:
            continue
        aim_px = inside[rng.integers(len(inside))] if len(inside) else 0.5 * size_px
        return _cut(rng, camera, window, aim_px)
    raise AssertionError


def _any_place(
    rng: np.random.Generator, surface: MountSurface, ego_bounds_m: np.ndarray, model: CameraModel, name: str
) -> RigCamera:
    pitch_rad = 0.0 if rng.random() < _LEVEL_SHARE else math.radians(rng.uniform(*_PITCH_DEG))
    if rng.random() < _ROOF_SHARE:
        position_m = rng.uniform(*surface.bounds_m)
        offset_m = math.exp(rng.uniform(*np.log(_ROOF_OFFSET_M)))
        z_m = float(surface.height_at_m(position_m[None])[0]) + offset_m
        return RigCamera(name, np.array([*position_m, z_m]), rng.uniform(-math.pi, math.pi), pitch_rad, 0.0, model)
    low_m, high_m = ego_bounds_m[:, :2].astype(np.float64)
    side = int(rng.integers(4))  # front, left, rear, right
    outwards = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][side])
    position_m = rng.uniform(low_m, high_m)
    axis = side % 2
    position_m[axis] = (high_m if side < 2 else low_m)[axis]
    position_m = position_m + _BODY_STANDOFF_M * outwards
    yaw_rad = 0.5 * math.pi * side + math.radians(rng.uniform(-_BODY_YAW_DEG, _BODY_YAW_DEG))
    return RigCamera(name, np.array([*position_m, rng.uniform(*_BODY_HEIGHT_M)]), yaw_rad, pitch_rad, 0.0, model)


def _cut(rng: np.random.Generator, camera: RigCamera, window: Window, aim_px: np.ndarray) -> RigCamera:
    """The camera that sees a window of another's image with a place in it, nowhere beyond the image."""
    model = camera.model
    size_px = np.array([window.width_px, window.height_px])
    spare_px = np.array([model.width_px, model.height_px]) - size_px
    corner_px = np.clip(np.round(aim_px - rng.uniform(0.15, 0.85, 2) * size_px), 0.0, spare_px)
    return replace(camera, model=window_model(model, corner_px, size_px))


def window_model(model: CameraModel, corner_px: np.ndarray, size_px: np.ndarray) -> CameraModel:
    """The camera that sees a window of a camera's image, pixel by pixel."""
    fx, fy, cx, cy = model.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    return CameraModel(
        int(size_px[0]),
        int(size_px[1]),
        near_m=model.near_m,
        lens=model.lens,
        focal_px=(fx, fy),
        centre_px=(cx - float(corner_px[0]), cy - float(corner_px[1])),
        distortion=model.distortion,
    )
