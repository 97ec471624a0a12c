"""The training objective of the thesis: losses of a rig on a batch of scenes, and their gradient."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpav.detection.detector import Detector
from warpav.detection.observe import Observation, observe
from warpav.objective.constraints import CONSTRAINTS, constraint_losses_of
from warpav.objective.losses import OBJECTIVES, LossSettings, add_placement_losses, lagrangian_of
from warpav.objective.mount import CameraMount, PlacedViews, views_of_rig
from warpav.render.device_scene import DeviceScene
from warpav.render.renderer import Measures, Occlusion, Renderer
from warpav.rig.rig import Rig


@dataclass(frozen=True)
class AssignedScene:
    """A scene and the camera that answers for each of its vehicles.

    Attributes:
        scene: The scene on the device.
        assigned_camera: Index of the camera of every vehicle, -1 for none, int32 [vehicle].
    """

    scene: DeviceScene
    assigned_camera: np.ndarray


@dataclass(frozen=True)
class Evaluation:
    """Losses of a rig on some scenes.

    Attributes:
        total: The Lagrangian.
        objective: Scaled sum of the objectives, without constraints.
        terms: Every loss by name, unscaled.
        gradient: Of the total to the mount poses, float32 [camera, 5]; None if it was not asked for.
        multiplier_gradient: Of the total to the multipliers, float32 [constraint]; None likewise.
        seconds: Wall time by stage: render, detect, backward, total [s].
    """

    total: float
    objective: float
    terms: dict[str, float]
    gradient: np.ndarray | None
    multiplier_gradient: np.ndarray | None
    seconds: dict[str, float]


class ThesisObjective:
    """In-frame rotation and detected area under the bounds and spacing constraints (thesis section III.C)."""

    def __init__(
        self,
        mount: CameraMount,
        detector: Detector,
        *,
        camera_count: int,
        settings: LossSettings,
        confidence_min: float = 0.1,
        iou_min: float = 0.5,
        occlusion: Occlusion = Occlusion.PAIRWISE,
        supersampling: int = 1,
    ) -> None:
        """Objective for rigs of ``camera_count`` cameras of the mount's model.

        Args:
            mount: Where the cameras stand.
            detector: Runs on what the cameras see ahead; no gradient flows through it.
            camera_count: Number of cameras, at least 1.
            settings: Scales and parameters of the losses.
            confidence_min: Least confidence of a true positive.
            iou_min: Least intersection over union of a true positive.
            occlusion: What hides a vehicle.
            supersampling: Samples per pixel along each axis.
        """
        self.mount = mount
        self.detector = detector
        self.settings = settings
        self.camera_count = camera_count
        self.confidence_min = confidence_min
        self.iou_min = iou_min
        self.occlusion = occlusion
        self.supersampling = supersampling
        self.device = mount.device
        self.ahead_view = [camera * mount.rotation_count for camera in range(camera_count)]
        self._renderer = Renderer(
            [mount.camera] * (camera_count * mount.rotation_count),
            supersampling=supersampling,
            occlusion=occlusion,
            device=mount.device,
        )

    def evaluate(
        self,
        mount_pose: np.ndarray,
        scenes: Sequence[AssignedScene],
        *,
        multiplier: np.ndarray | None = None,
        gradient: bool = False,
    ) -> Evaluation:
        """Losses of cameras on the mount surface, the mean over scenes; scenes are summed in the order given.

        Args:
            mount_pose: x, y [m], yaw, pitch, roll [rad] of every camera, float [camera, 5].
            scenes: The batch.
            multiplier: Lagrange multipliers, float [constraint]; None: 0.
            gradient: Whether to differentiate.
        """
        started = time.perf_counter()
        seconds = {"render": 0.0, "detect": 0.0, "backward": 0.0}
        pose = wp.array(np.asarray(mount_pose, np.float32), dtype=float, device=self.device, requires_grad=True)
        multiplier_array = wp.array(
            np.zeros(len(CONSTRAINTS), np.float32) if multiplier is None else multiplier,
            dtype=float,
            device=self.device,
            requires_grad=True,
        )
        tape = wp.Tape()
        with tape:
            views = self.mount.place(pose)
            objective_loss = wp.zeros(len(OBJECTIVES), dtype=float, device=self.device, requires_grad=True)
        for assigned in scenes:
            _, measures = self._observe(assigned.scene, views, seconds)
            with tape:
                self._add_scene(objective_loss, views, assigned, measures, 1.0 / len(scenes))
        with tape:
            constraint_loss = constraint_losses_of(
                views,
                self.mount.surface,
                min_spacing_m=self.settings.min_spacing_m,
                rotation_count=self.mount.rotation_count,
            )
            total = lagrangian_of(objective_loss, constraint_loss, multiplier_array, self.settings)
        pose_gradient = multiplier_gradient = None
        if gradient:
            backward_started = time.perf_counter()
            tape.backward(total)
            wp.synchronize_device(self.device)
            assert pose.grad is not None
            assert multiplier_array.grad is not None
            pose_gradient, multiplier_gradient = pose.grad.numpy().copy(), multiplier_array.grad.numpy().copy()
            seconds["backward"] = time.perf_counter() - backward_started
        seconds["total"] = time.perf_counter() - started
        objectives, constraints = objective_loss.numpy(), constraint_loss.numpy()
        return Evaluation(
            total=float(total.numpy()[0]),
            objective=float(np.dot(objectives, self.settings.objective_scale)),
            terms={
                name: float(value)
                for name, value in zip((*OBJECTIVES, *CONSTRAINTS), (*objectives, *constraints), strict=True)
            },
            gradient=pose_gradient,
            multiplier_gradient=multiplier_gradient,
            seconds=seconds,
        )

    def observe_rig(self, rig: Rig, assigned: AssignedScene) -> tuple[Observation, Measures, float]:
        """What a rig that stands anywhere sees of one scene.

        Returns:
            The detections, the measures of all views, and the scaled objective of this scene alone.
        """
        views = views_of_rig(
            rig,
            rotation_count=self.mount.rotation_count,
            rotation_step_rad=self.mount.rotation_step_rad,
            device=self.device,
        )
        observation, measures = self._observe(assigned.scene, views, {})
        loss = wp.zeros(len(OBJECTIVES), dtype=float, device=self.device)
        self._add_scene(loss, views, assigned, measures, 1.0)
        return observation, measures, float(np.dot(loss.numpy(), self.settings.objective_scale))

    def _observe(
        self, scene: DeviceScene, views: PlacedViews, seconds: dict[str, float]
    ) -> tuple[Observation, Measures]:
        """Decide, detect, measure; adds the wall time to ``seconds``."""
        start = time.perf_counter()
        self._renderer.render(scene, views.position_ego_m, views.camera_from_ego)
        rendered = time.perf_counter()
        observation = observe(
            self._renderer,
            scene,
            self.detector,
            ahead_view=self.ahead_view,
            confidence_min=self.confidence_min,
            iou_min=self.iou_min,
        )
        detected = time.perf_counter()
        box_px = np.zeros((self._renderer.view_count, scene.vehicle_count, 4), np.float32)
        box_px[self.ahead_view] = observation.matched_box_px()
        measures = self._renderer.measure(scene, wp.array(box_px, dtype=wp.vec4, device=self.device))
        measured = time.perf_counter()
        seconds["render"] = seconds.get("render", 0.0) + (rendered - start) + (measured - detected)
        seconds["detect"] = seconds.get("detect", 0.0) + (detected - rendered)
        return observation, measures

    def _add_scene(
        self, loss: wp.array, views: PlacedViews, assigned: AssignedScene, measures: Measures, weight: float
    ) -> None:
        add_placement_losses(
            loss,
            mount=self.mount,
            views=views,
            rendered=measures,
            assigned_camera=wp.array(assigned.assigned_camera, dtype=wp.int32, device=self.device),
            assigned_count=int(np.count_nonzero(assigned.assigned_camera >= 0)),
            scene_weight=weight,
            settings=self.settings,
        )
