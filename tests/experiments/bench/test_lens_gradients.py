"""The gradient of every lens against differences of images that embree draws through OpenCV's lenses.

The truth shares no code with the renderer: OpenCV finds the rays of 12 x 12 places in every pixel around a vehicle, and
embree says which of them hit it. Its own error, from the finite number of rays and the size of the steps, is seen where
it is compared with the workload's exact truth for a pinhole.
"""

import dataclasses
import math
import sys

import cv2
import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from warpav.experiments.bench._items import Bench
from warpav.experiments.bench._workload import LENSES, ROTATION_COUNT, embedded_truth, embedded_workload, pack_workload

POSES = 4
RAYS = 12  # along each side of a pixel
STEPS = (0.05, 0.05, 0.005)  # m, m, rad


def opencv_rays(lens, intrinsics, place_px):
    """Directions through places of an image, float64 [place, 3]."""
    distortion, place_px = np.array(LENSES[lens][1]), place_px.reshape(-1, 1, 2)
    if lens == "fisheye":
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-10)
        # OpenCV returns tangents, which end at 90 degrees: beyond, the angle comes from the radius
        place = (place_px.reshape(-1, 2) - intrinsics[:2, 2]) / np.diag(intrinsics)[:2]
        radius = np.linalg.norm(place, axis=1)
        angle = np.linspace(0.0, math.radians(100.0), 20001)
        grown = angle * (1.0 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(distortion)))
        found = np.interp(radius, grown, angle)
        inner = np.flatnonzero(found < 1.2)[:1000]
        if len(inner):
            solved = cv2.fisheye.undistortPoints(place_px[inner], intrinsics, distortion, criteria=criteria)
            np.testing.assert_allclose(np.arctan(np.linalg.norm(solved[:, 0], axis=1)), found[inner], atol=1e-6)
        around = place / np.maximum(radius, 1e-12)[:, None]
        return np.c_[np.sin(found)[:, None] * around, np.cos(found)]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    distortion = distortion if lens == "brown_conrady" else np.zeros(4)
    flat = cv2.undistortPoints(place_px, intrinsics, distortion, criteria=criteria)
    return np.c_[flat[:, 0], np.ones(len(flat))]


def projected_rectangle(workload, lens, intrinsics, points):
    """Pixels around the images of points in camera axes: first column, first row, and those after the last; or None."""
    size, distortion = workload.size_px, np.array(LENSES[lens][1] or (0.0,) * 4)
    if lens == "fisheye":
        across = np.linalg.norm(points[:, :2], axis=1)
        angle = np.arctan2(across, points[:, 2])
        if angle.min() > 2.4:
            return None
        angle = np.minimum(angle, 2.4)
        grown = angle * (1.0 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(distortion)))
        place = points[:, :2] / across[:, None] * grown[:, None] * np.diag(intrinsics)[:2] + intrinsics[:2, 2]
    else:
        seen = points[points[:, 2] > 0.3 * np.abs(points[:, :2]).max(axis=1)]
        if len(seen) == 0:
            return None
        if points[:, 2].min() < 0.3:
            return 0, 0, size, size
        place = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), intrinsics, distortion)[0].reshape(-1, 2)
    low, high = np.clip(np.floor(place.min(axis=0)) - 3, 0, size), np.clip(np.ceil(place.max(axis=0)) + 3, 0, size)
    return (*low.astype(int), *high.astype(int)) if (low < high).all() else None


