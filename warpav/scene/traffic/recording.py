"""A recording of traffic: who was where and when, on which lanes. All numbers are checked before anything is built.

Recording frame: x and y level, z up, metres; yaw counter-clockwise from x. What is wrong with one road user costs that
road user; a recording is refused where nothing usable is left, or where more than half of it is wrong, as then units
or axes are.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from warpav.core.errors import InputError
from warpav.core.records import unread_text
from warpav.scene._scene import outline_gap_m
from warpav.scene.town._town_layout import Footprint

CLASSES = ("car", "truck", "bus", "motorcycle", "bicycle", "pedestrian")
"""What road users can be. Two-wheelers have their riders on them; trailers are trucks."""
LANE_WIDTH_M = 3.5  # where a file gives none

_SIZES = ("length_m", "width_m", "height_m")
_POSSIBLE_SIZE_M = {
    "car": ((2.0, 25.0), (0.9, 3.2), (0.9, 4.6)),
    "truck": ((2.5, 30.0), (1.2, 3.6), (1.5, 4.8)),
    "bus": ((4.0, 30.0), (1.5, 3.6), (1.8, 4.8)),
    "motorcycle": ((1.0, 3.5), (0.3, 1.8), (0.7, 2.4)),
    "bicycle": ((1.0, 3.5), (0.2, 1.6), (0.7, 2.4)),
    "pedestrian": ((0.15, 2.0), (0.15, 2.0), (0.5, 2.4)),
}
"""Least and greatest length, width and height by class. Recorded cars may be long vehicles of any kind."""
_SIZE_TOLERANCE = 0.3  # beyond these bounds, within which a size is clipped

_STEP_MAX = 1_000_000  # the last step that a recording may have, 27 hours at 10 Hz: beyond there are timestamps
_POSSIBLE_SPEED_M_S = 90.0
_SPEED_RATIO = (0.6, 1.7)  # recorded speeds over those by positions, in the median: others contradict the positions
_MOVING_M_S = 1.5
_MOVING_SHARE_MIN = 20  # samples of moving road users that such a judgement takes
_SPAN_S = 0.5  # over which positions give a speed
_LANE_REACH_M = 60.0
_CELL_M = 0.5  # ways that are nearer to one another are one
_TRACK_STEP_M, _TRACK_MIN_M, _TRACK_AHEAD_M = 2.0, 8.0, 25.0  # of lanes along tracks: spacing, least way, beyond ends
_TRACK_WIDTH_M, _STANDING_M = 5.0, 10.0  # their width, and what there is of them before and behind who stands
_TRACK_CELL_M, _TRACK_NEW_SHARE = 1.5, 0.15  # a track gives a lane where so much of it lies beside the lanes before


@dataclass(frozen=True, eq=False)
class Lanelet:
    """A piece of a lane."""

    left_m: np.ndarray  # its left border in driving direction [m], float64 [point, 2]
    right_m: np.ndarray  # its right border [m], float64 [point, 2]
    # What it is, such as ``urban`` or ``intersection``; ``crosswalk`` is no lane but a crossing of people.
    kinds: tuple[str, ...] = ()

    @classmethod
    def along(cls, centre_m: np.ndarray, width_m: float = LANE_WIDTH_M, kinds: tuple[str, ...] = ()) -> Lanelet:
        """The piece around a centre line [point, 2]."""
        moved = np.r_[True, (np.diff(centre_m, axis=0) != 0.0).any(axis=1)]  # points repeat in some files
        centre_m = centre_m[moved] if moved.sum() > 1 else centre_m
        way = np.gradient(centre_m, axis=0)
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
        aside_m = 0.5 * width_m * np.stack([-way[:, 1], way[:, 0]], axis=1)
        return cls(centre_m + aside_m, centre_m - aside_m, kinds)

    @property
    def is_crosswalk(self) -> bool:
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


@dataclass(frozen=True)
class Fault:
    """What is wrong with a road user, which is left out for it."""

    field: str  # what it is counted by
    text: str  # who, what was expected, what came

    @classmethod
    def of(cls, error: InputError, place: str) -> Fault:
        """What an error says of the road user at a place, counted by the field that follows the place."""
        text = error.args[0]
        field, *rest = text.removeprefix(f"{place}: ").split(":")
        return cls(field if rest else "form", text)


@dataclass(frozen=True, eq=False)
class Recording:
    """Recorded traffic on a map, as `recording_of` makes it."""

    recording_id: str  # its name
    source: str  # where it comes from, in words
    step_s: float  # time between two steps [s]
    lanelets: tuple[Lanelet, ...]  # lanes and crossings
    users: tuple[RecordedUser, ...]  # everybody
    ego_id: str | None = None  # who carried the sensors, where somebody did; nobody else becomes the ego vehicle
    account: str = ""  # who was left out and why, and what was supposed, in one line; empty where nothing was

    @property
    def last_step(self) -> int:
        return max(int(user.step[-1]) for user in self.users)

    @cached_property
    def _span(self) -> np.ndarray:
        """First and last step of everybody, int64 [2, user]."""
        return np.array([[user.step[0], user.step[-1]] for user in self.users]).T

    @cached_property
    def tracks(self) -> tuple[tuple[RecordedUser, np.ndarray], ...]:
        """Every way that somebody took once: one of those who took it, and points along it [m], float64 [point, 2]."""
        found: list[tuple[RecordedUser, np.ndarray]] = []
        covered: dict[str, set[tuple[int, int]]] = {}
        for user in self.users:
            line = _thinned(user.pose[:, :2], _CELL_M)
            seen = covered.setdefault(user.category, set())
            cells = set(map(tuple, np.round(line / _CELL_M).astype(int).tolist()))
            if len(line) > 1 and not cells <= seen:
                seen.update((x + i, y + j) for x, y in cells for i in (-1, 0, 1) for j in (-1, 0, 1))
                found.append((user, line))
        return tuple(found)

    def states_at(self, step: int) -> list[RecordedState]:
        """Everybody who is there at a step, in the order of `users`."""
        first, last = self._span
        there = np.flatnonzero((first <= step) & (step <= last)).tolist()
        return [state for k in there if (state := self._state(self.users[k], step)) is not None]

    def _state(self, user: RecordedUser, step: int) -> RecordedState | None:
        k = int(np.searchsorted(user.step, step))
        if user.step[k] != step:
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


def recording_of(
    recording_id: str,
    source: str,
    step_s: float,
    lanelets: Iterable[Lanelet],
    users: Iterable[RecordedUser],
    ego_id: str | None = None,
    *,
    faults: Iterable[Fault] = (),
    passed_over: Iterable[str] = (),
    notes: Iterable[str] = (),
    unread: Iterable[str] = (),
    found_map: str = "",
) -> Recording:
    """The recording of what a file holds.

    Args:
        recording_id: Its name.
        source: Where it comes from, in words.
        step_s: Time between two steps [s].
        lanelets: Lanes and crossings; without lanes the road follows the tracks of vehicles.
        users: Everybody whom the file describes well enough.
        ego_id: Who carried the sensors, where somebody did.
        faults: Of road users whom it does not.
        passed_over: The file's word for each object that is no road user.
        notes: What else the account says.
        unread: Keys and columns that the reader does not know.
        found_map: The name of a map that lay near and that the file does not name. If it is of another place, the
            recording has no lanes.

    Raises:
        InputError: Units or axes are wrong, the lanes lie elsewhere, or nobody is left.
    """
    if not 0.0 < step_s <= 5.0:
        raise InputError(f"dt_s: expected the time between two steps, up to 5 s, got {step_s:g}")
    found = list(faults)
    kept: dict[str, RecordedUser] = {}
    clipped = 0
    for user in users:
        checked = _checked(user, step_s)
        if isinstance(checked, Fault):
            found.append(checked)
            continue
        clipped += checked.size_m != user.size_m and not math.isnan(user.size_m[2])
        other = kept.get(user.user_id)
        if other is not None:
            found.append(Fault("id", f"road user {user.user_id}: id: expected every id once, got it twice"))
            checked = max(other, checked, key=lambda each: len(each.step))
        kept[user.user_id] = checked
    if 2 * len(found) > len(found) + len(kept):
        raise InputError(found[0].text)
    if not kept:
        raise InputError("road users: expected some, got none")
    if ego_id is not None and ego_id not in kept:
        raise InputError(f"ego: expected the id of a road user, got {ego_id!r}")
    recording = Recording(recording_id, source, step_s, tuple(lanelets), tuple(kept.values()), ego_id)
    parts = [*_account(found, clipped, Counter(passed_over), len(found) + len(kept)), *notes]
    parts += filter(None, [unread_text(sorted(set(unread)))])
    try:
        _check_lanes(recording)
    except InputError as error:
        if not found_map:
            raise
        recording = replace(recording, lanelets=())
        parts.append(f"{found_map}: {error}")
    _check_motion(recording)
    lanelets = recording.lanelets
    if all(lanelet.is_crosswalk for lanelet in lanelets):
        lanelets += tuple(_lanes_along(recording.users))
        parts.append("without lanes, the road follows the tracks")
    return replace(recording, lanelets=lanelets, account="; ".join(parts))


def _account(faults: Sequence[Fault], clipped: int, passed_over: Counter[str], count: int) -> list[str]:
    parts = []
    if faults:
        fields = _counts(Counter(fault.field for fault in faults))
        parts.append(f"{len(faults)} of {count} road users left out ({fields}), such as {faults[0].text}")
    if clipped:
        parts.append(f"{clipped} sizes clipped")
    if passed_over:
        parts.append(f"{passed_over.total()} objects passed over that are no road users ({_counts(passed_over)})")
    return parts


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counter.most_common())


def check_step(value: float, place: str) -> None:
    if value % 1 != 0:
        raise InputError(f"{place}: expected whole steps, got {value:g}")
    if not 0 <= value <= _STEP_MAX:
        raise InputError(f"{place}: expected steps from 0 to {_STEP_MAX}, in units of dt_s, got {value:.15g}")


def without_overlaps(
    states: Sequence[RecordedState], overlap_max_m: float
) -> tuple[list[RecordedState], list[RecordedState]]:
    """Those of whom no two overlap by more than ``overlap_max_m``, and those who are left out for it.

    Of two that overlap the one goes that is on foot, was there for fewer samples, or is smaller. A trailer may reach
    into its tractor.
    """
    if len(states) < 2:
        return list(states), []
    centre = np.array([state.centre_m for state in states])
    reach = np.array([0.5 * math.hypot(*state.user.size_m[:2]) for state in states])
    near = np.linalg.norm(centre[:, None] - centre, axis=2) < reach[:, None] + reach
    corners: dict[int, np.ndarray] = {}
    gone: set[int] = set()

    def weight(k: int) -> tuple[bool, int, float]:
        user = states[k].user
        return user.category != "pedestrian", len(user.step), user.size_m[0] * user.size_m[1]

    for pair in np.argwhere(np.triu(near, 1)).tolist():
        if gone.intersection(pair):
            continue
        one, other = (corners.setdefault(k, states[k].corners_m()) for k in pair)
        articulated = all(states[k].user.category in ("truck", "bus") for k in pair)
        if -outline_gap_m(one, other) > (_COUPLING_M if articulated else overlap_max_m):
            gone.add(min(pair, key=weight))
    return [state for k, state in enumerate(states) if k not in gone], [states[k] for k in sorted(gone)]


_COUPLING_M = 2.0  # by which a trailer may reach into its tractor


def _checked(user: RecordedUser, step_s: float) -> RecordedUser | Fault:
    place = f"road user {user.user_id}"
    if user.category not in CLASSES:
        return Fault("type", f"{place}: type: expected one of {', '.join(CLASSES)}, got {user.category!r}")
    size = []
    for name, value, (low, high) in zip(_SIZES, user.size_m, _POSSIBLE_SIZE_M[user.category], strict=True):
        is_unknown = name == "height_m" and math.isnan(value)
        if not is_unknown and not low * (1.0 - _SIZE_TOLERANCE) <= value <= high * (1.0 + _SIZE_TOLERANCE):
            expected = f"expected {low:g} to {high:g} m for a {user.category}, got {value:g}"
            return Fault(name, f"{place}: {name}: {expected}; sizes and positions must be in metres")
        size.append(value if is_unknown else min(max(value, low), high))
    count = len(user.step)
    if count == 0 or user.pose.shape != (count, 3) or (user.speed_m_s is not None and user.speed_m_s.shape != (count,)):
        return Fault("t", f"{place}: expected as many positions, yaws and speeds as steps, at least one")
    if (np.diff(user.step) <= 0).any():
        return Fault("t", f"{place}: t: expected ascending steps from 0")
    try:
        check_step(int(user.step[0]), f"{place}: t")
        check_step(int(user.step[-1]), f"{place}: t")
    except InputError as error:
        return Fault("t", str(error))
    sample = user.pose if user.speed_m_s is None else np.c_[user.pose, user.speed_m_s]
    known = np.isfinite(sample).all(axis=1)
    if not known.any():
        return Fault("x_m", f"{place}: expected finite positions, yaws and speeds")
    step, sample = user.step[known], sample[known]
    fastest = _speeds(step, sample, step_s)[1].max(initial=0.0)
    if fastest > _POSSIBLE_SPEED_M_S:
        return Fault(
            "x_m",
            f"{place}: expected at most {_POSSIBLE_SPEED_M_S:g} m/s by its positions, got {fastest:.0f}; positions "
            "must be in metres, dt_s in seconds",
        )
    speed = None if user.speed_m_s is None else sample[:, 3]
    return replace(user, size_m=(size[0], size[1], size[2]), step=step, pose=sample[:, :3], speed_m_s=speed)


def _speeds(step: np.ndarray, pose: np.ndarray, step_s: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Ways [m] over `_SPAN_S`, [span, 2], speeds by them [m/s], [span], and over how many samples."""
    span = max(1, round(_SPAN_S / step_s))
    way_m = pose[span:, :2] - pose[:-span, :2]
    return way_m, np.linalg.norm(way_m, axis=1) / ((step[span:] - step[:-span]) * step_s), span


