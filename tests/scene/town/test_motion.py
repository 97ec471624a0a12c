"""How fast everybody in the town moves."""

import itertools

import numpy as np
import pytest

from tests.scene.town.test_town import _rectangle, _rectangles_overlap
from warpav.scene.town.lanes import HEADWAY_S, STREET_KM_H, stop_lines, velocities_m_s
from warpav.scene.town.street_life import RoadUser
from warpav.scene.town.town import town_scene
from warpav.scene.town.town_layout import Footprint, Layout, Slot

STREET = Layout("avenue", ((-64.0, -7.0, 64.0, 7.0),), (), (), (), Slot(0.0, -2.0, 0.0, 5.0, parked=False))
JUNCTION = Layout(
    "crossroads", ((-64.0, -4.0, 64.0, 4.0), (5.0, 4.0, 12.0, 48.0)), (), (), (),
    Slot(0.0, -2.0, 0.0, 5.0, parked=False),
)  # fmt: skip
FREE_M_S = np.array(STREET_KM_H) / 3.6


def car(x_m, y_m, heading_rad=0.0, category="saloon", *, parked=False):
    place = Footprint(x_m, y_m, heading_rad, 4.0, 2.0)
    return RoadUser(category=category, footprint=place, heading_rad=None if parked else heading_rad)


def speeds(users, layout=STREET, obstacles=(), seed=0):
    return velocities_m_s(users, [*obstacles, *stop_lines(layout)], np.random.default_rng(seed))


def test_a_free_driver_follows_its_lane_at_the_speed_of_a_street():
    for seed in range(50):
        ahead, left, parked, oncoming = speeds(
            [car(0.0, -2.0), car(0.0, 20.0, 0.5 * np.pi), car(9.0, -5.0, parked=True), car(30.0, 2.0, np.pi)], seed=seed
        )
        for velocity, direction in ((ahead, [1, 0]), (left, [0, 1]), (oncoming, [-1, 0])):
            assert FREE_M_S[0] <= velocity @ direction <= FREE_M_S[1]
            assert np.linalg.norm(velocity) == pytest.approx(velocity @ direction, rel=1e-12)
        assert parked.tolist() == [0.0, 0.0]


def test_what_is_ahead_in_the_lane_slows_a_driver_down():
    behind, front, beside = speeds([car(0.0, 0.0), car(7.0, 0.5), car(5.0, 3.0)])
    assert behind.tolist() == [pytest.approx(3.0 / HEADWAY_S), 0.0]  # 3 m between the bumpers
    assert min(front[0], beside[0]) >= FREE_M_S[0]
    [before_works] = speeds([car(0.0, 0.0)], obstacles=[Footprint(5.0, 0.0, 0.0, 3.0, 2.0)])
    assert before_works[0] == pytest.approx(1.5 / HEADWAY_S)
    bicycle, person = speeds([car(0.0, 0.0, 0.0, "cyclist"), car(5.0, 0.0, np.pi, "pedestrian")])
    assert bicycle[0] == pytest.approx(1.0 / HEADWAY_S)
    assert 1.1 <= -person[0] <= 1.7  # people on foot heed nobody


def test_who_comes_to_a_street_with_priority_slows_down_and_who_leaves_it_does_not():
    coming, leaving = speeds([car(7.0, 20.0, -0.5 * np.pi), car(10.0, 20.0, 0.5 * np.pi)], JUNCTION)
    assert FREE_M_S[0] <= -coming[1] <= (18.0 - 5.3) / HEADWAY_S
    [waiting] = speeds([car(7.0, 8.3, -0.5 * np.pi)], JUNCTION)  # the line lies 1.1 m outside, .4 m wide
    assert waiting[1] == pytest.approx(-(6.3 - 5.3) / HEADWAY_S)
    assert leaving[1] >= FREE_M_S[0]


@pytest.mark.parametrize(("seeds", "met_min"), [(range(8), 2), pytest.param(range(20), 5, marks=pytest.mark.nightly)])
def test_in_the_town_nobody_drives_into_who_is_ahead_within_the_headway(seeds, met_min):
    met = 0
    for scene in map(town_scene, seeds):
        low_m, high_m = scene.ego.bounds_m()[:, :2].astype(float)
        met += sum(np.isfinite(one.box.time_to_meet_s(low_m, high_m, one.velocity_ego_m_s)) for one in scene.road_users)
        later = [
            (one.box.yaw_rad, _rectangle(one.box.center_m[:2] + 0.99 * HEADWAY_S * one.velocity_ego_m_s,
                                         one.box.size_m, one.box.yaw_rad))
            for one in scene.vehicles
        ]  # fmt: skip
        for (yaw_rad, one), (other_rad, other) in itertools.combinations(later, 2):
            if np.cos(yaw_rad - other_rad) > 0.99:
                assert not _rectangles_overlap(one, other), scene.name
        fastest_m_s = max(np.abs(one.velocity_ego_m_s).max() for one in scene.road_users)
        assert fastest_m_s <= 2.0 * FREE_M_S[1]
    assert met >= met_min
