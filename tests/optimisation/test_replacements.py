"""Replacements of single cameras: against rigs put together one by one."""

from types import SimpleNamespace

import numpy as np
import pytest

from warpav.detection import expected_miss_rate
from warpav.optimisation._replacements import Replacements

UNIT = np.array([0.2, 0.2, 0.2, 0.0, 0.0, 0.0, 0.0])


def pool(seed=0, cameras=30, objects=12):
    rng = np.random.default_rng(seed)
    pose = np.zeros((cameras, 7))
    pose[:, :3] = rng.uniform(-1.0, 1.0, (cameras, 3))
    return pose, rng.uniform(0.0, 1.0, (cameras, objects))


def replacements(pose, probability, rig, too_near=(), held=0):
    is_apart = np.ones((len(pose), len(rig)), bool)
    for camera, member in too_near:
        is_apart[camera, member] = False
    cameras, fits = SimpleNamespace(mount_pose=pose, detection_probability=probability), np.ones_like(is_apart)
    return Replacements(cameras, np.asarray(rig[:held], int), np.asarray(rig[held:]), is_apart, fits, unit=UNIT)


@pytest.mark.parametrize("held", [0, 1])
def test_every_replacement_is_a_rig_put_together(held):
    pose, probability = pool()
    rig = [3, 8, 21]
    found = replacements(pose, probability, rig, held=held)
    assert found.miss_rate.shape == (30, 3 - held)
    for camera, slot in np.ndindex(found.miss_rate.shape):
        other = list(rig)
        other[held + slot] = camera
        assert found.miss_rate[camera, slot] == pytest.approx(expected_miss_rate(probability[other]), abs=1e-12)


def test_whoever_is_too_near_to_those_that_stay_is_no_replacement():
    pose, probability = pool()
    found = replacements(pose, probability, [3, 8, 21], too_near=[(5, 0)])
    assert np.isinf(found.miss_rate[5]).tolist() == [False, True, True]
    assert np.isfinite(found.miss_rate[6]).all()


def test_starts_are_apart_from_each_other_the_rig_and_known_places():
    pose, probability = pool(cameras=300)
    found = replacements(pose, probability, [3, 8])
    starts = found.starts(10, pose[[40]])
    places = np.concatenate([pose[[3, 8, 40]], pose[[camera for camera, _ in starts]]])[:, :3]
    apart = np.abs(places[:, None] - places[None])
    apart[..., 2] = np.abs((places[:, None, 2] - places[None, :, 2] + np.pi) % (2 * np.pi) - np.pi)
    assert (apart.max(axis=2) / 0.2)[~np.eye(len(places), dtype=bool)].min() >= 1.0
    value = [found.miss_rate[camera, slot] for camera, slot in starts]
    assert len(starts) == 10
    assert value == sorted(value)
    assert value == [found.miss_rate[camera].min() for camera, _ in starts]


def test_places_nearby_follow_the_valley():
    """One object, whose probability falls away from the line x = y: the best nearby lie along it, and so do samples."""
    rng = np.random.default_rng(1)
    pose = np.zeros((400, 7))
    pose[1:, :3] = rng.uniform(-0.1, 0.1, (399, 3))
    probability = np.exp(-200.0 * np.abs(pose[:, 0] - pose[:, 1]) - 200.0 * np.abs(pose[:, 2]))[:, None]
    near = replacements(pose, probability, [0]).near(0.4, 2000, rng)
    assert near.shape == (2000, 7)
    assert (near[:, 3:] == 0.0).all()
    assert np.abs(near[:, :3]).max() <= 2.0 * 0.4 * 0.2
    along, across = (near[:, 0] + near[:, 1]).std(), (near[:, 0] - near[:, 1]).std()
    assert along > 3.0 * across


def test_where_few_are_nearby_samples_fill_the_radius():
    pose, probability = pool(cameras=5)
    near = replacements(pose, probability, [0]).near(0.1, 1000, np.random.default_rng(2))
    spread = (near - pose[0])[:, :3].std(axis=0) / 0.2
    assert (spread > 0.05).all()
    assert (spread < 0.2).all()
