"""Metrics of a rig on test scenes: those of thesis section IV, COCO's, and the rig's recall."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from functools import cached_property, partial
from typing import Any

import numpy as np

from warpav.detection import (
    COCO_AREA_PX2,
    COCO_IOU,
    ROAD_USERS,
    Appearance,
    Detections,
    Detector,
    ImageBoxes,
    ImageScore,
    LidarProbability,
    Observation,
    average_precision,
    mean_image_average_precision,
    observe,
    score_images,
)
from warpav.optimisation._constraints import min_camera_distance_m
from warpav.optimisation._mount import CameraMount, PlacedViews, views_of_rig
from warpav.optimisation._objective import ObjectiveOptions, RigObjective, single_cameras_of
from warpav.optimisation._pool import CameraPool, Drawing, spread_mount_poses
from warpav.optimisation.losses._scene_on_tape import AssignedScene, CameraProbability, ObjectProbability
from warpav.raster.areas import AMODAL_AREA, Measures
from warpav.raster.camera import CameraModel
from warpav.raster.frame import Frame
from warpav.raster.mesh import Mesh
from warpav.raster.renderer import Renderer
from warpav.rig import Rig, bodies_of
from warpav.scene import DeviceScene
from warpav.sight import SECTORS, body_shares, redundancy, sectors_of

# metrics defined per scene, so that rigs can be compared scene by scene
PAIRED_METRICS = (
    "misses_at_equal_false_alarms",
    "tp_detection_rate",
    "rig_recall_visible",
    "misses_per_100",
    "recall_at_equal_false_alarms",
    "tp_in_frame_rate",
    "detection_confidence",
    "ap50_pooled",
    "false_alarms_per_frame",
    "objective",
)

OPTIONAL_METRICS = ("weighted_misses_per_100", "attainable_rate", "attainable_misses_per_100", "redundant_rate")
"""Metrics that not every evaluation has: where the objects have weights (section ``importance``), where it is known
which of them are attainable (`attainable_objects`), and where some are near; defined per scene as well, but for the
attainable rate."""

_OF_OBJECTS = frozenset(
    (
        "misses_at_equal_false_alarms",
        "tp_detection_rate",
        "misses_per_100",
        "recall_at_equal_false_alarms",
        "tp_in_frame_rate",
        "objective",
    )
)
"""Metrics of which that of all scenes is the mean over scenes, weighted by their objects."""

REDUNDANT_WITHIN_M = 20.0
"""Distance within which road users count for `ArmMetrics.redundant_rate` [m]."""

REDUNDANT_CAMERAS = 2
"""Cameras that have to see them there."""

_LOG_AVERAGE_RATES = np.logspace(-2.0, 0.0, 9)
"""False alarms an image at which misses are averaged (Dollar et al. 2012, Pedestrian detection)."""

DISTANCE_EDGES_M = (0.0, 10.0, 20.0, 30.0, 40.0, math.inf)
"""Bins of the horizontal distance from the centre of the ego vehicle to the centre of an object's box [m]; a bin
includes its lower edge."""


@dataclass(frozen=True)
class GroupRecall:
    """Recall of a rig for a group of objects; each object counts once, however many cameras see it."""

    objects: int
    visible: int
    detected: int
    recall: float | None
    recall_visible: float | None

    @classmethod
    def of(cls, visible: np.ndarray, detected: np.ndarray) -> GroupRecall:
        """From flags of the objects, bool [object]."""
        return cls(len(visible), int(visible.sum()), int(detected.sum()), _mean(detected), _mean(detected[visible]))

    def __post_init__(self) -> None:
        if self.objects and self.recall is None:
            raise ValueError("a group with objects has a recall")


@dataclass(frozen=True)
class ArmMetrics:
    """Metrics of one rig on the test scenes; None where a metric is not defined, or an older file has none.

    The objects are the targeted road users of the scenes (``scenes.targets``), each counted once. With several kinds of
    road users, average precisions are means over the kinds, like COCO's over classes; a detection only matches objects
    of its own kind. Objects that an image shows too little of for a ground-truth box are ignored there, as in COCO:
    they need not be detected, and a box that matches one is no false alarm.

    Rigs are compared at equal false alarms, ``evaluation.false_alarms_per_image``: each at the confidence of its own
    that leaves so many, ``confidence_at_equal_false_alarms``. So count what has it in its name, what is weighted or
    attainable, and the groups of ``recall_by``; the other recalls and misses are those at ``detector.confidence_min``.

    Attributes:
        misses_at_equal_false_alarms: Of 100 objects, those that no camera of the rig detects.
        log_average_miss_rate: Geometric mean of the share that is missed at nine rates of false alarms an image from
            .01 to 1, as the benchmarks of pedestrians have it.
        ap50_rig: Average precision at IoU .5 of the rig as one detector: an object counts once, with the confidence of
            the best camera; false alarms are those of all cameras.
        constraint_violation: Distance outside the mount zone plus missing camera spacing [m].
    """

    map50_average: float | None = None
    map50_min_camera: float | None = None
    map50_max_camera: float | None = None
    ap50_pooled: float | None = None
    ap50_95_pooled: float | None = None
    ap50_95_small: float | None = None
    ap50_95_medium: float | None = None
    ap50_95_large: float | None = None
    tp_detection_rate: float | None = None
    tp_in_frame_rate: float | None = None
    rig_recall_visible: float | None = None
    misses_per_100: float | None = None
    misses_at_equal_false_alarms: float | None = None
    log_average_miss_rate: float | None = None
    ap50_rig: float | None = None
    recall_at_equal_false_alarms: float | None = None
    confidence_at_equal_false_alarms: float | None = None
    visible_rate: float | None = None
    detection_confidence: float | None = None
    false_alarms_per_frame: float | None = None
    objective: float | None = None
    constraint_violation: float | None = None
    min_camera_distance_m: float | None = None
    body_share: dict[str, float] = field(default_factory=dict)
    body_share_max: float | None = None
    objects: int | None = None
    frames: int | None = None
    recall_by: dict[str, dict[str, GroupRecall]] = field(default_factory=dict)
    per_scene: dict[str, list[float | None]] = field(default_factory=dict)
    weighted_misses_per_100: float | None = None
    attainable_rate: float | None = None
    attainable_misses_per_100: float | None = None
    redundant_rate: float | None = None

    @property
    def detected(self) -> int | None:
        """How many objects some camera detects; None where that is not known."""
        if self.objects is None or self.tp_detection_rate is None:
            return None
        return round(self.tp_detection_rate * self.objects)

    def scene_weights(self, metric: str) -> list[float | None] | None:
        """What each scene counts in a difference of a metric, so that it is that of all objects; None: all alike."""
        if metric.startswith("weighted") or metric == "objective":
            return self.per_scene.get("object_weight")
        return self.per_scene.get("objects") if metric in _OF_OBJECTS else None

    def to_json(self) -> dict[str, Any]:
        """As ``evaluation.json`` has them; of `OPTIONAL_METRICS` those that are known."""
        found = asdict(self)
        return {name: value for name, value in found.items() if value is not None or name not in OPTIONAL_METRICS}


class ObjectOutcome(StrEnum):
    DETECTED = "detected"
    MISSED = "missed"
    """Some camera sees it well enough for a ground-truth box, but the detector does not find it."""

    HIDDEN = "hidden"
    """Some part lies in some camera's image, but too little of it is visible (occluded)."""

    OUT_OF_FRAME = "out of frame"


