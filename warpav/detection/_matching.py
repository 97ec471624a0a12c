"""Boxes around what is seen of objects, and which detection belongs to which: the thesis's true positive.

Thesis, section III.B, "Ground-Truth Detection Assessment".
"""

from __future__ import annotations

import numpy as np

# A rendered image of object indices marks nothing with -1, the environment with 0, the ego vehicle with 1, and vehicle
# k of the scene with 2 + k.
_FIRST_VEHICLE_INDEX = 2


def largest_component_box(silhouette: np.ndarray, *, min_area_px: int = 16) -> np.ndarray | None:
    """Edges ``x0, y0, x1, y1`` [px] around the largest 8-connected part of a silhouette; None where it is too small.

    Pixel (row 0, column 0) alone gives ``0, 0, 1, 1``; of parts of one size the uppermost wins.
    """
    import cv2

    # Label 0 is the background and takes no part.
    count, _, statistics, _ = cv2.connectedComponentsWithStats(silhouette.astype(np.uint8), connectivity=8)
    if count < 2:
        return None
    x, y, width, height, area_px = statistics[1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))]
    if area_px < min_area_px:
        return None
    return np.array([x, y, x + width, y + height], np.float32)


def visible_boxes(object_index: np.ndarray, vehicle_count: int, *, min_area_px: int = 16) -> np.ndarray:
    """Ground-truth boxes in an image of object indices [row, column], float32 [vehicle, 4] [px]; NaN where none."""
    from scipy.ndimage import find_objects

    box_px = np.full((vehicle_count, 4), np.nan, np.float32)
    if vehicle_count == 0:
        return box_px
    # One sweep finds the rectangle that holds each vehicle, so that components are sought in small crops only.
    label = np.asarray(object_index, np.int32) - (_FIRST_VEHICLE_INDEX - 1)
    for vehicle, region in enumerate(find_objects(np.maximum(label, 0), max_label=vehicle_count)):
        if region is None:
            continue
        box = largest_component_box(label[region] == vehicle + 1, min_area_px=min_area_px)
        if box is not None:
            row, column = region
            box_px[vehicle] = box + np.array([column.start, row.start, column.start, row.start], np.float32)
    return box_px


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
    """IoU of every pair of boxes, float64 [first, second]; 0 where a box is NaN or both are empty."""
    intersection, first_area, second_area = _overlap(first_box_px, second_box_px)
    union = first_area + second_area - intersection
    return np.divide(intersection, union, out=np.zeros_like(intersection), where=(union > 0.0) & (intersection > 0.0))


def covered_fraction(box_px: np.ndarray, region_px: np.ndarray) -> np.ndarray:
    """Share of each box that lies in each region, float64 [box, region]; 0 for an empty box."""
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
    """The detection of every object, matched one to one from the highest IoU on, -1 where none, int64 [object].

    A pair may match from `confidence_min` and `iou_min` on where part of the object is seen inside the detection, bool
    [object, detection]. At one IoU the higher confidence wins, then the earlier object, then the earlier detection.
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
