"""Which detection belongs to which object: the thesis's true positive.

Thesis, section III.B, "Ground-Truth Detection Assessment".
"""

from __future__ import annotations

import numpy as np


def _overlap(first_box_px: np.ndarray, second_box_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Area of the intersection, shape [first, second], and the boxes' own areas, shapes [first, 1] and [1, second]."""
    first = np.asarray(first_box_px, np.float64).reshape(-1, 1, 4)
    second = np.asarray(second_box_px, np.float64).reshape(1, -1, 4)
    size = np.minimum(first[..., 2:], second[..., 2:]) - np.maximum(first[..., :2], second[..., :2])
    intersection = np.prod(np.maximum(size, 0.0), axis=-1)
    return (
        intersection,
        np.prod(first[..., 2:] - first[..., :2], axis=-1),
        np.prod(second[..., 2:] - second[..., :2], axis=-1),
    )


def iou_matrix(first_box_px: np.ndarray, second_box_px: np.ndarray) -> np.ndarray:
    """Intersection over union of every pair of boxes.

    Args:
        first_box_px: Edges ``x0, y0, x1, y1``, shape [first, 4].
        second_box_px: Edges, shape [second, 4].

    Returns:
        IoU in 0..1, float64, shape [first, second]; 0 where a box is NaN or both are empty.
    """
    intersection, first_area, second_area = _overlap(first_box_px, second_box_px)
    union = first_area + second_area - intersection
    return np.divide(intersection, union, out=np.zeros_like(intersection), where=(union > 0.0) & (intersection > 0.0))


def covered_fraction(box_px: np.ndarray, region_px: np.ndarray) -> np.ndarray:
    """Share of each box that lies in each region.

    Args:
        box_px: Edges ``x0, y0, x1, y1``, shape [box, 4].
        region_px: Edges, shape [region, 4].

    Returns:
        Fraction in 0..1, float64, shape [box, region]; 0 for an empty box.
    """
    intersection, area, _ = _overlap(box_px, region_px)
    return np.divide(intersection, area, out=np.zeros_like(intersection), where=(area > 0.0) & (intersection > 0.0))


def match_detections(
    truth_box_px: np.ndarray,
    detection_box_px: np.ndarray,
    confidence: np.ndarray,
    *,
    confidence_min: float = 0.1,
    iou_min: float = 0.5,
    seen_inside: np.ndarray | None = None,
) -> np.ndarray:
    """Match ground-truth boxes and detections one to one, the pair of highest IoU first.

    A pair may match if the detection's confidence is at least `confidence_min`, their IoU at least `iou_min`, and part
    of the object is seen inside the detection. Among pairs of one IoU the higher confidence wins, then the earlier
    object, then the earlier detection.

    Args:
        truth_box_px: Ground-truth boxes, NaN where an object has none, shape [object, 4].
        detection_box_px: Boxes of the detector, shape [detection, 4].
        confidence: Their confidence, shape [detection].
        confidence_min: Least confidence.
        iou_min: Least IoU.
        seen_inside: From `warpav.detection.ground_truth.seen_inside`, bool, shape [object, detection]; None leaves the
            third condition out.

    Returns:
        The detection of every object, -1 where it has none, int64, shape [object].
    """
    confidence = np.asarray(confidence, np.float64).reshape(-1)
    iou = iou_matrix(truth_box_px, detection_box_px)
    # A pair without overlap never matches, even with iou_min 0.
    valid = (iou >= iou_min) & (iou > 0.0) & (confidence >= confidence_min)[None, :]
    if seen_inside is not None:
        valid &= seen_inside
    truth, detection = np.nonzero(valid)
    order = np.lexsort((detection, truth, -confidence[detection], -iou[truth, detection]))

    match = np.full(iou.shape[0], -1, np.int64)
    taken = np.zeros(iou.shape[1], bool)
    for i, j in zip(truth[order], detection[order], strict=True):
        if match[i] < 0 and not taken[j]:
            match[i] = j
            taken[j] = True
    return match
