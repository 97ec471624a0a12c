"""What was recorded of one traffic situation: colour, depth and instance images from known poses, and 3D boxes.

Everything is in the ego frame (ISO 8855; origin on the ground below the centre of the ego vehicle's rear axle), so that
captures of different locations have the same structure.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpav.raster.camera import CameraModel
from warpav.scene.scene import Box

ENVIRONMENT_INSTANCE, EGO_INSTANCE = 0, 65535
"""Values of instance images for what is no vehicle, and for the ego vehicle; the others are instance ids."""


class ViewKind(enum.StrEnum):
    """Why an image was taken (thesis, appendix VIII)."""

    EGO_TOP = "ego_top"
    """Top-down over the ego vehicle."""
    EGO_SIDE = "ego_side"
    """From outside towards a corner of the ego vehicle; beyond the thesis, for the sides that it leaves open."""
    TOWARDS_VEHICLE = "towards_vehicle"
    """From the ego vehicle towards another one."""
    VEHICLE_TOP = "vehicle_top"
    """Top-down over another vehicle."""
    SCENE_TOP = "scene_top"
    """Top-down above the ego vehicle, from some height."""
    ROTATION = "rotation"
    """From the ego vehicle's position, rotated about the vertical."""
    OTHER = "other"
    """Anything else; recordings of one's own."""


@dataclass(frozen=True, eq=False)
class CaptureView:
    """A camera pose of a capture."""

    name: str  # short name, unique within a capture; letters, digits, ``_`` and ``-``
    kind: ViewKind  # why it is taken
    ego_from_camera: np.ndarray  # pose, float64 [4, 4]; the camera's axes are OpenCV's (x right, y down, z forward)
    model: CameraModel  # image size and lens; a pinhole


@dataclass(frozen=True, eq=False)
class CapturedImage:
    """Three images from one camera pose."""

    view: CaptureView  # where from
    rgb: np.ndarray  # colours, sRGB, uint8 [row, column, 3]
    depth_m: np.ndarray  # depth along the optical axis [m], float32 [row, column]; inf where nothing is hit
    # Whose surface a pixel shows, glass included, uint16 [row, column]: `ENVIRONMENT_INSTANCE`, `EGO_INSTANCE` or an
    # instance id.
    instance: np.ndarray


@dataclass(frozen=True, eq=False)
class CapturedVehicle:
    """A vehicle other than the ego vehicle, as the simulator knows it."""

    instance_id: int  # its value in the instance images, 1 to 65534
    category: str  # what it is, such as ``hatchback`` or ``lorry``
    box: Box  # its 3D bounding box
    spawn_m: np.ndarray  # where it was spawned [m], shape [3]
    spawn_yaw_rad: float  # its heading there [rad]
    instance_rgb: np.ndarray  # the simulator's own colour for the instance, 0..255, shape [3]
    # As `warpav.scene.scene.Vehicle` has it: relative to the ego vehicle, forward and left [m/s], shape [2]; None:
    # unknown.
    velocity_ego_m_s: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Capture:
    """All that was recorded of one situation."""

    name: str  # short name, such as ``town_0007``
    source: str  # where it came from, such as ``town seed 7``
    ego_box: Box  # 3D bounding box of the ego vehicle
    vehicles: tuple[CapturedVehicle, ...]  # the others, in order of instance id
    images: Sequence[CapturedImage]  # the images; a sequence that may read each from disk when it is asked for
