"""Point clouds of objects from the images of a capture, and colours of meshes (thesis, III.A, figures 5 to 7)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import KDTree

from warpav.scene._scene import Box
from warpav.scene.capture._capture import EGO_INSTANCE, ENVIRONMENT_INSTANCE, Capture, CapturedImage
from warpav.scene.reconstruction._settings import CloudSettings

_MAP_CELL_M = 0.05
_PANE_DEPTH_M = 0.15  # points this far behind the bridged outside were seen through a pane
_BRIDGED_WIDTH, _BRIDGED_HEIGHT = 0.8, 0.5  # of the vehicle's extent: no pane is wider and higher than this


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of surfaces in the ego frame."""

    point_m: np.ndarray  # positions [m], float32 [point, 3]
    rgb: np.ndarray  # sRGB colours, uint8 [point, 3]
    sensor_m: np.ndarray  # where each point was seen from [m], float32 [point, 3]

    def __len__(self) -> int:
        return len(self.point_m)

    def chosen(self, index: np.ndarray) -> PointCloud:
        """Some of the points: indices or a mask."""
        return PointCloud(self.point_m[index], self.rgb[index], self.sensor_m[index])

    def below(self, height_m: float) -> PointCloud:
        """The points that are no higher than this above the ground [m]."""
        return self.chosen(self.point_m[:, 2] <= height_m)


@dataclass(frozen=True, eq=False)
class ObjectCloud:
    """The points of one object, and the rays on which it has surface that left no points, such as window panes."""

    cloud: PointCloud  # points of its outside
    ray_origin_m: np.ndarray  # origins of rays on which its instance was seen but none of its outside [m], [ray, 3]
    ray_direction: np.ndarray  # their directions, [ray, 3]


@dataclass(frozen=True, eq=False)
class _SceneClouds:
    """The point clouds of a situation."""

    environment: PointCloud  # what is no vehicle, up to the radius
    sphere: PointCloud  # what lies beyond, moved to the sphere of that radius along the line to the ego frame's origin
    ego: ObjectCloud  # the ego vehicle
    vehicles: tuple[ObjectCloud, ...]  # the others, in the order of the capture


def fuse(
    capture: Capture, images: Sequence[CapturedImage], settings: CloudSettings, *, thread_count: int = 2
) -> _SceneClouds:
    """Point clouds of everything that the images show.

    The instance image assigns each pixel to an object, and the 3D boxes correct it (figure 7): through a window pane
    the instance image still shows the vehicle while colour and depth show what lies behind. Points of a vehicle's
    pixels count for it only inside its box, and points count for the environment only outside all boxes.
    """
    boxes = [capture.ego_box, *(vehicle.box for vehicle in capture.vehicles)]
    ids = [EGO_INSTANCE, *(vehicle.instance_id for vehicle in capture.vehicles)]
    with ThreadPoolExecutor(thread_count) as pool:
        shares = pool.map(lambda image: _image_share(image, ids, boxes, settings), images)
        around, *of_images = zip(*shares, strict=True)
    parts, rays = (list(zip(*each, strict=True)) for each in of_images)
    environment = joined(around)
    environment = environment.chosen(first_in_cells(environment.point_m, settings.environment_grid_m))
    near, sphere = split_at_radius(environment, settings.radius_m)
    environment, sphere = near.below(settings.max_height_m), sphere.below(settings.max_height_m)
    with ThreadPoolExecutor(thread_count) as pool:
        objects = list(pool.map(lambda k: _outside(joined(parts[k]), boxes[k], rays[k]), range(len(ids))))
    return _SceneClouds(environment, sphere, objects[0], tuple(objects[1:]))


def _image_share(
    image: CapturedImage, ids: Sequence[int], boxes: Sequence[Box], settings: CloudSettings
) -> tuple[PointCloud, list[PointCloud], list[tuple[np.ndarray, np.ndarray]]]:
    """Points of the environment and of each vehicle in one image, and rays through window panes."""
    cloud, instance, row, column = unproject(image, far_depth_m=settings.far_depth_m)
    parts, rays = [], []
    is_around = np.ones(len(cloud), bool)
    # pixels of a vehicle whose points lie outside its box were seen through its panes, and so were those behind
    whole = image.instance.ravel()
    own_order, whole_order = np.argsort(instance, kind="stable"), np.argsort(whole, kind="stable")
    for instance_id, box in zip(ids, boxes, strict=True):
        own = own_order[slice(*np.searchsorted(instance, (instance_id, instance_id + 1), sorter=own_order))]
        passed = whole_order[slice(*np.searchsorted(whole, (instance_id, instance_id + 1), sorter=whole_order))]
        inside = own[box.contains(cloud.point_m[own], margin_m=settings.box_margin_m)]
        parts.append(cloud.chosen(inside))
        is_around[inside] = False
        kept = row[inside] * image.instance.shape[1] + column[inside]
        rays.append(_pixel_rays(image, np.setdiff1d(passed, kept, assume_unique=True)))
    around = np.flatnonzero(is_around)
    around = around[first_in_cells(cloud.point_m[around], settings.environment_grid_m)]
    for box in boxes:
        around = around[~box.contains(cloud.point_m[around], margin_m=-settings.box_margin_m)]
    return cloud.chosen(around), parts, rays