@dataclass(frozen=True)
class CameraObservation:
    """Ground truth and detections in one camera's image.

    Attributes:
        image_rgb: uint8 [row, column, 3].
        truth_box_px: Box of every object, NaN where too little of it is visible [px], float32 [object, 4].
    """

    image_rgb: np.ndarray
    truth_box_px: np.ndarray
    detections: Detections
    match: np.ndarray


@dataclass(frozen=True)
class RigObservation:
    """Observations of one scene by all cameras of a rig.

    Attributes:
        detection_probability: That each camera of the rig detects each object, by the model of detection probability,
            float [camera, object]; None where no model is known for these cameras.
        points: Those of each LiDAR that return from an object, NaN of cameras, float [camera, object], as the rig has
            them; None: there is no LiDAR.
        lidar_finds: Whether a LiDAR finds an object: with a probability of at least one half; bool [camera, object].
        needs_both: Which objects a camera and a LiDAR must find to count as detected, bool [object]; None: none.
    """

    observations: list[Observation]
    in_frame: np.ndarray
    camera: list[int]
    detection_probability: np.ndarray | None = None
    confidence_min: float = 0.0  # of a detection that is shown and matched; lower ones tell false alarms
    points: np.ndarray | None = None
    lidar_finds: np.ndarray | None = None
    needs_both: np.ndarray | None = None

    @property
    def cameras(self) -> list[CameraObservation]:
        """Ground truth and detections of every camera, in the order of the rig."""
        of_camera = [
            CameraObservation(image, truth, found.only(found.confidence >= self.confidence_min), match)
            for seen in self.observations
            for image, truth, found, match in zip(
                seen.image_rgb, seen.truth_box_px, seen.detections, seen.match, strict=True
            )
        ]
        return [of_camera[k] for k in np.argsort(self.camera)]

    @cached_property
    def _best_confidence(self) -> np.ndarray:
        """Highest confidence of a matched detection of every object, -inf without one."""
        confidence = np.concatenate([each.matched_confidence() for each in self.observations])
        best = np.where(np.isfinite(confidence), confidence, -np.inf).max(axis=0, initial=-np.inf)
        return self._with_lidars(best, 1.0)

    def _with_lidars(self, confidence: np.ndarray, by_lidar: float) -> np.ndarray:
        """What cameras find with some confidence [object], as the rig; ``by_lidar``: of what a LiDAR finds alone."""
        found = np.zeros(len(confidence), bool) if self.lidar_finds is None else np.any(self.lidar_finds, axis=0)
        alone = np.where(found, by_lidar, confidence)
        if self.needs_both is None:
            return alone
        return np.where(self.needs_both, np.where(found, confidence, -np.inf), alone)

    @property
    def images(self) -> list[Observation]:
        """What the cameras see, without the LiDARs."""
        return [each for each in self.observations if not isinstance(each, _Scan)]

    @property
    def detected(self) -> np.ndarray:
        """Whether some camera detects an object, bool [object]."""
        return np.isfinite(self._best_confidence)

    def detected_up_to(self, iou_min: float) -> np.ndarray:
        """Highest minimum confidence at which some camera detects an object, -inf without, float64 [object]."""
        up_to = [each.detected_up_to(iou_min) for each in self.observations]
        best = np.concatenate(up_to).max(axis=0, initial=-np.inf)
        return self._with_lidars(best, _SURELY)

    @property
    def confidence(self) -> np.ndarray:
        """Highest confidence of a matched detection of every object, NaN without one, float64 [object]."""
        return np.where(self.detected, self._best_confidence, np.nan)

    @property
    def visible_to_camera(self) -> np.ndarray:
        """Which camera of the rig sees which object well enough for a ground-truth box, bool [camera, object]."""
        box_px = np.concatenate([each.truth_box_px for each in self.observations])
        sees = np.asarray(np.isfinite(box_px).all(axis=2))[np.argsort(self.camera)]
        return sees if self.points is None else sees | (self.points >= _SEEN_POINTS)

    @property
    def detected_by_camera(self) -> np.ndarray:
        """Which camera of the rig detects which object, bool [camera, object]."""
        found = np.concatenate([each.match for each in self.observations])[np.argsort(self.camera)] >= 0
        return found if self.lidar_finds is None else found | self.lidar_finds

    @property
    def visible(self) -> np.ndarray:
        """Whether some camera sees an object well enough for a ground-truth box, bool [object]."""
        return np.asarray(self.visible_to_camera.any(axis=0))

    @property
    def outcomes(self) -> list[ObjectOutcome]:
        return [
            ObjectOutcome.DETECTED
            if detected
            else ObjectOutcome.MISSED
            if visible
            else ObjectOutcome.HIDDEN
            if in_frame
            else ObjectOutcome.OUT_OF_FRAME
            for detected, visible, in_frame in zip(self.detected, self.visible, self.in_frame, strict=True)
        ]


