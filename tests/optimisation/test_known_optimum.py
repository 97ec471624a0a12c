"""Regret in worlds whose best rig is known. Spread is 1 - optimum: the worst rig sees nothing and has the value 1."""

import importlib.util
import itertools
import math

import numpy as np
import pytest

from tests.optimisation.calls import pool_search
from tests.optimisation.known_optimum import behind_a_wall, bump, square
from warpav.optimisation import (
    OptimiserSettings,
    PoolSearchSettings,
    SearchSpace,
    SingleCameraValues,
    cma_es,
    run_search,
    single_cameras_of,
)
from warpav.thesis import Descent, evaluate_starts

WORLDS = [behind_a_wall, bump, square]
needs_cma = pytest.mark.skipif(importlib.util.find_spec("cma") is None, reason="no cma")


def regret(world, method, renders, seed=0):
    result = run_search(method, world.budget(renders), np.random.default_rng(seed))
    assert result.error is None
    assert result.camera_renders <= renders * world.camera_count
    assert world.space.violation_m(result.mount_pose) == 0.0
    return world.regret(result.value)


@pytest.mark.slow
@pytest.mark.parametrize("make", WORLDS)
def test_no_rig_of_all_that_were_tried_is_expected_to_miss_less(make):
    """All rigs of a grid, then ever closer samples around the best of them that lie apart."""
    world, rng = make(), np.random.default_rng(0)
    counts = (9, 7, 64) if world.camera_count == 1 else (7, 7, 48)
    values = SingleCameraValues(single_cameras_of(world.expected), [each.scene for each in world.scenes])
    low_m, high_m = world.space.mount.surface.bounds_m

    def look(points):
        points[:, :2] = np.clip(points[:, :2], low_m, high_m)
        return np.array(list(values(np.stack([world.space.feasible(world.rig_of(point)) for point in points]))))

    x, y = (np.linspace(low, high, n) for low, high, n in zip(low_m, high_m, counts[:2], strict=True))
    grid = np.array(list(itertools.product(x, y, 2.0 * np.pi * np.arange(counts[2]) / counts[2])))
    coarse = look(grid)
    apart: list[np.ndarray] = []
    for k in np.argsort(coarse):
        if all(np.linalg.norm((grid[k] - other) / [0.5, 0.5, 0.3]) > 1.0 for other in apart):
            apart.append(grid[k])
    found = np.inf
    for start in (*apart[:4], np.array(world.surest)):
        point, lowest = start, np.inf
        for radius in np.repeat(0.2 * 0.5 ** np.arange(10), 2):
            near = point + rng.uniform(-radius, radius, (300, 3)) * [1.0, 1.0, 0.4]
            near_values = look(near)
            if near_values.min() < lowest:
                point, lowest = near[near_values.argmin()], near_values.min()
        found = min(found, lowest)
    assert coarse.max() > 0.99
    assert world.regret(found) >= -0.0005


def descent_regret(world, seed, *, starts, descents, iterations):
    """The regret of what the descent finds: many starts, their mixture, descents with a panorama early in each."""
    settings = OptimiserSettings(
        learning_rate_position_m=0.04,
        learning_rate_yaw_deg=math.degrees(0.04),
        schedule="cosine",
        weight_decay=0.0,
        multiplier_learning_rate=1.0,
        keep="best",
        check_every=4,
        panorama_until=0.3,
        starts=starts,
        descents=descents,
    )
    objective, rng = world.expected, np.random.default_rng(seed)
    space = SearchSpace.over(objective.mount, world.camera_count, constraints=objective.constraints)
    looked = evaluate_starts(objective, world.scenes, space, starts, rng, known=space.random(rng))
    first, *others = [each.mount_pose for each in looked[:descents]]
    descent = Descent(objective, world.scenes, settings, first, rng, iterations, 1, further_starts=others)
    for _ in range(iterations):
        descent.step()
    result = descent.finish()
    assert space.violation_m(result.mount_pose) == 0.0
    return world.regret(result.training_objective)


def test_regret_of_the_descent_is_small_on_a_bump():
    assert -0.005 <= descent_regret(bump(), 0, starts=32, descents=2, iterations=160) <= 0.01


def pool_regret(world, seed, *, camera_renders):
    """The regret of the search by a pool with a budget: rounds until one brings nothing or it is spent."""
    settings = PoolSearchSettings(
        pool_cameras=camera_renders, rounds=1000, refinements=1000, camera_renders_max=camera_renders
    )
    cameras, scenes = single_cameras_of(world.expected), [each.scene for each in world.scenes]
    *_, last = pool_search(
        cameras, scenes, world.expected.constraints, world.camera_count, settings=settings, seed=seed
    )
    assert last.camera_renders <= camera_renders
    assert world.space.violation_m(last.mount_pose) == 0.0
    assert world.value(last.mount_pose) == pytest.approx(last.objective, abs=1e-6)
    return world.regret(last.objective)


def test_regret_of_the_pool_search_is_small_on_a_bump():
    assert -0.0005 <= pool_regret(bump(), 0, camera_renders=600) <= 0.01


@needs_cma
def test_cma_finds_the_optimum_behind_the_wall():
    assert -0.005 <= regret(behind_a_wall(), cma_es, 300) <= 0.05