def split_at_radius(cloud: PointCloud, radius_m: float) -> tuple[PointCloud, PointCloud]:
    """The points within a distance of the ego frame's origin, and those beyond, moved to the sphere of that radius."""
    distance_m = np.linalg.norm(cloud.point_m, axis=1)
    is_far = distance_m > radius_m
    far = cloud.chosen(is_far)
    scale = (radius_m / distance_m[is_far])[:, None]
    return cloud.chosen(~is_far), PointCloud((far.point_m * scale).astype(np.float32), far.rgb, far.sensor_m)


def unproject(image: CapturedImage, *, far_depth_m: float) -> tuple[PointCloud, np.ndarray, np.ndarray, np.ndarray]:
    """The points of all pixels that are nearer than a depth."""
    row, column = np.nonzero(image.depth_m < far_depth_m)
    ray = image.view.model.rays(np.stack([column + 0.5, row + 0.5], axis=-1))
    pose = image.view.ego_from_camera
    point = (ray * image.depth_m[row, column, None]) @ pose[:3, :3].T + pose[:3, 3]
    sensor = np.broadcast_to(pose[:3, 3].astype(np.float32), point.shape)
    cloud = PointCloud(point.astype(np.float32), image.rgb[row, column], sensor)
    return cloud, image.instance[row, column], row, column


def _pixel_rays(image: CapturedImage, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins [m] and directions of the rays of pixels (flat indices), each [ray, 3]."""
    row, column = np.divmod(pixel, image.instance.shape[1])
    ray = image.view.model.rays(np.stack([column + 0.5, row + 0.5], axis=-1)).reshape(-1, 3)
    pose = image.view.ego_from_camera
    return np.broadcast_to(pose[:3, 3], ray.shape), ray @ pose[:3, :3].T


def joined(clouds: Sequence[PointCloud]) -> PointCloud:
    """All points of some clouds, in order."""
    return PointCloud(
        np.concatenate([cloud.point_m for cloud in clouds]),
        np.concatenate([cloud.rgb for cloud in clouds]),
        np.concatenate([cloud.sensor_m for cloud in clouds]),
    )


def first_in_cells(point_m: np.ndarray, cell_m: float) -> np.ndarray:
    """Indices of the first point in every cell of a grid, ascending."""
    if len(point_m) == 0:
        return np.zeros(0, np.int64)
    x, y, z = (np.floor(place_m.astype(np.float64) / cell_m).astype(np.int64) for place_m in point_m.T)
    y -= y.min()
    z -= z.min()
    _, first = np.unique((x * (int(y.max()) + 1) + y) * (int(z.max()) + 1) + z, return_index=True)
    return np.sort(first)


def is_outside(local_m: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Which points of a vehicle lie on its outside, not on what its window panes show of its inside.

    From the front, rear, both sides and above, the outermost points in cells of 5 cm make a map of depths. Its pits
    that are neither wider nor higher than a pane are bridged (a grey closing). A point that lies deeper than that in
    all of the maps was seen through a pane.

    Shapes: ``local_m`` [point, 3], returns [point].
    """
    outside = np.zeros(len(local_m), bool)
    for axis, sign in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0)):
        across, up = (1 - axis, 2) if axis < 2 else (0, 1)
        place = local_m[:, [across, up]] + 0.5 * size_m[[across, up]]
        reach = np.array([_BRIDGED_WIDTH, _BRIDGED_HEIGHT if axis < 2 else _BRIDGED_WIDTH]) * size_m[[across, up]]
        window = tuple(int(value) | 1 for value in np.ceil(reach / _MAP_CELL_M))  # odd, so that it has a centre
        cells = np.ceil(size_m[[across, up]] / _MAP_CELL_M).astype(int) + 2
        cell = np.clip(np.floor(place / _MAP_CELL_M).astype(int) + 1, 0, cells - 1)
        # around the vehicle there is room for a pane of any size, so that what is open on a side is no pit
        depth = np.full(cells + 2 * np.array(window), -np.inf)
        where = tuple((cell + window).T)
        height = sign * local_m[:, axis]
        np.maximum.at(depth, where, height)
        bridged = minimum_filter(maximum_filter(depth, window), window)
        outside |= height >= bridged[where] - _PANE_DEPTH_M
    return outside


def _outside(cloud: PointCloud, box: Box, rays: Sequence[tuple[np.ndarray, np.ndarray]]) -> ObjectCloud:
    kept = is_outside(box.local_m(cloud.point_m.astype(np.float64)), np.asarray(box.size_m))
    inner = cloud.chosen(~kept)
    origin = np.concatenate([*(origin for origin, _ in rays), inner.sensor_m])
    direction = np.concatenate([*(direction for _, direction in rays), inner.point_m - inner.sensor_m])
    return ObjectCloud(cloud.chosen(kept), origin, direction)


_MIN_COSINE = 0.08  # flatter views are unreliable
_RIM_WEIGHT = 0.02  # of pixels at the rim of an object, where colours mix
_FAR_TOLERANCE = 0.01  # of the depth


def seen_rgb(
    vertex_m: np.ndarray, normal: np.ndarray, images: Sequence[CapturedImage], instance_id: int, *, tolerance_m: float
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
