"""A small street for tests: ground, houses, an ego vehicle with a roof, and noisy rounded cars. Deterministic."""

import functools
import math

import numpy as np
import trimesh
import warp as wp

from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.detection import Detections
from warpav.raster.mesh import Mesh, merge
from warpav.rig import MountSurface
from warpav.scene import Box, DeviceScene, Scene, Sky, Vehicle

SKY = Sky(np.array([200, 210, 220], np.uint8), np.array([90, 140, 220], np.uint8))
EGO_TOP_M = 1.5
# x, y [m] and yaw [rad] of the cars: ahead, beside, behind, hidden behind one another, far and near
CAR_PLACES = (
    (9.0, 3.4, 0.0),
    (7.5, -3.5, math.pi),
    (14.0, 0.3, 0.05),
    (19.0, 0.9, 0.1),
    (-8.0, 3.6, 0.0),
    (-10.5, -3.3, math.pi),
    (1.5, 7.0, 0.2),
    (2.5, -8.5, math.pi / 2),
    (1.0, 11.0, 0.3),
    (-16.0, -5.0, 0.0),
)

ALL_CARS = len(CAR_PLACES)


def coloured(mesh, rng, rgb=None):
    """The trimesh as a Mesh with a noisy colour."""
    base = rng.integers(40, 220, 3) if rgb is None else np.asarray(rgb)
    colour = np.clip(base + rng.normal(0, 18, (len(mesh.vertices), 3)), 0, 255).astype(np.uint8)
    return Mesh.create(mesh.vertices, mesh.faces, colour)


def rounded_box(size_m, subdivisions, roundness=0.4):
    """A superellipsoid around the origin."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    unit = np.sign(ball.vertices) * np.abs(ball.vertices) ** roundness
    return trimesh.Trimesh(unit * 0.5 * np.asarray(size_m), ball.faces, process=False)


def car(rng, subdivisions=3, noise_m=0.01):
    """A car around the origin, standing on z = 0: body and cabin, 40 * 4**subdivisions faces."""
    size_m = np.array([rng.uniform(4.0, 4.9), rng.uniform(1.7, 1.95), rng.uniform(1.4, 1.75)])
    body = rounded_box(size_m * [1.0, 1.0, 0.6], subdivisions)
    body.apply_translation([0.0, 0.0, 0.15 + 0.3 * size_m[2]])
    cabin = rounded_box(size_m * [0.55, 0.86, 0.55], subdivisions, 0.5)
    cabin.apply_translation([-0.2, 0.0, 0.72 * size_m[2]])
    parts = [coloured(body, rng), coloured(cabin, rng, (30, 35, 45))]
    whole = merge(parts)
    noisy = whole.vertex_m + rng.normal(0.0, noise_m, whole.vertex_m.shape).astype(np.float32)
    return Mesh(noisy.astype(np.float32), whole.triangle, whole.vertex_rgb)


def vehicle(instance_id, mesh, x_m, y_m, yaw_rad):
    """The mesh as a vehicle at a place."""
    turn = rotation_from_yaw_pitch_roll(yaw_rad, 0.0, 0.0)
    placed = mesh.transformed(turn, [x_m, y_m, 0.0])
    low, high = mesh.bounds_m()
    box = Box(turn @ (0.5 * (low + high)) + [x_m, y_m, 0.0], high - low, yaw_rad)
    return Vehicle(instance_id, "hatchback", placed, box)


def ground(rng, half_size_m=60.0, cells=8):
    """Flat ground of large triangles, so that some cross every near plane."""
    line = np.linspace(-half_size_m, half_size_m, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    faces = np.r_[np.c_[i, i + cells + 1, i + cells + 2], np.c_[i, i + cells + 2, i + 1]]
    return coloured(
        trimesh.Trimesh(np.c_[x.ravel(), y.ravel(), 0 * x.ravel()], faces, process=False), rng, (95, 95, 95)
    )


def block(rng, size_m, centre_m, subdivide=0):
    """A box."""
    box = trimesh.creation.box(extents=size_m)
    for _ in range(subdivide):
        box = box.subdivide()
    box.apply_translation(centre_m)
    return coloured(box, rng)


def ego_mesh(rng):
    """The ego vehicle: a hull and a roof, top at `EGO_TOP_M`."""
    hull = block(rng, [4.4, 1.8, 0.7], [1.35, 0.0, 0.65], subdivide=2)
    # the cabin reaches into the hull: coplanar faces would have no nearest one
    cabin = block(rng, [2.2, 1.6, EGO_TOP_M - 0.9], [1.1, 0.0, 0.5 * (0.9 + EGO_TOP_M)], subdivide=2)
    return merge([hull, cabin])


@functools.cache
def street(car_count=ALL_CARS, seed=0, subdivisions=3):
    """The scene with the first ``car_count`` cars; about 27 thousand triangles with all ten."""
    rng = np.random.default_rng(seed)
    houses = [
        block(rng, [rng.uniform(6, 12), 5.0, rng.uniform(5, 12)], [x, side * rng.uniform(15, 18), 4.0], subdivide=1)
        for side in (-1, 1)
        for x in (-24.0, -8.0, 8.0, 24.0)
    ]
    post = block(rng, [0.3, 0.3, 3.0], [6.0, 1.9, 1.5])  # hides a part of the first car
    environment = merge([ground(rng), *houses, post])
    ego = ego_mesh(rng)
    shift = np.random.default_rng([seed, 1]).normal(0.0, 0.3 * (seed > 0), (len(CAR_PLACES), 2))
    vehicles = tuple(
        vehicle(k + 1, car(rng, subdivisions), x + shift[k, 0], y + shift[k, 1], yaw)
        for k, (x, y, yaw) in enumerate(CAR_PLACES[:car_count])
    )
    return Scene(f"street_{seed}", environment, ego, vehicles, SKY)


@functools.cache
def roof():
    """A gently curved mount surface of 2.2 m x 1.4 m above the ego vehicle's cabin."""
    cell_m = 0.02
    x = 0.0 + cell_m * np.arange(111)
    y = -0.7 + cell_m * np.arange(71)
    height = EGO_TOP_M - 0.05 * (x[:, None] - 1.1) ** 2 - 0.08 * y[None, :] ** 2
    return MountSurface(height.astype(np.float32), np.array([x[0], y[0]]), cell_m)