_FOUND = 0.5  # probability from which on a LiDAR finds an object
_SEEN_POINTS = 1.0  # of a LiDAR that return from an object that it sees
_SURELY = 2.0  # confidence above that of any detection: what a LiDAR finds is found whatever a detector's threshold is


class _Scan(Observation):
    """What a LiDAR is shown: no detector looks at it."""

    @classmethod
    def of(cls, frame: Frame, object_count: int) -> _Scan:
        views = frame.view_count
        boxes = np.full((views, object_count, 4), np.nan, np.float32)
        match = np.full((views, object_count), -1, np.int64)
        nothing = [np.zeros((object_count, 0), bool) for _ in range(views)]
        return cls(frame.colours(), [Detections.none()] * views, boxes, boxes, match, nothing)


class RigObserver:
    """Observes scenes through the cameras of any rig, which need not share a camera model."""

    def __init__(
        self,
        rig: Rig,
        detector: Detector,
        options: ObjectiveOptions,
        *,
        device: str,
        probability_of: Callable[[CameraModel], ObjectProbability | None] | None = None,
    ) -> None:
        """Create the renderers; cameras of one model that look through one pane share one."""
        self._probability_of = probability_of
        self._detector, self._options = detector, options
        kind_of = [(camera.model, camera.behind_glass) for camera in rig.cameras]
        kinds = list(dict.fromkeys(kind_of))
        self._groups: list[tuple[Renderer, Rig]] = []
        for kind in kinds:
            model, _ = kind
            part = Rig([camera for camera, each in zip(rig.cameras, kind_of, strict=True) if each == kind])
            shown = [model] * len(part.cameras)
            renderer = Renderer(shown, supersampling=options.supersampling, occlusion=options.occlusion, device=device)
            self._groups.append((renderer, part))
        self._camera = [k for kind in kinds for k, each in enumerate(kind_of) if each == kind]

    def observe(self, scene: DeviceScene) -> RigObservation:
        """Render the scene in all cameras and run the detector."""
        observations, area_px, found, points, finds = [], [], [], [], []
        for renderer, part in self._groups:
            model = part.cameras[0].model
            views = views_of_rig(part, rotation_count=1, rotation_step_rad=0.0, device=str(renderer.device))
            raster = scene.raster.through(part.cameras[0].behind_glass)
            frame = renderer.render(raster, views.position_ego_m, views.camera_from_ego)
            forward_view = list(range(len(part.cameras)))
            measures = frame.measure()
            area_px.append(_amodal_area_px(measures, forward_view))
            known = None if self._probability_of is None else self._probability_of(model)
            if model.beams is not None:
                lidar = LidarProbability(model.beams, self._options.lidar)
                returned, probability = lidar.returned(frame, scene, views.position_ego_m)
                observations.append(_Scan.of(frame, scene.vehicle_count))
                points.append(returned.numpy())
                found.append(probability.numpy())
                finds.append(found[-1] >= _FOUND)
                continue
            observations.append(
                observe(
                    frame,
                    scene,
                    self._detector,
                    forward_view=forward_view,
                    confidence_min=self._options.confidence_min,
                    iou_min=self._options.iou_min,
                )
            )
            points.append(np.full(area_px[-1].shape, np.nan))
            finds.append(np.zeros(area_px[-1].shape, bool))
            if isinstance(known, CameraProbability):
                found.append(_detection_probability(known, frame, scene, views, measures))
        order = np.argsort(self._camera)
        is_known, has_lidar = len(found) == len(self._groups), any(isinstance(each, _Scan) for each in observations)
        return RigObservation(
            observations,
            _is_in_frame(np.concatenate(area_px)),
            self._camera,
            np.concatenate(found)[order] if is_known else None,
            self._options.confidence_min,
            np.concatenate(points)[order] if has_lidar else None,
            np.concatenate(finds)[order] if has_lidar else None,
            self._options.fusion.needs_both(scene.distance_m) if self._options.fusion.is_set else None,
        )


