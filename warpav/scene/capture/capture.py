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
    """A camera pose of a capture.

    Attributes:
        name: Short name, unique within a capture; letters, digits, ``_`` and ``-``.
        kind: Why it is taken.
        ego_from_camera: Pose, float64 [4, 4]; the camera's axes are OpenCV's (x right, y down, z forward).
        model: Image size and lens; a pinhole.
    """

    name: str
    kind: ViewKind
    ego_from_camera: np.ndarray
    model: CameraModel


@dataclass(frozen=True, eq=False)
class CapturedImage:
    """Three images from one camera pose.

    Attributes:
        view: Where from.
        rgb: Colours, sRGB, uint8 [row, column, 3].
        depth_m: Depth along the optical axis [m], float32 [row, column]; inf where nothing is hit.
        instance: Whose surface a pixel shows, glass included, uint16 [row, column]: `ENVIRONMENT_INSTANCE`,
            `EGO_INSTANCE` or an instance id.
    """

    view: CaptureView
    rgb: np.ndarray
    depth_m: np.ndarray
    instance: np.ndarray


@dataclass(frozen=True, eq=False)
class CapturedVehicle:
    """A vehicle other than the ego vehicle, as the simulator knows it.

    Attributes:
        instance_id: Its value in the instance images, 1 to 65534.
        category: What it is, such as ``hatchback`` or ``lorry``.
        box: Its 3D bounding box.
        spawn_m: Where it was spawned [m], shape [3].
        spawn_yaw_rad: Its heading there [rad].
        instance_rgb: The simulator's own colour for the instance, 0..255, shape [3].
        velocity_ego_m_s: As `warpav.scene.scene.Vehicle` has it: relative to the ego vehicle, forward and left [m/s],
            shape [2]; None: unknown.
    """

    instance_id: int
    category: str
    box: Box
    spawn_m: np.ndarray
    spawn_yaw_rad: float
    instance_rgb: np.ndarray
    velocity_ego_m_s: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Capture:
    """All that was recorded of one situation.

    Attributes:
        name: Short name, such as ``town_0007``.
        source: Where it came from, such as ``town seed 7``.
        ego_box: 3D bounding box of the ego vehicle.
        vehicles: The others, in order of instance id.
        images: The images; a sequence that may read each from disk when it is asked for.
    """

    name: str
    source: str
    ego_box: Box
    vehicles: tuple[CapturedVehicle, ...]
    images: Sequence[CapturedImage]
