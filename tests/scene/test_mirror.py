"""Scenes with left and right exchanged: the same traffic on the other side, seen in a mirror."""

import math

import numpy as np
import pytest

from tests.scene.town.closed_surface import signed_volume_m3
from warpav.detection.images import render_images
from warpav.raster.camera import CameraModel
from warpav.rig.rig import RigCamera
from warpav.scene.town.town import town_scene

LEFT_RIGHT = np.array([1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def scene():
    return town_scene(2)


def all_users(scene):
    return (*scene.vehicles, *scene.others)


def test_a_mirrored_scene_keeps_who_is_there_and_the_ego_vehicle(scene):
    mirrored = scene.mirrored()
    assert mirrored.name == f"{scene.name}_mirrored"
    assert mirrored.ego is scene.ego
    assert mirrored.sky == scene.sky
    assert [(user.instance_id, user.category) for user in mirrored.vehicles] == [
        (user.instance_id, user.category) for user in scene.vehicles
    ]
    assert len(mirrored.others) == len(scene.others) > 0
    for user, original in zip(all_users(mirrored), all_users(scene), strict=True):
        np.testing.assert_allclose(user.box.center_m, original.box.center_m * LEFT_RIGHT)
        # its mesh is where its box is, and turned outwards as before
        assert user.box.contains(user.mesh.vertex_m.astype(float), margin_m=1e-3).all()
        assert signed_volume_m3(user.mesh) == pytest.approx(signed_volume_m3(original.mesh), rel=1e-4)
        assert signed_volume_m3(user.mesh) > 0.0


@pytest.mark.parametrize("yaw_rad", [0.0, math.pi, 0.9])
def test_cameras_see_the_mirror_image(scene, yaw_rad):
    # above the roof, so that the ego vehicle, which stays as it is, is not in the picture
    model, position_m = CameraModel(96, 64, math.radians(80.0)), np.array([1.5, 0.0, 3.0])
    (image,) = render_images(scene, [RigCamera("one", position_m, yaw_rad, 0.0, 0.0, model)])
    (mirrored,) = render_images(scene.mirrored(), [RigCamera("one", position_m, -yaw_rad, 0.0, 0.0, model)])
    assert image.rgb.std() > 10.0
    same = np.abs(mirrored.rgb[:, ::-1].astype(int) - image.rgb).max(axis=2) <= 1
    assert same.mean() > 0.999  # worst seen 1
    same = mirrored.object_index[:, ::-1] == image.object_index
    assert same.mean() > 0.999  # worst seen 1
