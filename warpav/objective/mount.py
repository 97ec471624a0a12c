"""Cameras on the mount surface: from the numbers that are optimised to the poses of all views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpav.geometry.mount_surface import MountSurface
from warpav.rig.camera import CameraModel, rotational_additions
from warpav.rig.rig import Rig, RigCamera
from warpav_kernels import mount_pose as kernels

X_M, Y_M, YAW_RAD = int(kernels.X_M), int(kernels.Y_M), int(kernels.YAW_RAD)
PITCH_RAD, ROLL_RAD = int(kernels.PITCH_RAD), int(kernels.ROLL_RAD)
MOUNT_POSE_SIZE = int(kernels.MOUNT_POSE_SIZE)


@dataclass(frozen=True)
class PlacedViews:
    """Poses of all views of a rig: view = camera * rotation_count + rotational addition.

    Attributes:
        mount_pose: x, y [m], yaw, pitch, roll [rad] of every camera, float [camera, 5].
        position_ego_m: Centre of every view [m], vec3 [view].
        camera_from_ego: Rotation from ego to camera axes of every view, mat33 [view].
    """

    mount_pose: wp.array
    position_ego_m: wp.array
    camera_from_ego: wp.array


class CameraMount:
    """A mount surface on the device, and the cameras that stand a fixed height above it."""

    def __init__(
        self, surface: MountSurface, *, camera: CameraModel, height_offset_m: float, device: str = "cpu"
    ) -> None:
        """Mount for cameras of one model.

        Args:
            surface: Height map of the ego vehicle.
            camera: The model that all cameras share; its field of view gives the rotational additions.
            height_offset_m: Height of the camera centres above the surface [m].
            device: Warp device.
        """
        self.surface = surface
        self.camera = camera
        self.height_offset_m = height_offset_m
        self.device = device
        self.rotation_count, self.rotation_step_rad = rotational_additions(camera.fov_rad)
        self._height_m = wp.array(surface.height_m, dtype=float, device=device)

    def place(self, mount_pose: wp.array, rotation_count: int | None = None) -> PlacedViews:
        """Poses of all views; recorded on the active tape, gradients flow to ``mount_pose`` [camera, 5].

        Args:
            mount_pose: x, y [m], yaw, pitch, roll [rad] of every camera, float [camera, 5].
            rotation_count: Views of every camera; None: all rotational additions.
        """
        camera_count = mount_pose.shape[0]
        rotation_count = self.rotation_count if rotation_count is None else rotation_count
        view_count = camera_count * rotation_count
        position_ego_m = wp.zeros(view_count, dtype=wp.vec3, device=self.device, requires_grad=True)
        camera_from_ego = wp.zeros(view_count, dtype=wp.mat33, device=self.device, requires_grad=True)
        wp.launch(
            kernels.place_on_surface_kernel,
            dim=camera_count,
            inputs=[
                mount_pose,
                self._height_m,
                wp.vec2(*self.surface.origin_m),
                self.surface.cell_m,
                self.height_offset_m,
                rotation_count,
                self.rotation_step_rad,
            ],
            outputs=[position_ego_m, camera_from_ego],
            device=self.device,
        )
        return PlacedViews(mount_pose, position_ego_m, camera_from_ego)

    def rig(self, mount_pose: np.ndarray) -> Rig:
        """The rig whose cameras stand at ``mount_pose`` [camera, 5], named ``camera_0``, ``camera_1``, ..."""
        height_m = self.surface.height_at_m(mount_pose[:, [X_M, Y_M]]) + self.height_offset_m
        return Rig.create(
            [
                RigCamera(
                    name=f"camera_{i}",
                    position_m=np.array([pose[X_M], pose[Y_M], height_m[i]], np.float64),
                    yaw_rad=float(pose[YAW_RAD]),
                    pitch_rad=float(pose[PITCH_RAD]),
                    roll_rad=float(pose[ROLL_RAD]),
                    model=self.camera,
                )
                for i, pose in enumerate(mount_pose)
            ]
        )


def mount_pose_of_rig(rig: Rig) -> np.ndarray:
    """x, y [m], yaw, pitch, roll [rad] of every camera, float32 [camera, 5]; the height is the mount's business."""
    return np.array([[*c.position_m[:2], c.yaw_rad, c.pitch_rad, c.roll_rad] for c in rig.cameras], np.float32)


def views_of_rig(rig: Rig, *, rotation_count: int, rotation_step_rad: float, device: str = "cpu") -> PlacedViews:
    """Poses of all views of a rig that stands anywhere; nothing is taped.

    Args:
        rig: The rig.
        rotation_count: Rotational additions per camera.
        rotation_step_rad: Angle between them about the vertical [rad].
        device: Warp device.
    """
    position, rotation = [], []
    for camera in rig.cameras:
        transform = camera.ego_from_camera
        for a in range(rotation_count):
            cosine, sine = np.cos(a * rotation_step_rad), np.sin(a * rotation_step_rad)
            turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
            position.append(transform[:3, 3])
            rotation.append((turn @ transform[:3, :3]).T)
    return PlacedViews(
        wp.array(mount_pose_of_rig(rig), dtype=float, device=device),
        wp.array(np.array(position, np.float32), dtype=wp.vec3, device=device),
        wp.array(np.array(rotation, np.float32), dtype=wp.mat33, device=device),
    )
