"""How much of the vehicles the ego vehicle hides (thesis Eqs. 17 to 19)."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from warpav.optimisation.losses.assigned_vehicles import AssignedVehicleLoss
from warpav.optimisation.losses.loss import LossSchedule, Needs
from warpav.optimisation.losses.options import LossOptions
from warpav.optimisation.losses.scene_on_tape import SceneOnTape
from warpav_kernels.placement import placement_losses


@dataclass(frozen=True)
class SurfaceBlockage(AssignedVehicleLoss):
    """How much of a vehicle the ego vehicle hides from the camera from which it hides least.

    Attributes:
        min_unblocked_area: Share of a vehicle left free below which it costs something, in (0, 1].
    """

    min_unblocked_area: float = 0.5
    name = "surface_blockage"

    @classmethod
    def of(cls, options: LossOptions) -> SurfaceBlockage:
        """With the parameters of a configuration."""
        return cls(options.settings.min_unblocked_area)

    def needs(self, schedule: LossSchedule) -> Needs:
        """The panorama, and the unblocked areas."""
        del schedule
        return Needs(panorama=True, unblocked_area=True, one_field=True)

    def add(self, scene: SceneOnTape, vehicle_loss: wp.array) -> None:
        """As in `AssignedVehicleLoss`."""
        device, vehicle_count = scene.frame.device, scene.scene.vehicle_count
        clearest_camera = wp.zeros(vehicle_count, dtype=wp.int32, device=device)
        wp.launch(
            placement_losses.find_clearest_cameras_kernel,
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
            placement_losses.surface_blockage_loss_kernel,
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
