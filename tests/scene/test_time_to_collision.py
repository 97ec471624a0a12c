"""When boxes meet the ego vehicle: closed forms, stepping through time, and the way of velocities through scenes."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.scene.town.test_town import _rectangle, _rectangles_overlap
from tests.view.stand_ins import scene, vehicle
from warpav.scene import Box, DeviceScene, SceneRecipe, StoredScene, TownSource, read_scene, town_scene, write_scene
from warpav.scene._cache import built_scenes

LOW_M, HIGH_M = np.array([-1.0, -1.0]), np.array([3.0, 1.0])


def box_at(x_m, y_m, yaw_rad=0.0, size_m=(4.0, 2.0, 1.5)):
    return Box(np.array([x_m, y_m, 0.75]), np.array(size_m), yaw_rad)


@pytest.mark.parametrize(
    ("box", "velocity_m_s", "expected_s"),
    [
        (box_at(15.0, 0.0), (-5.0, 0.0), 2.0),  # 10 m between the bumpers
        (box_at(-13.0, 0.0), (2.0, 0.0), 5.0),  # from behind
        (box_at(15.0, 0.0), (5.0, 0.0), math.inf),  # it leaves
        (box_at(15.0, 0.0), (0.0, 0.0), math.inf),  # it keeps its distance
        (box_at(2.0, 0.5), (0.0, 0.0), 0.0),  # they overlap
        (box_at(2.0, 0.5), (50.0, 0.0), 0.0),
        (box_at(15.0, 2.5), (-5.0, 0.0), math.inf),  # the next lane, half a metre between them
        (box_at(15.0, 2.0), (-5.0, 0.0), math.inf),  # they would slide along each other
        (box_at(15.0, 2.5), (-5.0, -0.25), 2.0),  # it drifts by half a metre in the 2 s until the bumpers are level
        (box_at(15.0, 2.5), (-5.0, -0.2), 2.5),  # it drifts over later, and hits the side
        (box_at(15.0, 2.5), (-5.0, -0.1), math.inf),  # past after 3.6 s, when it has drifted by .36 m
        (box_at(1.0, 11.0, math.pi / 2), (0.0, -4.0), 2.0),  # crossing, half its length ahead of its centre
        (box_at(1.0, 1.0 + math.sqrt(2.0) + 6.0, math.pi / 4, (2.0, 2.0, 1.5)), (0.0, -3.0), 2.0),  # corner first
    ],
)
def test_closed_forms(box, velocity_m_s, expected_s):
    found = box.time_to_meet_s(LOW_M, HIGH_M, np.array(velocity_m_s))
    assert found == pytest.approx(expected_s, abs=1e-9)
    mirrored = box.mirrored().time_to_meet_s(LOW_M, HIGH_M, np.array(velocity_m_s) * [1.0, -1.0])
    assert mirrored == pytest.approx(expected_s, abs=1e-9)


place_m, length_m = st.floats(-30.0, 30.0), st.floats(0.3, 12.0)


@given(place_m, place_m, st.floats(-math.pi, math.pi), length_m, length_m, st.floats(-20.0, 20.0), st.floats(-20, 20))
def test_stepping_through_time(x_m, y_m, yaw_rad, along_m, across_m, forward_m_s, left_m_s):
    box, velocity = box_at(x_m, y_m, yaw_rad, (along_m, across_m, 1.0)), np.array([forward_m_s, left_m_s])
    ego = _rectangle(0.5 * (LOW_M + HIGH_M), HIGH_M - LOW_M, 0.0)
    found = box.time_to_meet_s(LOW_M, HIGH_M, velocity)

    def overlap(time_s, grown_m=0.0):
        outline = _rectangle(box.center_m[:2] + time_s * velocity, box.size_m + grown_m, yaw_rad)
        return _rectangles_overlap(outline, ego)

    assert not any(overlap(time_s, -1e-6) for time_s in np.arange(0.0, 10.0, 0.02) if time_s < found)
    if found < 1e6:
        assert found >= 0.0
        assert overlap(found, 1e-6 * (1.0 + found))


def moving(user, *velocity_m_s):
    return dataclasses.replace(user, velocity_ego_m_s=np.array(velocity_m_s))


def test_packed_scenes_know_the_time_and_what_is_unknown(tmp_path):
    ahead, unknown = moving(vehicle(1, 15.0, 0.0), -5.0, 0.0), vehicle(3, -20.0, 0.0)
    parked = moving(vehicle(2, 9.0, 4.0), -8.0, 0.0)
    street = scene(ahead, parked, unknown)
    bumper_m = ahead.box.center_m[0] - 0.5 * ahead.box.size_m[0] - street.ego.bounds_m()[1, 0]
    packed = DeviceScene.pack(street)
    np.testing.assert_allclose(packed.time_to_collision_s, [bumper_m / 5.0, np.inf, np.nan], rtol=1e-6)
    again = DeviceScene.of_arrays(packed.arrays())
    np.testing.assert_array_equal(again.time_to_collision_s, packed.time_to_collision_s)
    write_scene(street, tmp_path / "scene_1.glb")
    stored = StoredScene(SceneRecipe(tmp_path / "scene_1.glb"), tmp_path, "cpu")
    np.testing.assert_array_equal(stored.time_to_collision_s, packed.time_to_collision_s)
    # what can be seen is the same, so what was computed of the images stays
    plain = scene(*(dataclasses.replace(user, velocity_ego_m_s=None) for user in street.vehicles))
    assert DeviceScene.pack(plain).fingerprint == packed.fingerprint
    assert DeviceScene.pack(scene()).time_to_collision_s.shape == (0,)


def velocities(street):
    return [None if each.velocity_ego_m_s is None else each.velocity_ego_m_s.tolist() for each in street.road_users]


def test_velocities_go_wherever_scenes_go(tmp_path):
    street = scene(moving(vehicle(1, 15.0, 0.0), -5.25, 0.5), vehicle(2, 9.0, 4.0))
    assert velocities(street.mirrored()) == [[-5.25, -0.5], None]
    assert velocities(street.mirrored().mirrored()) == velocities(street)
    assert velocities(street.targeting(["pedestrian"])) == velocities(street)
    assert velocities(street.around(street.ego)) == velocities(street)
    assert velocities(street.to_pyvista().warpav.as_scene()) == velocities(street)
    write_scene(street, tmp_path / "scene.glb")
    assert velocities(read_scene(tmp_path / "scene.glb")) == velocities(street)
    write_scene(scene(vehicle(1, 9.0, 0.0)), tmp_path / "old.glb")  # as files were before velocities
    assert b"velocity" not in (tmp_path / "old.glb").read_bytes()
    town = town_scene(2)
    for _ in range(2):  # built, then read
        [cached] = built_scenes([TownSource(2)], folder=tmp_path)
        assert velocities(cached) == velocities(town)
