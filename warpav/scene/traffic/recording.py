"""A recording of traffic: who was where and when, on which lanes. All numbers are checked before anything is built.

Recording frame: x and y level, z up, metres; yaw counter-clockwise from x.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from warpav.core.errors import InputError
from warpav.scene._scene import outline_gap_m
from warpav.scene.town._town_layout import Footprint

CLASSES = ("car", "truck", "bus", "motorcycle", "bicycle", "pedestrian")
"""What road users can be. Two-wheelers have their riders on them."""

_POSSIBLE_SIZE_M = {
    "car": ((2.0, 25.0), (0.9, 3.2), (0.9, 4.6)),
    "truck": ((2.5, 30.0), (1.2, 3.6), (1.5, 4.8)),
    "bus": ((4.0, 30.0), (1.5, 3.6), (1.8, 4.8)),
    "motorcycle": ((1.0, 3.5), (0.3, 1.8), (0.7, 2.4)),
    "bicycle": ((1.0, 3.5), (0.2, 1.6), (0.7, 2.4)),
    "pedestrian": ((0.15, 2.0), (0.15, 2.0), (0.5, 2.4)),
}
"""Least and greatest length, width and height by class. Recorded cars may be long vehicles of any kind."""

_STEP_MAX = 1_000_000  # the last step that a recording may have, 27 hours at 10 Hz: beyond there are timestamps
_POSSIBLE_SPEED_M_S = 90.0
_SPEED_RATIO = (0.6, 1.7)  # recorded speeds over those by positions, in the median: others contradict the positions
_MOVING_M_S = 1.5
_MOVING_SHARE_MIN = 20  # samples of moving road users that such a judgement takes
_SPAN_S = 0.5  # over which positions give a speed
_LANE_REACH_M = 60.0


@dataclass(frozen=True, eq=False)
class Lanelet:
    """A piece of a lane."""

    left_m: np.ndarray  # its left border in driving direction [m], float64 [point, 2]
    right_m: np.ndarray  # its right border [m], float64 [point, 2]
    # What it is, such as ``urban`` or ``intersection``; ``crosswalk`` is no lane but a crossing of people.
    kinds: tuple[str, ...] = ()

    @property
    def is_crosswalk(self) -> bool:
        """Whether people cross here."""
        return "crosswalk" in self.kinds

    @property
    def outline_m(self) -> np.ndarray:
        """Closed polygon around it, without its first point again [m], float64 [point, 2]."""
        return np.concatenate([self.left_m, self.right_m[::-1]])


@dataclass(frozen=True, eq=False)
class RecordedUser:
    """A road user and its track."""

    user_id: str  # its name in the recording
    category: str  # out of `CLASSES`
    size_m: tuple[float, float, float]  # length, width and height [m]; the height is NaN where none was recorded
    step: np.ndarray  # samples, ascending, int64 [sample]
    pose: np.ndarray  # x [m], y [m] of the box's centre and its yaw [rad], float64 [sample, 3]
    speed_m_s: np.ndarray | None = None  # speed along the yaw, float64 [sample]; None where none was recorded


@dataclass(frozen=True, eq=False)
class RecordedState:
    """A road user at one moment."""

    user: RecordedUser  # who
    centre_m: np.ndarray  # centre of the box [m], shape [2]
    yaw_rad: float  # heading
    velocity_m_s: np.ndarray  # velocity over ground [m/s], shape [2]

    def corners_m(self) -> np.ndarray:
        """Corners of its outline on the ground [m], float64 [4, 2]."""
        return Footprint.at(self.centre_m, self.yaw_rad, self.user.size_m).corners_m()


@dataclass(frozen=True, eq=False)
class Recording:
    """Recorded traffic on a map."""

    recording_id: str  # its name
    source: str  # where it comes from, in words
    step_s: float  # time between two steps [s]
    lanelets: tuple[Lanelet, ...]  # lanes and crossings
    users: tuple[RecordedUser, ...]  # everybody
    ego_id: str | None = None  # who carried the sensors, where somebody did; nobody else becomes the ego vehicle

    def __post_init__(self) -> None:
        _check(self)

    @property
    def last_step(self) -> int:
        """The last step of anybody."""
        return max(int(user.step[-1]) for user in self.users)

    def states_at(self, step: int) -> list[RecordedState]:
        """Everybody who is there at a step, in the order of `users`."""
        return [state for user in self.users if (state := self._state(user, step)) is not None]

    def _state(self, user: RecordedUser, step: int) -> RecordedState | None:
        k = int(np.searchsorted(user.step, step))
        if k == len(user.step) or user.step[k] != step:
            return None
        x, y, yaw = user.pose[k].tolist()
        if user.speed_m_s is not None:
            velocity = float(user.speed_m_s[k]) * np.array([math.cos(yaw), math.sin(yaw)])
        else:
            # nothing is known of who has a single sample, so it stands
            span = max(1, round(0.5 * _SPAN_S / self.step_s))
            first, last = max(k - span, 0), min(k + span, len(user.step) - 1)
            elapsed_s = (user.step[last] - user.step[first]) * self.step_s
            velocity = (user.pose[last, :2] - user.pose[first, :2]) / elapsed_s if elapsed_s > 0.0 else np.zeros(2)
        return RecordedState(user, np.array([x, y]), yaw, velocity)


def check_step(value: float, place: str) -> None:
    """Make sure that a number is a step."""
    if value % 1 != 0:
        raise InputError(f"{place}: expected whole steps, got {value:g}")
    if not 0 <= value <= _STEP_MAX:
        raise InputError(f"{place}: expected steps from 0 to {_STEP_MAX}, in units of dt_s, got {value:.15g}")


def deepest_overlap(states: list[RecordedState]) -> tuple[float, tuple[str, str]]:
    """The deepest overlap of any two [m], and who they are; 0 where nobody overlaps."""
    deepest, pair = 0.0, ("", "")
    if len(states) < 2:
        return deepest, pair
    centre = np.array([state.centre_m for state in states])
    reach = np.array([0.5 * math.hypot(*state.user.size_m[:2]) for state in states])
    away = np.linalg.norm(centre[:, None] - centre, axis=2)
    near = np.argwhere(np.triu(away < reach[:, None] + reach, 1))
    for i, j in near.tolist():
        depth = -outline_gap_m(states[i].corners_m(), states[j].corners_m())
        if depth > deepest:
            deepest, pair = depth, (states[i].user.user_id, states[j].user.user_id)
    return deepest, pair


def _check(recording: Recording) -> None:
    """Make sure that a recording is traffic in metres, radians and seconds."""
    if not 0.0 < recording.step_s <= 5.0:
        raise InputError(f"dt_s: expected the time between two steps, up to 5 s, got {recording.step_s:g}")
    if not recording.users:
        raise InputError("road users: expected some, got none")
    lanes = [lanelet for lanelet in recording.lanelets if not lanelet.is_crosswalk]
    if not lanes:
        raise InputError(
            "lanelets: expected left and right borders of lanes, got none, so there is no road to drive on"
        )
    for number, lanelet in enumerate(recording.lanelets):
        for name, line in (("left", lanelet.left_m), ("right", lanelet.right_m)):
            if line.ndim != 2 or line.shape[1] != 2 or len(line) < 2 or not np.isfinite(line).all():
                raise InputError(f"lanelet {number}: {name}: expected at least two points of finite x and y")
    names = [user.user_id for user in recording.users]
    if len(set(names)) < len(names):
        twice = Counter(names).most_common(1)[0][0]
        raise InputError(f"road user {twice}: expected every id once, got it twice")
    for user in recording.users:
        _check_user(user)
    if recording.ego_id is not None and recording.ego_id not in names:
        raise InputError(f"ego: expected the id of a road user, got {recording.ego_id!r}")
    _check_motion(recording)
    border = np.concatenate([lanelet.outline_m for lanelet in lanes])
    centre = np.concatenate([user.pose[:, :2] for user in recording.users])
    low, high = border.min(axis=0) - _LANE_REACH_M, border.max(axis=0) + _LANE_REACH_M
    if not ((centre >= low) & (centre <= high)).all(axis=1).any():
        raise InputError(
            f"lanelets: expected the lanes that the road users drive on, got all more than {_LANE_REACH_M:g} m "
            "away from the lanes; both must be in metres in one frame"
        )


def _check_user(user: RecordedUser) -> None:
    place = f"road user {user.user_id}"
    if user.category not in CLASSES:
        raise InputError(f"{place}: type: expected one of {', '.join(CLASSES)}, got {user.category!r}")
    for name, value, (low, high) in zip(
        ("length_m", "width_m", "height_m"), user.size_m, _POSSIBLE_SIZE_M[user.category], strict=True
    ):
        if name == "height_m" and math.isnan(value):
            continue
        if not low <= value <= high:
            raise InputError(
                f"{place}: {name}: expected {low:g} to {high:g} m for a {user.category}, got {value:g}; "
                "sizes and positions must be in metres"
            )
    count = len(user.step)
    if count == 0 or user.pose.shape != (count, 3) or (user.speed_m_s is not None and user.speed_m_s.shape != (count,)):
        raise InputError(f"{place}: expected as many positions, yaws and speeds as steps, at least one")
    check_step(int(user.step.min()), f"{place}: t")
    check_step(int(user.step.max()), f"{place}: t")
    if (np.diff(user.step) <= 0).any():
        raise InputError(f"{place}: t: expected ascending steps from 0")
    if not np.isfinite(user.pose).all() or (user.speed_m_s is not None and not np.isfinite(user.speed_m_s).all()):
        raise InputError(f"{place}: expected finite positions, yaws and speeds")
    if np.abs(user.pose[:, 2]).max() > 4.0 * math.pi:
        raise InputError(f"{place}: yaw_rad: expected radians, got {np.abs(user.pose[:, 2]).max():g}; degrees?")


def _check_motion(recording: Recording) -> None:
    """Whether speeds and headings are those of the positions, taken over everybody who moves."""
    ratio, away = [], []
    for user in recording.users:
        span = max(1, round(_SPAN_S / recording.step_s))
        if len(user.step) <= span:
            continue
        way_m = user.pose[span:, :2] - user.pose[:-span, :2]
        speed = np.linalg.norm(way_m, axis=1) / ((user.step[span:] - user.step[:-span]) * recording.step_s)
        if speed.max() > _POSSIBLE_SPEED_M_S:
            raise InputError(
                f"road user {user.user_id}: expected at most {_POSSIBLE_SPEED_M_S:g} m/s by its positions, got "
                f"{speed.max():.0f}; positions must be in metres, dt_s in seconds"
            )
        moving = speed > _MOVING_M_S
        if user.speed_m_s is not None:
            recorded = np.abs(0.5 * (user.speed_m_s[span:] + user.speed_m_s[:-span]))
            either = moving | (recorded > _MOVING_M_S)
            ratio += (recorded[either] / np.maximum(speed[either], 1e-3)).tolist()
        if user.category != "pedestrian":  # people step sideways and turn on the spot
            heading = np.exp(1j * user.pose[span:, 2]) + np.exp(1j * user.pose[:-span, 2])
            away += np.abs(np.angle((way_m[:, 0] + 1j * way_m[:, 1]) * heading.conj()))[moving].tolist()
    if (
        len(ratio) >= _MOVING_SHARE_MIN
        and not _SPEED_RATIO[0] <= (middle := float(np.median(ratio))) <= _SPEED_RATIO[1]
    ):
        hint = f"dt_s {recording.step_s / middle:.2g} would fit" if middle < 1.0 else "km/h, or another dt_s?"
        raise InputError(
            f"v_mps: expected the speeds by positions over dt_s {recording.step_s:g}, got {middle:.2f} of them "
            f"(median); {hint}"
        )
    if len(away) >= _MOVING_SHARE_MIN and np.median(away) > math.radians(45.0):
        raise InputError(
            "yaw_rad: expected headings counter-clockwise from x along which road users move, got "
            f"{math.degrees(float(np.median(away))):.0f} deg off (median); is y to the right, or z down?"
        )