def _detection_probability(
    model: CameraProbability, frame: Frame, scene: DeviceScene, views: PlacedViews, measures: Measures
) -> np.ndarray:
    """Probability that each view detects each object, float [view, object]."""
    if scene.vehicle_count == 0:
        return np.zeros((frame.view_count, 0), np.float32)
    appearance = Appearance.of(frame, scene, measures=measures)
    seen = model.model.on_tape(appearance, views.position_ego_m, views.camera_from_ego)
    return (model.share_of_box(seen) or seen.probability).numpy()


def _amodal_area_px(measures: Measures, view: Sequence[int]) -> np.ndarray:
    return measures.value.numpy()[view][:, :, AMODAL_AREA]


def _is_in_frame(area_px: np.ndarray) -> np.ndarray:
    """Whether some part of an object lies in some image, from the unoccluded areas [view, object]."""
    return area_px.max(axis=0, initial=0.0) > 0.0


@dataclass(frozen=True)
class SceneObservations:
    """Observations of several scenes by one rig."""

    rig: Rig
    scenes: list[DeviceScene]
    observations: list[RigObservation]
    losses: list[float]

    @property
    def detection_probability(self) -> np.ndarray | None:
        """That each camera detects each object, the objects scene by scene, float [camera, object]; None: unknown."""
        found = [each.detection_probability for each in self.observations if each.detection_probability is not None]
        if not found or len(found) < len(self.observations):
            return None
        return np.concatenate(found, axis=1)

    def at(self, confidence_min: float, iou_min: float) -> SceneObservations:
        """The same by a detector that drops what is less confident."""
        kept = [[seen.at(confidence_min, iou_min) for seen in each.observations] for each in self.observations]
        pairs = zip(self.observations, kept, strict=True)
        observations = [replace(each, observations=of_it, confidence_min=confidence_min) for each, of_it in pairs]
        return replace(self, observations=observations)


