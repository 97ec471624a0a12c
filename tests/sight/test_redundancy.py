"""Redundancy, against every outcome that cameras can have."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest

from warpav.sight import redundancy
from warpav.sight._sight import probability_of_at_least


@pytest.mark.parametrize("cameras", [0, 1, 2, 3, 5])
def test_the_probability_is_that_of_all_outcomes(rng, cameras):
    probability = rng.uniform(0.0, 1.0, (4, 3))
    expected = np.zeros(3)
    for outcome in itertools.product([False, True], repeat=4):
        if sum(outcome) >= cameras:
            expected += np.prod(np.where(np.array(outcome)[:, None], probability, 1.0 - probability), axis=0)
    np.testing.assert_allclose(probability_of_at_least(cameras, probability), expected, atol=1e-12)


def scene(*from_ego_m):
    return SimpleNamespace(name="s", vehicle_count=len(from_ego_m), from_ego_m=np.array(from_ego_m).reshape(-1, 2))


def test_only_road_users_within_the_radius_count():
    scenes = [scene((3.0, 4.0), (30.0, 0.0), (0.0, -10.0)), scene((8.0, 0.0))]
    seen = [np.array([[1, 1, 0], [1, 1, 1]], bool), np.array([[1], [1]], bool)]
    one, two = (redundancy(seen, scenes, radius_m=10.0, cameras=k) for k in (1, 2))
    assert (one.objects, one.share) == (3, 1.0)
    assert (two.objects, two.share) == (3, pytest.approx(2.0 / 3.0))
    assert redundancy(seen, scenes, radius_m=1.0, cameras=1).share is None
    likely = [np.full((2, 3), 0.5), np.full((2, 1), 0.5)]
    assert redundancy(likely, scenes, radius_m=math.inf, cameras=2).share == pytest.approx(0.25)


def test_wrong_numbers_are_rejected():
    with pytest.raises(ValueError, match="radius_m must be positive"):
        redundancy([], [], radius_m=0.0, cameras=1)
    with pytest.raises(ValueError, match=r"expected \[camera, 1\], got \(2, 2\)"):
        redundancy([np.ones((2, 2))], [scene((1.0, 0.0))], radius_m=5.0, cameras=1)
