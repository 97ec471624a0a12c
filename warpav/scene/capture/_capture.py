"""Captures: images and 3D boxes of a traffic situation, the simulators that take them, and where from.

Everything is in the ego frame (ISO 8855; origin on the ground below the centre of the ego vehicle's rear axle), so that
captures of different locations have the same structure.
"""

from __future__ import annotations

import enum
import math
from abc import abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpav.core.frames import FLU_FROM_RDF
from warpav.raster.camera import CameraModel
from warpav.scene._scene import Box

ENVIRONMENT_INSTANCE, EGO_INSTANCE = 0, 65535
"""Values of instance images for what is no vehicle, and for the ego vehicle; the others are instance ids."""


class ViewKind(enum.StrEnum):
    """Why an image was taken (thesis, appendix VIII)."""

    EGO_TOP = "ego_top"  # top-down over the ego vehicle
    EGO_SIDE = "ego_side"  # from outside towards its corners; beyond the thesis, for the sides that it leaves open
    TOWARDS_VEHICLE = "towards_vehicle"  # from the ego vehicle towards another one
    VEHICLE_TOP = "vehicle_top"  # top-down over another vehicle
    SCENE_TOP = "scene_top"  # top-down above the ego vehicle, from some height
    ROTATION = "rotation"  # from the ego vehicle's position, rotated about the vertical
    OTHER = "other"  # anything else; recordings of one's own


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
    # As `warpav.scene._scene.Vehicle` has it: relative to the ego vehicle, forward and left [m/s], shape [2]; None:
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


@dataclass(frozen=True, eq=False)
class SpawnPoint:
    """A pose along a lane or in a parking bay where a vehicle may be spawned."""

    position_m: np.ndarray  # on the ground, in the ego frame [m], shape [3]
    yaw_rad: float  # heading [rad]


class Simulator(AbstractContextManager["Simulator"]):
    """A simulator with a static world; a context manager that restores its state on exit.

    All poses and boxes are in the ego frame of the situation that was begun last.
    """

    name: str  # short name of that situation, such as ``town_0007``; letters, digits, ``_`` and ``-``
    source: str  # where it comes from, such as ``town seed 7``
    world: str  # fingerprint of its world: captures of another world are recorded again

    @abstractmethod
    def begin(self, seed: int) -> Box:
        """Begin a situation: the ego vehicle alone, in clear weather, the sun overhead, no vegetation."""

    @abstractmethod
    def spawn_points(self, radius_m: float) -> Sequence[SpawnPoint]:
        """Places for other vehicles within a radius of the ego vehicle, in an order that the seed chooses."""

    @abstractmethod
    def spawn(self, point: SpawnPoint) -> CapturedVehicle | None:
        """Spawn a randomly chosen and coloured vehicle; None if the simulator rejects it, for example if occupied."""

    @abstractmethod
    def remove(self, vehicle: CapturedVehicle) -> None:
        """Take a vehicle out again."""

    @abstractmethod
    def capture(self, view: CaptureView) -> CapturedImage:
        """Take the three images of a view."""

    def __exit__(self, *failure: Any) -> None:  # noqa: ANN401
        """Destroy all actors of this simulator and restore everything it changed, even after an error."""


_TOP_FOV_RAD = math.radians(90.0)
_NARROWEST_RAD, _WIDEST_RAD = math.radians(12.0), math.radians(100.0)
_MARGIN = 1.25  # how much wider than the vehicle an image of one is
_VISIBILITY_SIZE_PX = (320, 240)
_SIDE_CLEAR_M = 0.3  # above a vehicle that an image of the ego vehicle's sides would be taken from within


