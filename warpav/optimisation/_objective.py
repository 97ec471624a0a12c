"""The training objective: losses of a rig on a batch of scenes, and their gradient."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial, reduce
from operator import or_

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav.detection import (
    Detections,
    Detector,
    DetectorInLoop,
    Fusion,
    LidarCurve,
    LidarProbability,
    Observation,
    RenderedImage,
    VisibleObjects,
    expected_miss_rate,
    expected_miss_slope,
    matched_boxes_px,
    observe,
    shares_of,
    visible_objects,
)
from warpav.optimisation._constraints import Constraints
from warpav.optimisation._importance import Importance
from warpav.optimisation._mount import MOUNT_POSE_SIZE, CameraMount, views_of_rig
from warpav.optimisation._scene_step import Exchange, Objective, RigViews, SceneLosses, SceneStep
from warpav.optimisation._single_cameras import SingleCameras
from warpav.optimisation.losses._expected_miss_rate import ExpectedMissRate
from warpav.optimisation.losses._lagrangian import lagrangian_of
from warpav.optimisation.losses._loss import DetectedImages, DeviceLoss, HostLoss, Loss, LossSchedule, Needs
from warpav.optimisation.losses._scene_on_tape import AssignedScene, CameraProbability, ObjectProbability, SceneOnTape
from warpav.optimisation.losses._user_loss import LossFunction, UserLoss
from warpav.raster.areas import Measures
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.rig import Rig
from warpav.scene import DeviceScene

# Images of so many scenes go to the detector together, while as many others are rendered.
_SCENES_PER_QUESTION = 2
# Renders of more samples are not held several at once.
_HELD_SAMPLES_MAX = 2**23


@dataclass(frozen=True)
class Evaluation:
    """Losses of a rig on some scenes."""

    total: float  # the Lagrangian
    objective: float  # weighted sum of the losses, without constraints
    terms: dict[str, float]  # every loss by name, without its weight; then every constraint's
    gradient: np.ndarray | None  # of the total to the mount poses, float32 [camera, 7]; None if it was not asked for
    multiplier_gradient: np.ndarray | None  # of the total to the multipliers, float32 [constraint]; None likewise
    seconds: dict[str, float]  # wall time by stage: render
    detection_probability: np.ndarray | None = None  # that each camera detects each object, by the model alone


@dataclass(frozen=True)
class _Observed:
    """A scene that has been rendered and waits for its detections."""

    step: SceneStep  # its step; the step's renderer holds the render
    seen: VisibleObjects | None  # what the cameras see of its vehicles; None where no loss asks for it
    camera: list[int]  # Cameras whose images go to the detector


@dataclass(frozen=True)
class ObjectiveOptions:
    """How scenes are looked at, and how constraints count."""

    confidence_min: float = 0.1  # least confidence of a true positive
    iou_min: float = 0.5  # least intersection over union of a true positive
    false_alarms_per_image: float = 0.5  # at which rigs are compared, see `evaluation.metrics.ArmMetrics`
    occlusion: Occlusion = Occlusion.PAIRWISE  # what hides a vehicle
    supersampling: int = 1  # samples per pixel along each axis
    multiplier_damping: float = 0.0  # damping of the multipliers, at least 0; 0 as in the thesis
    lidar: LidarCurve = field(default_factory=LidarCurve)  # how many points it takes to find an object
    fusion: Fusion = field(default_factory=Fusion)  # which objects a camera and a LiDAR must find
    false_alarms: float = 0.0  # cost of one p (1 - p), see `false_alarm_cost`, of one object missed, for searches
    cameras_have_bodies: bool = False  # whether the housings of cameras hide things where a rig is judged


class RigObjective:
    """What a rig is worth on some scenes: a weighted sum of losses, under constraints."""

    def __init__(
        self,
        mount: CameraMount,
        detector: Detector,
        *,
        camera_count: int,
        losses: Sequence[tuple[float, Loss | LossFunction]],
        constraints: Constraints,
        camera_probability: ObjectProbability | Sequence[ObjectProbability] | None = None,
        importance: Importance | None = None,
        options: ObjectiveOptions | None = None,
    ) -> None:
        """Objective for rigs of ``camera_count`` cameras of the mount's model."""
        self.mount = mount  # where the cameras stand
        self.detector = detector  # runs on what the cameras see ahead
        # every loss with its weight
        self.losses: list[tuple[float, Loss]] = [
            (weight, loss if isinstance(loss, Loss) else UserLoss.of(loss)) for weight, loss in losses if weight != 0.0
        ]
        given = camera_probability if isinstance(camera_probability, Sequence) else (camera_probability,)
        self._probabilities = tuple(each for each in given if each is not None)
        self._others: dict[CameraModel, ObjectProbability] = {}
        self._check()
        self.constraints = constraints  # where the cameras may stand
        self.camera_count = camera_count  # number of cameras
        self.options = options = options or ObjectiveOptions()
        self.importance = importance  # weights of the objects; None: all 1
        self.device = mount.device
        # how the losses are at the end of an optimisation; rigs are compared with it
        self.final_schedule = LossSchedule(detector_share=max(loss.detector_share for _, loss in self.losses))
        self._objective = Objective(
            tuple(loss for _, loss in self.losses if isinstance(loss, DeviceLoss)),
            tuple(loss for _, loss in self.losses if isinstance(loss, HostLoss)),
            next((each for each in self.camera_probabilities or () if isinstance(each, CameraProbability)), None),
            importance,
        )
        device_weights = [weight for weight, loss in self.losses if isinstance(loss, DeviceLoss)]
        self._loop = DetectorInLoop(detector)
        self._views: dict[int, RigViews] = {}
        constraint_count = len(self.constraints.names)
        self._exchange = Exchange(camera_count, constraint_count, len(device_weights), device=mount.device)
        scale = [self.constraint_scale] * constraint_count
        self._lagrangian = partial(
            lagrangian_of,
            weight=wp.array(device_weights, dtype=float, device=mount.device),
            scale=None if constraints.are_inequalities else wp.array(scale, dtype=float, device=mount.device),
            repeats=float(len(self.losses)),
            damping=options.multiplier_damping,
        )

    def _check(self) -> None:
        names = [loss.name for _, loss in self.losses]
        twice = sorted({name for name in names if names.count(name) > 1})
        if not names:
            raise InputError("losses: expected at least one of weight above 0, got none")
        if twice:
            raise InputError(f"losses: expected a name of its own for each, got {twice[0]} twice")
        negative = [loss.name for weight, loss in self.losses if not weight > 0.0]
        if negative:
            raise InputError(f"losses: {negative[0]}: expected a weight of at least 0")
        for _, loss in self.losses:
            needs = loss.needs(LossSchedule())
            if needs.detection_probability and not self._probabilities:
                raise InputError(f"losses: {loss.name} needs the model of detection probability, got none")
            if needs.one_field and not self.mount.has_one_field:
                raise InputError(f"losses: {loss.name} takes one field of view for all cameras, got several")
        if self.mount.sees_apart and not self.is_by_single_cameras:
            what = "modules of different images" if self.mount.is_mixed else "cameras behind glass"
            raise InputError(
                "losses: expected the expected_miss_rate alone, with combine=any and detector_share=0, for "
                f"{what}, got {', '.join(names)}"
            )

    @property
    def forward_view(self) -> list[int]:
        """The view of each camera, among those of `observe_rig`, in which it really looks."""
        return self._views_for(self.final_schedule).ahead

    @property
    def camera_probabilities(self) -> tuple[ObjectProbability, ...] | None:
        """How likely a camera of each of the mount's models is to detect; None where no loss needs it."""
        return self._probabilities if self._needs(LossSchedule()).detection_probability else None

    def probability_of(self, model: CameraModel) -> ObjectProbability | None:
        """How likely a camera of a model is to detect; None where no loss needs it, or no model of it was added."""
        found, mount = self.camera_probabilities, self.mount
        if found is None:
            return None
        if not mount.has_model(model):
            return LidarProbability(model.beams, self.options.lidar) if model.beams else self._others.get(model)
        return found[mount.cameras.index(model)] if mount.is_mixed else found[0]

    def add_camera_model(self, model: CameraModel, probability: ObjectProbability) -> None:
        """From now on say of cameras of another model than the mount's how likely they are to detect."""
        self._others[model] = probability

    @property
    def is_by_single_cameras(self) -> bool:
        """Whether a rig's value follows from what each camera detects by itself: the expected miss rate alone."""
        losses = [loss for _, loss in self.losses]
        loss = losses[0]
        if len(losses) > 1 or not isinstance(loss, ExpectedMissRate) or not self._probabilities:
            return False
        return loss.combine == "any" and not loss.detector_share > 0.0

    def value_of(self, detection_probability: np.ndarray, scene: AssignedScene, is_lidar: Sequence[bool] = ()) -> float:
        """The objective on one scene by what single cameras detect, float [camera, object]; 0 without objects."""
        [(weight, _)] = self.losses
        object_weight = self.object_weight([scene])
        detection_probability = self.columns_of(detection_probability, [scene.scene], is_lidar)
        if not detection_probability.shape[1] or (object_weight is not None and not object_weight.any()):
            return 0.0
        return weight * expected_miss_rate(detection_probability, shares_of(object_weight))

    @cached_property
    def single_cameras(self) -> SingleCameras:
        """Its cameras each by itself; only where `is_by_single_cameras`."""
        assert self.is_by_single_cameras
        probability = self._probabilities if self.mount.is_mixed else self._probabilities[0]
        options = self.options
        given = {"occlusion": options.occlusion, "supersampling": options.supersampling}
        return SingleCameras(self.mount, probability, **given, is_fused=options.fusion.is_set)

    @property
    def needs_panorama(self) -> bool:
        """Whether a loss looks round from every camera to the end, as those of the thesis do."""
        return self._needs(self.final_schedule).panorama

    @property
    def constraint_scale(self) -> float:
        """Scale of every constraint of the thesis: the largest of the weights."""
        return max(weight for weight, _ in self.losses)

    def object_weight(self, scenes: Sequence[AssignedScene]) -> np.ndarray | None:
        """Weight of the objects of some scenes, or of their columns, float64 [object]; None: all 1."""
        return self.weights_of([each.scene for each in scenes])

    def weights_of(self, scenes: Sequence[DeviceScene], *, alike: bool = False) -> np.ndarray | None:
        """The same; ``alike``: as if no road user mattered more than another."""
        importance, fusion = None if alike else self.importance, self.options.fusion
        if not fusion.is_set:
            return None if importance is None else importance.weights_of(scenes)
        own = [None if importance is None else importance.weights(scene) for scene in scenes]
        parts = [fusion.weights(scene.distance_m, each) for scene, each in zip(scenes, own, strict=True)]
        return np.concatenate([np.zeros(0), *parts])

    def charge_of(self, scenes: Sequence[DeviceScene]) -> np.ndarray | None:
        """What searches charge for false alarms at the objects of scenes, float64 [object or column]; None: nothing."""
        if not self.options.false_alarms:
            return None
        counts = [scene.vehicle_count for scene in scenes]
        weight = self.weights_of(scenes)
        share = np.full(sum(counts), 1.0 / max(sum(counts), 1)) if weight is None else weight / weight.sum()
        if self.options.fusion.is_set:
            share[Fusion.triples(counts)[:, 1:]] = 0.0
        return self.options.false_alarms * np.abs(share)

    def columns_of(
        self, detection_probability: np.ndarray, scenes: Sequence[DeviceScene], is_lidar: Sequence[bool]
    ) -> np.ndarray:
        """What sensors find of the objects of scenes, float [camera, object], in the columns that have weights."""
        if not self.options.fusion.is_set:
            return detection_probability
        return Fusion.columns(detection_probability, is_lidar, [scene.vehicle_count for scene in scenes])

    def _count(self, loss: Loss, scenes: Sequence[AssignedScene]) -> float:
        """What the mean of a loss over some scenes is over: the sum of `Loss.count`, or of weights; never 0."""
        weight = self.object_weight(scenes) if loss.weighs_objects else None
        total = sum(loss.count(each.scene) for each in scenes) if weight is None else float(weight.sum())
        return total if total > 0 else 1

    def _needs(self, schedule: LossSchedule) -> Needs:
        return reduce(or_, (loss.needs(schedule) for _, loss in self.losses), Needs())

    def evaluate(
        self,
        mount_pose: np.ndarray,
        scenes: Sequence[AssignedScene],
        *,
        multiplier: np.ndarray | None = None,
        gradient: bool = False,
        schedule: LossSchedule | None = None,
        detection_probability: bool = False,
        with_constraints: bool = True,
    ) -> Evaluation:
        """Losses of cameras on the mount surface on some scenes; scenes are summed in the order given.

        Everything goes to the device in one copy and comes back in one, unless the detector or a loss of the host takes
        part.
        """
        started = time.perf_counter()
        pose = np.asarray(mount_pose, np.float32)
        if self.mount.sees_apart:
            return self._evaluate_single_cameras(pose, scenes, gradient=gradient)
        seconds = {"render": 0.0, "detect": 0.0, "backward": 0.0}
        schedule = schedule or self.final_schedule
        views, exchange = self._views_for(schedule), self._exchange
        multiplier = np.zeros(len(self.constraints.names), np.float32) if multiplier is None else multiplier
        count = {loss.name: self._count(loss, scenes) for _, loss in self.losses}
        # the mean over scenes is linear, so every scene can send its share of the gradient back at once
        share = {loss.name: weight * (1.0 / count[loss.name]) for weight, loss in self.losses}
        device, host = self._objective.device, self._objective.host
        while True:
            exchange.send(
                pose,
                multiplier,
                schedule,
                weight=[share[loss.name] for loss in device],
                count=[count[loss.name] for loss in device],
                host_weight=[share[loss.name] for loss in host],
            )
            with wp.Tape() as tape:
                self.mount.place(exchange.pose, views.rotation_count, into=views.placed)
            losses = self._losses(pose, views, scenes, schedule, seconds, gradient=gradient)
            closed = time.perf_counter()
            with tape if with_constraints else contextlib.nullcontext():
                constraint_loss = self.constraints.losses_of(views.placed, views.rotation_count)
                total = self._lagrangian(exchange.mean_loss(), constraint_loss, exchange.multiplier)
            if gradient:
                tape.backward(total if with_constraints else None)
            fetched = exchange.fetch(constraint_loss, total, views.renderers)
            seconds["backward"] += time.perf_counter() - closed
            asked = zip(views.renderers, fetched.needed_samples, strict=True)
            grown = [renderer.grew(needed) for renderer, needed in asked]
            if not any(grown):
                break

        sums = dict(zip((loss.name for loss in device), fetched.batch_loss, strict=True))
        for k, loss in enumerate(host):
            sums[loss.name] = sum(each.host_value[k] for each in losses)
        mean = {name: (1.0 / count[name]) * value for name, value in sums.items()}
        values = [float(mean[loss.name]) for _, loss in self.losses]
        terms = {loss.name: value for (_, loss), value in zip(self.losses, values, strict=True)}
        terms |= dict(zip(self.constraints.names, fetched.constraint_loss.tolist(), strict=True))
        objective = float(np.dot(values, [weight for weight, _ in self.losses]))
        of_host = sum(weight * mean[loss.name] for weight, loss in self.losses if isinstance(loss, HostLoss))
        pose_gradient = fetched.pose_gradient
        if self.mount.frozen is not None:
            pose_gradient[self.mount.frozen.is_frozen] = 0.0
        asked = losses if detection_probability else []
        found = [each.detection_probability.numpy() for each in asked if each.detection_probability is not None]
        seconds["total"] = time.perf_counter() - started
        return Evaluation(
            total=fetched.total + of_host if with_constraints else objective,
            objective=objective,
            terms=terms,
            gradient=pose_gradient if gradient else None,
            multiplier_gradient=fetched.multiplier_gradient if gradient else None,
            seconds=seconds,
            detection_probability=np.concatenate(found, axis=1) if found else None,
        )

    def _evaluate_single_cameras(
        self, pose: np.ndarray, scenes: Sequence[AssignedScene], *, gradient: bool
    ) -> Evaluation:
        """The same of cameras that see apart, each rendered by itself; constraints are left out."""
        started = time.perf_counter()
        packed, [(weight, loss)] = [each.scene for each in scenes], self.losses
        jacobian = None
        if gradient:
            probability, jacobian = self.single_cameras.with_jacobian(pose, packed)
        else:
            found = [self.single_cameras.detection_probability(pose, scene) for scene in packed]
            probability = np.concatenate(found, axis=1)
        share = shares_of(self.object_weight(scenes))
        value = expected_miss_rate(probability, share) if probability.shape[1] else 0.0
        slope = None
        if jacobian is not None:
            slope = (weight * expected_miss_slope(probability, jacobian, share)).astype(np.float32)
            if self.mount.frozen is not None:
                slope[self.mount.frozen.is_frozen] = 0.0
        seconds, triples = time.perf_counter() - started, self.single_cameras.triples(packed)
        return Evaluation(
            total=weight * value,
            objective=weight * value,
            terms={loss.name: value},
            gradient=slope,
            multiplier_gradient=None,
            seconds={"render": seconds, "detect": 0.0, "backward": 0.0, "total": seconds},
            detection_probability=probability if triples is None else probability[:, triples[:, 0]],
        )

    def gradients(self, mount_pose: np.ndarray, scenes: Sequence[AssignedScene]) -> dict[str, np.ndarray]:
        """Gradient of every loss of the device and of the constraints by itself, unweighted, [camera, 7] by name."""
        pose, exchange, schedule = np.asarray(mount_pose, np.float32), self._exchange, self.final_schedule
        views = self._views_for(schedule)
        device = self._objective.device
        share = [1.0 / self._count(loss, scenes) for loss in device]
        constraint_count = len(self.constraints.names)

        def send(weight: np.ndarray) -> wp.Tape:
            exchange.send(
                pose,
                np.zeros(constraint_count),
                schedule,
                weight=weight,
                count=np.ones(len(device)),
                host_weight=[0.0] * len(self._objective.host),
            )
            with wp.Tape() as tape:
                self.mount.place(exchange.pose, views.rotation_count, into=views.placed)
            return tape

        def fetched(tape: wp.Tape, constraint: int | None = None) -> np.ndarray:
            if constraint is not None:
                with tape:
                    loss = self.constraints.losses_of(views.placed, views.rotation_count)
                seed = np.eye(constraint_count, dtype=np.float32)[constraint]
                tape.backward(grads={loss: wp.array(seed, dtype=float, device=self.device)})
            else:
                tape.backward()
            assert exchange.pose.grad is not None
            return exchange.pose.grad.numpy().reshape(self.camera_count, MOUNT_POSE_SIZE).copy()

        while True:
            result = {loss.name: np.zeros((self.camera_count, MOUNT_POSE_SIZE), np.float32) for loss in device}
            for scene in scenes:
                send(np.zeros(len(device)))
                step = self._step_of(views, scene, 0)
                step.observe()
                observed, images = self._observed(step, scene, pose, schedule)
                self._match(observed, self._loop.ask(images)())
                for k, loss in enumerate(device):
                    tape = send(np.where(np.arange(len(device)) == k, share[k], 0.0))
                    step.loss_and_grad()
                    result[loss.name] += fetched(tape)
            if not views.renderers[0].grew():
                break
        for k, name in enumerate(self.constraints.names):
            result[name] = fetched(send(np.zeros(len(device))), k)
        return result

    def _views_for(self, schedule: LossSchedule) -> RigViews:
        """The views that the losses need: of every camera all rotational additions, or the one ahead."""
        rotation_count = self.mount.rotation_count if self._needs(schedule).panorama else 1
        if rotation_count not in self._views:
            camera, samples = self.mount.camera, self.options.supersampling**2
            samples *= self.camera_count * rotation_count * camera.width_px * camera.height_px
            # while the detector works on some scenes, the next are rendered; a GPU takes less time than that would save
            is_alone = wp.get_device(self.device).is_cuda or samples > _HELD_SAMPLES_MAX
            renderers = [
                Renderer(
                    [self.mount.camera] * (self.camera_count * rotation_count),
                    supersampling=self.options.supersampling,
                    occlusion=self.options.occlusion,
                    device=self.device,
                    foreground_layer=self._needs(schedule).unblocked_area,
                )
                for _ in range(1 if is_alone else 2 * _SCENES_PER_QUESTION)
            ]
            self._views[rotation_count] = RigViews(self.mount, self._exchange.pose, rotation_count, renderers)
        return self._views[rotation_count]

    def _losses(
        self,
        pose: np.ndarray,
        views: RigViews,
        scenes: Sequence[AssignedScene],
        schedule: LossSchedule,
        seconds: dict[str, float],
        *,
        gradient: bool,
    ) -> list[SceneLosses]:
        """Losses of every scene; the detector works on images of some while the next are rendered."""
        slots = len(views.renderers)
        per_question = max(1, slots // 2)
        asked: deque[tuple[list[_Observed], Callable[[], list[Detections]]]] = deque()
        losses: list[SceneLosses] = []

        groups = [range(k, min(k + per_question, len(scenes))) for k in range(0, len(scenes), per_question)]
        for group in [*groups, range(0)]:
            while asked and (not group or (len(asked) + 1) * per_question > slots):  # until their renderers are free
                observed, answers = asked.popleft()
                started = time.perf_counter()
                found = iter(answers())
                for each in observed:
                    self._match(each, [next(found) for _ in each.camera])
                    matched = time.perf_counter()
                    (each.step.loss_and_grad if gradient else each.step.loss)()
                    losses.append(each.step.losses)
                    seconds["detect"] += matched - started
                    started = time.perf_counter()
                    seconds["backward"] += started - matched
            if not group:
                break
            started = time.perf_counter()
            observed, images = [], []
            for k in group:
                step = self._step_of(views, scenes[k], k % slots)
                step.observe()
                seen, shown = self._observed(step, scenes[k], pose, schedule)
                observed.append(seen)
                images += shown
            rendered = time.perf_counter()
            asked.append((observed, self._loop.ask(images)))
            seconds["render"] += rendered - started
            seconds["detect"] += time.perf_counter() - rendered
        return losses

    def _observed(
        self, step: SceneStep, assigned: AssignedScene, pose: np.ndarray, schedule: LossSchedule
    ) -> tuple[_Observed, list[RenderedImage]]:
        """A scene that its step has rendered, and the images of it that the detector is asked about."""
        needs = self._needs(schedule)
        if not (needs.detections or needs.true_boxes):
            return _Observed(step, None, []), []
        seen = visible_objects(step.frame, step.scene, forward_view=step.ahead)
        step.truth_box_px = seen.truth_box_px
        cameras = self._cameras_that_matter(seen, assigned, needs.detections)
        if cameras:
            step.draw()
        return _Observed(step, seen, cameras), [
            RenderedImage(assigned, camera, pose[camera].tobytes(), step.image[camera : camera + 1])
            for camera in cameras
        ]

    def _cameras_that_matter(
        self, seen: VisibleObjects, assigned: AssignedScene, detections: DetectedImages
    ) -> list[int]:
        """Cameras that see enough of an object that some loss asks them for."""
        if detections is DetectedImages.NONE:
            return []
        is_seen = np.isfinite(seen.truth_box_px[..., 0])
        if detections is DetectedImages.ASSIGNED:
            is_seen &= assigned.assigned_camera == np.arange(self.camera_count)[:, None]
        return [int(camera) for camera in np.nonzero(is_seen.any(axis=1))[0]]

    def _step_of(self, views: RigViews, assigned: AssignedScene, slot: int) -> SceneStep:
        """The step of a scene on one of the renderers, with what it has recorded."""
        steps = views.steps.setdefault(assigned, {})
        if slot not in steps:
            steps[slot] = SceneStep(views, views.renderers[slot], assigned, self._exchange, self._objective)
        return steps[slot]

    def _match(self, observed: _Observed, found: Sequence[Detections]) -> None:
        """Hand what matches a vehicle to the scene's step; ``found`` in the order of ``observed.camera``."""
        if observed.seen is None:
            return
        detections = [Detections.none()] * self.camera_count
        for camera, each in zip(observed.camera, found, strict=True):
            detections[camera] = each
        match = observed.seen.match(
            detections, confidence_min=self.options.confidence_min, iou_min=self.options.iou_min
        )
        observed.step.set_boxes(matched_boxes_px(match, detections))
        observed.step.set_detected(match >= 0)

    def observe_rig(self, rig: Rig, assigned: AssignedScene) -> tuple[Observation, Measures, float, np.ndarray | None]:
        """What a rig that stands anywhere sees of one scene: detections, measures, the objective of this scene alone.

        And the probability that each camera detects each object, [camera, object]; None where no loss needs it.
        """
        at = self._views_for(self.final_schedule)
        views = views_of_rig(
            rig,
            rotation_count=at.rotation_count,
            rotation_step_rad=self.mount.rotation_step_rad,
            device=self.device,
            mount=self.mount,
        )
        scene, renderer = assigned.scene, at.renderers[0]
        frame = renderer.render(scene.raster, views.position_ego_m, views.camera_from_ego, log_focal=views.log_zoom)
        observation = observe(
            frame,
            scene,
            self.detector,
            forward_view=at.ahead,
            confidence_min=self.options.confidence_min,
            iou_min=self.options.iou_min,
        )
        box_px = np.zeros((renderer.view_count, scene.vehicle_count, 4), np.float32)
        box_px[at.ahead] = observation.matched_box_px()
        measures = frame.measure(wp.array(box_px, dtype=wp.vec4, device=self.device))
        seen = SceneOnTape(
            self.mount,
            frame,
            scene,
            views,
            measures,
            assigned.assigned_camera,
            wp.array(assigned.assigned_camera, dtype=wp.int32, device=self.device),
            wp.array((observation.match >= 0).astype(np.float32), dtype=float, device=self.device),
            wp.array([self.final_schedule.panorama_share], dtype=float, device=self.device),
            wp.array([self.final_schedule.detector_share], dtype=float, device=self.device),
            at.ahead,
            self._objective.camera_probability,
            observation.truth_box_px,
            self._objective.object_weight(scene),
        )
        value = 0.0
        for weight, loss in self.losses:
            if isinstance(loss, DeviceLoss):
                found = float(loss.on_tape(seen).numpy()[0])
            else:
                assert isinstance(loss, HostLoss)
                found, _ = loss.on_host(seen, None, None)
            value += weight * (1.0 / self._count(loss, [assigned])) * found
        probability = None
        if seen.camera_probability is not None:
            is_peopled = scene.vehicle_count > 0
            probability = seen.detection_probability.numpy() if is_peopled else np.zeros((len(at.ahead), 0), np.float32)
        return observation, measures, value, probability


def single_cameras_of(objective: RigObjective) -> SingleCameras | None:
    """The cameras of an objective, where a rig's value follows from what each of them detects by itself; else None."""
    return objective.single_cameras if objective.is_by_single_cameras else None
