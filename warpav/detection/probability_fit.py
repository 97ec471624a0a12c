"""Fit the probability that a detector finds an object, and say how good it is on scenes that it has not seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpav.detection.detector import Detector
from warpav.detection.observe import observe
from warpav.detection.probability import (
    FEATURE_COUNT,
    FEATURES,
    IN_FRAME_SHARE,
    VISIBLE_SHARE,
    VISIBLE_SIZE,
    Appearance,
    DetectionProbability,
    natural_range,
    spline_basis,
)
from warpav.geometry.mount_surface import MountSurface
from warpav.render.device_scene import DeviceScene
from warpav.render.renderer import VISIBLE_AREA, Renderer
from warpav.rig.camera import CameraModel
from warpav.rig.rig import RigCamera

KNOT_COUNT = 9
PENALTIES = (0.1, 1.0, 10.0, 100.0, 1000.0)
FOLD_COUNT = 5
RIDGE = 0.01
BIN_COUNT = 15
MIN_OBJECTS = 200
MIN_OF_EACH = 10
_STEPS_MAX = 50


@dataclass(frozen=True)
class Sightings:
    """Objects in views, of which at least one pixel was visible, and whether the detector found them.

    Attributes:
        feature: In the order of `FEATURES`, float64 [object, feature].
        is_detected: Whether a detection matched, bool [object].
        seed: The scene's seed, int64 [object].
    """

    feature: np.ndarray
    is_detected: np.ndarray
    seed: np.ndarray

    def __len__(self) -> int:
        return len(self.is_detected)

    @classmethod
    def join(cls, parts: Sequence[Sightings]) -> Sightings:
        """All of them."""
        return cls(
            np.concatenate([np.zeros((0, FEATURE_COUNT)), *(part.feature for part in parts)]),
            np.concatenate([np.zeros(0, bool), *(part.is_detected for part in parts)]),
            np.concatenate([np.zeros(0, np.int64), *(part.seed for part in parts)]),
        )

    def of_seeds(self, seeds: Sequence[int]) -> Sightings:
        """Those in the scenes of some seeds."""
        kept = np.isin(self.seed, np.asarray(seeds, np.int64))
        return Sightings(self.feature[kept], self.is_detected[kept], self.seed[kept])


def random_cameras(
    rng: np.random.Generator, surface: MountSurface, model: CameraModel, *, height_offset_m: float, count: int
) -> list[RigCamera]:
    """Cameras anywhere on a mount surface, level, and turned anywhere: where an optimisation may lead them."""
    place_m = rng.uniform(*surface.bounds_m, size=(count, 2))
    height_m = surface.height_at_m(place_m) + height_offset_m
    yaw_rad = rng.uniform(-math.pi, math.pi, count)
    return [
        RigCamera(f"camera_{i}", np.array([*place_m[i], height_m[i]]), float(yaw_rad[i]), 0.0, 0.0, model)
        for i in range(count)
    ]


def look(
    renderer: Renderer,
    scene: DeviceScene,
    cameras: Sequence[RigCamera],
    detector: Detector,
    *,
    seed: int,
    confidence_min: float,
    iou_min: float,
) -> Sightings:
    """Show a scene to the detector through cameras of the renderer's lenses, as many as it has views.

    Args:
        renderer: Renders them.
        scene: The scene.
        cameras: One for every view.
        detector: Whose chances are wanted.
        seed: Of the scene.
        confidence_min: Least confidence of a detection that counts.
        iou_min: Least overlap with the true box.
    """
    transform = np.stack([camera.ego_from_camera for camera in cameras])
    device = str(renderer.device)
    position_ego_m = wp.array(transform[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device)
    turn = transform[:, :3, :3].transpose(0, 2, 1).astype(np.float32)
    camera_from_ego = wp.array(turn, dtype=wp.mat33, device=device)
    renderer.render(scene, position_ego_m, camera_from_ego)
    image = renderer.rgb(scene)
    observation = observe(
        renderer,
        scene,
        detector,
        image=image,
        ahead_view=range(renderer.view_count),
        confidence_min=confidence_min,
        iou_min=iou_min,
    )
    appearance = Appearance.of(renderer, scene, image=image)
    seen = DetectionProbability.blank().on_tape(appearance, position_ego_m, camera_from_ego)
    is_visible = appearance.measures.value.numpy()[:, :, VISIBLE_AREA] >= 1.0
    is_detected = observation.match[is_visible] >= 0
    return Sightings(
        seen.feature.numpy()[is_visible].astype(np.float64),
        is_detected,
        np.full(len(is_detected), seed, np.int64),
    )


@dataclass(frozen=True)
class Scores:
    """How good probabilities are.

    Attributes:
        auc: Share of pairs of a detected and a missed object of which the detected one has the higher probability; ties
            count half.
        brier: Mean squared difference between probability and outcome.
        brier_base_rate: The same for one probability for all, the share that was detected.
        calibration_error: Expected calibration error: objects sorted by probability, cut into 15 bins of equal number;
            the mean over bins of |mean probability - share detected|, weighted by the number in the bin.
        bins: The bins, in the order of probability.
    """

    auc: float
    brier: float
    brier_base_rate: float
    calibration_error: float
    bins: tuple[CalibrationBin, ...]


@dataclass(frozen=True)
class CalibrationBin:
    """Objects of about one probability.

    Attributes:
        count: How many.
        predicted: Their mean probability.
        detected: The share that was detected.
        low: Lower end of its 95 % interval (Wilson).
        high: Upper end.
    """

    count: int
    predicted: float
    detected: float
    low: float
    high: float


def score(probability: np.ndarray, is_detected: np.ndarray, *, bin_count: int = BIN_COUNT) -> Scores:
    """Compare probabilities with outcomes.

    Args:
        probability: In 0..1, [object].
        is_detected: bool [object].
        bin_count: Bins of the calibration error.

    Raises:
        ValueError: Fewer objects than bins, or all, or none of them were detected.
    """
    from scipy.stats import rankdata

    probability, is_detected = np.asarray(probability, np.float64), np.asarray(is_detected, bool)
    found, count = int(is_detected.sum()), len(is_detected)
    if count < bin_count or found in (0, count):
        raise ValueError(f"expected at least {bin_count} objects, some detected and some not, got {found} of {count}")
    rank = rankdata(probability)
    auc = (rank[is_detected].sum() - 0.5 * found * (found + 1)) / (found * (count - found))
    bins = []
    for members in np.array_split(np.argsort(probability, kind="stable"), bin_count):
        number, share = len(members), float(is_detected[members].mean())
        low, high = _wilson_interval(share, number)
        bins.append(CalibrationBin(number, float(probability[members].mean()), share, low, high))
    base = found / count
    return Scores(
        auc=float(auc),
        brier=float(np.mean((probability - is_detected) ** 2)),
        brier_base_rate=base * (1.0 - base),
        calibration_error=sum(each.count * abs(each.predicted - each.detected) for each in bins) / count,
        bins=tuple(bins),
    )


def _wilson_interval(share: float, count: int) -> tuple[float, float]:
    z = 1.959964
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    reach = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return max(0.0, middle - reach), min(1.0, middle + reach)
