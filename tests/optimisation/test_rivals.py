"""Searches on functions with a known minimum: within budget, feasible, repeatable, and better than chance."""

import functools
import importlib.util
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.driving_scene import roof
from tests.thesis.test_descent import street_objective, street_scenes
from warpav.core.errors import InputError
from warpav.optimisation import (
    X_M,
    Y_M,
    YAW_RAD,
    BudgetedValue,
    CameraMount,
    SearchSpace,
    cma_es,
    detections_of,
    greedy_cover,
    highest_mount_pose,
    random_search,
    run_search,
    sobol_search,
)
from warpav.optimisation._budget import SearchRecord
from warpav.raster.camera import CameraModel
from warpav.thesis import BoundsAndSpacing

SPACING_M = 0.2
MOUNT = CameraMount(roof(), camera=CameraModel(64, 64, math.pi / 2), height_offset_m=0.25)
CONSTRAINTS = BoundsAndSpacing(MOUNT.surface, min_spacing_m=SPACING_M)
needs_cma = pytest.mark.skipif(importlib.util.find_spec("cma") is None, reason="no cma")
SEARCHES = [
    pytest.param(random_search, id="random"),
    pytest.param(sobol_search, id="sobol"),
    pytest.param(cma_es, id="cma", marks=needs_cma),
]


def space_of(camera_count, **options):
    return SearchSpace.over(MOUNT, camera_count, constraints=CONSTRAINTS, **options)


def bowl(camera_count):
    """A quadratic with its minimum of 0 inside the space: places 0.3 m and more apart, yaws all round."""
    place = np.array([[0.4, -0.35], [1.7, 0.4], [1.1, 0.1]])[:camera_count]
    yaw = np.array([0.9, -2.4, 3.1])[:camera_count]

    def value(pose):
        turn = np.angle(np.exp(1j * (pose[:, YAW_RAD] - yaw)))
        return float(((pose[:, [X_M, Y_M]] - place) ** 2).sum() + 0.1 * (turn**2).sum())

    return value


def alone(value):
    """Values of rigs by a function of one rig."""
    return lambda rigs: map(value, rigs)


def search(method, camera_count=2, *, seed=0, renders=600, each=4, value=None, **options):
    budget = BudgetedValue(
        alone(value or bowl(camera_count)),
        space_of(camera_count, **options),
        scene_count=each,
        camera_renders_max=camera_count * renders,
    )
    return run_search(method, budget, np.random.default_rng(seed))


def detected_near(place):
    """Cameras surely see the objects towards which they look: objects stand at ``place``."""

    def detections(pose):
        towards = place[None, :, :] - pose[:, None, [X_M, Y_M]]
        bearing = np.arctan2(towards[..., 1], towards[..., 0]) - pose[:, None, YAW_RAD]
        return np.abs(np.angle(np.exp(1j * bearing))) < math.pi / 4

    return detections


RING = 8.0 * np.stack([np.cos(np.arange(12) * math.pi / 6), np.sin(np.arange(12) * math.pi / 6)], axis=1)
GREEDY = functools.partial(greedy_cover, detections=detected_near(RING))


@pytest.mark.parametrize("method", [*SEARCHES, pytest.param(GREEDY, id="greedy")])
@pytest.mark.parametrize("renders", [24, 163, 400])
def test_budget_is_kept_and_the_best_rig_is_feasible(method, renders):
    asked = []

    def value(pose):
        assert space_of(3).violation_m(pose) == 0.0
        asked.append(pose)
        return bowl(3)(pose)

    result = search(method, 3, renders=renders, each=4, value=value)
    assert result.error is None
    assert result.camera_renders <= 3 * renders
    if method is GREEDY:
        assert len(asked) == 1
        assert 3 * renders - result.camera_renders < 0.9 * renders + 48  # the grid's cells are nearly square
    else:
        assert 3 * renders - result.camera_renders < 12  # too little for a look
        assert result.camera_renders == 3 * 4 * len(asked)
    assert result.mount_pose.dtype == np.float32
    assert space_of(3).violation_m(result.mount_pose) == 0.0
    # what is claimed is the value of that very rig, and the least of all
    assert result.value == bowl(3)(result.mount_pose) == min(map(bowl(3), asked))
    best = [each.best_value for each in result.history]
    np.testing.assert_array_equal(best, np.minimum.accumulate(list(map(bowl(3), asked))))
    spent = [each.camera_renders for each in result.history]
    assert spent == sorted(set(spent))
    assert result.history[-1] == SearchRecord(result.camera_renders, result.value, 0.0)


