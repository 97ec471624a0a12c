"""Views of a situation of the CARLA simulator, and a vehicle in it."""

import math

import numpy as np

from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.raster.camera import CameraModel
from warpav.scene.capture.capture import CaptureView, ViewKind

MODEL = CameraModel(96, 64, math.radians(80.0))


def view_from(position_m, *, yaw_rad=0.0, pitch_rad=0.0, model=MODEL):
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_yaw_pitch_roll(yaw_rad, pitch_rad, 0.0) @ FLU_FROM_RDF
    pose[:3, 3] = position_m
    return CaptureView("view", ViewKind.OTHER, pose, model)


def view_above(box, height_m=9.0, model=MODEL):
    """Straight down, from above a box's middle."""
    return view_from(np.add(box.center_m, [0.0, 0.0, height_m]), pitch_rad=math.pi / 2, model=model)


def first_vehicle(simulator, radius_m=40.0):
    for point in simulator.spawn_points(radius_m):
        vehicle = simulator.spawn(point)
        if vehicle is not None:
            return vehicle
    raise AssertionError("no place takes a vehicle")