class RayCastLoss:
    """The loss of W1 for a pose, by casting rays at one vehicle after the other."""

    def __init__(self, workload, lens):
        self.workload, self.lens = workload, lens
        self.points, self.scenes = [], []
        end = np.cumsum(workload.triangle_count)
        for k in range(workload.vehicle_count):
            triangle = workload.triangle[end[k] - workload.triangle_count[k] : end[k]]
            scene = EmbreeScene()
            TriangleMesh(scene, workload.vertex_m, triangle)
            self.scenes.append(scene)
            self.points.append(workload.vertex_m[np.unique(triangle)].astype(np.float64))

    def __call__(self, pose, camera, weight, rectangles):
        """The loss; ``rectangles`` remembers the pixels of each pair, so that steps are taken over the same rays."""
        workload, total = self.workload, 0.0
        model = workload.models([camera])[0]
        intrinsics = model.intrinsics.astype(np.float64)
        x_m, z_m, yaw_rad = pose
        centre = np.array([x_m, workload.height_m[camera], z_m])
        for rotation in range(ROTATION_COUNT):
            angle = yaw_rad + rotation * 0.5 * math.pi
            axes = np.stack(
                [[-math.cos(angle), 0.0, math.sin(angle)], [0.0, -1.0, 0.0], [math.sin(angle), 0.0, math.cos(angle)]]
            )
            for k, (scene, points) in enumerate(zip(self.scenes, self.points, strict=True)):
                if (rotation, k) not in rectangles:
                    found = projected_rectangle(workload, self.lens, intrinsics, (points - centre) @ axes.T)
                    rays = None
                    if found is not None:
                        left, top, right, bottom = found
                        offset = (np.arange(RAYS) + 0.5) / RAYS
                        column = (np.arange(left, right)[:, None] + offset).ravel()
                        row = (np.arange(top, bottom)[:, None] + offset).ravel()
                        place = np.stack(np.meshgrid(column, row), axis=-1).reshape(-1, 2)
                        rays = opencv_rays(self.lens, intrinsics, place).astype(np.float32)
                    rectangles[rotation, k] = found, rays
                found, rays = rectangles[rotation, k]
                if found is None:
                    continue
                left, top, right, bottom = found
                direction = np.ascontiguousarray(rays @ axes.astype(np.float32))
                origin = np.float32(centre) + np.float32(workload.near_m[camera]) * direction
                hit = scene.run(origin, direction) >= 0
                share = hit.reshape(bottom - top, RAYS, right - left, RAYS).mean(axis=(1, 3))
                total += workload.vehicle_weight[k] * float((share * weight[top:bottom, left:right]).sum())
        return total


def ray_cast_gradient(workload, lens, weight):
    """Differences of the ray-cast loss at the first scored poses, [pose, 3]."""
    loss = RayCastLoss(workload, lens)
    gradient = np.zeros((POSES, 3))
    for i, pose in enumerate(workload.scored_pose[:POSES]):
        rectangles = {}
        camera = i % len(workload.pose)
        for axis, step in enumerate(STEPS):
            moved = step * np.eye(3)[axis]
            loss_up, loss_down = (loss(pose + sign * moved, camera, weight, rectangles) for sign in (1.0, -1.0))
            gradient[i, axis] = (loss_up - loss_down) / (2.0 * step)
    return gradient


def relative_error(one, other):
    """The score of `warpav bench`: of all poses together."""
    return float(np.linalg.norm(one - other) / np.linalg.norm(other))


@pytest.fixture(scope="module")
def errors():
    """Error of the smoothly weighted gradient against the ray-cast one by lens, and that of the exact one."""
    workload = embedded_workload()
    weight = workload.weight["smooth"].astype(np.float64)
    found = {}
    for lens in ("pinhole", "brown_conrady", "fisheye"):
        seen = dataclasses.replace(workload, lens=lens)
        truth = ray_cast_gradient(seen, lens, weight)
        ours = Bench(seen, pack_workload(seen)).score_silhouettes(1)[0]["smooth"][:POSES]
        found[lens] = relative_error(ours, truth)
        if lens == "pinhole":
            found["truth"] = relative_error(embedded_truth(workload).gradient["smooth"][:POSES], truth)
    sys.stdout.write(f"{ {name: round(value, 5) for name, value in found.items()} }\n")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("lens", ["brown_conrady", "fisheye"])
def test_gradients_are_as_good_as_the_pinholes(errors, lens):
    assert errors["truth"] < 0.02
    assert errors[lens] < 1.5 * errors["pinhole"]
