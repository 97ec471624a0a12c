"""What one more camera would bring: the objective's own difference, cameras that may join, the best of every place."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.optimisation.calls import draw
from tests.optimisation.test_polish import zone_of
from tests.optimisation.test_pool import cameras_of, mount_of, poses_of, streets
from warpav.detection import expected_miss_rate, further_gain, missed_probability
from warpav.optimisation import PITCH_RAD, YAW_RAD, FurtherCameras
from warpav.optimisation._further_camera import further_cameras


def cameras_at(position_m, gain):
    count = len(position_m)
    return FurtherCameras(
        np.asarray(position_m, float), np.zeros(count), np.zeros(count), np.full(count, 1.5), np.asarray(gain, float)
    )


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 6), st.integers(1, 30))
def test_the_gain_is_what_the_objective_falls_by(seed, rig_count, count, object_count):
    rng = np.random.default_rng(seed)
    # sure, blind and anything between
    found = np.round(rng.random((rig_count + count, object_count)) * 1.4 - 0.2, 2).clip(0.0, 1.0)
    rig, others = found[:rig_count], found[rig_count:]
    gain = further_gain(missed_probability(rig), others)
    for other, each in zip(others, gain, strict=True):
        expected = expected_miss_rate(rig) - expected_miss_rate(np.vstack([rig, other]))
        assert each == pytest.approx(expected, abs=1e-12)
        by_hand = 0.0
        for o in range(object_count):
            missed = 1.0
            for camera in rig:
                missed *= 1.0 - min(camera[o], 0.9999)
            by_hand += missed * min(other[o], 0.9999)
        assert each == pytest.approx(by_hand / object_count, abs=1e-12)


@pytest.fixture(scope="module")
def pool():
    return draw(poses_of(40), scenes=streets(), cameras=cameras_of())


@pytest.fixture(scope="module")
def further(pool):
    mount, twice = mount_of(), np.r_[np.arange(40), 5, 6]
    return further_cameras(
        pool.mount_pose[twice],
        pool.detection_probability[twice],
        np.array([3, 17]),
        mount=mount,
        constraints=zone_of(mount, 2),
    )


def test_a_rig_with_one_more_camera_is_rendered_to_the_same_gain(pool, further):
    """The best of them, placed and rendered again beside the rig."""
    mount, cameras = mount_of(), cameras_of()
    pose = pool.mount_pose[[3, 17]]
    position_m = mount.position_m(pool.mount_pose)
    for k in (0, 5, len(further) - 1):
        row = np.linalg.norm(position_m - further.position_m[k], axis=1).argmin()
        assert further.yaw_rad[k] == pytest.approx(pool.mount_pose[row, YAW_RAD])
        assert further.pitch_rad[k] == pytest.approx(pool.mount_pose[row, PITCH_RAD])
        rigs = (pose, np.vstack([pose, pool.mount_pose[row]]))
        before, after = (
            expected_miss_rate(np.hstack([cameras.detection_probability(rig, scene) for scene in streets()]))
            for rig in rigs
        )
        assert further.gain[k] == pytest.approx(before - after, abs=1e-6)
    assert further.gain[0] > 0.0


def test_only_cameras_that_may_join_are_left_the_best_first(pool, further):
    mount = mount_of()
    position_m = mount.position_m(pool.mount_pose)
    rig_m, spacing_m = position_m[[3, 17]], zone_of(mount, 2).min_spacing_m
    is_near = np.linalg.norm(position_m[:, None] - rig_m, axis=2).min(axis=1) < spacing_m
    assert is_near.sum() > 2  # the rig itself, and others
    assert len(further) == 40 - is_near.sum()  # none of them twice
    assert (np.diff(further.gain) <= 0.0).all()
    assert np.linalg.norm(further.position_m[:, None] - rig_m, axis=2).min() >= spacing_m


def test_the_best_of_every_place():
    found = cameras_at([[0.0, 0.0, 1.5], [0.15, 0.0, 1.5], [0.3, 0.0, 1.5], [0.0, 0.0, 1.5]], [0.4, 0.3, 0.2, 0.1])
    assert found.best_places(0.2).tolist() == [0, 2]
    assert found.best_places(0.1).tolist() == [0, 1, 2]  # two of them stand at one place
    assert found[found.best_places(0.2)].gain.tolist() == [0.4, 0.2]
    assert cameras_at(np.zeros((0, 3)), []).best_places().tolist() == []


def test_the_best_ten_are_told_in_numbers(rng):
    angles = rng.uniform(-1.5, 1.5, (3, 12))
    found = FurtherCameras(rng.uniform(-3.0, 3.0, (12, 3)), *angles, np.sort(rng.random(12))[::-1])
    ahead = Rotation.from_euler("ZY", angles[:2].T).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(found.direction, ahead, atol=1e-12)
    table = np.c_[100.0 * found.gain, found.position_m, np.degrees(angles.T)][:10]
    np.testing.assert_allclose([list(row.values()) for row in found.rows()], table)
    heading, *lines = str(found).splitlines()
    assert heading.split() == " ".join(found.rows()[0]).split()
    assert len({len(line) for line in (heading, *lines)}) == 1
    np.testing.assert_allclose([list(map(float, line.split())) for line in lines], table, atol=0.005)
    for value in table.ravel():
        assert f"<td>{value:.2f}</td>" in found._repr_html_()
    assert repr(found) == f"FurtherCameras(12, the best finds {100 * found.gain[0]:.2f} more of 100 objects)"
    assert repr(found[:0]) == "FurtherCameras(0)"
