"""The expected share of objects that a rig misses: what the default method lowers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import warp as wp

from warpav.optimisation.losses._loss import DetectedImages, DeviceLoss, LossOptions, LossSchedule, Needs
from warpav.optimisation.losses._scene_on_tape import SceneOnTape
from warpav.scene import DeviceScene
from warpav_kernels.placement import expected_misses


@dataclass(frozen=True)
class ExpectedMissRate(DeviceLoss):
    """The rig misses what all its cameras miss, each with the probability that `CameraProbability` gives."""

    combine: Literal["any", "best"] = "any"  # ``any`` camera may detect an object (noisy or)
    detector_share: float = 0.0  # how much of a probability is what the detector really found, at the end of a run
    name = "expected_miss_rate"
    weighs_objects = True

    @classmethod
    def of(cls, options: LossOptions) -> ExpectedMissRate:
        return cls(options.settings.combine, options.settings.detector_share)

    def needs(self, schedule: LossSchedule) -> Needs:
        return Needs(
            panorama=schedule.panorama_share > 0.0,
            detections=DetectedImages.ALL if schedule.detector_share > 0.0 else DetectedImages.NONE,
            detection_probability=True,
        )

    def count(self, scene: DeviceScene) -> int:
        """The mean is over all objects of the batch, by their weights where there are any."""
        return scene.vehicle_count

    def on_tape(self, scene: SceneOnTape) -> wp.array:
        """Expected number of missed objects by their weights, as in `DeviceLoss`."""
        device = scene.frame.device
        loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        object_count = scene.scene.vehicle_count
        if object_count == 0:
            return loss
        found, given = scene.detection_probability, [scene.detected, scene.detector_share]
        counted_camera = wp.full(object_count, -1, dtype=wp.int32, device=device)
        if self.combine == "best":
            wp.launch(
                expected_misses.find_surest_cameras_kernel,
                dim=object_count,
                inputs=[found, *given],
                outputs=[counted_camera],
                device=device,
                record_tape=False,
            )
        log_missed = wp.zeros(object_count, dtype=float, device=device, requires_grad=True)
        wp.launch(
            expected_misses.log_missed_kernel,
            dim=object_count,
            inputs=[found, *given, counted_camera],
            outputs=[log_missed],
            device=device,
        )
        wp.launch(
            expected_misses.expected_misses_kernel,
            dim=1,
            inputs=[log_missed, scene.object_weight],
            outputs=[loss],
            device=device,
        )
        return loss
