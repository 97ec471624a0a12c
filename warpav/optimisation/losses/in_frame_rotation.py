"""How far cameras have to turn to see their vehicles (thesis Eqs. 10 to 13)."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from warpav.optimisation.losses.assigned_vehicles import AssignedVehicleLoss
from warpav.optimisation.losses.loss import LossSchedule, Needs
from warpav.optimisation.losses.options import LossOptions
from warpav.optimisation.losses.scene_on_tape import SceneOnTape
from warpav_kernels.placement import placement_losses


@dataclass(frozen=True)
class InFrameRotation(AssignedVehicleLoss):
    """The angle by which its camera misses a vehicle; gradients flow to the yaw alone.

    Attributes:
        epsilon: Weight of a vehicle that is in the frame already, in [0, 1).
    """

    epsilon: float = 1e-5
    name = "in_frame_rotation"

    @classmethod
    def of(cls, options: LossOptions) -> InFrameRotation:
        """With the parameters of a configuration."""
        return cls(options.settings.epsilon)

    def needs(self, schedule: LossSchedule) -> Needs:
        """The panorama."""
        del schedule
        return Needs(panorama=True, one_field=True)

    def add(self, scene: SceneOnTape, vehicle_loss: wp.array) -> None:
        """As in `AssignedVehicleLoss`."""
        mount, views, device = scene.mount, scene.views, scene.frame.device
        vehicle_count = scene.scene.vehicle_count
        bearing_rad = wp.zeros(vehicle_count, dtype=wp.vec2, device=device)
        frame_state = wp.zeros(vehicle_count, dtype=wp.int32, device=device)
        wp.launch(
            placement_losses.find_vehicle_bearings_kernel,
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
            placement_losses.in_frame_rotation_loss_kernel,
            dim=scene.camera_count,
            inputs=[views.mount_pose, scene.assigned_on_device, bearing_rad, frame_state, self.epsilon],
            outputs=[vehicle_loss],
            device=device,
        )
