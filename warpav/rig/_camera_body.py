"""Cameras as bodies: the box of a housing on a stalk, what it hides from other cameras, and where boxes meet.

A housing is a box along the camera's axes (`warpav.rig._module.Housing`). What lies ahead of the optical centre is not
drawn, so that no camera sees its own housing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np

from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh, merge
from warpav.rig._module import Housing
from warpav.rig._rig import Rig, RigCamera

LENS_M = 1e-3
"""How far behind the optical centre the drawn box begins [m]."""

_STALK_M = 0.02
"""Thickness of a stalk [m]."""

_STALK_MOST_M = 1.0
"""A camera farther from the body than this stands on nothing that can be known [m]."""

_EDGE_STEPS = 5
"""Points along every edge of a box, so that a box of which a part is behind the camera keeps the other."""

_RGB = (40, 40, 44)
_CORNER = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
# counter-clockwise seen from outside, for corners in the order of `_CORNER`
_FACES = np.array(
    [
        *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
        *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
    ]
)
_EDGE = np.array([(a, b) for a, b in itertools.combinations(range(8), 2) if (_CORNER[a] != _CORNER[b]).sum() == 1])


def corners_m(ego_from_camera: np.ndarray, housing: Housing) -> np.ndarray:
    """Corners of a housing in the ego frame [m], float64 [..., 8, 3]; `_CORNER` is their order.

    ``ego_from_camera`` float [..., 4, 4].
    """
    local_m = _CORNER * housing.size_m + housing.offset_m
    pose = np.asarray(ego_from_camera, np.float64)
    return local_m @ np.swapaxes(pose[..., :3, :3], -1, -2) + pose[..., None, :3, 3]


def body_of(camera: RigCamera, skin_m: np.ndarray | None = None) -> Mesh:
    """The housing of a camera behind its optical centre, and a stalk to a point of the skin; in the ego frame [m].

    ``skin_m`` float [3]; None, or farther than `_STALK_MOST_M`: no stalk.
    """
    pose, housing = camera.ego_from_camera, camera.housing
    local_m = _CORNER * housing.size_m + housing.offset_m
    local_m[:, 2] = np.minimum(local_m[:, 2], -LENS_M)
    parts = [local_m @ pose[:3, :3].T + pose[:3, 3]]
    if skin_m is not None:
        foot_m = parts[0].mean(axis=0)
        length_m = math.dist(foot_m, skin_m)
        if 1e-3 < length_m <= _STALK_MOST_M:
            parts.append(_beam(foot_m, np.asarray(skin_m, np.float64)))
    vertex_m = np.concatenate(parts)
    triangle = np.concatenate([_FACES + 8 * k for k in range(len(parts))])
    return Mesh.create(vertex_m.astype(np.float32), triangle, _RGB)


def _beam(start_m: np.ndarray, end_m: np.ndarray) -> np.ndarray:
    """Corners of a thin box from a point to another, in the order of `_CORNER`."""
    along = (end_m - start_m) / math.dist(start_m, end_m)
    aside = np.cross(along, [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 else [0.0, 1.0, 0.0])
    aside /= np.linalg.norm(aside)
    axes = np.stack([aside, np.cross(along, aside), along])
    local_m = _CORNER * [_STALK_M, _STALK_M, math.dist(start_m, end_m)]
    return local_m @ axes + 0.5 * (start_m + end_m)


def bodies_of(rig: Rig, vehicle: Mesh) -> Mesh | None:
    """The bodies of all cameras of a rig that stand outside of the vehicle, as one mesh in the ego frame [m].

    None where all stand behind glass. ``vehicle`` in the ego frame [m]; stalks go to its nearest point.
    """
    outside = [camera for camera in rig.cameras if camera.behind_glass is None]
    meshes = [
        body_of(camera, point_m)
        for camera, point_m in zip(outside, nearest_on(vehicle, [c.position_m for c in outside]), strict=True)
    ]
    return merge(meshes) if meshes else None


def nearest_on(vehicle: Mesh, point_m: Sequence[np.ndarray]) -> np.ndarray:
    """The points of a mesh's faces that are nearest to some points [m], float64 [point, 3]."""
    corner_m = vehicle.vertex_m[vehicle.triangle].astype(np.float64)
    side_m = np.roll(corner_m, -1, axis=1) - corner_m
    normal = np.cross(side_m[:, 0], side_m[:, 1])
    inward, per_m2 = np.cross(normal[:, None], side_m), 1.0 / np.maximum((side_m**2).sum(axis=2), 1e-30)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    nearest_m = np.zeros((len(point_m), 3))
    for k, each_m in enumerate(point_m):
        to_m = each_m - corner_m
        along = np.clip((to_m * side_m).sum(axis=2) * per_m2, 0.0, 1.0)
        is_over = ((to_m * inward).sum(axis=2) > 0.0).all(axis=1)  # else a side is nearest
        off_m = (to_m[is_over, 0] * normal[is_over]).sum(axis=1, keepdims=True) * normal[is_over]
        found_m = np.concatenate([(corner_m + along[..., None] * side_m).reshape(-1, 3), each_m - off_m])
        nearest_m[k] = found_m[np.linalg.norm(found_m - each_m, axis=1).argmin()]
    return nearest_m


