"""Colours of a surface from the images that saw it: sharper than those of the thinned points."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import KDTree

from warpav.scene.capture.capture import ENVIRONMENT_INSTANCE, CapturedImage

_MIN_COSINE = 0.08  # flatter views are unreliable
_RIM_WEIGHT = 0.02  # of pixels at the rim of an object, where colours mix
_FAR_TOLERANCE = 0.01  # of the depth


def vertex_normals(vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Unit normals of vertices, the mean of their triangles' by area, [vertex, 3]; 0 where there is none."""
    corner = vertex_m[triangle].astype(np.float64)
    area_normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.stack(
        [np.bincount(triangle.ravel(), np.repeat(area_normal[:, k], 3), minlength=len(vertex_m)) for k in range(3)],
        axis=1,
    )
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def seen_rgb(
    vertex_m: np.ndarray,
    normal: np.ndarray,
    images: Sequence[CapturedImage],
    instance_id: int,
    *,
    tolerance_m: float,
) -> np.ndarray:
    """The colour of each vertex in the image that shows it best: nearest and most squarely.

    An image shows a vertex where its instance is the right one and its depth agrees. Where the depth lies beyond, and
    the instance is a vehicle, the pixel shows a window pane at the vertex: its colour counts as well, so panes look as
    they did. Vertices that no image shows take the colour of the nearest one that is shown.

    Shapes: ``vertex_m`` [vertex, 3], ``normal`` [vertex, 3], returns [vertex, 3].
    """
    best = np.zeros(len(vertex_m))
    rgb = np.zeros((len(vertex_m), 3), np.uint8)
    for image in images:
        mask = (image.instance == instance_id).astype(np.uint8)
        if not mask.any():
            continue
        pose, model = image.view.ego_from_camera, image.view.model
        local = (vertex_m - pose[:3, 3]) @ pose[:3, :3]
        depth_m = local[:, 2]
        to_camera = pose[:3, 3] - vertex_m
        distance_m = np.linalg.norm(to_camera, axis=1)
        cosine = np.einsum("ij,ij->i", to_camera, normal) / np.maximum(distance_m, 1e-9)
        focal_px = model.intrinsics[0, 0]
        weight = cosine * (focal_px / np.maximum(distance_m, 1e-9)) ** 2
        asked = np.flatnonzero((depth_m > model.near_m) & (cosine > _MIN_COSINE) & (weight > best))
        place = local[asked, :2] / depth_m[asked, None] * model.intrinsics[[0, 1], [0, 1]] + model.intrinsics[:2, 2]
        column, row = np.floor(place).astype(np.int64).T
        inside = (column >= 0) & (column < model.width_px) & (row >= 0) & (row < model.height_px)
        asked, row, column = asked[inside], row[inside], column[inside]
        beyond_m = image.depth_m[row, column] - depth_m[asked]
        allowed_m = tolerance_m + _FAR_TOLERANCE * depth_m[asked]
        shown = np.abs(beyond_m) <= allowed_m
        if instance_id != ENVIRONMENT_INSTANCE:
            shown |= beyond_m > 0.0
        shown &= mask[row, column] > 0
        is_core = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=1)[row, column] > 0
        found = weight[asked] * np.where(is_core, 1.0, _RIM_WEIGHT)
        better = shown & (found > best[asked])
        best[asked[better]] = found[better]
        rgb[asked[better]] = image.rgb[row[better], column[better]]
    known = best > 0.0
    if known.any() and not known.all():
        rgb[~known] = rgb[known][KDTree(vertex_m[known]).query(vertex_m[~known])[1]]
    return rgb
