"""Which directions no camera covers (thesis Eqs. 20 to 23)."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from warpav.optimisation.losses.loss import DeviceLoss, LossSchedule, Needs
from warpav.optimisation.losses.options import LossOptions
from warpav.optimisation.losses.scene_on_tape import SceneOnTape
from warpav_kernels.placement import placement_losses


@dataclass(frozen=True)
class AngularCoverage(DeviceLoss):
    """The share of the angle that a rig could cover and does not; the same on all scenes."""

    name = "angular_coverage"

    @classmethod
    def of(cls, options: LossOptions) -> AngularCoverage:
        """It has no parameters."""
        del options
        return cls()

    def needs(self, schedule: LossSchedule) -> Needs:
        """One field of view; the panorama as with all of the thesis's losses."""
        del schedule
        return Needs(panorama=True, one_field=True)

    def on_tape(self, scene: SceneOnTape) -> wp.array:
        """As in `DeviceLoss`."""
        device, mount_pose = scene.frame.device, scene.views.mount_pose
        loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        next_camera = wp.zeros(scene.camera_count, dtype=wp.int32, device=device)
        next_turns = wp.zeros(scene.camera_count, dtype=wp.int32, device=device)
        wp.launch(
            placement_losses.find_next_cameras_kernel,
            dim=scene.camera_count,
            inputs=[mount_pose],
            outputs=[next_camera, next_turns],
            device=device,
            record_tape=False,
        )
        wp.launch(
            placement_losses.angular_coverage_loss_kernel,
            dim=1,
            inputs=[mount_pose, next_camera, next_turns, scene.mount.camera.fov_rad],
            outputs=[loss],
            device=device,
        )
        return loss
