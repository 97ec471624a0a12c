"""A plain vehicle, street and rig for the pictures of these tests."""

import math

import numpy as np
import pytest
from PIL import Image

from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh, merge
from warpav.rig import Rig, RigCamera
from warpav.scene import Box, Scene, Vehicle
from warpav.view import opengl_problem

needs_opengl = pytest.mark.skipif(opengl_problem() is not None, reason=f"no OpenGL: {opengl_problem()}")


def block(low_m, high_m, rgb):
    low, high = np.asarray(low_m, float), np.asarray(high_m, float)
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
    triangle = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return Mesh.create(corner, triangle, rgb)


def vehicle(instance_id, x, y, rgb=(150, 20, 20)):
    size = np.array([4.0, 1.8, 1.5])
    centre = np.array([x, y, 0.75])
    return Vehicle(instance_id, "saloon", block(centre - size / 2, centre + size / 2, rgb), Box(centre, size, 0.0))


def scene(*vehicles):
    road = Mesh.create([[-60, -7, 0], [60, -7, 0], [60, 7, 0], [-60, 7, 0]], [[0, 1, 2], [0, 2, 3]], (110, 110, 112))
    wall = block((-60, 7, 0), (60, 8, 9), (160, 90, 70))
    return Scene("test", merge([road, wall]), ego(), tuple(vehicles))


def ego():
    return block((-0.9, -0.9, 0.1), (3.6, 0.9, 1.5), (90, 95, 100))


def rig(count=4, fov_deg=80.0):
    model = CameraModel(fov_rad=math.radians(fov_deg))
    turn = np.arange(count) * 2 * math.pi / count
    return Rig(
        RigCamera(f"cam_{i}", np.array([1.3 + 0.8 * math.cos(a), 0.6 * math.sin(a), 1.58]), a, 0.0, 0.0, model)
        for i, a in enumerate(turn)
    )


def pixels(path):
    """An image as float64 [row, column, 3]."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(float)


def near(image, rgb, tolerance=10.0):
    """Which pixels have about this colour."""
    return np.linalg.norm(image - np.asarray(rgb, float), axis=-1) < tolerance
