"""Fit the detection probability model, and score it on held-out scenes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from threadpoolctl import threadpool_limits

from warpav.detection._detector import Detector
from warpav.detection._observe import observe
from warpav.detection._probability import (
    CONTRAST,
    ELEVATION,
    FEATURE_COUNT,
    IN_FRAME_SHARE,
    UPRIGHT,
    VISIBLE_SHARE,
    VISIBLE_SIZE,
    Appearance,
    DetectionProbability,
    natural_range,
    spline_basis,
)
from warpav.raster.areas import VISIBLE_AREA
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer
from warpav.rig import MountSurface, RigCamera
from warpav.scene import DeviceScene

_KNOT_COUNT = 9
_PENALTIES = (0.3, 3.0, 30.0, 300.0)
_FOLD_COUNT = 5
_RIDGE = 0.01
BIN_COUNT = 15
_MIN_OBJECTS = 200
_MIN_OF_EACH = 10
_ITERATIONS_MAX = 100

# More pixels of the same thing, less of it hidden, less of it cut off, clearer colours, a view from less high above and
# that it stands upright in the image never make it harder to find (docs/decisions/detection.md).
MONOTONE = (VISIBLE_SIZE, VISIBLE_SHARE, IN_FRAME_SHARE, CONTRAST, ELEVATION, UPRIGHT)
# ... but that holds for sizes that one camera shows: a network also misses what is larger than all it was trained on.
MONOTONE_FOR_ANY_CAMERA = tuple(feature for feature in MONOTONE if feature != VISIBLE_SIZE)


@dataclass(frozen=True)
class DetectionSamples:
    """Objects in views, of which at least one pixel was visible, and whether the detector found them."""

    feature: np.ndarray  # in the order of `warpav.detection._probability.FEATURES`, float64 [object, feature]
    is_detected: np.ndarray  # whether a detection matched, bool [object]
    seed: np.ndarray  # the scene's seed, int64 [object]
    kind: np.ndarray  # of road user, index into `ROAD_USERS`, int64 [object]

    def __len__(self) -> int:
        return len(self.is_detected)

    @classmethod
    def join(cls, parts: Sequence[DetectionSamples]) -> DetectionSamples:
        return cls(
            np.concatenate([np.zeros((0, FEATURE_COUNT)), *(part.feature for part in parts)]),
            np.concatenate([np.zeros(0, bool), *(part.is_detected for part in parts)]),
            np.concatenate([np.zeros(0, np.int64), *(part.seed for part in parts)]),
            np.concatenate([np.zeros(0, np.int64), *(part.kind for part in parts)]),
        )

    def of_seeds(self, seeds: Sequence[int]) -> DetectionSamples:
        return self.only(np.isin(self.seed, np.asarray(seeds, np.int64)))

    def only(self, kept: np.ndarray) -> DetectionSamples:
        """Some of the objects; ``kept`` bool [object]."""
        return DetectionSamples(*(part[kept] for part in vars(self).values()))


def random_cameras(
    rng: np.random.Generator,
    surface: MountSurface,
    model: CameraModel,
    *,
    height_offset_m: float,
    count: int,
    pitch_rad: tuple[float, float] | None = None,
    height_m: tuple[float, float] | None = None,
    fov_rad: tuple[float, float] | None = None,
) -> list[RigCamera]:
    """Cameras anywhere on a mount surface, turned anywhere: where an optimisation may lead them."""
    position_m = rng.uniform(*surface.bounds_m, size=(count, 2))
    yaw_rad = rng.uniform(-math.pi, math.pi, count)
    pitches_rad = np.zeros(count) if pitch_rad is None else rng.uniform(*pitch_rad, count)
    offset_m = height_offset_m if height_m is None else rng.uniform(*height_m, count)
    z_m = surface.height_at_m(position_m) + offset_m
    models = [model] * count
    if fov_rad is not None:
        low, high = (dataclasses.replace(model, fov_rad=angle).log_zoom_over(model) for angle in fov_rad[::-1])
        models = [model.zoomed(float(log_zoom)) for log_zoom in rng.uniform(low, high, count)]
    return [
        RigCamera(
            f"camera_{i}", np.array([*position_m[i], z_m[i]]), float(yaw_rad[i]), float(pitches_rad[i]), 0.0, models[i]
        )
        for i in range(count)
    ]


def sample_detections(
    renderer: Renderer,
    scene: DeviceScene,
    cameras: Sequence[RigCamera],
    detector: Detector,
    *,
    seed: int,
    confidence_min: float,
    iou_min: float,
    network_scale: tuple[float, float] = (1.0, 1.0),
) -> DetectionSamples:
    """Run the detector on a scene in some cameras; returns one sample per visible object."""
    count, cameras = len(cameras), [*cameras, *[cameras[-1]] * (renderer.view_count - len(cameras))]
    transform = np.stack([camera.ego_from_camera for camera in cameras])
    device = str(renderer.device)
    position_ego_m = wp.array(transform[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device)
    turn = transform[:, :3, :3].transpose(0, 2, 1).astype(np.float32)
    camera_from_ego = wp.array(turn, dtype=wp.mat33, device=device)
    renderer.set_lenses([camera.model for camera in cameras])
    frame = renderer.render(scene.raster, position_ego_m, camera_from_ego)
    appearance = Appearance.of(frame, scene)
    model = DetectionProbability.unfitted(network_scale=network_scale)
    seen = model.on_tape(appearance, position_ego_m, camera_from_ego)
    is_visible = appearance.measures.value.numpy()[:count, :, VISIBLE_AREA] >= 1.0
    shown = np.flatnonzero(is_visible.any(axis=1)).tolist()
    if not shown:  # the detector would find nothing that counts
        return DetectionSamples.join([])
    observation = observe(frame, scene, detector, forward_view=shown, confidence_min=confidence_min, iou_min=iou_min)
    is_detected = observation.match[is_visible[shown]] >= 0
    return DetectionSamples(
        seen.feature.numpy()[:count][is_visible].astype(np.float64),
        is_detected,
        np.full(len(is_detected), seed, np.int64),
        np.broadcast_to(scene.road_user_index, is_visible.shape)[is_visible].astype(np.int64),
    )


@dataclass(frozen=True)
class ProbabilityScores:
    # Share of pairs of a detected and a missed object of which the detected one has the higher probability; ties count
    # half
    auc: float
    brier: float  # mean squared difference between probability and outcome
    brier_base_rate: float  # the same for one probability for all, the share that was detected
    # Expected calibration error: objects sorted by probability, cut into 15 bins of equal number; the mean over bins of
    # abs(mean probability - share detected), weighted by the number in the bin
    calibration_error: float
    bins: tuple[CalibrationBin, ...]  # the bins, in the order of probability


@dataclass(frozen=True)
class CalibrationBin:
    count: int  # how many
    predicted: float  # their mean probability
    detected: float  # the share that was detected
    low: float  # lower end of its 95 % interval (Wilson)
    high: float  # upper end


def score(probability: np.ndarray, is_detected: np.ndarray, *, bin_count: int = BIN_COUNT) -> ProbabilityScores:
    from scipy.stats import binomtest, rankdata

    probability, is_detected = np.asarray(probability, np.float64), np.asarray(is_detected, bool)
    found, count = int(is_detected.sum()), len(is_detected)
    if count < bin_count or found in (0, count):
        raise ValueError(f"expected at least {bin_count} objects, some detected and some not, got {found} of {count}")
    rank = rankdata(probability)
    auc = (rank[is_detected].sum() - 0.5 * found * (found + 1)) / (found * (count - found))
    bins = []
    for members in np.array_split(np.argsort(probability, kind="stable"), bin_count):
        number, hits = len(members), int(is_detected[members].sum())
        interval = binomtest(hits, number).proportion_ci(0.95, method="wilson")
        bins.append(CalibrationBin(number, float(probability[members].mean()), hits / number, *map(float, interval)))
    base = found / count
    return ProbabilityScores(
        auc=float(auc),
        brier=float(np.mean((probability - is_detected) ** 2)),
        brier_base_rate=base * (1.0 - base),
        calibration_error=sum(each.count * abs(each.predicted - each.detected) for each in bins) / count,
        bins=tuple(bins),
    )


@threadpool_limits.wrap(limits=1, user_api="blas")  # more threads would only wait for one another
def fit_probability(
    samples: DetectionSamples,
    *,
    rng: np.random.Generator,
    knot_count: int = _KNOT_COUNT,
    penalties: Sequence[float] = _PENALTIES,
    monotone: Sequence[int] = MONOTONE,
) -> tuple[DetectionProbability, list[float]]:
    """Fit the curves by logistic regression, penalised by their second differences; also gives each kind's penalty.

    Kinds of which there are too few objects take the curves of all objects.
    """
    _check_counts(samples)
    ranges = [natural_range(samples.feature[:, f], knot_count) for f in range(FEATURE_COUNT)]
    basis = np.stack([spline_basis(samples.feature[:, f], *ranges[f], knot_count) for f in range(FEATURE_COUNT)], 1)
    of_all, found = None, []
    for kind in range(int(samples.kind.max()) + 1):
        own = samples.kind == kind
        if len(samples) > own.sum() and not _is_enough(samples.is_detected[own]):
            of_all = of_all or _fitted_curves(basis, samples, rng, penalties, monotone)
            found.append(of_all)
        else:
            found.append(_fitted_curves(basis[own], samples.only(own), rng, penalties, monotone))
    coefficient, constant, penalty = zip(*found, strict=True)
    start, step = np.array(ranges).T
    return DetectionProbability(start, step, np.array(coefficient), np.array(constant)), list(penalty)


def _is_enough(is_detected: np.ndarray) -> bool:
    found, count = int(is_detected.sum()), len(is_detected)
    return count >= _MIN_OBJECTS and min(found, count - found) >= _MIN_OF_EACH


def _check_counts(samples: DetectionSamples) -> None:
    found, count = int(samples.is_detected.sum()), len(samples)
    if not _is_enough(samples.is_detected):
        raise ValueError(
            f"expected at least {_MIN_OBJECTS} visible objects, {_MIN_OF_EACH} of them detected and {_MIN_OF_EACH} "
            f"missed, got {count}, {found} detected and {count - found} missed"
        )


def _fitted_curves(
    basis: np.ndarray,
    samples: DetectionSamples,
    rng: np.random.Generator,
    penalties: Sequence[float],
    monotone: Sequence[int],
) -> tuple[np.ndarray, float, float]:
    """Coefficients [feature, knot], constant and penalty of some objects, ``basis`` float64 [object, feature, knot].

    The penalty is the one whose likelihood is greatest on scenes that were left out, over folds of whole scenes.
    """
    knot_count = basis.shape[2]
    regression = _Regression.of(basis.reshape(len(basis), -1), samples.is_detected, knot_count, monotone)
    seeds = rng.permutation(np.unique(samples.seed))
    fold_of = np.argsort(seeds)[np.searchsorted(np.sort(seeds), samples.seed)] % _FOLD_COUNT
    best = penalties[0]
    if len(seeds) >= _FOLD_COUNT and len(penalties) > 1:
        folds = [fold_of == k for k in range(_FOLD_COUNT)]

        def loss(penalty: float) -> float:
            """Negative log-likelihood of the objects of each fold under what is fitted to the others."""
            logit = [regression.design[fold] @ regression.fit(~fold, penalty) for fold in folds]
            pairs = zip(logit, (regression.outcome[fold] for fold in folds), strict=True)
            return sum(float(np.logaddexp(0.0, each).sum() - each @ outcome) for each, outcome in pairs)

        best = min(penalties, key=loss)
    weight = regression.fit(np.ones(len(basis), bool), best)
    coefficient = weight[1:].reshape(FEATURE_COUNT, knot_count)
    # every curve gives 0 in the mean; the constant is the logit of an average object
    middle = np.einsum("fk,fk->f", coefficient, basis.mean(axis=0))
    return coefficient - middle[:, None], float(weight[0] + middle.sum()), best


@dataclass(frozen=True)
class _Regression:
    """A logistic regression whose coefficients of some curves may not fall.

    The weights are the constant, then the coefficients of every curve. They are sought as sums of steps (``rising``),
    of which those of a curve that may not fall are not negative; then neither falls the curve.
    """

    design: np.ndarray
    outcome: np.ndarray
    rising: np.ndarray
    lower: np.ndarray
    bend: np.ndarray

    @classmethod
    def of(cls, basis: np.ndarray, is_detected: np.ndarray, knot_count: int, monotone: Sequence[int]) -> _Regression:
        design = np.c_[np.ones(len(basis)), basis]
        size = design.shape[1]
        rising, lower, bend = np.eye(size), np.full(size, -np.inf), np.zeros((size, size))
        second = np.diff(np.eye(knot_count), n=2, axis=0)
        for f in range(FEATURE_COUNT):
            own = slice(1 + f * knot_count, 1 + (f + 1) * knot_count)
            bend[own, own] = second.T @ second
            if f in monotone:
                rising[own, own] = np.tril(np.ones((knot_count, knot_count)))
                lower[own.start + 1 : own.stop] = 0.0
        return cls(design, is_detected.astype(np.float64), rising, lower, bend)

    def fit(self, used: np.ndarray, penalty: float) -> np.ndarray:
        """The weights for some of the objects, by Newton's method with bounds."""
        from scipy.linalg import solve_triangular
        from scipy.optimize import lsq_linear
        from scipy.special import expit

        design, outcome = self.design[used] @ self.rising, self.outcome[used]
        ridge = np.full(len(self.bend), _RIDGE)
        ridge[0] = 1e-9  # the constant goes where it wants
        costs = self.rising.T @ (penalty * self.bend + np.diag(ridge)) @ self.rising

        def loss(at: np.ndarray) -> float:
            logit = design @ at
            return float(np.logaddexp(0.0, logit).sum() - logit @ outcome + 0.5 * at @ costs @ at)

        share = outcome.mean().clip(1e-3, 1.0 - 1e-3)
        point = np.zeros(len(costs))
        point[0] = math.log(share / (1.0 - share))
        reached = loss(point)
        for _ in range(_ITERATIONS_MAX):
            probability = expit(design @ point)
            slope = design.T @ (probability - outcome) + costs @ point
            root = np.linalg.cholesky((design.T * (probability * (1.0 - probability))) @ design + costs)
            # the least value of the quadratic model within the bounds is a problem of least squares
            target = root.T @ point - solve_triangular(root, slope, lower=True)
            step = lsq_linear(root.T, target, (self.lower, np.inf), method="bvls").x - point
            length, tried = 1.0, loss(point + step)
            while tried > reached and length > 1e-6:
                length *= 0.5
                tried = loss(point + length * step)
            if tried > reached - 1e-9 * (1.0 + abs(reached)):
                break
            point, reached = point + length * step, tried
        return self.rising @ point