def hidden_share(model: CameraModel, camera_from_ego: np.ndarray, corner_m: np.ndarray) -> np.ndarray:
    """Share of a camera's image behind a box, 0..1, float64 [box]: the convex hull of its edges in the image.

    Nothing stands before the box; what of it is nearer than ``model.near_m`` is left out.

    ``camera_from_ego`` float [4, 4], or of each box [box, 4, 4]; ``corner_m`` float [box, 8, 3], as of `corners_m`.
    """
    start_m, end_m = (corner_m[:, _EDGE[:, k], None] for k in (0, 1))
    point_m = (start_m + (end_m - start_m) * np.linspace(0.0, 1.0, _EDGE_STEPS)[:, None]).reshape(len(corner_m), -1, 3)
    point_m = point_m @ np.swapaxes(camera_from_ego[..., :3, :3], -1, -2) + camera_from_ego[..., None, :3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        place_px = model.project(point_m)
    depth_m = np.linalg.norm(point_m, axis=-1) if model.shape.has_unit_rays else point_m[..., 2]
    is_seen = np.isfinite(place_px).all(axis=-1) & (depth_m > model.near_m)
    # what is behind a wide lens has places all round its image
    ahead = point_m[..., 2] / np.maximum(np.linalg.norm(point_m, axis=-1), 1e-12)
    is_seen &= ahead >= least_cosine(model)
    frame = np.array([[0, 0], [model.width_px, 0], [model.width_px, model.height_px], [0, model.height_px]], np.float32)
    share = np.zeros(len(corner_m))
    for k in np.flatnonzero(is_seen.sum(axis=1) >= 3):
        hull = cv2.convexHull(np.clip(place_px[k][is_seen[k]], -1e5, 1e5).astype(np.float32))
        if len(hull) >= 3:
            share[k] = cv2.intersectConvexConvex(hull, frame)[0] / (model.width_px * model.height_px)
    return share


@lru_cache(maxsize=64)
def least_cosine(model: CameraModel) -> float:
    """Cosine of the greatest angle between the axis and a ray of an image."""
    width, height = model.width_px, model.height_px
    share = np.linspace(0.0, 1.0, _EDGE_STEPS)[:, None]
    sides = (([0.0, 0.0], [width, 0.0]), ([0.0, height], [width, height]), ([0.0, 0.0], [0.0, height]))
    border_px = np.concatenate([(1.0 - share) * a + share * b for a, b in (*sides, ([width, 0.0], [width, height]))])
    ray = model.rays(border_px)
    cosine = ray[:, 2] / np.linalg.norm(ray, axis=1)
    return float(np.nanmin(cosine)) - 1e-9


def boxes_meet(one_m: np.ndarray, other_m: np.ndarray) -> np.ndarray:
    """Whether pairs of boxes meet, bool [pair]; corners float [pair, 8, 3], as of `corners_m`.

    Source: separating axes of two boxes (Gottschalk, Lin and Manocha 1996, OBBTree, section 5).
    """
    axes = [np.stack([box[:, k] - box[:, 0] for k in (4, 2, 1)], axis=1) for box in (one_m, other_m)]
    cross = np.cross(axes[0][:, :, None], axes[1][:, None]).reshape(len(one_m), 9, 3)
    every = np.concatenate([*axes, cross], axis=1)
    one, other = (np.einsum("pck,pak->pac", box, every) for box in (one_m, other_m))
    # boxes with an axis in common have cross products of 0, which separate nothing
    apart = (one.min(axis=2) > other.max(axis=2)) | (other.min(axis=2) > one.max(axis=2))
    return ~apart.any(axis=1)