def flat_surface(low_m, high_m, height_m=1.5, cell_m=0.1):
    """A mount surface of constant height over a rectangle; the high end is rounded to whole cells."""
    size = np.round((np.asarray(high_m) - low_m) / cell_m).astype(int) + 1
    return MountSurface(np.full(size, height_m, np.float32), np.asarray(low_m, float), cell_m)


def camera_pose(position_m, yaw_rad, pitch_rad=0.0, roll_rad=0.0):
    """``ego_from_camera``, float64 [4, 4]."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_yaw_pitch_roll(yaw_rad, pitch_rad, roll_rad) @ FLU_FROM_RDF
    pose[:3, 3] = position_m
    return pose


def random_poses(rng, count, *, near_ground=False):
    """Random six-degree-of-freedom poses on and around the ego vehicle, float64 [count, 4, 4]."""
    low, high = (-12.0, -9.0, 0.05 if near_ground else 0.4), (12.0, 9.0, 2.5)
    return np.stack(
        [
            camera_pose(
                rng.uniform(low, high),
                rng.uniform(-math.pi, math.pi),
                rng.uniform(-1.2, 1.2),
                rng.uniform(-math.pi, math.pi),
            )
            for _ in range(count)
        ]
    )


@functools.cache
def packed_street(device="cpu", car_count=ALL_CARS, seed=0):
    """`street` on a device."""
    return DeviceScene.pack(street(car_count, seed), device=device)


def on_device(poses, device="cpu"):
    """Poses ``ego_from_camera`` [view, 4, 4] as the renderer takes them: centres and rotations."""
    poses = np.asarray(poses)
    return (
        wp.array(poses[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(poses[:, :3, :3].transpose(0, 2, 1).astype(np.float32), dtype=wp.mat33, device=device),
    )


class SilentDetector:
    """Finds nothing, in any number of images."""

    names = ("car",)

    def detect(self, images_rgb):
        """Nothing, for every image."""
        return [Detections.none(self.names)] * len(images_rgb)


class ConstantDetector:
    """Says the same about every batch of images: boxes [px] and confidences, one pair per image.

    Everything is a vehicle unless ``road_users`` holds indices into `ROAD_USERS`, a list per image.
    """

    names = ("car",)

    def __init__(self, boxes_px, confidences, road_users=None):
        kinds = [[0] * len(each) for each in confidences] if road_users is None else road_users
        self.answer = [
            Detections(
                np.asarray(box_px, np.float32).reshape(-1, 4),
                np.asarray(confidence, np.float32).reshape(-1),
                np.zeros(len(confidence), np.int32),
                self.names,
                np.asarray(kind, np.int32),
            )
            for box_px, confidence, kind in zip(boxes_px, confidences, kinds, strict=True)
        ]
        self.images = []

    @classmethod
    def silent(cls, image_count):
        """A detector that finds nothing."""
        return cls([[]] * image_count, [[]] * image_count)

    def detect(self, images_rgb):
        """The constant answer; remembers the images."""
        assert images_rgb.dtype == np.uint8
        assert len(images_rgb) == len(self.answer)
        self.images.append(np.array(images_rgb))
        return self.answer
