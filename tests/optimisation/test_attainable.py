"""Which objects can be found from somewhere on the mount, and what recalls are of them alone."""

import numpy as np
import pytest

from tests.driving_scene import SKY, ConstantDetector, block, car, vehicle
from tests.optimisation.evaluation.test_camera_outage import objective_of
from tests.optimisation.evaluation.test_metrics import SCENES as PLACES
from tests.optimisation.evaluation.test_metrics import ScriptedDetector, answers, rig_of, scene_of
from tests.raster.test_renderer import FAR_AWAY
from warpav.detection import ROAD_USERS
from warpav.optimisation import AssignedScene, attainable_objects, metrics_of, observe_scenes, paired_differences
from warpav.optimisation._pool import spread_mount_poses
from warpav.scene import DeviceScene, Scene

IN_THE_OPEN, BEHIND_A_WALL = (9.0, 0.0, 0.4), (-15.0, 0.0, 1.2)


def street(*places):
    """Cars at some places around the vehicle, and a wall across the street behind it."""
    rng = np.random.default_rng(1)
    wall = block(rng, [0.3, 40.0, 8.0], [-9.0, 0.0, 4.0], subdivide=2)
    users = tuple(vehicle(k + 1, car(rng, subdivisions=2), *place) for k, place in enumerate(places))
    scene = Scene("street", wall, FAR_AWAY, users, SKY).targeting(ROAD_USERS)
    return AssignedScene(DeviceScene.pack(scene), np.full(len(places), -1, np.int32))


def test_what_stands_behind_a_wall_is_not_attainable():
    [found] = attainable_objects(objective_of(), [street(IN_THE_OPEN, BEHIND_A_WALL)])
    assert found.tolist() == [True, False]


def test_no_other_cameras_find_what_is_not_attainable():
    """And those that are looked through find what is: by ten times as many cameras of another sequence."""
    objective = objective_of()
    scenes = [AssignedScene(place(), np.full(3, -1, np.int32)) for place in PLACES]
    found = attainable_objects(objective, scenes)
    single, constraints = objective.single_cameras, objective.constraints
    others = spread_mount_poses(single.mount, constraints, 1280, seed=7)
    for flags, assigned in zip(found, scenes, strict=True):
        best = single.detection_probability(others, assigned.scene).max(axis=0)
        assert flags[best > 0.5 + 0.1].all()
        assert not flags[best < 0.5 - 0.1].any()


def test_misses_of_the_attainable():
    scenes = [AssignedScene(place(), np.full(3, -1, np.int32)) for place in PLACES[:2]]
    scenes.append(AssignedScene(scene_of(), np.zeros(0, np.int32)))
    rig = rig_of()
    calls = [ConstantDetector(*answer) for answer in answers(rig, scenes[:2])] + [ConstantDetector.silent(2)]
    objective = objective_of(ScriptedDetector(calls))
    seen = observe_scenes(rig, scenes, objective)
    detected = [each.detected for each in seen.observations]
    assert 0 < np.concatenate(detected).sum() < 6
    attainable = [np.array([True, False, True]), np.zeros(3, bool), np.zeros(0, bool)]
    found, plain = metrics_of(seen, objective, attainable=attainable), metrics_of(seen, objective)
    by_hand = (int(detected[0][0]) + int(detected[0][2])) / 2
    assert found.attainable_rate == pytest.approx(2 / 6)
    assert found.attainable_misses_per_100 == pytest.approx(100 * (1 - by_hand))
    assert found.per_scene["attainable_misses_per_100"] == [pytest.approx(100 * (1 - by_hand)), None, None]
    more = {"attainable_rate", "attainable_misses_per_100"}
    assert set(found.to_json()) - set(plain.to_json()) == more
    assert {
        name: value for name, value in found.to_json().items() if name in plain.to_json() and name != "per_scene"
    } == {name: value for name, value in plain.to_json().items() if name != "per_scene"}
    assert "attainable_misses_per_100" in paired_differences(found, found)
    assert "attainable_misses_per_100" not in paired_differences(found, plain)
