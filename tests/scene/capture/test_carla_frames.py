"""Places and geometry of CARLA's world, and what its cameras send."""

import math

import numpy as np
import pytest

from tests.scene.capture import carla_double
from tests.scene.capture.carla_double import Server
from warpav.core.frames import rotation_from_yaw_pitch_roll
from warpav.scene import Box
from warpav.scene.capture._carla_client import (
    boxes_overlap,
    code_from_bgra,
    depth_from_bgra,
    ego_pose_of_wheels,
    lane_places,
    meets_box,
)


def test_own_points_lie_on_the_road_and_come_before_those_of_lanes():
    position_m, yaw_rad = lane_places(carla_double.Map(Server(slope=0.05)), spacing_m=10.0)
    own = position_m[:6]
    assert own[:, 0].tolist() == [-40.0, -15.0, 15.0, 20.0, 31.0, 40.0]  # -14 is within 2.5 m of -15
    np.testing.assert_allclose(position_m[:, 2], 3.0 + 0.05 * position_m[:, 0], atol=1e-3)
    # CARLA's y points right: the lane towards +x lies at -1.75 here, the other one's heading is turned
    is_bay = position_m[:, 1] < -4.0
    np.testing.assert_allclose(np.abs(position_m[~is_bay, 1]), 1.75, atol=1e-9)
    np.testing.assert_allclose(np.cos(yaw_rad)[~is_bay], np.where(position_m[~is_bay, 1] < 0.0, 1.0, -1.0), atol=1e-6)
    assert np.degrees(yaw_rad[is_bay]).tolist() == pytest.approx([-50.0], abs=1e-3)


def test_neither_junctions_nor_pavements_nor_neighbours():
    position_m, _ = lane_places(carla_double.Map(Server()), spacing_m=10.0)
    assert len(position_m) == 6 + 2 * 13 - 2 - 3  # two in the junction, three on own points
    assert not np.any(np.abs(position_m[6:, 0]) < 6.0)
    apart_m = np.linalg.norm(position_m[:, None] - position_m[None], axis=-1) + 1e3 * np.eye(len(position_m))
    assert apart_m.min() > 2.5


def test_ego_frame_of_wheels():
    turn = rotation_from_yaw_pitch_roll(0.01, -0.02, 0.015)
    wheel_m = np.array([[2.8, 0.8, 0.35], [0.0, -0.8, 0.35], [2.8, -0.8, 0.35], [0.0, 0.8, 0.35]])
    pose = ego_pose_of_wheels(wheel_m @ turn.T + [-1.4, 0.02, 0.0], np.full(4, 0.35))
    assert pose is not None
    np.testing.assert_allclose(pose[:3, :3], turn, atol=1e-12)
    # a wheel's radius is taken off along the actor's z, which leans by 1.4 degrees here
    np.testing.assert_allclose(pose[:3, 3], [-1.4, 0.02, 0.0], atol=0.01)
    assert ego_pose_of_wheels(wheel_m[:2], np.full(2, 0.35)) is None
    assert ego_pose_of_wheels(100.0 * wheel_m, np.full(4, 0.35)) is None
    assert ego_pose_of_wheels(wheel_m @ rotation_from_yaw_pitch_roll(0.0, 0.2, 0.0).T, np.full(4, 0.35)) is None


def test_rays_meet_boxes_as_sampled_points_do(rng):
    for _ in range(20):
        box = Box(rng.normal(size=3), rng.uniform(0.5, 2.0, 3), rng.uniform(-3.0, 3.0))
        origin_m = rng.normal(size=3) * 3.0
        ray = rng.normal(size=(50, 3))
        along = origin_m + np.linspace(0.0, 20.0, 2000)[:, None, None] * ray
        meets = meets_box(box, origin_m, ray, margin_m=0.0)
        inside, nearly = (
            box.contains(along.reshape(-1, 3), margin_m=margin_m).reshape(along.shape[:2]).any(axis=0)
            for margin_m in (0.0, 0.02)
        )
        assert not np.any(~meets & inside)
        assert not np.any(meets & ~nearly)


def test_overlap_of_turned_boxes():
    first = Box(np.zeros(3), np.array([4.0, 2.0, 1.5]), 0.0)
    assert boxes_overlap(first, Box(np.array([2.9, 0.0, 0.0]), np.array([4.0, 2.0, 1.5]), 1.5))
    assert not boxes_overlap(first, Box(np.array([3.2, 0.0, 0.0]), np.array([4.0, 2.0, 1.5]), math.pi / 2))
    assert not boxes_overlap(first, Box(np.array([0.0, 0.0, 1.6]), np.array([4.0, 2.0, 1.5]), 0.0))  # on a bridge
    corner = Box(np.array([3.0, 2.0, 0.0]), np.array([2.0, 2.0, 1.5]), math.pi / 4)
    assert not boxes_overlap(first, corner)


def test_depth_counts_red_lowest_over_one_kilometre():
    bgra = np.array([[[0, 0, 0, 255], [0, 1, 2, 255], [6, 0, 0, 255], [255, 255, 255, 255]]], np.uint8)
    expected_m = np.array([0.0, (2 + 256) * 1000 / (2**24 - 1), 6 * 65536 * 1000 / (2**24 - 1), np.inf])
    np.testing.assert_allclose(depth_from_bgra(bgra)[0], expected_m, rtol=1e-7)
    assert depth_from_bgra(bgra).dtype == np.float32


def test_code_keeps_tag_and_both_bytes():
    bgra = np.array([[[3, 2, 14, 255], [0, 0, 0, 255]]], np.uint8)
    assert code_from_bgra(bgra).tolist() == [[14 + 2 * 256 + 3 * 65536, 0]]
