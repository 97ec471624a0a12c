"""The training objective of the thesis: losses of a rig on a batch of scenes, and their gradient."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from warpav.detection.detector import Detector
from warpav.detection.differentiable import DifferentiableDetector
from warpav.detection.observe import Observation, observe
from warpav.objective.constraints import CONSTRAINTS, constraint_losses_of
from warpav.objective.detector_loss import detector_loss_of
from warpav.objective.losses import OBJECTIVES, LossSettings, lagrangian_of, placement_losses_of
from warpav.objective.mount import MOUNT_POSE_SIZE, CameraMount, views_of_rig
from warpav.objective.scene_step import AssignedScene, SceneStep
from warpav.render.renderer import Measures, Occlusion, Renderer
from warpav.rig.rig import Rig


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
        differentiable_detector: DifferentiableDetector | None = None,
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
            differentiable_detector: The network of the loss ``detector_gradient``; needed where its scale is not 0.

        Raises:
            ValueError: It is needed and not there.
        """
        if settings.detector_gradient > 0.0 and differentiable_detector is None:
            raise ValueError("settings.detector_gradient needs a differentiable_detector")
        self.mount = mount
        self.differentiable_detector = differentiable_detector if settings.detector_gradient > 0.0 else None
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
        self._pose = wp.zeros((camera_count, MOUNT_POSE_SIZE), dtype=float, device=mount.device, requires_grad=True)
        self._seed = wp.zeros(len(OBJECTIVES), dtype=float, device=mount.device)
        self._steps: WeakKeyDictionary[AssignedScene, SceneStep] = WeakKeyDictionary()

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
        self._pose.assign(np.asarray(mount_pose, np.float32))
        # the mean over scenes is linear, so every scene can send its share of the gradient back at once
        self._seed.assign(np.array(self.settings.placement_scale, np.float32) / len(scenes))
        steps = [self._step_of(assigned) for assigned in scenes]
        while True:
            assert self._pose.grad is not None
            self._pose.grad.zero_()
            losses = [self._run(step, seconds, gradient=gradient, share=1.0 / len(scenes)) for step in steps]
            objectives = np.array([[*loss.numpy(), *more] for loss, more in losses], np.float64).mean(axis=0)
            if not self._renderer.grew():
                break

        multiplier_array = wp.array(
            np.zeros(len(CONSTRAINTS), np.float32) if multiplier is None else multiplier,
            dtype=float,
            device=self.device,
            requires_grad=True,
        )
        objective_loss = wp.array(objectives.astype(np.float32), dtype=float, device=self.device)
        tape = wp.Tape()
        with tape:
            views = self.mount.place(self._pose)
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
            assert multiplier_array.grad is not None
            pose_gradient, multiplier_gradient = self._pose.grad.numpy().copy(), multiplier_array.grad.numpy().copy()
            seconds["backward"] += time.perf_counter() - backward_started
        constraints = constraint_loss.numpy()
        seconds["total"] = time.perf_counter() - started
        return Evaluation(
            total=float(total.numpy()[0]),
            objective=float(np.dot(objectives, self.settings.objective_scale)),
            terms={
                name: float(value)
                for name, value in zip(
                    (*self.settings.objectives, *CONSTRAINTS), (*objectives, *constraints), strict=True
                )
            },
            gradient=pose_gradient,
            multiplier_gradient=multiplier_gradient,
            seconds=seconds,
        )

    def _step_of(self, assigned: AssignedScene) -> SceneStep:
        """The step of a scene, with what it has recorded."""
        if assigned not in self._steps:
            self._steps[assigned] = SceneStep(
                self.mount,
                self._renderer,
                assigned,
                pose=self._pose,
                seed=self._seed,
                ahead_view=self.ahead_view,
                settings=self.settings,
            )
        return self._steps[assigned]

    def _run(
        self, step: SceneStep, seconds: dict[str, float], *, gradient: bool, share: float
    ) -> tuple[wp.array, list[float]]:
        """Decide, detect, measure, differentiate; adds the wall time to ``seconds``.

        Returns:
            The scene's placement losses, and the detection network's own where it takes part.
        """
        start = time.perf_counter()
        step.look()
        looked = time.perf_counter()
        observation = observe(
            self._renderer,
            step.scene,
            self.detector,
            image=step.image,
            ahead_view=self.ahead_view,
            confidence_min=self.confidence_min,
            iou_min=self.iou_min,
        )
        step.set_boxes(observation.matched_box_px())
        detected = time.perf_counter()
        loss = step.learn() if gradient else step.judge()
        more = []
        if self.differentiable_detector is not None:
            weight = share * self.settings.detector_gradient if gradient else None
            more.append(step.detector_loss(self.differentiable_detector, observation.truth_box_px, weight=weight))
        seconds["render"] += looked - start
        seconds["detect"] += detected - looked
        seconds["backward"] += time.perf_counter() - detected
        return loss, more

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
        scene = assigned.scene
        self._renderer.render(scene, views.position_ego_m, views.camera_from_ego)
        observation = observe(
            self._renderer,
            scene,
            self.detector,
            ahead_view=self.ahead_view,
            confidence_min=self.confidence_min,
            iou_min=self.iou_min,
        )
        box_px = np.zeros((self._renderer.view_count, scene.vehicle_count, 4), np.float32)
        box_px[self.ahead_view] = observation.matched_box_px()
        measures = self._renderer.measure(scene, wp.array(box_px, dtype=wp.vec4, device=self.device))
        loss = placement_losses_of(
            self.mount,
            views,
            measures,
            wp.array(assigned.assigned_camera, dtype=wp.int32, device=self.device),
            assigned_count=int(np.count_nonzero(assigned.assigned_camera >= 0)),
            settings=self.settings,
        )
        losses = list(loss.numpy())
        if self.differentiable_detector is not None:
            losses.append(
                detector_loss_of(
                    self._renderer,
                    scene,
                    views,
                    measures,
                    self.differentiable_detector,
                    truth_box_px=observation.truth_box_px,
                    assigned_camera=assigned.assigned_camera,
                    ahead_view=self.ahead_view,
                )
            )
        return observation, measures, float(np.dot(losses, self.settings.objective_scale))
