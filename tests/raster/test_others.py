"""Road users that are no vehicles: drawn, in the way, and no object of their own."""

import dataclasses
import math

import numpy as np
import pytest

from tests.driving_scene import EGO_TOP_M, camera_pose, packed_street, street
from tests.oracle.ray_cast import cast_scene
from tests.raster.test_renderer import images_of
from warpav.detection import render_images
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer
from warpav.rig import RigCamera
from warpav.scene import Box, DeviceScene, Vehicle, person_mesh

MODEL = CameraModel(160, 160, math.pi / 2, 0.1)
EYE_M = np.array([1.1, 0.0, EGO_TOP_M + 0.2])


def _street_with_people(count=3):
    scene = street()
    rng = np.random.default_rng(5)
    others = []
    for k in range(count):
        vehicle = scene.vehicles[k]
        toward = vehicle.box.center_m - EYE_M
        foot = EYE_M + 0.5 * toward
        mesh = person_mesh("pedestrian", rng).transformed(np.eye(3), np.array([foot[0], foot[1], 0.0]))
        low, high = mesh.bounds_m().astype(np.float64)
        box = Box(0.5 * (low + high), high - low, 0.0)
        others.append(Vehicle(len(scene.vehicles) + 1 + k, "pedestrian", mesh, box))
    return dataclasses.replace(scene, others=tuple(others))


def test_images_with_people_agree_with_rays():
    scene = _street_with_people()
    poses = np.stack([camera_pose(EYE_M, yaw, 0.05, 0.0) for yaw in (0.0, 2.1, -2.1)])
    depth_m, object_index, rgb = images_of(Renderer([MODEL] * len(poses)), DeviceScene.pack(scene).raster, poses)
    _, without, _ = images_of(Renderer([MODEL] * len(poses)), packed_street().raster, poses)
    rays = cast_scene(scene)
    people_px = 0
    for view, pose in enumerate(poses):
        truth = rays.look(pose, MODEL)
        same = object_index[view] == truth.object_index
        assert same.mean() > 0.999  # a handful of outline samples may tip either way
        np.testing.assert_allclose(depth_m[view][same], truth.depth_m[same], rtol=2e-4)
        drawn = (object_index[view] == 0) & (without[view] > 0)
        people_px += np.count_nonzero(drawn)
        assert np.abs(rgb[view] * 255.0 - truth.rgb * 255.0)[same].mean() < 2.0
    assert people_px > 50  # people stand before vehicles


def test_a_pedestrian_hides_a_vehicle_and_is_asked_for_by_nobody():
    with_people = _street_with_people(count=1)
    offset = with_people.vehicles[0].box.center_m - EYE_M
    camera = RigCamera("front", EYE_M, float(np.arctan2(offset[1], offset[0])), 0.0, 0.0, CameraModel(256, 256))
    before = render_images(street(), [camera], supersampling=2)[0]
    after = render_images(with_people, [camera], supersampling=2)[0]
    assert after.visible_area_px.shape == before.visible_area_px.shape  # no object of its own
    assert after.visible_area_px[0] < before.visible_area_px[0] - 20.0
    assert after.amodal_area_px[0] == pytest.approx(before.amodal_area_px[0], rel=1e-6)
    assert after.object_index.max() < 2 + len(with_people.vehicles)
