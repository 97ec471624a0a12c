"""Rigs of known vehicles on another one: what is kept, what is not, and why a camera stands where it stands."""

import math

import numpy as np
import pytest

from tests.driving_scene import EGO_TOP_M, flat_surface, street
from warpav.optimisation import CameraMount, ZoneAndSpacing, move_to_vehicle
from warpav.optimisation._baselines import _PLACE_STEP_M
from warpav.raster.camera import CameraModel
from warpav.rig import Rig, RigCamera, mount_surface_from_mesh, preset_names, preset_rig
from warpav.scene import town_scene
from warpav.thesis import BoundsAndSpacing

MODEL = CameraModel(64, 64, math.pi / 2)


def mount_on(surface, offset_m=0.25):
    return CameraMount(surface, camera=MODEL, height_offset_m=offset_m)


def camera(name, position_m, yaw_deg=0.0, pitch_deg=0.0, fov_deg=90.0):
    model = CameraModel(64, 64, math.radians(fov_deg))
    return RigCamera(name, np.array(position_m), math.radians(yaw_deg), math.radians(pitch_deg), 0.0, model)


@pytest.fixture(scope="module")
def town_ego():
    return town_scene(1000).ego


@pytest.mark.parametrize("name", preset_names())
def test_presets_keep_everything_but_their_places(name, town_ego):
    original, surface = preset_rig(name), mount_surface_from_mesh(town_ego)
    moved = move_to_vehicle(original, mount_on(surface), town_ego, constraints=BoundsAndSpacing(surface))
    assert BoundsAndSpacing(surface).violation_m(moved.rig) == 0.0
    for before, after in zip(original.cameras, moved.rig.cameras, strict=True):
        assert after.name == before.name
        assert (after.yaw_rad, after.pitch_rad, after.roll_rad) == (before.yaw_rad, before.pitch_rad, before.roll_rad)
        assert after.model == before.model
    distance = [math.dist(a.position_m, b.position_m) for a, b in zip(original.cameras, moved.rig.cameras, strict=True)]
    np.testing.assert_allclose(moved.moved_m, distance)
    position = np.array([each.position_m for each in moved.rig.cameras])
    np.testing.assert_allclose(position[:, 2], surface.height_at_m(position[:, :2]) + 0.25)
    assert moved.blocked_share.max() == 0.0


def test_a_camera_goes_where_the_vehicle_does_not_hide_its_view():
    # on a bonnet before the cabin; the cabin reaches from x = 0 to 2.2, y = -0.8 to 0.8, up to EGO_TOP_M
    ego, bonnet = street().ego, flat_surface([2.3, -0.8], [3.5, 0.8], height_m=1.0)
    rig = Rig([camera("front", [2.4, 0.0, 1.25]), camera("rear", [2.4, 0.0, 1.25], yaw_deg=180.0, fov_deg=20.0)])
    moved = move_to_vehicle(rig, mount_on(bonnet), ego, constraints=BoundsAndSpacing(bonnet))
    front, rear = moved.rig.cameras
    np.testing.assert_allclose(front.position_m[:2], [2.4, 0.0], atol=_PLACE_STEP_M)
    assert moved.blocked_share[0] == 0.0
    # backwards the cabin fills most from everywhere; what is best is at the edge, looking past it
    assert abs(rear.position_m[1]) == pytest.approx(0.8)
    assert 0.0 < moved.blocked_share[1] < 1.0
    # above the cabin nothing hides anything
    high = move_to_vehicle(rig, mount_on(bonnet, EGO_TOP_M), ego, constraints=BoundsAndSpacing(bonnet))
    assert not high.blocked_share.any()


def test_presets_stay_in_the_zone(town_ego):
    surface = mount_surface_from_mesh(town_ego, min_upward_normal=0.8)
    rig = preset_rig("nuscenes")
    constraints = ZoneAndSpacing(surface, camera_count=len(rig.cameras), margin_m=0.02)
    moved = move_to_vehicle(rig, mount_on(surface), town_ego, constraints=constraints)
    assert constraints.violation_m(moved.rig) == 0.0
