"""The rigs that a descent may begin with."""

import itertools
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tests.driving_scene import roof
from warpav.optimisation import X_M, Y_M, YAW_RAD, CameraMount, Evaluation, SearchSpace, highest_mount_pose
from warpav.raster.camera import CameraModel
from warpav.thesis import BoundsAndSpacing, evaluate_starts
from warpav.thesis._starts import _HIGHEST_TURNS, _first_rigs, exchange_cameras

MOUNT = CameraMount(roof(), camera=CameraModel(64, 64, math.pi / 2), height_offset_m=0.25)
SPACE = SearchSpace.over(MOUNT, 3, constraints=BoundsAndSpacing(MOUNT.surface))


def test_the_highest_point_comes_first_and_all_turns_are_there():
    highest = highest_mount_pose(SPACE.constraints, 3)
    rigs = list(itertools.islice(_first_rigs(SPACE, np.random.default_rng(1)), _HIGHEST_TURNS))
    np.testing.assert_allclose(rigs[0], SPACE.feasible(highest))
    turns = [(np.degrees(rig[0, YAW_RAD] - highest[0, YAW_RAD]) + 1e-3) % 120.0 for rig in rigs]
    assert sorted(np.round(turns)) == [0.0, 30.0, 60.0, 90.0]
    assert round(turns[1]) == 60.0
    for rig in rigs:
        np.testing.assert_allclose(rig[:, [X_M, Y_M]], highest[:, [X_M, Y_M]], atol=1e-6)


def test_the_others_fill_the_space_and_are_feasible():
    rigs = list(itertools.islice(_first_rigs(SPACE, np.random.default_rng(1)), _HIGHEST_TURNS, _HIGHEST_TURNS + 64))
    assert all(SPACE.violation_m(rig) == 0.0 for rig in rigs)
    unit = np.array([SPACE.unit_of(rig) for rig in rigs])
    # of 64 points of a Sobol sequence 16 lie in each quarter; the spacing moves a few
    assert np.abs(np.histogram(unit[:, 2], 4, (0, 1))[0] - 16).max() <= 3
    again = list(itertools.islice(_first_rigs(SPACE, np.random.default_rng(1)), _HIGHEST_TURNS, _HIGHEST_TURNS + 64))
    np.testing.assert_array_equal(rigs, again)


class Chances:
    """An objective in which camera i finds object k the better the nearer it is to a place of its own.

    The places lie along the middle of the roof, so that the best rig has one camera at each.
    """

    def __init__(self, objects=3, knows=True):
        low_m, high_m = MOUNT.surface.bounds_m
        self.place_m = np.linspace(low_m, high_m, objects + 2)[1:-1]
        self.knows = knows
        self.looked = []

    def object_weight(self, scenes):
        return None

    def chance(self, mount_pose):
        away_m = np.linalg.norm(mount_pose[:, None, [X_M, Y_M]] - self.place_m, axis=-1)
        return np.exp(-((away_m / 0.5) ** 2))

    def evaluate(self, mount_pose, scenes, *, detection_probability):
        assert detection_probability
        assert scenes == ["a scene"]
        assert SPACE.violation_m(mount_pose) == 0.0
        self.looked.append(mount_pose)
        chance = self.chance(mount_pose)
        value = float(np.prod(1.0 - chance, axis=0).sum())
        return Evaluation(value, value, {}, None, None, {}, chance if self.knows else None)


def look(objective, count, seed=2, known=None):
    known = SPACE.random(np.random.default_rng(3)) if known is None else known
    return evaluate_starts(objective, ["a scene"], SPACE, count, np.random.default_rng(seed), known=known)


def test_all_are_looked_at_and_the_best_come_first():
    known = SPACE.random(np.random.default_rng(3))
    objective = Chances(knows=False)
    found = look(objective, 12, known=known)
    assert len(found) == len(objective.looked) == 12
    np.testing.assert_array_equal(objective.looked[0], SPACE.feasible(SPACE.in_order(known)))
    values = [each.value for each in found]
    assert values == sorted(values)
    assert any(found[0].mount_pose is pose for pose in objective.looked)
    [alone] = look(Chances(), 1, known=known)
    np.testing.assert_array_equal(alone.mount_pose, SPACE.feasible(SPACE.in_order(known)))


def test_cameras_of_several_rigs_make_a_better_one():
    better = []
    for seed in range(5):
        with_mixture, without = (look(Chances(knows=knows), 16, seed) for knows in (True, False))
        better.append(with_mixture[0].value < without[0].value)
        # every camera of the mixture was looked at before, but for what the constraints moved
        objective = Chances()
        look(objective, 16, seed)
        *others, mixture = objective.looked
        seen = np.concatenate(others)[:, None, [X_M, Y_M]]
        assert np.linalg.norm(seen - mixture[:, [X_M, Y_M]], axis=-1).min(axis=0).max() <= 0.2
    assert sum(better) >= 4


@given(
    st.integers(1, 3),
    hnp.arrays(np.float64, st.tuples(st.integers(3, 6), st.integers(1, 5)), elements=st.floats(0.0, 1.0)),
    st.randoms(use_true_random=False),
)
def test_no_exchange_of_a_camera_is_left_that_would_help(camera_count, chance, random):
    first = np.array(random.sample(range(len(chance)), camera_count))
    chosen = exchange_cameras(chance, first)

    def missed(cameras):
        return np.prod(1.0 - chance[cameras], axis=0).sum()

    assert missed(chosen) <= missed(first) + 1e-12
    for camera, candidate in itertools.product(range(camera_count), range(len(chance))):
        other = chosen.copy()
        other[camera] = candidate
        assert missed(chosen) <= missed(other) + 1e-8
