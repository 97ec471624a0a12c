"""The thesis's losses: in-frame rotation (Eqs. 10 to 13), detected area (14 to 16), and appendix IX (17 to 24)."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import warp as wp

from warpav.optimisation import DetectedImages, DeviceLoss, LossOptions, LossSchedule, Needs, Reference, SceneOnTape
from warpav_kernels.thesis import losses as kernels


class _ThesisLoss(DeviceLoss):
    """A loss that needs the panorama and one field of view at all times."""

    needed = Needs(panorama=True, one_field=True)

    def needs(self, schedule: LossSchedule) -> Needs:
        del schedule
        return self.needed


class _AssignedVehicleLoss(_ThesisLoss):
    """Mean over the assigned vehicles of a scene; a scene without any costs nothing."""

    def on_tape(self, scene: SceneOnTape) -> wp.array:
        device = scene.frame.device
        loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        if scene.assigned_count == 0:
            return loss
        vehicle_loss = wp.zeros(scene.scene.vehicle_count, dtype=float, device=device, requires_grad=True)
        self.add(scene, vehicle_loss)
        wp.launch(
            kernels.mean_vehicle_loss_kernel,
            dim=1,
            inputs=[vehicle_loss, scene.assigned_count],
            outputs=[loss],
            device=device,
        )
        return loss

    @abstractmethod
    def add(self, scene: SceneOnTape, vehicle_loss: wp.array) -> None:
        """Write the loss of every assigned vehicle into float [vehicle], which holds 0."""


def _area_around(scene: SceneOnTape, reference: Reference) -> wp.array:
    """Area of every vehicle over all directions of its camera [px^2], float [vehicle]."""
    around = wp.zeros(scene.scene.vehicle_count, dtype=float, device=scene.frame.device, requires_grad=True)
    wp.launch(
        kernels.sum_area_around_kernel,
        dim=around.shape,
        inputs=[scene.measure, scene.assigned_on_device, scene.rotation_count, reference.value],
        outputs=[around],
        device=scene.frame.device,
    )
    return around


@dataclass(frozen=True)
class InFrameRotation(_AssignedVehicleLoss):
    """The angle by which its camera misses a vehicle; gradients flow to the yaw alone."""

    epsilon: float = 1e-5  # weight of a vehicle that is in the frame already, in [0, 1)
    name = "in_frame_rotation"

    @classmethod
    def of(cls, options: LossOptions) -> InFrameRotation:
        return cls(options.settings.epsilon)

    def add(self, scene: SceneOnTape, vehicle_loss: wp.array) -> None:
        mount, views, device = scene.mount, scene.views, scene.frame.device
        vehicle_count = scene.scene.vehicle_count
        bearing_rad = wp.zeros(vehicle_count, dtype=wp.vec2, device=device)
        frame_state = wp.zeros(vehicle_count, dtype=wp.int32, device=device)
        wp.launch(
            kernels.find_vehicle_bearings_kernel,
            dim=vehicle_count,
            inputs=[
                scene.measures.value,
                scene.assigned_on_device,
                views.mount_pose,
                scene.rotation_count,
                mount.rotation_step_rad,
                float(mount.camera.width_px),
                mount.camera.fov_rad,
            ],
            outputs=[bearing_rad, frame_state],
            device=device,
            record_tape=False,
        )
        wp.launch(
            kernels.in_frame_rotation_loss_kernel,
            dim=scene.camera_count,
            inputs=[views.mount_pose, scene.assigned_on_device, bearing_rad, frame_state, self.epsilon],
            outputs=[vehicle_loss],
            device=device,
        )


@dataclass(frozen=True)
class DetectedArea(_AssignedVehicleLoss):
    """How much of a vehicle's silhouette lies outside the matched detection's box."""

    min_detected_area: float = 0.5  # detected share of a vehicle below which it costs something, in (0, 1]
    epsilon: float = 1e-5  # weight of pixels outside the box, in [0, 1)
    reference: Reference = Reference.NON_OCCLUDED  # what the detected area is compared with
    name = "detected_area"
    # its own vehicles in each camera's images
    needed = Needs(panorama=True, detections=DetectedImages.ASSIGNED, one_field=True)

    @classmethod
    def of(cls, options: LossOptions) -> DetectedArea:
        return cls(options.settings.min_detected_area, options.settings.epsilon, options.reference)

    def add(self, scene: SceneOnTape, vehicle_loss: wp.array) -> None:
        wp.launch(
            kernels.detected_area_loss_kernel,
            dim=scene.scene.vehicle_count,
            inputs=[
                scene.measure,
                _area_around(scene, self.reference),
                scene.assigned_on_device,
                scene.rotation_count,
                self.min_detected_area,
                self.epsilon,
            ],
            outputs=[vehicle_loss],
            device=scene.frame.device,
        )


@dataclass(frozen=True)
class ObjectVisibility(_AssignedVehicleLoss):
    """The detected-area loss of a detector that misses nothing: how much of a vehicle is not visible."""

    min_visible_area: float = 0.5  # visible share of a vehicle below which it costs something, in (0, 1]
    reference: Reference = Reference.NON_OCCLUDED  # what the visible area is compared with
    name = "object_visibility"

    @classmethod
    def of(cls, options: LossOptions) -> ObjectVisibility:
        return cls(options.settings.min_detected_area, options.reference)

    def add(self, scene: SceneOnTape, vehicle_loss: wp.array) -> None:
        wp.launch(
            kernels.object_visibility_loss_kernel,
            dim=scene.scene.vehicle_count,
            inputs=[
                scene.measure,
                _area_around(scene, self.reference),
                scene.assigned_on_device,
                scene.rotation_count,
                self.min_visible_area,
            ],
            outputs=[vehicle_loss],
            device=scene.frame.device,
        )


@dataclass(frozen=True)
class SurfaceBlockage(_AssignedVehicleLoss):
    """How much of a vehicle the ego vehicle hides from the camera from which it hides least."""

    min_unblocked_area: float = 0.5  # share of a vehicle left free below which it costs something, in (0, 1]
    name = "surface_blockage"
    needed = Needs(panorama=True, unblocked_area=True, one_field=True)

    @classmethod
    def of(cls, options: LossOptions) -> SurfaceBlockage:
        return cls(options.settings.min_unblocked_area)

    def add(self, scene: SceneOnTape, vehicle_loss: wp.array) -> None:
        device, vehicle_count = scene.frame.device, scene.scene.vehicle_count
        clearest_camera = wp.zeros(vehicle_count, dtype=wp.int32, device=device)
        wp.launch(
            kernels.find_clearest_cameras_kernel,
            dim=vehicle_count,
            inputs=[
                scene.measures.value,
                scene.unblocked.value,
                scene.assigned_on_device,
                scene.camera_count,
                scene.rotation_count,
            ],
            outputs=[clearest_camera],
            device=device,
            record_tape=False,
        )
        wp.launch(
            kernels.surface_blockage_loss_kernel,
            dim=vehicle_count,
            inputs=[
                scene.measure,
                scene.unblocked_area,
                scene.assigned_on_device,
                clearest_camera,
                scene.rotation_count,
                self.min_unblocked_area,
            ],
            outputs=[vehicle_loss],
            device=device,
        )


@dataclass(frozen=True)
class AngularCoverage(_ThesisLoss):
    """The share of the angle that a rig could cover and does not; the same on all scenes."""

    name = "angular_coverage"

    @classmethod
    def of(cls, options: LossOptions) -> AngularCoverage:
        del options
        return cls()

    def on_tape(self, scene: SceneOnTape) -> wp.array:
        device, mount_pose = scene.frame.device, scene.views.mount_pose
        loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        next_camera = wp.zeros(scene.camera_count, dtype=wp.int32, device=device)
        next_turns = wp.zeros(scene.camera_count, dtype=wp.int32, device=device)
        wp.launch(
            kernels.find_next_cameras_kernel,
            dim=scene.camera_count,
            inputs=[mount_pose],
            outputs=[next_camera, next_turns],
            device=device,
            record_tape=False,
        )
        wp.launch(
            kernels.angular_coverage_loss_kernel,
            dim=1,
            inputs=[mount_pose, next_camera, next_turns, scene.mount.camera.fov_rad],
            outputs=[loss],
            device=device,
        )
        return loss
