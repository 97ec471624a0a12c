"""Recordings: states at moments, overlaps, and numbers that are no traffic."""

import math
import re

import numpy as np
import pytest

from tests.scene.traffic.recordings import recording_of, street, track
from warpav.core.errors import InputError
from warpav.scene.traffic.recording import without_overlaps


def test_velocities_without_recorded_speeds_are_those_of_the_positions():
    data = street()
    for user in data["road_users"]:
        user.pop("v_mps")
    state = {each.user.user_id: each for each in recording_of(data).states_at(0)}
    assert state["c"].velocity_m_s == pytest.approx([-10.0, 0.0])
    assert state["e"].velocity_m_s == pytest.approx([1.0, 0.0])


def changed(*, everybody=False, **changes):
    """The street with a number of its first road user changed, or of all."""
    data = street()
    for user in data["road_users"] if everybody else data["road_users"][:1]:
        user |= changes
    return data


FAULTS = [
    ({"length_m": 400.0}, r"length_m: expected 2 to 25 m for a car, got 400"),
    ({"length_m": math.nan}, r"length_m: expected 2 to 25 m for a car, got nan"),
    ({"width_m": 0.0}, r"width_m: expected 0.9 to 3.2 m for a car, got 0"),
    ({"height_m": 30.0}, r"height_m: expected 0.9 to 4.6 m for a car, got 30"),
    ({"t": [0, 1, 2, 3, 4, 5, 6, 8, 7]}, r"t: expected ascending steps"),
    ({"t": list(range(1_000_000, 1_000_009))}, r"t: expected steps from 0 to 1000000, in units of dt_s, got 1000008"),
    ({"x_m": [math.inf] * 9}, r"expected finite positions"),
    ({"x_m": [1e4 * k for k in range(9)]}, r"expected at most 90 m/s by its positions, got 20000"),
    ({"type": "tram"}, r"type: expected one of car, truck, .*, got 'tram'"),
    ({"id": "b"}, r"id: expected every id once"),
]


@pytest.mark.parametrize(("changes", "message"), FAULTS)
def test_a_bad_road_user_costs_itself_alone(changes, message):
    recording = recording_of(changed(**changes))
    assert len(recording.users) == 4
    assert re.search(rf"1 of 5 road users left out \(\w+ 1\), such as road user [ab]: .*{message}", recording.account)
    with pytest.raises(InputError, match=message) as error:
        recording_of(changed(everybody=True, **changes))
    assert "\n" not in str(error.value)


def test_what_can_be_put_right_is_put_right():
    """A size a little too large is clipped, a sample without a position is left out, headings count modulo a turn."""
    data = street()
    data["road_users"][2] |= {"type": "bus", "length_m": 3.9, "height_m": 3.0}
    data["road_users"][0]["x_m"][3] = math.nan
    data["road_users"][1]["yaw_rad"] = [4.0 * math.pi] * 5 + [-8.0 * math.pi] * 4
    recording = recording_of(data)
    a, b, c, *_ = recording.users
    assert c.size_m == (4.0, 2.4, 3.0)
    assert recording.account == "1 sizes clipped"
    assert a.step.tolist() == [0, 1, 2, 4, 5, 6, 7, 8]
    [state] = [each for each in recording.states_at(0) if each.user is b]
    assert np.cos(state.yaw_rad) == pytest.approx(1.0)


def test_without_lanes_the_road_follows_the_tracks():
    lanelets = recording_of(street(lanelets=[])).lanelets
    # the lorry comes towards cars a and b, of which one reaches farther; the cyclist gives none
    assert len(lanelets) == 3
    for lanelet, y in zip(lanelets, (1.75, -1.75, -1.75), strict=True):
        assert np.linalg.norm(lanelet.left_m - lanelet.right_m, axis=1) == pytest.approx(5.0)
        assert 0.5 * (lanelet.left_m + lanelet.right_m)[:, 1] == pytest.approx(y)
        assert np.ptp(lanelet.left_m[:, 0]) > 70.0


def test_of_two_that_overlap_the_smaller_or_rarer_is_left_out():
    users = [
        track("a", "car", (4.5, 1.8), (0.0, 0.0), 0.0, 5.0),
        track("b", "car", (4.2, 1.8), (4.0, 0.0), 0.0, 5.0),
        track("c", "car", (4.5, 1.8), (30.0, 0.0), 0.0, 5.0, steps=4),
        track("d", "car", (3.5, 1.6), (33.0, 0.0), 0.0, 5.0),
        track("e", "pedestrian", (0.5, 0.5), (33.0, 0.0), 0.0, 5.0),
        track("f", "truck", (6.0, 2.5), (60.0, 0.0), 0.0, 5.0),
        track("g", "truck", (12.0, 2.5), (52.0, 0.0), 0.0, 5.0),  # its trailer
    ]
    kept, left_out = without_overlaps(recording_of(street(users=users)).states_at(0), 0.3)
    assert "".join(state.user.user_id for state in kept) == "adfg"
    assert "".join(state.user.user_id for state in left_out) == "bce"


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
        (street(dt_s=0.0), r"dt_s: expected the time between two steps"),
        (street(dt_s=0.1), r"v_mps: expected the speeds by positions over dt_s 0.1, got 0.20 .*; dt_s 0.5 would fit"),
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
