"""The best box that any detector could give: around the largest connected part of what is seen of a vehicle.

Thesis, section III.B, "Ground-Truth Detection Assessment".
"""

from __future__ import annotations

import numpy as np

# A rendered image of object indices marks nothing with -1, the environment with 0, the ego vehicle with 1, and vehicle
# k of the scene with 2 + k.
FIRST_VEHICLE_INDEX = 2


def largest_component_box(silhouette: np.ndarray, *, min_area_px: int = 16) -> np.ndarray | None:
    """The box around the largest 8-connected component of a silhouette.

    Args:
        silhouette: True where the object is seen, bool, shape [row, column].
        min_area_px: A largest component of fewer pixels has no box.

    Returns:
        Edges ``x0, y0, x1, y1`` [px], float32, shape [4]: pixel (row 0, column 0) alone gives ``0, 0, 1, 1``. None
        where the component is too small. Of components of one size the uppermost wins.
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
    """The ground-truth box of every vehicle of a scene in one image.

    Args:
        object_index: What each pixel sees, as `warpav.detection.images` writes it, int, shape [row, column].
        vehicle_count: Number of vehicles in the scene.
        min_area_px: See `largest_component_box`.

    Returns:
        Edges ``x0, y0, x1, y1`` [px], float32, shape [vehicle, 4]; NaN where a vehicle has no box.
    """
    from scipy.ndimage import find_objects

    box_px = np.full((vehicle_count, 4), np.nan, np.float32)
    if vehicle_count == 0:
        return box_px
    # One sweep finds the rectangle that holds each vehicle, so that components are sought in small crops only.
    label = np.asarray(object_index, np.int32) - (FIRST_VEHICLE_INDEX - 1)
    for vehicle, region in enumerate(find_objects(np.maximum(label, 0), max_label=vehicle_count)):
        if region is None:
            continue
        box = largest_component_box(label[region] == vehicle + 1, min_area_px=min_area_px)
        if box is not None:
            row, column = region
            box_px[vehicle] = box + np.array([column.start, row.start, column.start, row.start], np.float32)
    return box_px


def seen_inside(object_index: np.ndarray, vehicle_count: int, box_px: np.ndarray) -> np.ndarray:
    """Whether any visible part of a vehicle lies in a box: the third condition of the thesis's true positive.

    Args:
        object_index: See `visible_boxes`.
        vehicle_count: Number of vehicles in the scene.
        box_px: Boxes of a detector ``x0, y0, x1, y1`` [px], shape [detection, 4].

    Returns:
        True where a pixel centre of the vehicle lies in the box, bool, shape [vehicle, detection].
    """
    inside = np.zeros((vehicle_count, len(box_px)), bool)
    for detection, (x0, y0, x1, y1) in enumerate(np.asarray(box_px, np.float64)):
        # Pixel i has its centre at i + 0.5.
        rows = slice(max(int(np.ceil(y0 - 0.5)), 0), max(int(np.floor(y1 - 0.5)) + 1, 0))
        columns = slice(max(int(np.ceil(x0 - 0.5)), 0), max(int(np.floor(x1 - 0.5)) + 1, 0))
        seen = np.unique(object_index[rows, columns]) - FIRST_VEHICLE_INDEX
        inside[seen[(seen >= 0) & (seen < vehicle_count)], detection] = True
    return inside
