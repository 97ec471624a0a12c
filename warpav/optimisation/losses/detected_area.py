"""How much of its vehicles a camera shows: in boxes of detections, or at all (thesis Eqs. 14 to 16, 24)."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from warpav.optimisation.losses.assigned_vehicles import AssignedVehicleLoss
from warpav.optimisation.losses.loss import DetectedImages, LossSchedule, Needs
from warpav.optimisation.losses.options import LossOptions, Reference
from warpav.optimisation.losses.scene_on_tape import SceneOnTape
from warpav_kernels.placement import placement_losses


@dataclass(frozen=True)
class DetectedArea(AssignedVehicleLoss):
    """How much of a vehicle's silhouette lies outside the matched detection's box.

    Attributes:
        min_detected_area: Detected share of a vehicle below which it costs something, in (0, 1].
        epsilon: Weight of pixels outside the box, in [0, 1).
        reference: What the detected area is compared with.
    """

    min_detected_area: float = 0.5
    epsilon: float = 1e-5
    reference: Reference = Reference.NON_OCCLUDED
    name = "detected_area"

    @classmethod
    def of(cls, options: LossOptions) -> DetectedArea:
        """With the parameters of a configuration."""
        return cls(options.settings.min_detected_area, options.settings.epsilon, options.reference)

    def needs(self, schedule: LossSchedule) -> Needs:
        """The panorama, and each camera's detections of its own vehicles."""
        del schedule
        return Needs(panorama=True, detections=DetectedImages.ASSIGNED, one_field=True)

    def add(self, scene: SceneOnTape, vehicle_loss: wp.array) -> None:
        """As in `AssignedVehicleLoss`."""
        wp.launch(
            placement_losses.detected_area_loss_kernel,
            dim=scene.scene.vehicle_count,
            inputs=[
                scene.measure,
                scene.area_around(self.reference.value),
                scene.assigned_on_device,
                scene.rotation_count,
                self.min_detected_area,
                self.epsilon,
            ],
            outputs=[vehicle_loss],
            device=scene.frame.device,
        )


@dataclass(frozen=True)
class ObjectVisibility(AssignedVehicleLoss):
    """The detected-area loss of a detector that misses nothing: how much of a vehicle is not visible.

    Attributes:
        min_visible_area: Visible share of a vehicle below which it costs something, in (0, 1].
        reference: What the visible area is compared with.
    """

    min_visible_area: float = 0.5
    reference: Reference = Reference.NON_OCCLUDED
    name = "object_visibility"

    @classmethod
    def of(cls, options: LossOptions) -> ObjectVisibility:
        """With the parameters of a configuration."""
        return cls(options.settings.min_detected_area, options.reference)

    def needs(self, schedule: LossSchedule) -> Needs:
        """The panorama."""
        del schedule
        return Needs(panorama=True, one_field=True)

    def add(self, scene: SceneOnTape, vehicle_loss: wp.array) -> None:
        """As in `AssignedVehicleLoss`."""
        wp.launch(
            placement_losses.object_visibility_loss_kernel,
            dim=scene.scene.vehicle_count,
            inputs=[
                scene.measure,
                scene.area_around(self.reference.value),
                scene.assigned_on_device,
                scene.rotation_count,
                self.min_visible_area,
            ],
            outputs=[vehicle_loss],
            device=scene.frame.device,
        )
