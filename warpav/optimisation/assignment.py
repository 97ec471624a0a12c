"""Which camera answers for which vehicle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial

import numpy as np

from warpav.rig.rig import Rig
from warpav.scene.device_scene import DeviceScene


class AssignedScene:
    """A scene and the camera that answers for each of its vehicles; equal only to itself.

    Attributes:
        scene: The scene on the device.
    """

    def __init__(self, scene: DeviceScene, assigned_camera: np.ndarray | Callable[[], np.ndarray]) -> None:
        """A scene with its vehicles assigned.

        Args:
            scene: The scene on the device.
            assigned_camera: As the property, or what finds it: that takes renders, and few losses ask for it.
        """
        self.scene = scene
        self._given = assigned_camera

    @cached_property
    def assigned_camera(self) -> np.ndarray:
        """Index of the camera of every vehicle, -1 for none, int32 [vehicle]."""
        return self._given() if callable(self._given) else self._given


def assign_vehicles(scenes: Sequence[DeviceScene], areas: Sequence[np.ndarray]) -> list[AssignedScene]:
    """Give every vehicle to the camera whose orientation sees most of it; to none where no orientation sees it.

    Args:
        scenes: The scenes.
        areas: Area of every vehicle in the orientation of every camera (`areas_around`), one [vehicle, camera] per
            scene.
    """
    return [AssignedScene(scene, cameras_of(area)) for scene, area in zip(scenes, areas, strict=True)]


def cameras_of(area: np.ndarray) -> np.ndarray:
    """The camera whose orientation sees most of a vehicle, -1 where none sees it, int32 [vehicle].

    Args:
        area: As one of those of `assign_vehicles`, [vehicle, camera].
    """
    found = np.where((area > 0.0).any(axis=1), area.argmax(axis=1), -1) if len(area) else np.zeros(0)
    return found.astype(np.int32)


def assign_to_nearest_cameras(scenes: Sequence[AssignedScene], yaw_rad: np.ndarray, rig: Rig) -> list[AssignedScene]:
    """Scenes whose vehicles belong to the camera that looks the way of their orientation.

    Segregation gives every vehicle an orientation; a rig from elsewhere lists its cameras in its own order.
    Orientations and cameras are paired so that the sum of the squared angles between them is smallest. (Without the
    squares many pairings are equally good, and rounding would choose.)

    Args:
        scenes: Scenes with vehicles assigned to orientations.
        yaw_rad: The orientations [rad], [orientation]; as many as the rig has cameras.
        rig: The rig.
    """
    camera_of_orientation = nearest_cameras(yaw_rad, rig)
    return [AssignedScene(each.scene, partial(_renamed, each, camera_of_orientation)) for each in scenes]


def _renamed(assigned: AssignedScene, camera_of_orientation: np.ndarray) -> np.ndarray:
    """The cameras of a scene's vehicles by the orientations' cameras, int32 [vehicle]."""
    orientation = assigned.assigned_camera
    return np.where(orientation >= 0, camera_of_orientation[np.maximum(orientation, 0)], -1).astype(np.int32)


def nearest_cameras(yaw_rad: np.ndarray, rig: Rig) -> np.ndarray:
    """The camera of a rig that each orientation is paired with, int [orientation]; see `assign_to_nearest_cameras`."""
    from scipy.optimize import linear_sum_assignment

    camera_yaw_rad = np.array([camera.yaw_rad for camera in rig.cameras])
    difference = np.asarray(yaw_rad)[:, None] - camera_yaw_rad[None, :]
    _, camera_of_orientation = linear_sum_assignment(np.angle(np.exp(1j * difference)) ** 2)
    return camera_of_orientation
