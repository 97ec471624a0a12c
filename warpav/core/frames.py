"""Frames and angles: the one place where conventions meet.

========= ============================================== ==========================================================
Frame     Axes                                           Used by
========= ============================================== ==========================================================
``ego``   x forward, y left, z up, right-handed [m];     everything in warpav and in its files (ISO 8855); the origin
          yaw left positive, pitch nose-down positive    lies on the ground below the centre of the rear axle
link      the axes of ``ego``, at a camera               ROS ``camera_link``
camera    x right, y down, z along the optical axis      OpenCV; pixel centres lie at +0.5
thesis    x left, y up, z forward, right-handed          the thesis plans in x and z, and y is the height (it renders
                                                         with PyTorch3D, whose world axes these are)
carla     x forward, y right, z up, left-handed;         CARLA's Python interface
          yaw right positive, pitch nose-up positive
========= ============================================== ==========================================================

``ego_from_link`` is ``Rz(yaw) Ry(pitch) Rx(roll)``, which is what URDF and ROS mean by ``rpy``. Angles are radians.
"""

from __future__ import annotations

import math

import numpy as np

FLU_FROM_RDF = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Link axes (forward, left, up) from camera axes (right, down, forward), [3, 3]; its columns are the camera's axes."""

EGO_FROM_THESIS = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Ego coordinates from the thesis's letters (x left, y up, z forward), [3, 3]."""

EGO_FROM_CARLA = np.diag([1.0, -1.0, 1.0])
"""Ego coordinates from CARLA's, [3, 3]: a mirror, so it is its own inverse and turns no rotation into a rotation."""


def wrap_angle_rad(angle_rad: float) -> float:
    """The same direction as ``angle_rad``, in (-pi, pi]."""
    wrapped = math.remainder(angle_rad, 2.0 * math.pi)
    return math.pi if wrapped <= -math.pi else wrapped


def rotation_from_yaw_pitch_roll(yaw_rad: float, pitch_rad: float, roll_rad: float) -> np.ndarray:
    """``ego_from_link`` [3, 3], ``Rz(yaw) Ry(pitch) Rx(roll)``: yaw turns left, pitch nose down, roll right down."""
    cos_yaw, sin_yaw = math.cos(yaw_rad), math.sin(yaw_rad)
    cos_pitch, sin_pitch = math.cos(pitch_rad), math.sin(pitch_rad)
    cos_roll, sin_roll = math.cos(roll_rad), math.sin(roll_rad)
    about_z = np.array([[cos_yaw, -sin_yaw, 0.0], [sin_yaw, cos_yaw, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cos_pitch, 0.0, sin_pitch], [0.0, 1.0, 0.0], [-sin_pitch, 0.0, cos_pitch]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos_roll, -sin_roll], [0.0, sin_roll, cos_roll]])
    return about_z @ about_y @ about_x


def yaw_pitch_roll_from_rotation(ego_from_link: np.ndarray) -> tuple[float, float, float]:
    """The angles of ``ego_from_link`` [3, 3], pitch in [-pi/2, pi/2]; looking straight up or down roll is 0."""
    rotation = np.asarray(ego_from_link, dtype=np.float64)
    level = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch_rad = math.atan2(-rotation[2, 0], level)
    if level < 1e-9:  # straight up or down
        return wrap_angle_rad(math.atan2(-rotation[0, 1], rotation[1, 1])), pitch_rad, 0.0
    yaw_rad = math.atan2(rotation[1, 0], rotation[0, 0])
    roll_rad = math.atan2(rotation[2, 1], rotation[2, 2])
    return wrap_angle_rad(yaw_rad), pitch_rad, wrap_angle_rad(roll_rad)


def rotation_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] of a quaternion ``w, x, y, z`` of any length but 0."""
    w, x, y, z = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """The quaternion ``w, x, y, z`` of a rotation [3, 3], of length 1 with ``w >= 0``."""
    turn = np.asarray(rotation, dtype=np.float64)
    xx, yy, zz = np.diag(turn)
    # four times the products of all components with one another; the row of the largest has no cancellation
    product = np.array(
        [
            [1.0 + xx + yy + zz, turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]],
            [turn[2, 1] - turn[1, 2], 1.0 + xx - yy - zz, turn[0, 1] + turn[1, 0], turn[0, 2] + turn[2, 0]],
            [turn[0, 2] - turn[2, 0], turn[0, 1] + turn[1, 0], 1.0 - xx + yy - zz, turn[1, 2] + turn[2, 1]],
            [turn[1, 0] - turn[0, 1], turn[0, 2] + turn[2, 0], turn[1, 2] + turn[2, 1], 1.0 - xx - yy + zz],
        ]
    )
    quaternion = product[np.argmax(np.diag(product))]
    quaternion = quaternion / np.linalg.norm(quaternion)
    return -quaternion if quaternion[0] < 0.0 else quaternion


def ego_from_carla_pose(
    location_m: np.ndarray, *, pitch_deg: float, yaw_deg: float, roll_deg: float
) -> tuple[np.ndarray, float, float, float]:
    """Position [m], [3], yaw, pitch and roll [rad] in the ego frame from CARLA's ``Transform`` (a mirror of y)."""
    position_m = EGO_FROM_CARLA @ np.asarray(location_m, dtype=np.float64)
    yaw_rad, pitch_rad, roll_rad = (math.radians(angle) for angle in (-yaw_deg, -pitch_deg, roll_deg))
    return position_m, wrap_angle_rad(yaw_rad), pitch_rad, wrap_angle_rad(roll_rad)


def carla_from_ego_pose(
    position_m: np.ndarray, *, yaw_rad: float, pitch_rad: float, roll_rad: float
) -> tuple[np.ndarray, float, float, float]:
    """CARLA's location [m], [3], and its pitch, yaw and roll [deg], in the order of ``carla.Rotation``."""
    location_m = EGO_FROM_CARLA @ np.asarray(position_m, dtype=np.float64)
    pitch_deg, yaw_deg, roll_deg = (
        math.degrees(angle) for angle in (-pitch_rad, wrap_angle_rad(-yaw_rad), wrap_angle_rad(roll_rad))
    )
    return location_m, pitch_deg, yaw_deg, roll_deg
