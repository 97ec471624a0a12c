"""Requirements as a scene of a search: probabilities, Jacobians, hard rows, rigs that keep them."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from tests.driving_scene import street
from tests.optimisation.calls import pool_search
from tests.optimisation.test_modules import MODULES, columns, symmetric_cameras, symmetric_mount
from tests.optimisation.test_pool import cameras_of, streets
from tests.optimisation.test_zones import MODEL, chart, constraints_of, mount_of, spread
from warpav.core.errors import InputError
from warpav.optimisation import HEIGHT_DELTA_M, PITCH_RAD, X_M, Y_M, YAW_RAD, PoolSearchSettings, RequiredPoints
from warpav.optimisation._mount import ROLL_RAD
from warpav.optimisation._required_points import _HARD_WEIGHT, MET
from warpav.sight import Requirement, check_requirements, read_requirements
from warpav.sight._requirement import Band

SMALL = PoolSearchSettings(pool_cameras=40, rounds=1, priced_cameras=3, gap=0.0)


@functools.cache
def scene(weight=None, share=0.5, far_m=4.0, cameras=1, pixels=0.0):
    post = read_requirements("near_field")[0].test_object
    near = Requirement("near", Band((0.5, far_m)), 1.0, post, share, pixels, cameras, weight=weight)
    return RequiredPoints([near], street().ego)


def test_points_count_by_how_near_cameras_come_to_meeting_them():
    cameras, pose = cameras_of(mount=mount_of()), spread()[:40]
    found = cameras.detection_probability(pose, scene())
    rig = mount_of().rig(pose)
    seen = check_requirements(rig, street().ego, scene().requirements)
    np.testing.assert_array_equal(found >= MET - 1e-4, seen.meets)
    assert 0.0 < seen.meets.mean() < 1.0
    closeness = seen.visibility.closeness(seen.ghosts)
    np.testing.assert_allclose(found[~seen.meets], 0.9 * closeness[~seen.meets], atol=1e-4)
    assert scene().weight.sum() == pytest.approx(_HARD_WEIGHT)
    assert scene(weight=0.3).weight.sum() == pytest.approx(0.3)


def test_the_jacobian_agrees_with_differences():
    cameras = cameras_of(mount=mount_of(model=MODEL.resized(640, 640)))  # as wide as they are drawn: less rough
    pose = spread()[:8].astype(np.float64)
    ghosts = scene(share=0.97)
    found, jacobian = cameras.with_jacobian(pose, [ghosts])
    np.testing.assert_allclose(found, cameras.detection_probability(pose, ghosts), atol=1e-3)
    size = 0.02
    for column in (X_M, Y_M, HEIGHT_DELTA_M, YAW_RAD, PITCH_RAD, ROLL_RAD):
        ends = [cameras.detection_probability(pose + side * size * np.eye(7)[column], ghosts) for side in (1.0, -1.0)]
        slope = (ends[0] - ends[1]) / (2.0 * size)
        smooth = (np.abs(slope) < 10.0) & (found > 0.0) & (np.max([found, *ends], axis=0) < 0.89)
        one, other = slope[smooth], jacobian[..., column][smooth]
        assert smooth.sum() > 40
        assert one @ other / (np.linalg.norm(one) * np.linalg.norm(other)) > 0.95, column


def test_scenes_and_points_stand_side_by_side():
    cameras, pose = cameras_of(mount=mount_of()), spread()[:5]
    traffic = [each for each in streets() if each.vehicle_count]
    alone, slope = cameras.with_jacobian(pose, traffic)
    both, both_slope = cameras.with_jacobian(pose, [*traffic, scene()])
    np.testing.assert_array_equal(both[:, : alone.shape[1]], alone)
    np.testing.assert_array_equal(both_slope[:, : alone.shape[1]], slope)
    assert both.shape[1] == alone.shape[1] + scene().vehicle_count


def test_a_pair_meets_what_one_of_its_cameras_meets():
    mount, cameras = symmetric_mount(), symmetric_cameras()
    pose = columns()[mount.is_pair(columns())][:6]
    found = cameras.detection_probability(pose, scene()) >= MET - 1e-4
    rig, row = mount.rig(pose), mount.rows_of_cameras(pose)
    meets = check_requirements(rig, street().ego, scene().requirements).meets
    expected = np.array([meets[row == number].any(axis=0) for number in range(len(pose))])
    assert (found == expected).mean() > 0.995  # a hair's breadth from what is asked
    assert len(MODULES) == 3


@functools.cache
def last_without_requirements():
    settings = replace(SMALL, pool_cameras=100)
    return list(pool_search(cameras_of(mount=mount_of()), streets(), constraints_of(6), 6, settings=settings))[-1]


@pytest.mark.parametrize(("weight", "rounds"), [(None, 1), (1.0, 0)])
def test_a_search_keeps_hard_requirements_and_follows_weighted_ones(weight, rounds):
    ghosts = scene(weight, share=0.1, far_m=1.6)
    cameras, constraints = cameras_of(mount=mount_of()), constraints_of(6)
    settings = replace(SMALL, pool_cameras=100, rounds=rounds)
    states = list(pool_search(cameras, streets(), constraints, 6, settings=settings, requirements=ghosts))
    shares = []
    for state in (states[-1], last_without_requirements()):
        result = check_requirements(mount_of().rig(state.mount_pose), street().ego, ghosts.requirements)
        shares.append(result.outcomes[0].share)
    assert shares[0] > shares[1]
    if weight is None:
        assert shares[0] == 1.0
    values = [state.objective for state in states]
    assert values == sorted(values, reverse=True)
    assert chart().zones


def test_what_no_camera_of_the_pool_can_meet_is_named():
    ghosts = scene(share=0.5, far_m=4.0, pixels=1e7)
    with pytest.raises(InputError, match=r"^requirement near: \d+ points that the pool cannot meet, such as \("):
        next(
            pool_search(
                cameras_of(mount=mount_of()), streets(), constraints_of(3), 3, settings=SMALL, requirements=ghosts
            )
        )
