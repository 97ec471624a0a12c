"""Moments: spaced, of fitting vehicles, the same for the same seed, and never of one recording in both parts."""

import numpy as np
import pytest

from tests.scene.traffic.recordings import STEP_S, street, track, write
from warpav.core.errors import InputError
from warpav.scene.traffic.files import content_digest, read_recording, shipped_recordings
from warpav.scene.traffic.moments import LENGTH_RATIO, MOVED_M, OVERLAP_MAX_M, SPACING_S, moments_of, traffic_of
from warpav.scene.traffic.recording import without_overlaps

CAR_M = np.array([[-1.0, -1.1, 0.0], [3.7, 1.1, 1.5]])
BUS_M = np.array([[-2.0, -1.3, 0.0], [7.0, 1.3, 3.1]])


def test_moments_are_spaced_and_of_vehicles_about_as_large(tmp_path):
    file = write(tmp_path, street())
    moments = moments_of([file], CAR_M)
    assert {moment.ego_id for moment in moments} == {"a", "b"}
    steps = sorted({moment.step for moment in moments})
    assert min(np.diff(steps)) * STEP_S >= SPACING_S
    assert steps == [0, 2, 4, 6, 8]
    assert {moment.ego_id for moment in moments_of([file], BUS_M)} == {"c"}


def test_moments_of_shipped_recordings_keep_what_they_promise():
    files = shipped_recordings()[:3]
    moments = moments_of(files, CAR_M)
    place = {}
    for moment in sorted(moments, key=lambda each: (each.file, each.ego_id, each.step)):
        states, _ = without_overlaps(read_recording(moment.file).states_at(moment.step), OVERLAP_MAX_M)
        states = {state.user.user_id: state for state in states}
        own = states[moment.ego_id]
        assert LENGTH_RATIO[0] <= 4.7 / own.user.size_m[0] <= LENGTH_RATIO[1]
        key = (moment.file, moment.ego_id)
        if key in place:
            assert np.linalg.norm(own.centre_m - place[key]) >= MOVED_M
        place[key] = own.centre_m
    assert len(set(moments)) == len(moments)


def test_search_and_test_share_no_recording():
    traffic = traffic_of(None, None, CAR_M)
    search, test = ({content_digest(moment.file) for moment in part} for part in traffic)
    assert (len(search), len(test)) == (10, 5)
    assert not search & test
    # the test comes later
    assert max(moment.file.name for moment in traffic[0]) < min(moment.file.name for moment in traffic[1])


def overlapping(at_m):
    """A car, another in it, two cyclists, and a lorry somewhere; only cars are as large as the ego vehicle."""
    return street(
        users=[
            track("a", "car", (4.5, 1.8), (at_m, -1.75), 0.0, 5.0),
            track("b", "car", (4.2, 1.8), (at_m + 3.7, -1.75), 0.0, 5.0),
            track("c", "bicycle", (1.8, 0.6), (10.0, -3.2), 0.0, 5.0),
            track("d", "bicycle", (1.8, 0.6), (13.0, -3.2), 0.0, 5.0),
            track("e", "truck", (9.0, 2.5), (20.0, -1.75), 0.0, 5.0),
        ]
    )


def test_an_overlap_costs_the_moment_at_the_ego_vehicle_alone(tmp_path):
    data = overlapping(-20.0)
    data["road_users"].append(track("f", "car", (4.5, 1.8), (40.0, 1.75), np.pi, 5.0))
    said = []
    moments = moments_of([write(tmp_path, data)], CAR_M, say=said.append)
    assert {moment.ego_id for moment in moments} == {"f"}
    assert said == [
        f"{tmp_path / 'street.json'}: 1 of 6 road users left out where they overlap others by more than 0.3 m, and 5 "
        "moments with such an overlap at the ego vehicle"
    ]


@pytest.mark.parametrize(
    ("data", "bounds_m", "message"),
    [
        (
            overlapping(0.0),
            CAR_M,
            r"expected moments without boxes that overlap within 10 m of the ego vehicle, got none; 1 of 5 road users",
        ),
        (street(users=street()["road_users"][:1]), CAR_M, r"got none: they are empty"),
        (
            street(),
            np.array([[-6, -1.3, 0], [20, 1.3, 3]]),
            r"expected a road user about as large as the ego vehicle, 26",
        ),
    ],
)
def test_recordings_without_a_moment_say_why(tmp_path, data, bounds_m, message):
    file = write(tmp_path, data)
    with pytest.raises(InputError, match=message) as error:
        moments_of([file], bounds_m)
    assert str(error.value).startswith(str(file))
    assert "\n" not in str(error.value)