@dataclass(frozen=True)
class PlanSettings:
    """How a situation is recorded."""

    vehicle_count: int = 12  # vehicles that are spawned at most
    radius_m: float = 30.0  # maximum distance from the ego vehicle [m]
    width_px: int = 640  # image width [px]
    height_px: int = 480  # image height [px]
    eye_above_roof_m: float = 0.4  # height above the ego vehicle's box of the images that are taken from it [m]
    above_vehicle_m: float = 4.0  # height above a vehicle's box of the image from straight above [m]
    scene_heights_m: tuple[float, ...] = (14.0, 28.0, 45.0)  # heights above the ground of the overview images [m]
    rotation_count: int = 4  # images from the ego vehicle all around
    ego_side_count: int = 4  # images of the ego vehicle from beside it, evenly around it, starting at the front left
    ego_side_m: float = 1.8  # how far beside its box they are taken [m]


def capture_plan(ego_box: Box, vehicles: Sequence[CapturedVehicle], settings: PlanSettings) -> list[CaptureView]:
    """The views in the order of the thesis's figure 14, then the sides of the ego vehicle."""
    eye_m = _eye_position_m(ego_box, settings)
    named = [(f"{vehicle.instance_id:03d}", vehicle.box) for vehicle in vehicles]
    views = [_top(settings, "ego_top", ViewKind.EGO_TOP, ego_box)]
    views += [_towards(settings, f"towards_vehicle_{n}", ViewKind.TOWARDS_VEHICLE, eye_m, box) for n, box in named]
    views += [_top(settings, f"vehicle_top_{n}", ViewKind.VEHICLE_TOP, box) for n, box in named]
    for index, height_m in enumerate(settings.scene_heights_m):
        pose = rigid_pose(_down(ego_box.yaw_rad), np.array([*ego_box.center_m[:2], height_m]))
        views.append(_view(settings, f"scene_top_{index}", ViewKind.SCENE_TOP, pose, _TOP_FOV_RAD))
    step_rad = 2.0 * math.pi / max(settings.rotation_count, 1)
    for index in range(settings.rotation_count):
        yaw_rad = ego_box.yaw_rad + index * step_rad
        pose = rigid_pose(_facing(np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])), eye_m)
        fov_rad = min(step_rad + math.radians(10.0), _WIDEST_RAD)
        views.append(_view(settings, f"rotation_{index}", ViewKind.ROTATION, pose, fov_rad))
    # the sides, from the height of the ego vehicle's roof, or from above a vehicle that stands there
    for index in range(settings.ego_side_count):
        angle_rad = (index + 0.5) * 2.0 * math.pi / settings.ego_side_count
        towards = np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
        edge_m = 0.5 * np.asarray(ego_box.size_m) * (towards / np.abs(towards).max() + [0.0, 0.0, 1.0])
        position_m = ego_box.center_m + ego_box.ego_from_box @ (edge_m + settings.ego_side_m * towards)
        for _, box in named:
            at_its_height_m = np.array([[*position_m[:2], box.center_m[2]]])
            if box.contains(at_its_height_m, margin_m=_SIDE_CLEAR_M).all():
                position_m[2] = max(position_m[2], box.center_m[2] + 0.5 * box.size_m[2] + _SIDE_CLEAR_M)
        views.append(_towards(settings, f"ego_side_{index}", ViewKind.EGO_SIDE, position_m, ego_box))
    return views


def _eye_position_m(ego_box: Box, settings: PlanSettings) -> np.ndarray:
    return ego_box.center_m + np.array([0.0, 0.0, 0.5 * ego_box.size_m[2] + settings.eye_above_roof_m])


def record(simulator: Simulator, seed: int, settings: PlanSettings) -> Capture:
    """Set up a situation and keep its images in memory; `record_capture` in `folder` keeps them on disk."""
    ego_box = simulator.begin(seed)
    vehicles = spawn_visible_traffic(simulator, ego_box, settings)
    images = [simulator.capture(view) for view in capture_plan(ego_box, vehicles, settings)]
    return Capture(simulator.name, simulator.source, ego_box, vehicles, images)