@functools.cache
def chance(camera_count):
    return np.median([search(random_search, camera_count, seed=seed, renders=512, each=1).value for seed in range(7)])


@pytest.mark.parametrize("camera_count", [1, pytest.param(3, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(("method", "most"), [(sobol_search, 1.0), pytest.param(cma_es, 0.01, marks=needs_cma)])
def test_searches_beat_chance_on_a_bowl(method, most, camera_count):
    found = np.median([search(method, camera_count, seed=seed, renders=512, each=1).value for seed in range(7)])
    assert found <= most * chance(camera_count)


@pytest.mark.parametrize("method", SEARCHES)
@pytest.mark.parametrize("first_bad", [3, 30])
def test_a_search_that_fails_keeps_its_best(method, first_bad):
    calls = []

    def value(pose):
        calls.append(bowl(2)(pose))
        if len(calls) > first_bad:
            raise InputError("the detector is gone")
        return calls[-1]

    result = search(method, value=value)
    assert result.error == "InputError: the detector is gone"
    assert result.value == min(calls[:first_bad])
    assert result.camera_renders == 2 * 4 * len(calls)
    assert space_of(2).violation_m(result.mount_pose) == 0.0


@pytest.mark.parametrize("method", SEARCHES)
def test_values_that_are_not_finite_are_never_best(method):
    def value(pose):
        return [math.nan, math.inf, -math.inf][int(1e6 * pose[0, X_M]) % 3] if pose[0, X_M] < 1.0 else bowl(2)(pose)

    result = search(method, value=value)
    assert result.error is None
    assert math.isfinite(result.value)
    assert result.mount_pose[0, X_M] >= 1.0
    assert result.camera_renders == 1200


@needs_cma
def test_cma_starts_again_with_twice_as_many():
    counts = []

    def values(rigs):
        counts.append(len(rigs))
        return [1.0] * len(rigs)  # nothing to find: every start ends early

    budget = BudgetedValue(values, space_of(2), scene_count=1, camera_renders_max=2 * 2500)
    run_search(cma_es, budget, np.random.default_rng(0))
    population = sorted(set(counts[:-1]))
    assert population[0] == 4 + int(3 * math.log(budget.space.size))
    assert len(population) >= 2
    assert population == [population[0] * 2**k for k in range(len(population))]


# the space


wild = st.lists(st.floats(-1e3, 1e3, allow_nan=False), min_size=9, max_size=9).map(np.array)


@settings(max_examples=60, derandomize=True)
@given(unit=wild)
def test_every_point_becomes_a_feasible_rig(unit):
    space = space_of(3)
    pose = space.pose_of(unit)
    assert space.violation_m(pose) == 0.0
    assert not pose[:, 3:].any()
    assert (np.abs(pose[:, YAW_RAD]) <= np.float32(math.pi)).all()
    # a whole turn changes nothing, and what is feasible stays: seen 2e-6, the margin of the projection
    turned = np.where(space.goes_round, unit + 1.0, unit)
    difference = space.pose_of(turned) - pose
    difference[:, YAW_RAD] = np.angle(np.exp(1j * difference[:, YAW_RAD]))
    np.testing.assert_allclose(difference, 0.0, atol=1e-5)
    again = space.feasible(pose)
    np.testing.assert_allclose(again[:, :2], pose[:, :2], atol=2e-5)
    np.testing.assert_allclose(np.exp(1j * again[:, YAW_RAD]), np.exp(1j * pose[:, YAW_RAD]), atol=1e-6)


def test_other_numbers_are_searched_where_they_are_free(rng):
    plain = space_of(2)
    low, high = plain.low.copy(), plain.high.copy()
    low[:, 3], high[:, 3] = -0.1, 0.3  # pitch
    low[:, 4] = high[:, 4] = 0.05  # roll
    space = SearchSpace(MOUNT, CONSTRAINTS, low, high)
    assert space.size == 8
    for pose in (space.random(rng), space.pose_of(rng.uniform(size=8))):
        assert (pose[:, 3] > -0.1).all()
        assert (pose[:, 3] < 0.3).all()
        assert pose[0, 3] != pose[1, 3]
        np.testing.assert_allclose(pose[:, 4], 0.05, rtol=1e-6)


def test_cameras_are_put_in_the_order_of_their_ranges(rng):
    space = space_of(4)
    pose = highest_mount_pose(CONSTRAINTS, 4)
    pose[:, YAW_RAD] += rng.uniform(-0.5, 0.5, 4)
    np.testing.assert_array_equal(space.in_order(pose[rng.permutation(4)]), pose)


# greedy


def test_greedy_covers_what_single_cameras_see():
    # three of the four quarters hold objects; three cameras cover all of them, wherever they stand
    objects = RING[:9]
    rigs = []

    def value(pose):
        rigs.append(pose)
        return float(np.count_nonzero(~detected_near(objects)(pose).any(axis=0)))

    method = functools.partial(greedy_cover, detections=detected_near(objects))
    result = search(method, 3, renders=60, each=1, value=value)
    assert result.value == 0.0
    assert len(rigs) == 1


def test_greedy_looks_at_places_all_over_the_surface_alike():
    asked = []

    def detections(pose):
        asked.append(pose)
        return detected_near(RING)(pose)

    search(functools.partial(greedy_cover, detections=detections, yaw_count=1))
    place_m = np.unique(np.concatenate(asked)[:, [X_M, Y_M]], axis=0)
    low_m, high_m = CONSTRAINTS.surface.bounds_m
    np.testing.assert_allclose(place_m.mean(axis=0), 0.5 * (low_m + high_m), atol=1e-6)
    assert (place_m.max(axis=0) - place_m.min(axis=0) > 0.6 * (high_m - low_m)).all()


def test_yaws_without_ends_go_round():
    space = space_of(2)
    assert space.goes_round.sum() == 2
    assert space.size == 6


def test_greedy_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="greedy_cover needs at least 10 camera renders, got 8"):
        search(GREEDY, 2, renders=4, each=1)
    assert search(GREEDY, 2, renders=5, each=1).camera_renders == 10
    with pytest.raises(ValueError, match="yaws that are free"):
        search(GREEDY, 2, yaw_reach_rad=1.0)


# on rendered scenes


def street_budget(objective, scenes, renders):
    """A budget for as many scenes in both cameras."""
    space = SearchSpace.over(objective.mount, 2, constraints=objective.constraints)
    return BudgetedValue.of(objective, scenes, space, camera_renders_max=2 * renders)


class Counted:
    """An objective that counts the camera renders it makes, in two cameras each."""

    def __init__(self):
        self.objective, self.renders = street_objective(), 0

    def __getattr__(self, name):
        return getattr(self.objective, name)

    def evaluate(self, mount_pose, scenes, **options):
        self.renders += 2 * len(scenes)
        return self.objective.evaluate(mount_pose, scenes, **options)

    def observe_rig(self, rig, scene):
        self.renders += 2
        return self.objective.observe_rig(rig, scene)


@pytest.mark.parametrize("renders", [13, 40])
@pytest.mark.parametrize("method", [pytest.param(random_search, id="random"), pytest.param(greedy_cover, id="greedy")])
def test_renders_are_counted_as_they_are_made(method, renders):
    objective, scenes = Counted(), street_scenes()
    budget = street_budget(objective, scenes, renders)
    options = {}
    if method is greedy_cover:
        options |= {"detections": detections_of(objective, scenes), "yaw_count": 4}
    result = run_search(functools.partial(method, **options), budget, np.random.default_rng(0))
    assert result.error is None
    assert result.camera_renders == objective.renders <= 2 * renders
    assert budget.space.violation_m(result.mount_pose) == 0.0
    again = objective.evaluate(result.mount_pose, scenes).objective
    assert again == pytest.approx(result.value, rel=1e-6)
