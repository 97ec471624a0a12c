"""The family of the thesis's losses: a mean over the vehicles of a scene that are assigned to a camera."""

from __future__ import annotations

from abc import abstractmethod

import warp as wp

from warpav.optimisation.losses.loss import DeviceLoss
from warpav.optimisation.losses.scene_on_tape import SceneOnTape
from warpav_kernels.placement import placement_losses


class AssignedVehicleLoss(DeviceLoss):
    """Mean over the assigned vehicles of a scene; a scene without any costs nothing."""

    def on_tape(self, scene: SceneOnTape) -> wp.array:
        """As in `DeviceLoss`."""
        device = scene.frame.device
        loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        if scene.assigned_count == 0:
            return loss
        vehicle_loss = wp.zeros(scene.scene.vehicle_count, dtype=float, device=device, requires_grad=True)
        self.add(scene, vehicle_loss)
        wp.launch(
            placement_losses.mean_vehicle_loss_kernel,
            dim=1,
            inputs=[vehicle_loss, scene.assigned_count],
            outputs=[loss],
            device=device,
        )
        return loss

    @abstractmethod
    def add(self, scene: SceneOnTape, vehicle_loss: wp.array) -> None:
        """Write the loss of every assigned vehicle into float [vehicle], which holds 0."""