def observe_scenes(
    rig: Rig,
    scenes: Sequence[AssignedScene],
    objective: RigObjective,
    *,
    with_objective: bool = True,
    with_probability: bool = False,
) -> SceneObservations:
    """Observe scenes through the cameras of a rig."""
    mount: CameraMount = objective.mount
    is_of_mount = all(mount.has_model(camera.model) for camera in rig.cameras)
    # one render does not show what they see
    sees_apart = mount.is_mixed or bool(rig.panes)
    is_placed = with_objective and is_of_mount and (mount.is_mixed or len(rig.cameras) == objective.camera_count)
    is_placed &= objective.is_by_single_cameras or not sees_apart
    is_known = not is_of_mount and objective.is_by_single_cameras
    is_known = is_known and all(objective.probability_of(camera.model) is not None for camera in rig.cameras)
    has_objective = is_placed or (with_objective and is_known)
    observer = None
    if sees_apart or not is_placed:
        observer = RigObserver(
            rig,
            objective.detector,
            objective.options,
            device=objective.device,
            probability_of=objective.probability_of if with_probability or has_objective else None,
        )
    observations: list[RigObservation] = []
    losses = []
    for assigned in _carrying(rig, scenes) if objective.options.cameras_have_bodies else scenes:
        if observer is None:
            observation, measures, loss, probability = objective.observe_rig(rig, assigned)
            is_in_frame = _is_in_frame(_amodal_area_px(measures, objective.forward_view))
            camera = list(range(len(rig.cameras)))
            least = objective.options.confidence_min
            observations.append(RigObservation([observation], is_in_frame, camera, probability, least))
            losses.append(loss)
        else:
            observations.append(observer.observe(assigned.scene))
            probability = observations[-1].detection_probability
            if has_objective and probability is not None:
                losses.append(objective.value_of(probability, assigned, rig.is_lidar))
    return SceneObservations(rig, [each.scene for each in scenes], observations, losses)


def _carrying(rig: Rig, scenes: Sequence[AssignedScene]) -> Iterator[AssignedScene]:
    """The scenes with the bodies of a rig's cameras on their vehicle; of one vehicle they are made once."""
    bodies: dict[bytes, Mesh | None] = {}
    for assigned in scenes:
        vehicle = assigned.scene.ego_bounds_m.tobytes()
        if vehicle not in bodies:
            bodies = {vehicle: bodies_of(rig, assigned.scene.raster.foreground_mesh())}
        yield AssignedScene(assigned.scene.carrying(bodies[vehicle]), partial(getattr, assigned, "assigned_camera"))


