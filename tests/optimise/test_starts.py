"""The rigs that a descent may begin with."""

import itertools
import math

import numpy as np
import pytest

from tests.driving_scene import roof
from warpav.objective.constraints import BoundsAndSpacing
from warpav.objective.mount import X_M, Y_M, YAW_RAD, CameraMount
from warpav.optimise.baselines import highest_mount_pose
from warpav.optimise.search import BudgetedValue, BudgetSpentError, SearchSpace
from warpav.optimise.starts import HIGHEST_TURNS, best_start, first_rigs
from warpav.rig.camera import CameraModel

MOUNT = CameraMount(roof(), camera=CameraModel(64, 64, math.pi / 2), height_offset_m=0.25)
SPACE = SearchSpace.over(MOUNT, 3, constraints=BoundsAndSpacing(MOUNT.surface))


def budget(value, renders=100):
    return BudgetedValue(value, SPACE, renders_per_value=1, render_budget=renders)


def test_the_highest_point_comes_first_and_all_turns_are_there():
    highest = highest_mount_pose(SPACE.constraints, 3)
    rigs = list(itertools.islice(first_rigs(SPACE, np.random.default_rng(1)), HIGHEST_TURNS))
    np.testing.assert_allclose(rigs[0], SPACE.feasible(highest))
    turns = [(np.degrees(rig[0, YAW_RAD] - highest[0, YAW_RAD]) + 1e-3) % 120.0 for rig in rigs]
    assert sorted(np.round(turns)) == [0.0, 30.0, 60.0, 90.0]
    assert round(turns[1]) == 60.0
    for rig in rigs:
        np.testing.assert_allclose(rig[:, [X_M, Y_M]], highest[:, [X_M, Y_M]], atol=1e-6)


def test_the_others_fill_the_space_and_are_feasible():
    rigs = list(itertools.islice(first_rigs(SPACE, np.random.default_rng(1)), HIGHEST_TURNS, HIGHEST_TURNS + 64))
    assert all(SPACE.violation_m(rig) == 0.0 for rig in rigs)
    unit = np.array([SPACE.unit_of(rig) for rig in rigs])
    # of 64 points of a Sobol sequence 16 lie in each quarter; the spacing moves a few
    assert np.abs(np.histogram(unit[:, 2], 4, (0, 1))[0] - 16).max() <= 3
    again = list(itertools.islice(first_rigs(SPACE, np.random.default_rng(1)), HIGHEST_TURNS, HIGHEST_TURNS + 64))
    np.testing.assert_array_equal(rigs, again)


def test_the_best_is_found_and_paid_for():
    known = SPACE.random(np.random.default_rng(3))
    looked = []

    def value(pose):
        looked.append(pose)
        return float(pose[0, X_M])

    money = budget(value)
    best = best_start(money, 12, np.random.default_rng(2), known=known)
    assert len(looked) == money.renders == 12
    np.testing.assert_array_equal(looked[0], SPACE.feasible(known))
    assert best[0, X_M] == min(pose[0, X_M] for pose in looked)
    alone = best_start(budget(value), 1, np.random.default_rng(2), known=known)
    np.testing.assert_array_equal(alone, SPACE.feasible(known))


def test_what_cannot_be_paid_or_compared_is_refused():
    known = SPACE.random(np.random.default_rng(3))
    with pytest.raises(BudgetSpentError):
        best_start(budget(lambda pose: 1.0, renders=5), 6, np.random.default_rng(2), known=known)
    with pytest.raises(ValueError, match="none of 4 rigs had a finite value"):
        best_start(budget(lambda pose: math.nan), 4, np.random.default_rng(2), known=known)
