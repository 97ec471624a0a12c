"""Average precision as COCO computes it: 101 points, boxes matched in order of confidence, for many images at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from warpav.detection._matching import iou_matrix

COCO_IOU = tuple(float(value) for value in np.linspace(0.5, 0.95, 10))
"""The thresholds of AP@[.5:.95]."""

COCO_AREA_PX2 = {"all": (0.0, 1e10), "small": (0.0, 32.0**2), "medium": (32.0**2, 96.0**2), "large": (96.0**2, 1e10)}
"""Least and greatest area of a box [px^2]; both belong to the range, so a box of 32 x 32 px is small and medium."""

# As many images as are matched at once; more would only need more memory.
_IMAGES_AT_ONCE = 512


@dataclass(frozen=True)
class ImageBoxes:
    """Ground truth and detections of one image."""

    # Edges ``x0, y0, x1, y1`` of the objects; those without a box (NaN) take no part; [object, 4]
    truth_box_px: np.ndarray
    detection_box_px: np.ndarray  # edges, [detection, 4]
    confidence: np.ndarray  # in any order, [detection]
    # Objects that need not be found (too small, say), bool [object]; None: none
    truth_ignored: np.ndarray | None = None
    # Detections that count only if they find an object, bool [detection]; None: none, but for those outside the size
    # range that is being scored
    detection_ignored_unless_matched: np.ndarray | None = None


@dataclass(frozen=True)
class ImageScore:
    """How the detections of one image fared; pooled by `average_precision`."""

    confidence: np.ndarray  # of the detections that count, descending, shape [detection]
    true_positive: np.ndarray  # whether each found an object of its own, bool, shape [detection]
    object_count: int  # number of objects that could be found


@dataclass(frozen=True)
class _Scores:
    """How the detections of many images fared, in several size ranges and at several thresholds."""

    image: np.ndarray  # image of every detection, ascending, int64 [detection]
    confidence: np.ndarray  # descending within an image, float64 [detection]
    true_positive: np.ndarray  # whether it found an object of its own, bool [size range, threshold, detection]
    counts: np.ndarray  # whether it counts for or against the detector at all, bool [size range, threshold, detection]
    object_count: np.ndarray  # objects that could be found, int64 [size range, image]

    def average_precision(self) -> np.ndarray:
        order = np.argsort(-self.confidence, kind="stable")
        object_count = self.object_count.sum(axis=1)
        result = np.full(self.counts.shape[:2], np.nan)
        for size_range, threshold in np.ndindex(result.shape):
            kept = order[self.counts[size_range, threshold, order]]
            hits = self.true_positive[size_range, threshold, kept]
            result[size_range, threshold] = _interpolated(hits, int(object_count[size_range]))
        return result

    def image_scores(self, size_range: int = 0, threshold: int = 0) -> list[ImageScore]:
        """The images one by one, for one size range and one threshold."""
        counts = self.counts[size_range, threshold]
        confidence, hits = self.confidence[counts], self.true_positive[size_range, threshold, counts]
        object_count = self.object_count[size_range]
        end = np.searchsorted(self.image[counts], np.arange(len(object_count) + 1))
        return [
            ImageScore(confidence[a:b], hits[a:b], int(count))
            for a, b, count in zip(end[:-1], end[1:], object_count, strict=True)
        ]


def score_images(
    images: Iterable[ImageBoxes],
    *,
    iou_min: Sequence[float] = COCO_IOU,
    area_px2: Sequence[tuple[float, float]] = tuple(COCO_AREA_PX2.values()),
    detection_max: int = 100,
) -> _Scores:
    """Match the detections of images to their objects, as COCO does.

    From the most confident on, each detection takes the free object of highest IoU, an ignored one only where no
    counted one is left; one that takes an ignored object does not count. In a size range objects of another area are
    ignored, and detections of another area that find nothing.
    """
    held = [_Image.of(image, detection_max) for image in images]
    image = np.repeat(np.arange(len(held)), [len(each.confidence) for each in held])
    low_px2, high_px2 = np.asarray(area_px2, np.float64).reshape(-1, 2).T[:, :, None]
    # COCO admits an IoU that a rounding error keeps from being exactly 1.
    threshold = np.minimum(np.asarray(iou_min, np.float64), 1.0 - 1e-10)
    shape = (len(area_px2), len(threshold))
    true_positive, ignored, object_count = [np.zeros((*shape, 0), bool)], [np.zeros((*shape, 0), bool)], []
    for first in range(0, len(held), _IMAGES_AT_ONCE):
        chunk = held[first : first + _IMAGES_AT_ONCE]
        hit, waived, count = _match(chunk, threshold, low_px2, high_px2)
        true_positive.append(hit)
        ignored.append(waived)
        object_count.append(count)
    true_positive, ignored = np.concatenate(true_positive, axis=2), np.concatenate(ignored, axis=2)
    return _Scores(
        image,
        np.concatenate([np.zeros(0), *(each.confidence for each in held)]),
        true_positive,
        ~ignored,
        np.concatenate([np.zeros((shape[0], 0), np.int64), *object_count], axis=1),
    )


def average_precision(scores: Iterable[ImageScore]) -> float:
    """Average precision of all images together."""
    scores = list(scores)
    confidence = np.concatenate([np.zeros(0), *(score.confidence for score in scores)])
    hits = np.concatenate([np.zeros(0, bool), *(score.true_positive for score in scores)])
    return _interpolated(hits[np.argsort(-confidence, kind="stable")], sum(score.object_count for score in scores))


def mean_image_average_precision(scores: Iterable[ImageScore]) -> float:
    """The thesis's mAP of one camera (section IV): the mean over images that hold both objects and detections."""
    each = [average_precision([score]) for score in scores if score.object_count and len(score.confidence)]
    return float(np.mean(each)) if each else float("nan")


