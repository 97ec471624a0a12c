"""W2 and W3 by embree on one thread, measured in the same run: a yardstick that goes with the machine.

Rays go through the pixel centres and start at the near plane. Building the tree and making the rays is not timed; for
W3 the interpolation of the vertex colours in NumPy is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import numpy as np

from warpav.experiments.bench._workload import ROTATION_COUNT, Truth, Workload
from warpav.scene import triangle_caster


def time_embree(workload: Workload, *, repeat: int) -> dict[str, list[float]]:
    """Wall times of every repeat [ms], by item."""
    scene = triangle_caster(workload.vertex_m[workload.triangle])
    times_ms: dict[str, list[float]] = {"w2": [], "w3": []}
    for number in range(repeat + 1):
        cast_s = shade_s = 0.0
        for origin_m, direction in view_rays(workload):
            began = time.perf_counter()
            hit = scene.run(origin_m, direction, output=1)
            cast_s += time.perf_counter() - began
            began = time.perf_counter()
            _hit_rgb(workload, hit)
            shade_s += time.perf_counter() - began
        if number > 0:
            times_ms["w2"].append(1000.0 * cast_s)
            times_ms["w3"].append(1000.0 * (cast_s + shade_s))
    return times_ms


def embree_truth(workload: Workload) -> Truth:
    """Objects and depths of all views by embree, without gradients: for lenses that no truth file knows."""
    scene = triangle_caster(workload.vertex_m[workload.triangle])
    shape = (workload.size_px, workload.size_px)
    near_m = np.repeat(workload.near_m, ROTATION_COUNT)
    index, depth_m = [], []
    for view, (origin_m, direction) in enumerate(view_rays(workload)):
        hit = scene.run(origin_m, direction, output=1)
        is_hit = (hit["primID"] >= 0) & (direction != 0.0).any(axis=1)
        index.append(np.where(is_hit, workload.triangle_object[hit["primID"]], -1).reshape(shape))
        depth_m.append(np.where(is_hit, hit["tfar"] + near_m[view], -1.0).reshape(shape))
    views = np.arange(len(index))
    return Truth("embree", {}, {}, views, np.stack(index), np.stack(depth_m).astype(np.float32))


def view_rays(workload: Workload) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rays of every view in turn, in the workload's world: origins on the near plane [m], and directions of depth 1.

    Both float32 [ray, 3], rows of the image one behind the other; directions of 0 where the lens sees nothing.
    """
    size = workload.size_px
    row, column = np.mgrid[0:size, 0:size] + 0.5
    models = workload.models(range(len(workload.pose)))
    for camera, (x_m, z_m, yaw_rad) in enumerate(workload.pose):
        ray = np.nan_to_num(models[ROTATION_COUNT * camera].rays(np.stack([column, row], axis=-1)).reshape(-1, 3))
        centre_m = np.array([x_m, workload.height_m[camera], z_m])
        for rotation in range(ROTATION_COUNT):
            angle_rad = yaw_rad + rotation * 0.5 * math.pi
            forward = np.array([math.sin(angle_rad), 0.0, math.cos(angle_rad)])
            left = np.array([math.cos(angle_rad), 0.0, -math.sin(angle_rad)])
            direction = ray @ np.stack([-left, [0.0, -1.0, 0.0], forward])
            origin_m = centre_m + workload.near_m[camera] * direction
            yield origin_m.astype(np.float32), direction.astype(np.float32)


def _hit_rgb(workload: Workload, hit: dict[str, np.ndarray]) -> np.ndarray:
    """Vertex colours interpolated at the hits of rays, float32 [ray, 3]; 0 where nothing is hit."""
    seen = np.flatnonzero(hit["primID"] >= 0)
    corner_rgb = workload.vertex_rgb[workload.triangle[hit["primID"][seen]]]
    u, v = hit["u"][seen, None], hit["v"][seen, None]
    rgb = np.zeros((len(hit["primID"]), 3), np.float32)
    rgb[seen] = (1.0 - u - v) * corner_rgb[:, 0] + u * corner_rgb[:, 1] + v * corner_rgb[:, 2]
    return rgb
