"""Design rules against closed forms, rays and known answers."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.driving_scene import street
from tests.raster.bodies import cuboid
from tests.rig.test_camera_body import looking, share_by_rays
from warpav.raster.camera import CameraModel
from warpav.rig import Rig
from warpav.sight import (
    AZIMUTH_STEP_RAD,
    NEAR_M,
    RuleCheck,
    Rules,
    border_margin,
    crossing_angle_rad,
    horizon_margin,
    ring_m,
)
from warpav.sight._rules import SECTORS, OwnBody, housing_shares, widest_gap

MODEL = CameraModel(96, 64, math.radians(90.0))


def poses(*cameras):
    return np.stack([camera.ego_from_camera for camera in cameras]), [camera.model for camera in cameras]


@pytest.mark.parametrize("pitch_deg", [-10.0, 0.0, 12.5, 30.0])
@pytest.mark.parametrize("model", [MODEL, CameraModel(200, 50, math.radians(50.0))], ids=["90 deg", "50 deg"])
def test_the_horizon_of_a_pinhole_is_a_tangent(model, pitch_deg):
    camera = looking([0.0, 0.0, 1.5], 70.0, pitch_deg, model=model)
    focal_px = 0.5 * model.width_px / math.tan(0.5 * model.fov_rad)
    row_px = 0.5 * model.height_px - focal_px * math.tan(math.radians(pitch_deg))
    expected = row_px / model.height_px
    assert horizon_margin(*poses(camera))[0] == pytest.approx(expected, abs=1e-9)


def test_the_horizon_of_a_camera_that_looks_down_is_nowhere():
    assert horizon_margin(*poses(looking([0, 0, 2], 0.0, 90.0), looking([0, 0, 2], 0.0, 170.0)))[0] == -1.0


@pytest.mark.parametrize(
    ("position_m", "yaw_deg", "expected_deg"),
    [
        ([2.0, 0.0, 1.5], 0.0, 180.0),
        ([2.0, 0.0, 1.5], 180.0, 0.0),
        ([0.0, 1.0, 1.5], 90.0, 180.0),
        ([0.0, 1.0, 1.5], -60.0, 30.0),
        ([2.0, 0.5, 1.5], -45.0, 45.0),  # from the left over the bonnet to the right
        ([2.0, 0.5, 1.5], 45.0, 135.0),
        ([0.1, 0.1, 1.5], -60.0, 180.0),  # in the middle nobody looks across it
    ],
)
def test_a_camera_looks_across_the_middle_by_an_angle(position_m, yaw_deg, expected_deg):
    views, _ = poses(looking(position_m, yaw_deg, 20.0))
    assert math.degrees(crossing_angle_rad(views, np.zeros(2))[0]) == pytest.approx(expected_deg, abs=1e-6)


@given(st.lists(st.booleans(), min_size=1, max_size=24))
def test_the_widest_gap_is_the_longest_run_going_round(flags):
    seen = np.array(flags)
    longest = max(
        (k for first in range(len(seen)) for k in range(len(seen) + 1) if not np.roll(seen, -first)[:k].any()),
    )
    assert widest_gap(seen) == longest


def test_the_border_is_as_far_as_it_is():
    camera = looking([0.0, 0.0, 0.0])  # the image spans 45 degrees to either side, 33.7 up and down
    point_m = np.array([[10.0, 0.0, 0.0], [10.0, 9.0, 0.0], [10.0, 11.0, 0.0], [-10.0, 0.0, 0.0]])
    found = border_margin(*poses(camera_of(MODEL, camera)), point_m)[0]
    np.testing.assert_allclose(found, [32 / 96, (48 - 0.9 * 48) / 96, (48 - 1.1 * 48) / 96, -1.0], atol=1e-9)


def camera_of(model, camera):
    from dataclasses import replace

    return replace(camera, model=model)


@pytest.mark.parametrize(("yaw_deg", "pitch_deg"), [(0.0, 20.0), (120.0, 35.0)])
def test_the_own_body_fills_what_rays_say_and_its_jacobian_is_that_of_differences(yaw_deg, pitch_deg):
    body = street().ego
    camera = looking([1.0, 0.2, 1.75], yaw_deg, pitch_deg, model=MODEL)
    own = OwnBody(body)
    share, jacobian = own.shares(*poses(camera))
    assert share[0] == pytest.approx(share_by_rays(camera, body), abs=0.004)
    assert 0.05 < share[0] < 0.9
    # against a fine image: its shares are smooth enough for differences
    step = 2e-3
    for axis in range(3):
        moved = [
            share_by_rays(
                looking(
                    np.array([1.0, 0.2, 1.75]) + sign * step * 10 * np.eye(3)[axis], yaw_deg, pitch_deg, model=MODEL
                ),
                body,
                12,
            )
            for sign in (1.0, -1.0)
        ]
        assert jacobian[0, axis] == pytest.approx((moved[0] - moved[1]) / (20 * step), abs=0.03)


def test_many_cameras_see_of_the_own_body_what_each_sees_alone():
    own = OwnBody(street().ego)
    cameras = [looking([1.0, 0.2, 1.75], 30.0 * k, 20.0, model=MODEL) for k in range(11)]
    share, jacobian = own.shares(*poses(*cameras))
    for k, camera in enumerate(cameras):
        alone = own.shares(*poses(camera))
        assert share[k] == alone[0][0]
        np.testing.assert_array_equal(jacobian[k], alone[1][0])


def test_one_limit_of_the_own_body_is_kept_without_the_other():
    body = cuboid((4.0, 2.0, 1.5), (0.0, 0.0, 0.75))
    margins = RuleCheck(box_rig(), body, Rules(own_body_wide=None, housing=None)).margins
    assert {each.rule: each.is_kept for each in margins}["own_body"] is False
    margins = RuleCheck(box_rig(), body, Rules(own_body=None, housing=None)).margins
    assert {each.rule: each.is_kept for each in margins}["own_body"] is True


def test_housings_hide_and_meet():
    front, behind, beside = looking([1.0, 0.0, 1.7]), looking([0.5, 0.0, 1.7]), looking([0.5, 0.06, 1.7], 90.0)
    views, models = poses(front, behind, beside)
    from warpav.rig import PLAIN_HOUSING

    share, meets = housing_shares(views, models, [PLAIN_HOUSING] * 3)
    assert share[1, 0] > 0.005
    assert share[0].max() == 0.0
    np.testing.assert_array_equal(meets, [[False, False, False], [False, False, True], [False, True, False]])


def box_rig(**options):
    """Four cameras amid the roof of a box of 4 x 2 x 1.5 m, crosswise, that see all round."""
    model = CameraModel(96, 96, math.radians(100.0))
    return Rig([looking([0.0, 0.0, 2.5], yaw, 25.0, name=f"camera_{yaw}", model=model) for yaw in (0, 90, 180, 270)])


def test_a_rig_has_a_margin_for_every_rule():
    body = cuboid((4.0, 2.0, 1.5), (0.0, 0.0, 0.75))
    check = RuleCheck(box_rig(), body, Rules(own_body=0.6, housing=None))
    assert {each.rule: each.is_kept for each in check.margins} == {
        "own_body": True,
        "horizon": True,
        "crossing": True,
        "azimuth_gap": True,
        "near_ground": True,
    }
    assert check.azimuth_gap_rad == 0.0
    one_less = RuleCheck(Rig(box_rig().cameras[:3]), body, Rules(housing=None))
    half = 0.5 * math.radians(100.0)
    assert one_less.azimuth_gap_rad == pytest.approx(
        2 * (math.pi / 4 - (half - math.pi / 4)), abs=2.5 * AZIMUTH_STEP_RAD
    )
    assert "azimuth_gap" not in {each.rule for each in one_less.margins}  # three are not to see all round


def test_the_ground_is_seen_from_where_the_body_ends():
    """From 2.5 m above the middle of a box 1.5 m high the edge at 1 m hides up to 2.5 m: 1.5 m off the side."""
    body = cuboid((4.0, 2.0, 1.5), (0.0, 0.0, 0.75))
    near_m = RuleCheck(box_rig(), body).near_m
    assert len(near_m) == SECTORS
    assert set(near_m) <= {*NEAR_M, np.inf}
    assert near_m[2] >= 1.5  # left
    assert near_m[0] >= 3.0  # ahead: 2 m of body hide up to 5 m, 3 m off it


def test_the_ring_goes_round_the_middle():
    ring = ring_m(cuboid((4.0, 2.0, 1.5), (1.0, 0.0, 0.75)))
    np.testing.assert_allclose(np.linalg.norm(ring[:, :2] - [1.0, 0.0], axis=1), 15.0)
    assert len(ring) == 120
