"""Rigs on other bodies: shares of the body in closed form, distances to boxes, and views that stay free."""

import math

import numpy as np
import pytest

from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh, merge
from warpav.rig import Rig, RigCamera, blocked_shares, preset_names, preset_on_vehicle, preset_rig, ray_caster
from warpav.rig._on_body import LEAST_STAND_OFF_M, REACH_M, Body, put_on_body
from warpav.scene import town_scene

SPACING_M = 0.06
"""Places are about 2 cm apart on a car; three times that is never exceeded in 100,000."""


def box(low_m, high_m, *, inside_out=False):
    side = [[0, 1, 3], [0, 3, 2]], [[4, 6, 7], [4, 7, 5]], [[0, 4, 5], [0, 5, 1]]
    other = [[2, 3, 7], [2, 7, 6]], [[0, 2, 6], [0, 6, 4]], [[1, 5, 7], [1, 7, 3]]
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    triangle = np.array([*side, *other]).reshape(-1, 3)
    low_m, high_m = np.array(low_m), np.array(high_m)
    return Mesh(low_m + corner * (high_m - low_m), triangle[:, ::-1] if inside_out else triangle, [90, 90, 90])


def camera(name, position_m, yaw_deg=0.0, fov_deg=60.0):
    return RigCamera(
        name, np.array(position_m), math.radians(yaw_deg), 0.0, 0.0, CameraModel(64, 48, math.radians(fov_deg))
    )


CAR = box([-1.0, -0.9, 0.0], [3.5, 0.9, 1.5])
LONG = box([-2.0, -1.2, 0.3], [10.0, 1.2, 3.0])


def test_the_box_of_a_body_leaves_mirrors_out():
    mirrors = merge([CAR, box([1.9, 0.9, 1.0], [2.0, 1.1, 1.1]), box([1.9, -1.1, 1.0], [2.0, -0.9, 1.1])])
    for mesh in (CAR, mirrors):
        found = Body.of(mesh)
        np.testing.assert_allclose(found.low_m, [-1.0, -0.9, 0.0], atol=1e-6)
        np.testing.assert_allclose(found.high_m, [3.5, 0.9, 1.5], atol=1e-6)
    sheet = Body.of_size(4.5, 1.8, 1.5, wheelbase_m=2.5)
    np.testing.assert_allclose([sheet.low_m, sheet.high_m], [[-1.0, -0.9, 0.0], [3.5, 0.9, 1.5]])


def test_shares_of_the_body_stay_and_so_does_what_stands_out():
    """Linear inside the box, metre by metre outside of it."""
    place_m, beyond_m = Body.of(CAR).carried_to(
        Body.of(LONG), np.array([[1.25, 0.45, 0.75], [1.25, 0.0, 1.8], [-1.3, -1.3, 0.0]])
    )
    np.testing.assert_allclose(place_m, [[4.0, 0.6, 1.5], [4.0, 0.0, 3.3], [-2.3, -1.6, 0.0]], atol=1e-6)
    np.testing.assert_allclose(beyond_m, [0.0, 0.3, 0.5], atol=1e-6)


@pytest.mark.parametrize("inside_out", [False, True])
@pytest.mark.parametrize(
    ("position_m", "yaw_deg", "expected_m"),
    [
        ([1.25, 0.9, 0.75], 90.0, [4.0, 1.2 + LEAST_STAND_OFF_M, 1.5]),
        ([1.25, -0.9, 0.75], -90.0, [4.0, -1.2 - LEAST_STAND_OFF_M, 1.5]),
        ([-1.0, 0.0, 0.75], 180.0, [-2.0 - LEAST_STAND_OFF_M, 0.0, 1.5]),
        ([1.25, 0.0, 1.75], 0.0, [4.0, 0.0, 3.25]),
    ],
    ids=["left", "right", "rear end", "rack on the roof"],
)
def test_cameras_stand_on_their_part_of_the_body(position_m, yaw_deg, expected_m, inside_out):
    vehicle = box([-2.0, -1.2, 0.3], [10.0, 1.2, 3.0], inside_out=inside_out)
    moved = put_on_body(Rig([camera("a", position_m, yaw_deg)]), vehicle, made_for=Body.of(CAR))
    found = moved.rig.cameras[0]
    np.testing.assert_allclose(found.position_m, expected_m, atol=2.0 * SPACING_M)
    off = np.abs(np.array(expected_m) - found.position_m)
    assert off[np.argmax(np.abs(np.array(expected_m) - [4.0, 0.0, 1.65]) / [6.0, 1.2, 1.35])] < 1e-6, "off the skin"
    assert moved.blocked_share[0] == 0.0
    assert (found.yaw_rad, found.model) == (math.radians(yaw_deg), CameraModel(64, 48, math.radians(60.0)))


def test_a_camera_gives_way_to_what_hides_its_view_but_not_far():
    pillar = merge([CAR, box([2.3, -0.1, 1.5], [2.4, 0.1, 2.5])])
    rig = Rig([camera("a", [2.25, 0.0, 1.53], fov_deg=20.0)])
    moved = put_on_body(rig, pillar)
    found = moved.rig.cameras[0]
    assert moved.blocked_share[0] == 0.0
    assert blocked_shares(ray_caster(pillar), found, found.position_m[None])[0] == 0.0
    assert moved.moved_m[0] < REACH_M
    wall = merge([CAR, box([2.4, -3.0, 1.5], [2.5, 3.0, 9.0])])
    hidden = put_on_body(Rig([camera("a", [1.5, 0.0, 1.53])]), wall)
    assert hidden.blocked_share[0] == 1.0
    assert hidden.moved_m[0] <= REACH_M + SPACING_M


def test_blocked_shares_are_those_of_the_angles():
    """A wide wall in front, from the middle to the left: half of the fan and its middle ray meet it."""
    wall = box([5.0, 0.0, 0.0], [5.1, 50.0, 9.0])
    share = blocked_shares(ray_caster(wall), camera("a", [0.0, 0.0, 1.0], fov_deg=90.0), np.array([[0.0, 1e-3, 1.0]]))
    assert share[0] == pytest.approx(9 / 17)


@pytest.mark.parametrize("name", preset_names())
def test_presets_see_freely_from_the_body_and_keep_their_cameras(name):
    vehicle = town_scene(1000).ego
    moved = preset_on_vehicle(name, vehicle)
    assert moved.blocked_share.max() == 0.0
    assert moved.moved_m.max() < 0.3
    for before, after in zip(preset_rig(name).cameras, moved.rig.cameras, strict=True):
        assert (after.name, after.model) == (before.name, before.model)
        np.testing.assert_array_equal(after.ego_from_camera[:3, :3], before.ego_from_camera[:3, :3])
        if abs(before.position_m[1]) > 0.1:
            assert np.sign(after.position_m[1]) == np.sign(before.position_m[1])