def _check_lanes(recording: Recording) -> None:
    lanes = [lanelet for lanelet in recording.lanelets if not lanelet.is_crosswalk]
    for number, lanelet in enumerate(recording.lanelets):
        for name, line in (("left", lanelet.left_m), ("right", lanelet.right_m)):
            if line.ndim != 2 or line.shape[1] != 2 or len(line) < 2 or not np.isfinite(line).all():
                raise InputError(f"lanelet {number}: {name}: expected at least two points of finite x and y")
    if not lanes:
        return
    border = np.concatenate([lanelet.outline_m for lanelet in lanes])
    centre = np.concatenate([user.pose[:, :2] for user in recording.users])
    low, high = border.min(axis=0) - _LANE_REACH_M, border.max(axis=0) + _LANE_REACH_M
    if not ((centre >= low) & (centre <= high)).all(axis=1).any():
        raise InputError(
            f"lanelets: expected the lanes that the road users drive on, got all more than {_LANE_REACH_M:g} m "
            "away from the lanes; both must be in metres in one frame"
        )


def _check_motion(recording: Recording) -> None:
    """Whether speeds and headings are those of the positions, taken over everybody who moves."""
    ratio, away, degrees = [], [], []
    for user in recording.users:
        degrees.append(np.abs(user.pose[:, 2]).max() > 4.0 * math.pi)
        way_m, speed, span = _speeds(user.step, user.pose, recording.step_s)
        moving = speed > _MOVING_M_S
        if user.speed_m_s is not None:
            recorded = np.abs(0.5 * (user.speed_m_s[span:] + user.speed_m_s[:-span]))
            either = moving | (recorded > _MOVING_M_S)
            ratio += (recorded[either] / np.maximum(speed[either], 1e-3)).tolist()
        if user.category != "pedestrian":  # people step sideways and turn on the spot
            heading = np.exp(1j * user.pose[span:, 2]) + np.exp(1j * user.pose[:-span, 2])
            away += np.abs(np.angle((way_m[:, 0] + 1j * way_m[:, 1]) * heading.conj()))[moving].tolist()
    if np.mean(degrees) > 0.5:
        largest = max(float(np.abs(user.pose[:, 2]).max()) for user in recording.users)
        raise InputError(f"yaw_rad: expected radians, got {largest:g}; degrees?")
    if (
        len(ratio) >= _MOVING_SHARE_MIN
        and not _SPEED_RATIO[0] <= (middle := float(np.median(ratio))) <= _SPEED_RATIO[1]
    ):
        hint = f"dt_s {recording.step_s / middle:.2g} would fit" if middle < 1.0 else "km/h, or another dt_s?"
        hint = hint if middle < 100.0 else "are the positions degrees?"
        raise InputError(
            f"v_mps: expected the speeds by positions over dt_s {recording.step_s:g}, got {middle:.2f} of them "
            f"(median); {hint}"
        )
    if len(away) >= _MOVING_SHARE_MIN and np.median(away) > math.radians(45.0):
        raise InputError(
            "yaw_rad: expected headings counter-clockwise from x along which road users move, got "
            f"{math.degrees(float(np.median(away))):.0f} deg off (median); is y to the right, or z down?"
        )


