"""Recordings: states at moments, overlaps, and numbers that are no traffic."""

import math

import pytest

from tests.scene.traffic.recordings import recording_of, street
from warpav.core.errors import InputError


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