def spawn_visible_traffic(simulator: Simulator, ego_box: Box, settings: PlanSettings) -> tuple[CapturedVehicle, ...]:
    """Spawn vehicles one after the other; one stays only if an instance image shows a new instance after it."""
    eye_m = _eye_position_m(ego_box, settings)
    visible: list[CapturedVehicle] = []
    for point in simulator.spawn_points(settings.radius_m):
        if len(visible) == settings.vehicle_count:
            break
        target_m = point.position_m + np.array([0.0, 0.0, 0.8])
        model = CameraModel(*_VISIBILITY_SIZE_PX, _TOP_FOV_RAD)
        view = CaptureView("visibility", ViewKind.OTHER, rigid_pose(_facing(target_m - eye_m), eye_m), model)
        before = np.unique(simulator.capture(view).instance)
        vehicle = simulator.spawn(point)
        if vehicle is None:
            continue
        if np.setdiff1d(np.unique(simulator.capture(view).instance), before).size:
            visible.append(vehicle)
        else:
            simulator.remove(vehicle)
    return tuple(sorted(visible, key=lambda vehicle: vehicle.instance_id))


def _top(settings: PlanSettings, name: str, kind: ViewKind, box: Box) -> CaptureView:
    """From straight above a box, its length along the image's width, as narrow as it fits."""
    above_m = 0.5 * box.size_m[2] + settings.above_vehicle_m
    aspect = settings.width_px / settings.height_px
    half_width_m = 0.5 * _MARGIN * max(box.size_m[0], aspect * box.size_m[1])
    fov_rad = 2.0 * math.atan(half_width_m / settings.above_vehicle_m)
    if fov_rad > _WIDEST_RAD:  # long vehicles from higher up
        fov_rad = _WIDEST_RAD
        above_m = 0.5 * box.size_m[2] + half_width_m / math.tan(0.5 * fov_rad)
    pose = rigid_pose(_down(box.yaw_rad + 0.5 * math.pi), box.center_m + np.array([0.0, 0.0, above_m]))
    return _view(settings, name, kind, pose, fov_rad)


def _towards(settings: PlanSettings, name: str, kind: ViewKind, eye_m: np.ndarray, box: Box) -> CaptureView:
    """From a position towards the centre of a box, with the narrowest field of view that contains it."""
    camera_from_ego = _facing(box.center_m - eye_m).T
    seen = (box.corners_m() - eye_m) @ camera_from_ego.T
    seen[:, 2] = np.maximum(seen[:, 2], 0.3)  # corners beside or behind the camera: the widest view
    tangent = np.abs(seen[:, :2] / seen[:, 2:]).max(axis=0)
    half = max(tangent[0], tangent[1] * settings.width_px / settings.height_px)
    fov_rad = float(np.clip(2.0 * math.atan(_MARGIN * half), _NARROWEST_RAD, _WIDEST_RAD))
    return _view(settings, name, kind, rigid_pose(camera_from_ego.T, eye_m), fov_rad)


def _view(settings: PlanSettings, name: str, kind: ViewKind, pose: np.ndarray, fov_rad: float) -> CaptureView:
    return CaptureView(name, kind, pose, CameraModel(settings.width_px, settings.height_px, fov_rad))


def rigid_pose(rotation: np.ndarray, position_m: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position_m
    return pose


def _facing(forward: np.ndarray) -> np.ndarray:
    """Rotation to ego axes of an upright camera that points along a direction."""
    forward = forward / np.linalg.norm(forward)
    level = math.hypot(forward[0], forward[1])
    if level < 1e-6:
        return _down(0.0) if forward[2] < 0.0 else _down(0.0) @ np.diag([1.0, -1.0, -1.0])
    left = np.array([-forward[1], forward[0], 0.0]) / level
    return np.stack([forward, left, np.cross(forward, left)], axis=1) @ FLU_FROM_RDF


def _down(yaw_rad: float) -> np.ndarray:
    """Rotation to ego axes of a camera that points straight down; its image's up direction is a heading."""
    top = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
    right = np.array([top[1], -top[0], 0.0])
    return np.stack([right, -top, [0.0, 0.0, -1.0]], axis=1)
