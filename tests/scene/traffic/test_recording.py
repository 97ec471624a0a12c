"""Recordings: states at moments, overlaps, and numbers that are no traffic."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.scene.traffic.recordings import STEP_S, recording_of, street, track
from warpav.core.errors import InputError
from warpav.scene.traffic.recording import RecordedState, RecordedUser, deepest_overlap, overlap_m

sizes = st.tuples(st.floats(0.5, 12.0), st.floats(0.5, 3.0))
places = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0), st.floats(-math.pi, math.pi))


def state_of(size, place, user_id="one"):
    user = RecordedUser(user_id, "car", (*size, math.nan), np.array([0]), np.array([place]))
    return RecordedState(user, np.array(place[:2]), place[2], np.zeros(2))


def common_area_m2(one, other):
    """Area that two convex polygons share: one is cut along every side of the other."""
    left = list(one)
    for start, end in zip(other, np.roll(other, -1, axis=0), strict=True):
        normal = np.array([start[1] - end[1], end[0] - start[0]])
        kept = []
        for a, b in zip(left, [*left[1:], *left[:1]], strict=True):
            inside_a, inside_b = (a - start) @ normal, (b - start) @ normal
            if inside_a >= 0.0:
                kept.append(a)
            if inside_a * inside_b < 0.0:
                kept.append(a + (b - a) * inside_a / (inside_a - inside_b))
        left = kept
    x, y = np.array(left).T if left else np.zeros((2, 1))
    return 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))


@given(sizes, places, sizes, places)
def test_boxes_overlap_where_their_polygons_do(size, place, other_size, other_place):
    one, other = state_of(size, place), state_of(other_size, other_place)
    depth = overlap_m(one, other)
    area = common_area_m2(one.corners_m(), other.corners_m())
    if depth == 0.0:
        assert area < 1e-3
    elif depth > 0.01:
        assert area > 0.0
    # that far apart they do not overlap, along one of the four normals
    ways = [yaw + turn for yaw in (place[2], other_place[2]) for turn in np.arange(4) * 0.5 * math.pi]
    apart = [
        overlap_m(one, state_of(other_size, (*(np.array(other_place[:2]) + (depth + 1e-6) * np.array(
            [math.cos(way), math.sin(way)])), other_place[2])))
        for way in ways
    ]  # fmt: skip
    assert min(apart) == 0.0


def test_the_deepest_overlap_names_the_pair():
    states = [state_of((4.0, 2.0), (x, 0.0, 0.0), name) for x, name in ((0.0, "a"), (3.9, "b"), (7.4, "c"))]
    assert deepest_overlap(states) == (pytest.approx(0.5), ("b", "c"))
    assert deepest_overlap(states[:1])[0] == 0.0


def test_states_are_those_of_the_samples():
    recording = recording_of(street(turn_rad=0.4, shift_m=(100.0, -50.0)))
    state = {each.user.user_id: each for each in recording.states_at(4)}
    assert set(state) == set("abcde")
    assert recording.last_step == 8
    way = 4 * STEP_S * 8.0
    c, s = math.cos(0.4), math.sin(0.4)
    x, y = -10.0 + way, -1.75
    assert state["a"].centre_m == pytest.approx([c * x - s * y + 100.0, s * x + c * y - 50.0])
    assert state["a"].velocity_m_s == pytest.approx([8.0 * c, 8.0 * s])
    assert recording.states_at(9) == []


def test_velocities_without_recorded_speeds_are_those_of_the_positions():
    data = street()
    for user in data["road_users"]:
        user.pop("v_mps")
    state = {each.user.user_id: each for each in recording_of(data).states_at(0)}
    assert state["c"].velocity_m_s == pytest.approx([-10.0, 0.0])
    assert state["e"].velocity_m_s == pytest.approx([1.0, 0.0])


def changed(**changes):
    """The street with one number of its first car changed."""
    data = street()
    data["road_users"][0] |= changes
    return data


def in_feet():
    data = street()
    for user in data["road_users"]:
        for name in ("x_m", "y_m"):
            user[name] = [1000.0 * each for each in user[name]]
    return data


def turned_by_degrees():
    data = street()
    for user in data["road_users"]:
        user["yaw_rad"] = [90.0] * len(user["yaw_rad"])
    return data


def with_left_headings():
    data = street()
    for user in data["road_users"]:
        user["yaw_rad"] = [each + 0.5 * math.pi for each in user["yaw_rad"]]
    return data


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (changed(length_m=400.0), r"road user a: length_m: expected 2 to 25 m for a car, got 400"),
        (changed(length_m=math.nan), r"road user a: length_m: expected 2 to 25 m for a car, got nan"),
        (changed(width_m=0.0), r"road user a: width_m: expected 0.9 to 3.2 m for a car, got 0"),
        (changed(height_m=30.0), r"road user a: height_m: expected 0.9 to 4.6 m for a car, got 30"),
        (changed(t=[0, 1, 2, 3, 4, 5, 6, 8, 7]), r"road user a: t: expected ascending steps"),
        (changed(x_m=[math.inf] * 9), r"road user a: expected finite positions"),
        (changed(id="b"), r"road user b: expected every id once"),
        (changed(type="tram"), r"type: expected one of car, truck, .*, got 'tram'"),
        (street(dt_s=0.0), r"dt_s: expected the time between two steps"),
        (street(dt_s=0.1), r"v_mps: expected the speeds by positions over dt_s 0.1, got 0.20 .*; dt_s 0.5 would fit"),
        (street(lanelets=[]), r"lanelets: expected left and right borders of lanes, got none"),
        (street(users=[]), r"road users: expected some, got none"),
        (street(ego="z"), r"ego: expected the id of a road user, got 'z'"),
        (in_feet(), r"expected at most 90 m/s by its positions, got 8000"),
        (turned_by_degrees(), r"yaw_rad: expected radians, got 90; degrees\?"),
        (with_left_headings(), r"yaw_rad: expected headings counter-clockwise from x .*, got 90 deg off"),
    ],
)
def test_numbers_that_are_no_traffic_are_refused_in_one_line(data, message):
    with pytest.raises(InputError, match=message) as error:
        recording_of(data)
    assert "\n" not in str(error.value)


def test_lanes_elsewhere_are_refused():
    data = street()
    for lanelet in data["lanelets"]:
        for side in ("left", "right"):
            lanelet[side] = [[x + 5000.0, y] for x, y in lanelet[side]]
    with pytest.raises(InputError, match=r"lanelets: expected the lanes that the road users drive on"):
        recording_of(data)


def test_speeds_in_km_h_are_refused():
    data = street()
    for user in data["road_users"]:
        user["v_mps"] = [3.6 * each for each in user["v_mps"]]
    with pytest.raises(InputError, match=r"got 3.60 of them \(median\); km/h"):
        recording_of(data)


def test_who_stands_needs_no_speed():
    users = [track(str(k), "car", (4.5, 1.8), (8.0 * k, -1.75), 0.0, 0.0) for k in range(4)]
    assert len(recording_of(street(users=users)).states_at(0)) == 4