def _interpolated(hits: np.ndarray, object_count: int) -> float:
    """Mean precision over 101 recalls of detections in order of confidence, NaN without objects."""
    if object_count == 0:
        return float("nan")
    found = np.cumsum(hits)
    recall = found / object_count
    precision = found / np.arange(1, len(found) + 1)
    # The interpolated precision at a recall is the best precision at that recall or beyond.
    envelope = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
    return float(envelope[np.searchsorted(recall, np.linspace(0.0, 1.0, 101), side="left")].mean())


@dataclass(frozen=True)
class _Image:
    """An image made ready: detections in order of confidence, objects with a box only."""

    confidence: np.ndarray  # [detection]
    detection_px2: np.ndarray  # [detection]
    waived: np.ndarray  # counts only if it finds an object, bool [detection]
    truth_px2: np.ndarray  # [object]
    truth_ignored: np.ndarray  # bool [object]
    iou: np.ndarray  # [detection, object]

    @classmethod
    def of(cls, image: ImageBoxes, detection_max: int) -> _Image:
        confidence = np.asarray(image.confidence, np.float64).reshape(-1)
        order = np.argsort(-confidence, kind="stable")[:detection_max]
        box_px = np.asarray(image.detection_box_px, np.float64).reshape(-1, 4)[order]
        truth_px = np.asarray(image.truth_box_px, np.float64).reshape(-1, 4)
        exists = np.asarray(np.isfinite(truth_px).all(axis=1))
        ignored, waived = image.truth_ignored, image.detection_ignored_unless_matched
        truth_px = truth_px[exists]
        return cls(
            confidence[order],
            np.prod(box_px[:, 2:] - box_px[:, :2], axis=1),
            np.zeros(len(order), bool) if waived is None else np.asarray(waived, bool)[order],
            np.prod(truth_px[:, 2:] - truth_px[:, :2], axis=1),
            np.zeros(len(truth_px), bool) if ignored is None else np.asarray(ignored, bool)[exists],
            iou_matrix(box_px, truth_px),
        )


def _match(
    images: Sequence[_Image], threshold: np.ndarray, low_px2: np.ndarray, high_px2: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Match images of any sizes side by side: the first detections of all, then the second ones, and so on."""
    first = np.cumsum([0, *(len(each.confidence) for each in images)])
    detection_px2 = np.concatenate([each.detection_px2 for each in images])
    waived = np.concatenate([each.waived for each in images])
    waived = waived | (detection_px2 < low_px2) | (detection_px2 > high_px2)  # [size range, detection]

    # objects padded to one number, the last index for none
    width = max(1, *(len(each.truth_px2) for each in images))
    exists = np.zeros((len(images), width), bool)
    counted = np.zeros((len(low_px2), len(images), width), bool)
    for k, each in enumerate(images):
        index = slice(len(each.truth_px2))
        exists[k, index] = True
        counted[:, k, index] = ~each.truth_ignored & (each.truth_px2 >= low_px2) & (each.truth_px2 <= high_px2)

    # only detections that reach some object can match; the others change nothing for the rest
    candidates = [np.flatnonzero((each.iou >= threshold.min()).any(axis=1)) for each in images]
    shape = (len(low_px2), len(threshold), len(waived[0]))
    hit, ignored = np.zeros(shape, bool), np.broadcast_to(waived[:, None], shape).copy()
    free = np.broadcast_to(exists, (len(low_px2), len(threshold), *exists.shape)).copy()
    for rank in range(max(map(len, candidates))):
        turn = np.array([k for k, own in enumerate(candidates) if len(own) > rank])
        iou = np.zeros((len(turn), width))
        for row, k in enumerate(turn):
            iou[row, : images[k].iou.shape[1]] = images[k].iou[candidates[k][rank]]
        # [size range, threshold, image whose turn it is, object]
        reach = np.where(free[:, :, turn] & (iou >= threshold[:, None, None]), iou, 0.0)
        best_counted = np.where(counted[:, None, turn], reach, 0.0)
        is_hit = np.asarray(best_counted.max(axis=3) > 0.0)
        best = np.where(is_hit[..., None], best_counted, reach)
        taken = width - 1 - best[..., ::-1].argmax(axis=3)  # of equals the last, as COCO's own loop has it
        is_taken = best.max(axis=3) > 0.0
        detection = np.array([first[k] + candidates[k][rank] for k in turn])
        hit[:, :, detection] = is_hit
        # one that takes an ignored object is ignored whatever its size, one that hits counts whatever its size
        ignored[:, :, detection] = np.where(is_taken, ~is_hit, ignored[:, :, detection])
        a, b, row = np.nonzero(is_taken)
        free[a, b, turn[row], taken[a, b, row]] = False
    return hit, ignored, counted.sum(axis=2)