def metrics_of(
    seen: SceneObservations,
    objective: RigObjective,
    *,
    attainable: Sequence[np.ndarray] | None = None,
    false_alarms_per_image: float | None = None,
) -> ArmMetrics:
    """Metrics of a rig from its observations; ``false_alarms_per_image``: at which it counts, None: the objective's."""
    rate = objective.options.false_alarms_per_image if false_alarms_per_image is None else false_alarms_per_image
    rig, scenes, observations, losses = seen.rig, seen.scenes, seen.observations, seen.losses
    detected, visible = [each.detected for each in observations], [each.visible for each in observations]
    in_frame, confidence = [each.in_frame for each in observations], [each.confidence for each in observations]
    boxes = _Boxes(scenes, [each.images for each in observations], objective)
    camera_map = boxes.map50_of_cameras()
    ap50, ap50_95 = boxes.average_precision()
    position_m = np.array([camera.position_m for camera in rig.cameras])
    flags = np.concatenate(visible), np.concatenate(detected)
    whole = GroupRecall.of(*flags)
    up_to = [each.detected_up_to(objective.options.iou_min) for each in observations]
    threshold = boxes.confidence_at(rate)
    found = [each >= threshold for each in up_to]
    found_all = np.concatenate(found)
    of_scene = [GroupRecall.of(*both) for both in zip(visible, detected, strict=True)]
    body_share = body_shares(rig, scenes[0]) if scenes else {}  # all scenes are around the same vehicle
    weights = None if objective.importance is None else [objective.importance.weights(scene) for scene in scenes]
    weight = np.array([len(each) for each in detected] if weights is None else [each.sum() for each in weights], float)
    optional: dict[str, list[float | None]] = {}
    weighted, can_be, attained = None, None, None
    if weights is not None:
        weighted = _misses(_weighted_mean(found_all, np.concatenate([np.zeros(0), *weights])))
        recalls = (_weighted_mean(*both) for both in zip(found, weights, strict=True))
        optional["weighted_misses_per_100"] = [_misses(each) for each in recalls]
    if attainable is not None:
        can_be = np.concatenate([np.zeros(0, bool), *attainable])
        attained = _misses(_mean(found_all[can_be]))
        recalls = (_mean(each[which]) for each, which in zip(found, attainable, strict=True))
        optional["attainable_misses_per_100"] = [_misses(each) for each in recalls]
    redundant = partial(redundancy, radius_m=REDUNDANT_WITHIN_M, cameras=REDUNDANT_CAMERAS)
    seen_by = [each.visible_to_camera for each in observations]
    return ArmMetrics(
        map50_average=_mean(np.array(camera_map)),
        map50_min_camera=min(camera_map, default=None),
        map50_max_camera=max(camera_map, default=None),
        ap50_pooled=ap50,
        ap50_95_pooled=ap50_95["all"],
        ap50_95_small=ap50_95["small"],
        ap50_95_medium=ap50_95["medium"],
        ap50_95_large=ap50_95["large"],
        tp_detection_rate=whole.recall,
        tp_in_frame_rate=_mean(np.concatenate(in_frame)),
        rig_recall_visible=whole.recall_visible,
        misses_per_100=_misses(whole.recall),
        misses_at_equal_false_alarms=_misses(_mean(found_all)),
        log_average_miss_rate=boxes.log_average_miss_rate(np.concatenate(up_to)),
        ap50_rig=boxes.ap50_of_rig(np.concatenate([each.detected_up_to(COCO_IOU[0]) for each in observations])),
        recall_at_equal_false_alarms=_mean(found_all),
        confidence_at_equal_false_alarms=threshold,
        visible_rate=_mean(flags[0]),
        detection_confidence=_mean(np.concatenate(confidence)),
        false_alarms_per_frame=_mean(boxes.false_alarms),
        objective=float(np.average(losses, weights=weight))  # weight: of the objects of every scene together
        if objective.is_by_single_cameras and len(losses) and weight.any()
        else _mean(np.array(losses)),
        constraint_violation=objective.constraints.violation_m(rig),
        min_camera_distance_m=_number(min_camera_distance_m(position_m)),
        body_share=body_share,
        body_share_max=max(body_share.values(), default=None),
        objects=whole.objects,
        frames=boxes.false_alarms.size,
        recall_by=_recall_by(scenes, flags[0], found_all),
        per_scene={
            "tp_detection_rate": [each.recall for each in of_scene],
            "rig_recall_visible": [each.recall_visible for each in of_scene],
            "misses_per_100": [_misses(each.recall) for each in of_scene],
            "misses_at_equal_false_alarms": [_misses(_mean(each)) for each in found],
            "recall_at_equal_false_alarms": [_mean(each) for each in found],
            "tp_in_frame_rate": [_mean(each) for each in in_frame],
            "detection_confidence": [_mean(values) for values in confidence],
            "ap50_pooled": boxes.ap50_of_scenes(),
            "false_alarms_per_frame": [_mean(counts) for counts in boxes.false_alarms],
            "objective": [_number(loss) for loss in losses] or [None] * len(scenes),
            "objects": [float(len(each)) for each in detected],
            **({"object_weight": weight.tolist()} if objective.is_by_single_cameras else {}),
            **optional,
            "redundant_rate": [redundant([sees], [scene]).share for sees, scene in zip(seen_by, scenes, strict=True)],
        },
        weighted_misses_per_100=weighted,
        attainable_rate=None if can_be is None else _mean(can_be),
        attainable_misses_per_100=attained,
        redundant_rate=redundant(seen_by, scenes).share,
    )