def _thinned(line_m: np.ndarray, cell_m: float) -> np.ndarray:
    """The points of a line [point, 2] at which it comes to another cell of a grid, and its ends."""
    moves = (np.diff(np.round(line_m / cell_m), axis=0) != 0.0).any(axis=1)
    moves[-1:] = True
    return line_m[np.r_[True, moves]]


def _lanes_along(users: Iterable[RecordedUser]) -> list[Lanelet]:
    """Lanes along the tracks of vehicles, one for those that follow one another; without lines, as where they cross."""
    found: list[Lanelet] = []
    covered: set[tuple[int, int]] = set()
    for user in sorted(users, key=lambda each: -float(np.ptp(each.pose[:, :2], axis=0).sum())):
        if user.category in ("pedestrian", "bicycle"):
            continue
        way = [user.pose[0, :2]]
        for point in _thinned(user.pose[:, :2], _CELL_M):
            if np.hypot(*(point - way[-1])) >= _TRACK_STEP_M:
                way.append(point)
        if (len(way) - 1) * _TRACK_STEP_M >= _TRACK_MIN_M:
            ends = way[0] - way[3], way[-1] - way[-4]
            before, after = (_TRACK_AHEAD_M * end / max(float(np.linalg.norm(end)), 1e-9) for end in ends)
            line = np.array([way[0] + before, *way, way[-1] + after])
        else:  # who stands, stands on a piece of road
            heading = np.array([math.cos(user.pose[0, 2]), math.sin(user.pose[0, 2])])
            line = way[0] + np.arange(-_STANDING_M, _STANDING_M + 1e-9, _TRACK_STEP_M)[:, None] * heading
        cells = list(map(tuple, np.round(line / _TRACK_CELL_M).astype(int).tolist()))
        if sum(cell not in covered for cell in cells) >= _TRACK_NEW_SHARE * len(cells):
            covered.update((x + i, y + j) for x, y in cells for i in (-1, 0, 1) for j in (-1, 0, 1))
            found.append(Lanelet.along(line, _TRACK_WIDTH_M, ("intersection",)))
    return found
