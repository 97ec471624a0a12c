import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from warpav.core.frames import (
    EGO_FROM_CARLA,
    EGO_FROM_THESIS,
    FLU_FROM_RDF,
    carla_from_ego_pose,
    ego_from_carla_pose,
    rotation_from_yaw_pitch_roll,
    wrap_angle_rad,
    yaw_pitch_roll_from_rotation,
)

# One camera in six conventions: 1.7 m ahead, 0.5 m left, 1.6 m up; rolled 2, nose 5 down, 45 to the left [deg].
# The quaternion and the matrix were computed with scipy, CARLA's signs with the transform class of its 0.9.16 wheel.
POSITION_M = np.array([1.7, 0.5, 1.6])
ROLL_RAD, PITCH_RAD, YAW_RAD = np.radians([2.0, 5.0, 45.0])
FORWARD = [0.704416, 0.704416, -0.087156]
QUATERNION_WXYZ = [0.628581, -0.676128, 0.293989, -0.247605]
CAMERA_FROM_EGO = [
    [0.704525, -0.708827, -0.034767, -0.787653],
    [-0.086269, -0.036913, -0.995588, 1.758054],
    [0.704416, 0.704416, -0.087156, -1.410266],
]

angles = st.floats(-20.0, 20.0)
steep_angles = st.floats(-math.pi / 2 + 1e-3, math.pi / 2 - 1e-3)
metres = st.floats(-100.0, 100.0)


def rotation_from_quaternion(w, x, y, z):
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def carla_rotation(pitch_deg, yaw_deg, roll_deg):
    """CARLA's rotation matrix, whose columns are forward, right and up in its own left-handed axes."""
    pitch, yaw, roll = np.radians([pitch_deg, yaw_deg, roll_deg])
    cp, sp, cy, sy, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw), np.cos(roll), np.sin(roll)
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr],
            [sp, -cp * sr, cp * cr],
        ]
    )


def test_optical_axes_of_the_known_pose():
    ego_from_camera = rotation_from_yaw_pitch_roll(YAW_RAD, PITCH_RAD, ROLL_RAD) @ FLU_FROM_RDF
    np.testing.assert_allclose(ego_from_camera[:, 2], FORWARD, atol=1e-6)
    np.testing.assert_allclose(ego_from_camera, rotation_from_quaternion(*QUATERNION_WXYZ), atol=3e-6)
    camera_from_ego = np.c_[ego_from_camera.T, -ego_from_camera.T @ POSITION_M]
    np.testing.assert_allclose(camera_from_ego, CAMERA_FROM_EGO, atol=1e-6)


def test_the_thesis_has_x_to_the_left_y_up_and_z_ahead():
    np.testing.assert_array_equal(EGO_FROM_THESIS @ [1.0, 2.0, 3.0], [3.0, 1.0, 2.0])


def test_carla_numbers_of_the_known_pose():
    location, pitch, yaw, roll = carla_from_ego_pose(
        POSITION_M, yaw_rad=YAW_RAD, pitch_rad=PITCH_RAD, roll_rad=ROLL_RAD
    )
    np.testing.assert_allclose([*location, pitch, yaw, roll], [1.7, -0.5, 1.6, -5.0, -45.0, 2.0], atol=1e-12)


@given(angles)
def test_wrapped_angle_is_the_same_direction(angle_rad):
    wrapped = wrap_angle_rad(angle_rad)
    assert -math.pi < wrapped <= math.pi
    assert math.remainder(wrapped - angle_rad, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-12)


@given(angles, steep_angles, angles)
def test_angles_survive_the_round_trip(yaw_rad, pitch_rad, roll_rad):
    back = yaw_pitch_roll_from_rotation(rotation_from_yaw_pitch_roll(yaw_rad, pitch_rad, roll_rad))
    difference = [math.remainder(a - b, 2 * math.pi) for a, b in zip(back, (yaw_rad, pitch_rad, roll_rad), strict=True)]
    np.testing.assert_allclose(difference, 0.0, atol=1e-9)


@given(angles, st.sampled_from([-math.pi / 2, math.pi / 2]), angles)
def test_rotation_survives_looking_straight_up_or_down(yaw_rad, pitch_rad, roll_rad):
    rotation = rotation_from_yaw_pitch_roll(yaw_rad, pitch_rad, roll_rad)
    angle = yaw_pitch_roll_from_rotation(rotation)
    assert angle[2] == 0.0
    np.testing.assert_allclose(rotation_from_yaw_pitch_roll(*angle), rotation, atol=1e-9)


@given(st.tuples(metres, metres, metres), st.floats(-3.1, 3.1), steep_angles, st.floats(-3.1, 3.1))
def test_carla_pose_survives_the_round_trip_and_is_the_mirror_image(position_m, yaw_rad, pitch_rad, roll_rad):
    location, pitch_deg, yaw_deg, roll_deg = carla_from_ego_pose(
        np.array(position_m), yaw_rad=yaw_rad, pitch_rad=pitch_rad, roll_rad=roll_rad
    )
    mirrored = EGO_FROM_CARLA @ carla_rotation(pitch_deg, yaw_deg, roll_deg) @ EGO_FROM_CARLA
    np.testing.assert_allclose(mirrored, rotation_from_yaw_pitch_roll(yaw_rad, pitch_rad, roll_rad), atol=1e-12)
    back = ego_from_carla_pose(location, pitch_deg=pitch_deg, yaw_deg=yaw_deg, roll_deg=roll_deg)
    np.testing.assert_allclose(back[0], position_m, atol=1e-12)
    np.testing.assert_allclose(back[1:], [yaw_rad, pitch_rad, roll_rad], atol=1e-12)
