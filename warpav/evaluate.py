"""How good a rig is on test scenes: the metrics of thesis section IV, pooled AP50, and paired differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpav.detection.average_precision import (
    ImageScore,
    average_precision,
    mean_image_average_precision,
    score_image,
)
from warpav.detection.detector import Detector
from warpav.detection.observe import Observation, observe
from warpav.objective.constraints import constraint_violation_m, min_camera_distance_m
from warpav.objective.mount import CameraMount, views_of_rig
from warpav.objective.objective import AssignedScene, ThesisObjective
from warpav.render.device_scene import DeviceScene
from warpav.render.renderer import AMODAL_AREA, Measures, Occlusion, Renderer
from warpav.rig.camera import CameraModel
from warpav.rig.rig import Rig

# metrics that exist per scene, and so can be compared scene by scene
PAIRED_METRICS = ("tp_detection_rate", "tp_in_frame_rate", "detection_confidence", "ap50_pooled", "objective")
BOOTSTRAP_RESAMPLES = 9999


@dataclass(frozen=True)
class ArmMetrics:
    """Metrics of one rig on the test scenes; None where a metric is not defined. Fields as in ``evaluation.json``.

    Attributes:
        map50_average: Mean over cameras of each camera's mAP@50, the thesis's way (images with truth and detections).
        map50_min_camera: The worst camera's.
        map50_max_camera: The best camera's.
        ap50_pooled: AP at IoU 0.5 over all images of all cameras together (COCO's interpolation).
        tp_detection_rate: Share of all vehicles that some camera detects.
        tp_in_frame_rate: Share of all vehicles of which some part lies in some camera's image, hidden or not.
        detection_confidence: Mean over detected vehicles of their best confidence.
        objective: Scaled training objective on the test scenes.
        constraint_violation: Excess over the bounds plus missing spacing [m].
        min_camera_distance_m: Smallest distance between two cameras [m].
        objects: Number of vehicles in the test scenes.
        per_scene: The metrics of `PAIRED_METRICS` scene by scene.
    """

    map50_average: float | None
    map50_min_camera: float | None
    map50_max_camera: float | None
    ap50_pooled: float | None
    tp_detection_rate: float | None
    tp_in_frame_rate: float | None
    detection_confidence: float | None
    objective: float | None
    constraint_violation: float
    min_camera_distance_m: float | None
    objects: int
    per_scene: dict[str, list[float | None]]


class RigObserver:
    """Looks at scenes through the cameras of any rig, whatever their sizes; for rigs without a common camera model."""

    def __init__(
        self,
        rig: Rig,
        detector: Detector,
        *,
        confidence_min: float,
        iou_min: float,
        occlusion: Occlusion,
        supersampling: int,
        device: str,
    ) -> None:
        """Renderers for the rig; cameras of one model share one."""
        self._detector, self._confidence_min, self._iou_min = detector, confidence_min, iou_min
        models = list(dict.fromkeys(camera.model for camera in rig.cameras))
        self._groups: list[tuple[Renderer, Rig]] = []
        for model in models:
            part = Rig.create([camera for camera in rig.cameras if camera.model == model])
            renderer = Renderer(
                [model] * len(part.cameras), supersampling=supersampling, occlusion=occlusion, device=device
            )
            self._groups.append((renderer, part))

    def look(self, scene: DeviceScene) -> list[tuple[Observation, Measures]]:
        """Observation and measures of the scene, one pair per camera model."""
        looks = []
        for renderer, part in self._groups:
            views = views_of_rig(part, rotation_count=1, rotation_step_rad=0.0, device=str(renderer.device))
            renderer.render(scene, views.position_ego_m, views.camera_from_ego)
            ahead = list(range(len(part.cameras)))
            observation = observe(
                renderer,
                scene,
                self._detector,
                ahead_view=ahead,
                confidence_min=self._confidence_min,
                iou_min=self._iou_min,
            )
            looks.append((observation, renderer.measure(scene)))
        return looks


def common_model(rig: Rig) -> CameraModel | None:
    """The camera model that all cameras of a rig share, None if they differ."""
    models = {camera.model for camera in rig.cameras}
    return models.pop() if len(models) == 1 else None


def assign_to_nearest_cameras(scenes: Sequence[AssignedScene], yaw_rad: np.ndarray, rig: Rig) -> list[AssignedScene]:
    """Scenes whose vehicles belong to the camera that looks the way of their orientation.

    Segregation gives every vehicle an orientation; a rig from elsewhere lists its cameras in its own order.
    Orientations and cameras are paired so that the sum of the squared angles between them is smallest. (Without the
    squares many pairings are equally good, and rounding would choose.)

    Args:
        scenes: Scenes with vehicles assigned to orientations.
        yaw_rad: The orientations [rad], [orientation]; as many as the rig has cameras.
        rig: The rig.
    """
    from scipy.optimize import linear_sum_assignment

    camera_yaw_rad = np.array([camera.yaw_rad for camera in rig.cameras])
    difference = np.asarray(yaw_rad)[:, None] - camera_yaw_rad[None, :]
    _, camera_of_orientation = linear_sum_assignment(np.angle(np.exp(1j * difference)) ** 2)
    return [
        AssignedScene(
            assigned.scene,
            np.where(
                assigned.assigned_camera >= 0, camera_of_orientation[np.maximum(assigned.assigned_camera, 0)], -1
            ).astype(np.int32),
        )
        for assigned in scenes
    ]


def evaluate_rig(
    rig: Rig,
    scenes: Sequence[AssignedScene],
    objective: ThesisObjective,
) -> ArmMetrics:
    """Metrics of a rig on scenes.

    Args:
        rig: The rig, anywhere in the ego frame.
        scenes: Test scenes with vehicles assigned to the rig's cameras (for the objective).
        objective: Knows the mount, the detector and the limits of a match. The objective is None for a rig whose
            cameras are not all of the mount's model; everything else is measured with the rig's own cameras.
    """
    mount: CameraMount = objective.mount
    has_objective = common_model(rig) == mount.camera and len(rig.cameras) == objective.camera_count
    observer = None
    if not has_objective:
        observer = RigObserver(
            rig,
            objective.detector,
            confidence_min=objective.confidence_min,
            iou_min=objective.iou_min,
            occlusion=objective.occlusion,
            supersampling=objective.supersampling,
            device=objective.device,
        )
    scores: list[list[ImageScore]] = []  # [scene][camera]
    in_frame, detected, confidence, losses = [], [], [], []
    for assigned in scenes:
        if observer is None:
            observation, measures, loss = objective.observe_rig(rig, assigned)
            area = measures.value.numpy()[objective.ahead_view][:, :, AMODAL_AREA]
            looks = [(observation, area)]
            losses.append(loss)
        else:
            looks = [
                (seen, measured.value.numpy()[:, :, AMODAL_AREA]) for seen, measured in observer.look(assigned.scene)
            ]
        in_frame.append(np.concatenate([area for _, area in looks]).max(axis=0, initial=0.0) > 0.0)
        best = np.concatenate([seen.matched_confidence() for seen, _ in looks])
        detected.append(np.isfinite(best).any(axis=0))
        confidence.append(np.where(detected[-1], np.nan_to_num(best, nan=-1.0).max(axis=0, initial=-1.0), np.nan))
        scores.append(
            [
                score_image(truth, found.box_px, found.confidence, iou_min=objective.iou_min)
                for seen, _ in looks
                for truth, found in zip(seen.truth_box_px, seen.detections, strict=True)
            ]
        )
    camera_map = [mean_image_average_precision(images) for images in zip(*scores, strict=True)]
    camera_map = [value for value in camera_map if math.isfinite(value)]
    position_m = np.array([camera.position_m for camera in rig.cameras])
    return ArmMetrics(
        map50_average=_number(float(np.mean(camera_map))) if camera_map else None,
        map50_min_camera=_number(min(camera_map)) if camera_map else None,
        map50_max_camera=_number(max(camera_map)) if camera_map else None,
        ap50_pooled=_number(average_precision([score for images in scores for score in images])),
        tp_detection_rate=_mean(np.concatenate(detected)),
        tp_in_frame_rate=_mean(np.concatenate(in_frame)),
        detection_confidence=_mean(np.concatenate(confidence)),
        objective=_mean(np.array(losses)),
        constraint_violation=constraint_violation_m(rig, mount.surface, min_spacing_m=objective.settings.min_spacing_m),
        min_camera_distance_m=_number(min_camera_distance_m(position_m)),
        objects=sum(len(flags) for flags in detected),
        per_scene={
            "tp_detection_rate": [_mean(flags) for flags in detected],
            "tp_in_frame_rate": [_mean(flags) for flags in in_frame],
            "detection_confidence": [_mean(values) for values in confidence],
            "ap50_pooled": [_number(average_precision(images)) for images in scores],
            "objective": [_number(loss) for loss in losses] or [None] * len(scenes),
        },
    )


def paired_differences(
    optimised: ArmMetrics, other: ArmMetrics, *, seed: int = 0
) -> dict[str, dict[str, float | int | None]]:
    """Mean difference optimised - other, scene by scene, with a 95 % interval (bootstrap over scenes, BCa).

    Args:
        optimised: Metrics of the optimised rig.
        other: Metrics of another rig on the same scenes.
        seed: Of the resampling.

    Returns:
        For every metric of `PAIRED_METRICS`: ``mean``, ``low``, ``high`` (None where fewer than two scenes have both
        numbers) and ``scenes``, the number of scenes that do. Where all differences are equal, the interval is that
        one number.
    """
    from scipy.stats import bootstrap

    result: dict[str, dict[str, float | int | None]] = {}
    for name in PAIRED_METRICS:
        pairs = [
            (a, b)
            for a, b in zip(optimised.per_scene[name], other.per_scene[name], strict=True)
            if a is not None and b is not None
        ]
        difference = np.array([a - b for a, b in pairs])
        low = high = None
        if len(difference) >= 2:
            low = high = float(difference[0])
            if np.ptp(difference) > 0.0:
                interval = bootstrap(
                    (difference,), np.mean, n_resamples=BOOTSTRAP_RESAMPLES, rng=np.random.default_rng(seed)
                ).confidence_interval
                low, high = _number(interval.low), _number(interval.high)
        result[name] = {"mean": _mean(difference), "low": low, "high": high, "scenes": len(difference)}
    return result


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _mean(values: np.ndarray) -> float | None:
    """Mean of the finite values, None if there are none."""
    finite = np.asarray(values, np.float64)
    finite = finite[np.isfinite(finite)]
    return float(finite.mean()) if len(finite) else None