def _image_boxes(
    scenes: Sequence[DeviceScene], observations: Sequence[Sequence[Observation]]
) -> list[list[ImageBoxes]]:
    """Boxes of every image by kind of road user: [kind][image], scene by scene, camera by camera."""
    images: list[list[ImageBoxes]] = [[] for _ in ROAD_USERS]
    for scene, of_scene in zip(scenes, observations, strict=True):
        for seen in of_scene:
            for truth, small, found in zip(seen.truth_box_px, seen.too_small_box_px, seen.detections, strict=True):
                for kind, images_of_kind in enumerate(images):
                    own, said = scene.road_user_index == kind, found.road_user_index == kind
                    images_of_kind.append(
                        ImageBoxes(
                            np.concatenate([truth[own], small[own]]),
                            found.box_px[said],
                            found.confidence[said],
                            truth_ignored=np.repeat([False, True], own.sum()),
                        )
                    )
    return images


class _Boxes:
    """Scores of the boxes of all images, separately for each kind of road user, since boxes never match across kinds.

    Attributes:
        false_alarms: Count per image, int64 [scene, camera].
    """

    def __init__(
        self, scenes: Sequence[DeviceScene], observations: Sequence[Sequence[Observation]], objective: RigObjective
    ) -> None:
        images = _image_boxes(scenes, observations)
        shape = (len(scenes), len(images[0]) // max(len(scenes), 1))
        # the last threshold is that of a true positive, for the false alarms
        scores = [score_images(each, iou_min=(*COCO_IOU, objective.options.iou_min)) for each in images]
        self.false_alarms = np.zeros(shape, np.int64)
        self._confidence_min = objective.options.confidence_min
        alarms, alarms_at_50 = [np.zeros(0)], [np.zeros(0)]
        for each in scores:
            is_false, is_false_at_50 = (each.counts[0, k] & ~each.true_positive[0, k] for k in (-1, 0))
            alarms.append(each.confidence[is_false])
            alarms_at_50.append(each.confidence[is_false_at_50])
            is_false &= each.confidence >= self._confidence_min
            self.false_alarms += np.bincount(each.image[is_false], minlength=self.false_alarms.size).reshape(shape)
        self._alarm_confidence = np.sort(np.concatenate(alarms))[::-1]
        self._alarm_confidence_at_50 = np.concatenate(alarms_at_50)
        self._average_precision = np.array([each.average_precision() for each in scores])  # [kind, size, threshold]
        self._images = [each.image_scores() for each in scores]  # at IoU 0.5, [kind][image]

    def average_precision(self) -> tuple[float | None, dict[str, float | None]]:
        """AP50 of all sizes, and AP50:95 by size."""
        whole = self._average_precision
        mean = whole[:, :, : len(COCO_IOU)].mean(axis=2)
        return _mean(whole[:, 0, 0]), {name: _mean(mean[:, k]) for k, name in enumerate(COCO_AREA_PX2)}

    def confidence_at(self, false_alarms_per_frame: float) -> float:
        """The lowest confidence that leaves at most so many false alarms an image; 0 where no more are reported."""
        allowed = math.floor(false_alarms_per_frame * self.false_alarms.size + 1e-9)
        if len(self._alarm_confidence) <= allowed:
            return 0.0
        return float(np.nextafter(self._alarm_confidence[allowed], math.inf))

    def log_average_miss_rate(self, up_to: np.ndarray) -> float | None:
        """See `ArmMetrics`; ``up_to``: minimum confidence up to which the rig detects each object, float [object]."""
        missed = [_mean(up_to < self.confidence_at(rate)) for rate in _LOG_AVERAGE_RATES]
        shares = [each for each in missed if each is not None]
        return float(np.exp(np.log(np.maximum(shares, 1e-10)).mean())) if shares else None

    def ap50_of_rig(self, up_to: np.ndarray) -> float | None:
        """See `ArmMetrics`; ``up_to`` as above, at an IoU of 0.5."""
        found = up_to[np.isfinite(up_to)]
        confidence = np.concatenate([found, self._alarm_confidence_at_50])
        hits = np.arange(len(confidence)) < len(found)
        return _number(average_precision([ImageScore(confidence, hits, len(up_to))]))

    def ap50_of_scenes(self) -> list[float | None]:
        count = self.false_alarms.shape[1]
        return [
            _mean(np.array([average_precision(images[count * k : count * (k + 1)]) for images in self._images]))
            for k in range(len(self.false_alarms))
        ]

    def map50_of_cameras(self) -> list[float]:
        """The thesis's mAP@50 of every camera that has one."""
        count = self.false_alarms.shape[1]
        values = [
            mean_image_average_precision([each for images in self._images for each in images[camera::count]])
            for camera in range(count)
        ]
        return [value for value in values if math.isfinite(value)]


def _recall_by(
    scenes: Sequence[DeviceScene], visible: np.ndarray, detected: np.ndarray
) -> dict[str, dict[str, GroupRecall]]:
    """The rig's recall by distance, sector, category and road user; flags are bool [object], scene by scene."""
    from_ego_m = np.concatenate([np.zeros((0, 2)), *(scene.from_ego_m for scene in scenes)])
    distance_bin = np.searchsorted(DISTANCE_EDGES_M, np.hypot(*from_ego_m.T), side="right") - 1
    sector = sectors_of(from_ego_m)
    category = np.array([name for scene in scenes for name in scene.category], object)
    road_user = np.concatenate([np.zeros(0, np.int32), *(scene.road_user_index for scene in scenes)])
    groups = {
        "distance_m": {
            f"{low:g}+" if math.isinf(high) else f"{low:g}-{high:g}": distance_bin == k
            for k, (low, high) in enumerate(itertools.pairwise(DISTANCE_EDGES_M))
        },
        "sector": {name: sector == k for k, name in enumerate(SECTORS)},
        "category": {name: category == name for name in sorted(set(category))},
        "road_user": {ROAD_USERS[k]: road_user == k for k in np.unique(road_user)},
    }
    return {
        by: {name: GroupRecall.of(visible[group], detected[group]) for name, group in flags.items()}
        for by, flags in groups.items()
    }


def _misses(recall: float | None) -> float | None:
    return None if recall is None else 100.0 * (1.0 - recall)


def _weighted_mean(flags: np.ndarray, weight: np.ndarray) -> float | None:
    """Share of the weight that is flagged, None without any weight."""
    return float(weight @ flags / weight.sum()) if weight.any() else None


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _mean(values: np.ndarray) -> float | None:
    """Mean of the finite values, None if there are none."""
    finite = np.asarray(values, np.float64)
    finite = finite[np.isfinite(finite)]
    return float(finite.mean()) if len(finite) else None


def attainable_objects(
    objective: RigObjective, scenes: Sequence[AssignedScene], *, cameras: int = 64, drawing: Drawing | None = None
) -> list[np.ndarray] | None:
    """Which objects of each scene can be found at all, bool [object] each: what stands behind a lorry every rig misses.

    An object is attainable if one of many cameras, spread over places and directions as the first pool of a search is,
    detects it with a probability of at least one half. That takes no detector, and no rig.
    """
    single = single_cameras_of(objective)
    if single is None:
        return None
    packed = [assigned.scene for assigned in scenes]
    if not any(scene.vehicle_count for scene in packed):
        return [np.zeros(0, bool) for _ in packed]
    pose = spread_mount_poses(single.mount, objective.constraints.of_single_cameras, cameras, seed=0)
    pool = CameraPool.empty(packed, single, drawing).extended(pose, may_see_nothing=True)
    is_likely = pool.detection_probability.max(axis=0, initial=0.0) >= 0.5
    if (triples := single.triples(packed)) is not None:
        near = objective.options.fusion.needs_both(np.concatenate([scene.distance_m for scene in packed]))
        by_any, by_camera, by_lidar = is_likely[triples].T
        is_likely = np.where(near, by_camera & by_lidar, by_any)
    return np.split(is_likely, np.cumsum([scene.vehicle_count for scene in packed])[:-1])
