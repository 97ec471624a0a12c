"""The training objective: losses of a rig on a batch of scenes, and their gradient."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from warpav.detection.detector import Detections, Detector
from warpav.detection.differentiable import DifferentiableDetector
from warpav.detection.in_loop import DetectorInLoop, Picture
from warpav.detection.observe import Observation, Sight, matched_boxes_px, observe, see
from warpav.detection.probability import DetectionProbability
from warpav.optimisation.constraints import BoundsAndSpacing, Constraints
from warpav.optimisation.detector_loss import detector_loss_of
from warpav.optimisation.losses import MISSED, OBJECTIVES, LossSettings, lagrangian_of
from warpav.optimisation.missed import Stage, StageOnDevice
from warpav.optimisation.mount import MOUNT_POSE_SIZE, CameraMount, views_of_rig
from warpav.optimisation.scene_step import AssignedScene, SceneLosses, SceneStep, losses_of_look
from warpav.raster.areas import Measures
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.rig.rig import Rig

# Images of so many scenes go to the detector together, while as many others are rendered.
_SCENES_PER_QUESTION = 2
# Renders of more samples are not held several at once.
_HELD_SAMPLES_MAX = 2**23


@dataclass(frozen=True)
class Evaluation:
    """Losses of a rig on some scenes.

    Attributes:
        total: The Lagrangian.
        objective: Scaled sum of the objectives, without constraints.
        terms: Every loss by name, unscaled; without those that have no scale and would have to be measured first.
        gradient: Of the total to the mount poses, float32 [camera, 7]; None if it was not asked for.
        multiplier_gradient: Of the total to the multipliers, float32 [constraint]; None likewise.
        seconds: Wall time by stage: render, detect (preparing images, waiting for the detector, matching), backward,
            total [s].
        chance: Probability that each camera finds each object, by p(detected) alone; float [camera, object], the
            objects scene by scene. None if it was not asked for, or where ``missed`` is left out.
    """

    total: float
    objective: float
    terms: dict[str, float]
    gradient: np.ndarray | None
    multiplier_gradient: np.ndarray | None
    seconds: dict[str, float]
    chance: np.ndarray | None = None


@dataclass(frozen=True)
class _Looked:
    """A scene that has been rendered and waits for its detections.

    Attributes:
        step: Its step; the step's renderer holds the render.
        sight: What the cameras see of its vehicles; None where no loss asks for it.
        camera: Cameras whose images go to the detector.
    """

    step: SceneStep
    sight: Sight | None
    camera: list[int]


class _Views:
    """The views of a rig that losses look at: renderers, each of which can hold a scene, and the steps on them.

    Attributes:
        rotation_count: Views of every camera.
        ahead: The view of each camera in which it really looks.
        renderers: One for each scene that is held at a time.
    """

    def __init__(self, rotation_count: int, camera_count: int, renderers: list[Renderer]) -> None:
        self.rotation_count = rotation_count
        self.ahead = [camera * rotation_count for camera in range(camera_count)]
        self.renderers = renderers
        self._steps: WeakKeyDictionary[AssignedScene, dict[int, SceneStep]] = WeakKeyDictionary()

    def step(
        self, assigned: AssignedScene, slot: int, make: Callable[[AssignedScene, Renderer], SceneStep]
    ) -> SceneStep:
        """The step of a scene on one of the renderers, with what it has recorded."""
        steps = self._steps.setdefault(assigned, {})
        if slot not in steps:
            steps[slot] = make(assigned, self.renderers[slot])
        return steps[slot]


class RigObjective:
    """What a rig is worth on some scenes: the expected missed objects and the losses of the thesis, under constraints.

    The losses of the thesis are those of its section III.C and appendix IX; `LossSettings` says which take part.
    """

    def __init__(
        self,
        mount: CameraMount,
        detector: Detector,
        *,
        camera_count: int,
        settings: LossSettings,
        constraints: Constraints | None = None,
        confidence_min: float = 0.1,
        iou_min: float = 0.5,
        occlusion: Occlusion = Occlusion.PAIRWISE,
        supersampling: int = 1,
        probability: DetectionProbability | None = None,
        differentiable_detector: DifferentiableDetector | None = None,
    ) -> None:
        """Objective for rigs of ``camera_count`` cameras of the mount's model.

        Args:
            mount: Where the cameras stand.
            detector: Runs on what the cameras see ahead; no gradient flows through it.
            camera_count: Number of cameras, at least 1.
            settings: Scales and parameters of the losses.
            constraints: Where the cameras may stand; None: the thesis's bounds, 0.2 m apart.
            confidence_min: Least confidence of a true positive.
            iou_min: Least intersection over union of a true positive.
            occlusion: What hides a vehicle.
            supersampling: Samples per pixel along each axis.
            probability: Of detection, for the loss ``missed``; needed where its scale is not 0.
            differentiable_detector: The network of the loss ``detector_gradient``; needed where its scale is not 0.

        Raises:
            ValueError: One of them is needed and not there, or a loss of the thesis is to take part while the mount's
                fields of view are free: all of these take one field of view for all cameras.
        """
        if settings.detector_gradient > 0.0 and differentiable_detector is None:
            raise ValueError("settings.detector_gradient needs a differentiable_detector")
        if settings.missed > 0.0 and probability is None:
            raise ValueError("settings.missed needs the probability of detection")
        if settings.needs_panorama and not mount.has_one_field:
            raise ValueError("the losses of the thesis need one field of view for all cameras, got several")
        self.mount = mount
        self.differentiable_detector = differentiable_detector if settings.detector_gradient > 0.0 else None
        self.probability = probability if settings.missed > 0.0 else None
        self.detector = detector
        self.settings = settings
        self.constraints: Constraints = constraints or BoundsAndSpacing(mount.surface)
        self.camera_count = camera_count
        self.confidence_min = confidence_min
        self.iou_min = iou_min
        self.occlusion = occlusion
        self.supersampling = supersampling
        self.device = mount.device
        self._loop = DetectorInLoop(detector)
        self._views: dict[int, _Views] = {}
        self._pose = wp.zeros((camera_count, MOUNT_POSE_SIZE), dtype=float, device=mount.device, requires_grad=True)
        self._seed = wp.zeros(len(OBJECTIVES), dtype=float, device=mount.device)
        self._stage = StageOnDevice(mount.device)

    @property
    def ahead_view(self) -> list[int]:
        """The view of each camera, among those of `observe_rig`, in which it really looks."""
        return self._views_for(self.last_stage).ahead

    @property
    def last_stage(self) -> Stage:
        """The stage at the end of an optimisation, in which rigs are compared."""
        return Stage(detector_share=self.settings.detector_share)

    def evaluate(
        self,
        mount_pose: np.ndarray,
        scenes: Sequence[AssignedScene],
        *,
        multiplier: np.ndarray | None = None,
        gradient: bool = False,
        stage: Stage | None = None,
        chances: bool = False,
    ) -> Evaluation:
        """Losses of cameras on the mount surface on some scenes; scenes are summed in the order given.

        The losses of the thesis are means over scenes, ``missed`` is the mean over all their objects.

        Args:
            mount_pose: As `CameraMount` counts them, float [camera, 7].
            scenes: The batch.
            multiplier: Lagrange multipliers, float [constraint]; None: 0.
            gradient: Whether to differentiate; to cameras that the mount holds the gradient is 0.
            stage: How far along the optimisation is, for ``missed``; None: the last one.
            chances: Whether to tell which camera finds which object.
        """
        started = time.perf_counter()
        seconds = {"render": 0.0, "detect": 0.0, "backward": 0.0}
        stage = stage or self.last_stage
        self._pose.assign(np.asarray(mount_pose, np.float32))
        self._stage.set(stage)
        # the mean over scenes is linear, so every scene can send its share of the gradient back at once
        share = self._shares(scenes)
        self._seed.assign((np.array(self.settings.placement_scale) * share[: len(OBJECTIVES)]).astype(np.float32))
        views = self._views_for(stage)
        while True:
            assert self._pose.grad is not None
            self._pose.grad.zero_()
            losses = self._losses(views, scenes, stage, seconds, gradient=gradient)
            objectives = share * np.array([[*each.value.numpy(), *more] for each, more in losses], np.float64).sum(
                axis=0
            )
            grown = [renderer.grew() for renderer in views.renderers]
            if not any(grown):
                break

        multiplier_array = wp.array(
            np.zeros(len(self.constraints.names), np.float32) if multiplier is None else multiplier,
            dtype=float,
            device=self.device,
            requires_grad=True,
        )
        objective_loss = wp.array(objectives.astype(np.float32), dtype=float, device=self.device)
        tape = wp.Tape()
        with tape:
            constraint_loss = self._constraint_loss()
            total = lagrangian_of(
                objective_loss,
                constraint_loss,
                multiplier_array,
                self.settings,
                are_inequalities=self.constraints.are_inequalities,
            )
        pose_gradient = multiplier_gradient = None
        if gradient:
            backward_started = time.perf_counter()
            tape.backward(total)
            assert multiplier_array.grad is not None
            pose_gradient, multiplier_gradient = self._pose.grad.numpy().copy(), multiplier_array.grad.numpy().copy()
            if self.mount.held is not None:
                pose_gradient[self.mount.held.is_held] = 0.0
            seconds["backward"] += time.perf_counter() - backward_started
        values = dict(zip(self.settings.objectives, objectives.tolist(), strict=True))
        terms = {name: values[name] for name in self.settings.measured_objectives}
        terms |= dict(zip(self.constraints.names, constraint_loss.numpy().tolist(), strict=True))
        seconds["total"] = time.perf_counter() - started
        return Evaluation(
            total=float(total.numpy()[0]),
            objective=float(np.dot(objectives, self.settings.objective_scale)),
            terms=terms,
            gradient=pose_gradient,
            multiplier_gradient=multiplier_gradient,
            seconds=seconds,
            chance=_side_by_side(losses) if chances else None,
        )

    def _shares(self, scenes: Sequence[AssignedScene]) -> np.ndarray:
        """What each scene's losses weigh in the batch, float64 [objective]."""
        share = np.full(len(self.settings.objectives), 1.0 / len(scenes))
        share[MISSED] = 1.0 / max(sum(assigned.scene.vehicle_count for assigned in scenes), 1)
        return share

    def gradients(self, mount_pose: np.ndarray, scenes: Sequence[AssignedScene]) -> dict[str, np.ndarray]:
        """Gradient of every loss by itself, unscaled, to the mount poses; float32 [camera, 7] by name.

        Of the objectives those of ``settings.measured_objectives`` whose gradient comes through the placement losses,
        each the mean over the scenes; then the constraints.

        Args:
            mount_pose: As in `evaluate`.
            scenes: The batch.
        """
        self._pose.assign(np.asarray(mount_pose, np.float32))
        self._stage.set(self.last_stage)
        views = self._views_for(self.last_stage)
        pose_gradient = self._pose.grad
        assert pose_gradient is not None
        names = [name for name in OBJECTIVES if name in self.settings.measured_objectives]
        share = self._shares(scenes)[: len(OBJECTIVES)]
        while True:
            result = {name: np.zeros((self.camera_count, MOUNT_POSE_SIZE), np.float32) for name in names}
            for scene in scenes:
                seconds = {"render": 0.0, "detect": 0.0}
                [looked], answers = self._look(views, [(scene, 0)], self.last_stage, seconds)
                self._match(looked, answers())
                for name in names:
                    self._seed.assign(np.where([name == each for each in OBJECTIVES], share, 0.0).astype(np.float32))
                    pose_gradient.zero_()
                    looked.step.learn()
                    result[name] += pose_gradient.numpy()
            if not views.renderers[0].grew():
                break
        for k, name in enumerate(self.constraints.names):
            pose_gradient.zero_()
            tape = wp.Tape()
            with tape:
                constraint_loss = self._constraint_loss()
            seed = np.eye(len(self.constraints.names), dtype=np.float32)[k]
            tape.backward(grads={constraint_loss: wp.array(seed, dtype=float, device=self.device)})
            result[name] = np.array(pose_gradient.numpy(), np.float32)
        return result

    def _constraint_loss(self) -> wp.array:
        """The constraint losses of the present poses, recorded on the active tape; float [constraint]."""
        return self.constraints.losses_of(self.mount.place(self._pose), self.mount.rotation_count)

    def _views_for(self, stage: Stage) -> _Views:
        """The views that the losses look at in a stage: of every camera all rotational additions, or the one ahead."""
        look_round = self.settings.needs_panorama or stage.panorama_share > 0.0
        rotation_count = self.mount.rotation_count if look_round else 1
        if rotation_count not in self._views:
            renderers = [
                Renderer(
                    [self.mount.camera] * (self.camera_count * rotation_count),
                    supersampling=self.supersampling,
                    occlusion=self.occlusion,
                    device=self.device,
                    foreground_layer=self.settings.surface_blockage > 0.0,
                )
                for _ in range(self._renderer_count(rotation_count))
            ]
            self._views[rotation_count] = _Views(rotation_count, self.camera_count, renderers)
        return self._views[rotation_count]

    def _renderer_count(self, rotation_count: int) -> int:
        """Scenes whose renders are held at once.

        While the detector looks at some, the next are rendered. On a GPU rendering takes less time than it would save.
        """
        camera = self.mount.camera
        pixels = self.camera_count * rotation_count * camera.width_px * camera.height_px
        if wp.get_device(self.device).is_cuda or pixels * self.supersampling**2 > _HELD_SAMPLES_MAX:
            return 1
        return 2 * _SCENES_PER_QUESTION

    def _losses(
        self, views: _Views, scenes: Sequence[AssignedScene], stage: Stage, seconds: dict[str, float], *, gradient: bool
    ) -> list[tuple[SceneLosses, list[float]]]:
        """Placement losses of every scene, and the detection network's own where it takes part.

        The detector looks at the images of some scenes while the next scenes are rendered; scenes are finished, and
        their gradients added, in the order given.
        """
        slots = len(views.renderers)
        per_question = max(1, slots // 2)
        asked: deque[tuple[list[_Looked], Callable[[], list[Detections]]]] = deque()
        losses: list[tuple[SceneLosses, list[float]]] = []
        for first in range(0, len(scenes), per_question):
            while (len(asked) + 1) * per_question > slots:  # until their renderers are free
                losses += self._finish(*asked.popleft(), seconds, gradient=gradient, share=1.0 / len(scenes))
            group = range(first, min(first + per_question, len(scenes)))
            asked.append(self._look(views, [(scenes[k], k % slots) for k in group], stage, seconds))
        while asked:
            losses += self._finish(*asked.popleft(), seconds, gradient=gradient, share=1.0 / len(scenes))
        return losses

    def _look(
        self, views: _Views, scenes: Sequence[tuple[AssignedScene, int]], stage: Stage, seconds: dict[str, float]
    ) -> tuple[list[_Looked], Callable[[], list[Detections]]]:
        """Render scenes, each on its renderer, and ask the detector about the images that can matter."""
        looked, pictures = [], []
        started = time.perf_counter()
        pose = self._pose.numpy()
        asks = self.settings.detected_area > 0.0 or (self.settings.missed > 0.0 and stage.detector_share > 0.0)
        for assigned, slot in scenes:
            step = self._step_of(views, assigned, slot)
            step.look()
            sight, cameras = None, []
            if asks or self.differentiable_detector is not None:
                sight = see(step.frame, step.scene, ahead_view=views.ahead)
            if sight is not None and asks:
                cameras = self._cameras_that_matter(sight, assigned, stage)
            looked.append(_Looked(step, sight, cameras))
            pictures += [
                Picture(assigned, camera, pose[camera].tobytes(), step.image[camera : camera + 1]) for camera in cameras
            ]
        rendered = time.perf_counter()
        answers = self._loop.ask(pictures)
        seconds["render"] += rendered - started
        seconds["detect"] += time.perf_counter() - rendered
        return looked, answers

    def _cameras_that_matter(self, sight: Sight, assigned: AssignedScene, stage: Stage) -> list[int]:
        """Cameras that see enough of an object that some loss asks them for."""
        is_seen = np.isfinite(sight.truth_box_px[..., 0])
        if not (self.settings.missed > 0.0 and stage.detector_share > 0.0):
            # the thesis asks each camera for its own objects only
            is_seen &= assigned.assigned_camera == np.arange(self.camera_count)[:, None]
        return [int(camera) for camera in np.nonzero(is_seen.any(axis=1))[0]]

    def _step_of(self, views: _Views, assigned: AssignedScene, slot: int) -> SceneStep:
        """The step of a scene on one of the renderers."""

        def make(assigned: AssignedScene, renderer: Renderer) -> SceneStep:
            return SceneStep(
                self.mount,
                renderer,
                assigned,
                pose=self._pose,
                seed=self._seed,
                ahead_view=views.ahead,
                settings=self.settings,
                probability=self.probability,
                stage=self._stage,
            )

        return views.step(assigned, slot, make)

    def _finish(
        self,
        looked: Sequence[_Looked],
        answers: Callable[[], list[Detections]],
        seconds: dict[str, float],
        *,
        gradient: bool,
        share: float,
    ) -> list[tuple[SceneLosses, list[float]]]:
        """Match, measure, differentiate scenes that were looked at."""
        started = time.perf_counter()
        found = iter(answers())
        seconds["detect"] += time.perf_counter() - started
        losses = []
        for each in looked:
            start = time.perf_counter()
            self._match(each, [next(found) for _ in each.camera])
            matched = time.perf_counter()
            judged = each.step.learn() if gradient else each.step.judge()
            more = []
            if self.differentiable_detector is not None and each.sight is not None:
                weight = share * self.settings.detector_gradient if gradient else None
                more.append(
                    each.step.detector_loss(self.differentiable_detector, each.sight.truth_box_px, weight=weight)
                )
            losses.append((judged, more))
            seconds["detect"] += matched - start
            seconds["backward"] += time.perf_counter() - matched
        return losses

    def _match(self, looked: _Looked, found: Sequence[Detections]) -> None:
        """Hand what matches a vehicle to the scene's step; ``found`` in the order of ``looked.camera``."""
        if looked.sight is None:
            return
        detections = [Detections.none()] * self.camera_count
        for camera, each in zip(looked.camera, found, strict=True):
            detections[camera] = each
        match = looked.sight.match(detections, confidence_min=self.confidence_min, iou_min=self.iou_min)
        looked.step.set_boxes(matched_boxes_px(match, detections))
        looked.step.set_detected(match >= 0)

    def observe_rig(self, rig: Rig, assigned: AssignedScene) -> tuple[Observation, Measures, float]:
        """What a rig that stands anywhere sees of one scene.

        Returns:
            The detections, the measures of all views, and the scaled objective of this scene alone.
        """
        looks = self._views_for(self.last_stage)
        self._stage.set(self.last_stage)
        views = views_of_rig(
            rig,
            rotation_count=looks.rotation_count,
            rotation_step_rad=self.mount.rotation_step_rad,
            device=self.device,
            mount=self.mount,
        )
        scene, renderer = assigned.scene, looks.renderers[0]
        frame = renderer.render(scene.raster, views.position_ego_m, views.camera_from_ego, log_focal=views.log_zoom)
        observation = observe(
            frame,
            scene,
            self.detector,
            ahead_view=looks.ahead,
            confidence_min=self.confidence_min,
            iou_min=self.iou_min,
        )
        box_px = np.zeros((renderer.view_count, scene.vehicle_count, 4), np.float32)
        box_px[looks.ahead] = observation.matched_box_px()
        measures = frame.measure(wp.array(box_px, dtype=wp.vec4, device=self.device))
        loss, _ = losses_of_look(
            self.mount,
            frame,
            scene,
            views,
            measures,
            wp.array(assigned.assigned_camera, dtype=wp.int32, device=self.device),
            assigned_count=int(np.count_nonzero(assigned.assigned_camera >= 0)),
            settings=self.settings,
            probability=self.probability,
            detected=wp.array((observation.match >= 0).astype(np.float32), dtype=float, device=self.device),
            stage=self._stage,
            image=observation.image,
        )
        losses = list(loss.numpy())
        if self.differentiable_detector is not None:
            losses.append(
                detector_loss_of(
                    frame,
                    scene,
                    views,
                    measures,
                    self.differentiable_detector,
                    truth_box_px=observation.truth_box_px,
                    assigned_camera=assigned.assigned_camera,
                    ahead_view=looks.ahead,
                )
            )
        scaled = np.array(losses, np.float64) * self._shares([assigned]) * self.settings.objective_scale
        return observation, measures, float(scaled.sum())


def _side_by_side(losses: Sequence[tuple[SceneLosses, list[float]]]) -> np.ndarray | None:
    """Chances of all scenes, float [camera, object]; None where no loss knows them."""
    chances = [each.chance.numpy() for each, _ in losses if each.chance is not None]
    return np.concatenate(chances, axis=1) if chances else None
