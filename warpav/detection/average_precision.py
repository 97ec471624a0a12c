"""Average precision of a single class, as COCO computes it: 101 points, boxes matched in order of confidence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from warpav.detection.matching import covered_fraction, iou_matrix


def _last_argmax(value: np.ndarray) -> int:
    """Where the largest value stands; of equals the last, as COCO's own loop has it."""
    return len(value) - 1 - int(np.argmax(value[::-1]))


@dataclass(frozen=True)
class ImageScore:
    """How the detections of one image fared; pooled by `average_precision`.

    Attributes:
        confidence: Of the detections that count, descending, shape [detection].
        true_positive: Whether each found an object of its own, bool, shape [detection].
        object_count: Number of objects that could be found.
    """

    confidence: np.ndarray
    true_positive: np.ndarray
    object_count: int


def score_image(
    truth_box_px: np.ndarray,
    detection_box_px: np.ndarray,
    confidence: np.ndarray,
    *,
    iou_min: float = 0.5,
    truth_ignored: np.ndarray | None = None,
    ignore_region_px: np.ndarray | None = None,
    detection_ignored_unless_matched: np.ndarray | None = None,
    detection_max: int = 100,
) -> ImageScore:
    """Match the detections of one image to its objects, as COCO does.

    From the most confident on, each detection takes the free object of highest IoU, and an ignored one only where no
    counted object is left for it. A detection that takes an ignored object, or has at least `iou_min` of its area in an
    ignore region, counts neither for nor against the detector.

    Args:
        truth_box_px: Edges ``x0, y0, x1, y1``; objects without a box (NaN) take no part; shape [object, 4].
        detection_box_px: Edges, shape [detection, 4].
        confidence: In any order, shape [detection].
        iou_min: Least IoU of a match.
        truth_ignored: Objects that need not be found (too small, say), bool, shape [object].
        ignore_region_px: Regions full of things that nobody labelled (COCO's crowds), shape [region, 4].
        detection_ignored_unless_matched: Detections that count only if they find an object (those outside the size
            range that is being scored), bool, shape [detection].
        detection_max: Only so many of the most confident detections count.

    Returns:
        The image's score.
    """
    box_px = np.asarray(detection_box_px, np.float64).reshape(-1, 4)
    confidence = np.asarray(confidence, np.float64).reshape(-1)
    order = np.argsort(-confidence, kind="stable")[:detection_max]
    box_px, confidence = box_px[order], confidence[order]
    waived = np.zeros(len(order), bool)
    if detection_ignored_unless_matched is not None:
        waived = np.asarray(detection_ignored_unless_matched, bool)[order]

    truth = np.asarray(truth_box_px, np.float64).reshape(-1, 4)
    exists = np.asarray(np.isfinite(truth).all(axis=1))
    counted = exists if truth_ignored is None else exists & ~np.asarray(truth_ignored, bool)
    region = np.zeros((0, 4)) if ignore_region_px is None else np.asarray(ignore_region_px, np.float64).reshape(-1, 4)
    coverage = covered_fraction(box_px, region).max(axis=1, initial=0.0)

    # COCO admits an IoU that a rounding error keeps from being exactly 1.
    threshold = min(iou_min, 1.0 - 1e-10)
    iou = iou_matrix(box_px, truth)
    iou[iou < threshold] = 0.0
    free = exists.copy()
    true_positive = np.zeros(len(order), bool)
    ignored = coverage >= threshold
    for detection in np.nonzero(iou.any(axis=1))[0]:
        best = _last_argmax(np.where(free & counted, iou[detection], 0.0))
        if free[best] and counted[best] and iou[detection, best] > 0.0:
            free[best] = False
            true_positive[detection], ignored[detection] = True, False
            continue
        best = _last_argmax(np.where(free & ~counted, iou[detection], 0.0))
        if free[best] and iou[detection, best] > coverage[detection] * ignored[detection]:
            free[best] = False
            ignored[detection] = True
    ignored |= ~true_positive & waived
    return ImageScore(confidence[~ignored], true_positive[~ignored], int(counted.sum()))


def average_precision(scores: Iterable[ImageScore]) -> float:
    """Average precision of all images together.

    Args:
        scores: One for every image.

    Returns:
        Mean of the interpolated precision at recall 0, .01, ... 1, in 0..1; NaN where there is no object to find.
    """
    scores = list(scores)
    object_count = sum(score.object_count for score in scores)
    if object_count == 0:
        return float("nan")
    confidence = np.concatenate([score.confidence for score in scores])
    true_positive = np.concatenate([score.true_positive for score in scores])
    if len(confidence) == 0:
        return 0.0
    found = np.cumsum(true_positive[np.argsort(-confidence, kind="stable")])
    recall = found / object_count
    precision = found / np.arange(1, len(found) + 1)
    # The interpolated precision at a recall is the best precision at that recall or beyond.
    envelope = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
    return float(envelope[np.searchsorted(recall, np.linspace(0.0, 1.0, 101), side="left")].mean())


def mean_image_average_precision(scores: Iterable[ImageScore]) -> float:
    """The thesis's mAP of one camera: the mean over those of its images that hold both objects and detections.

    It leaves out images in which everything was missed, and images with nothing but false alarms (thesis, section IV);
    `average_precision` over all images is the stricter figure.

    Args:
        scores: One for every image of the camera.

    Returns:
        In 0..1; NaN where no image qualifies.
    """
    each = [average_precision([score]) for score in scores if score.object_count and len(score.confidence)]
    return float(np.mean(each)) if each else float("nan")
