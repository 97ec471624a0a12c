"""The search by a pool: rigs never get worse, bounds hold, budgets and frozen cameras are kept."""

import contextlib
import functools
import itertools
from dataclasses import replace

import numpy as np
import pytest

from tests.optimisation.calls import draw, pool_search
from tests.optimisation.test_polish import zone_of
from tests.optimisation.test_pool import cameras_of, mount_of, poses_of, streets
from warpav.core.errors import InputError
from warpav.optimisation import PoolSearchSettings
from warpav.optimisation import _pool as pool_module
from warpav.optimisation import _pool_search as module
from warpav.optimisation._pool import spread_mount_poses

SMALL = PoolSearchSettings(pool_cameras=24, rounds=2, priced_cameras=4, gap=0.0)


def searched(mount=None, count=3, *, settings=SMALL, frozen=None, min_spacing_m=0.3, **options):
    mount = mount or mount_of(free=None)
    constraints = zone_of(mount, count, frozen, min_spacing_m)
    return list(pool_search(cameras_of(mount=mount), streets(), constraints, count, settings=settings, **options))


@contextlib.contextmanager
def short_refinement():
    """Refinements polish little and end after one replacement in vain and a look near the rig."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_VAIN_REPLACEMENTS", 1)
        patch.setattr(module, "_REPLACEMENT_POLISH", (3, 0.4))
        patch.setattr(module, "_REFINED_TO", 0.25)
        patch.setattr(module, "_NEAR_CAMERAS", 6)
        yield


@functools.cache
def small_states(cost=0.0):
    """The states of the plain search, for all tests that look at them."""
    return searched(charge=np.full(10, 0.1 * cost) if cost else None)


COSTS = pytest.mark.parametrize("cost", [0.0, 0.5], ids=["misses", "false alarms"])


def value(found, cost):
    """The expected miss rate, and so much for each p (1 - p)."""
    found = np.asarray(found, np.float64)
    return np.prod(1.0 - found, axis=0).mean() + cost * (found * (1.0 - found)).sum() / found.shape[1]


@COSTS
def test_states_never_get_worse_and_satisfy_the_constraints(cost):
    mount = mount_of(free=None)
    states = small_states(cost)
    assert states[0].stage == "selection"
    assert {state.stage for state in states} == {"selection", "polish", "pricing", "settled"}
    for before, after in itertools.pairwise(states):
        assert after.objective <= before.objective
        assert after.camera_renders >= before.camera_renders
    constraints = zone_of(mount)
    for state in states:
        assert constraints.violation_m(mount.rig(state.mount_pose)) == 0.0
        found = np.concatenate(
            [cameras_of(mount=mount).detection_probability(state.mount_pose, scene) for scene in streets()], axis=1
        )
        assert value(found, cost) == pytest.approx(state.objective, abs=1e-6)
    assert states[-1].objective < states[0].objective
    if cost:
        return
    again = searched(mount)
    np.testing.assert_array_equal(again[-1].mount_pose, states[-1].mount_pose)


@COSTS
def test_the_selection_is_the_best_rig_of_the_pool_by_brute_force(cost):
    mount = mount_of(free=None)
    constraints, cameras = zone_of(mount), cameras_of(mount=mount)
    charge = np.full(10, 0.1 * cost) if cost else None
    [chosen, _] = searched(mount, settings=replace(SMALL, polishes=False), charge=charge)
    pose = spread_mount_poses(mount, constraints, SMALL.pool_cameras, seed=0)
    pool = draw(pose, scenes=streets(), cameras=cameras)
    point = np.c_[pose[:, :2], mount.surface.height_at_m(pose[:, :2])]
    rigs = [
        rig
        for rig in itertools.combinations(range(len(pose)), 3)
        if all(np.linalg.norm(point[i] - point[j]) > 0.3 + 1e-6 for i, j in itertools.combinations(rig, 2))
    ]
    best = min(value(pool.detection_probability[list(rig)], cost) for rig in rigs)
    assert chosen.objective == pytest.approx(best, abs=1e-7)
    assert chosen.bound <= best + 1e-9
    assert chosen.gap == pytest.approx(0.0, abs=1e-6)


def test_frozen_cameras_are_part_of_every_rig():
    plain = mount_of(free=None)
    rig = plain.rig(poses_of(3, plain))
    mount = plain.freezing(rig, [rig.cameras[1].name])
    for state in searched(mount, frozen=mount.frozen):
        np.testing.assert_array_equal(state.mount_pose[1], mount.frozen.mount_pose[1])


def test_the_budget_of_camera_renders_is_kept():
    settings = PoolSearchSettings(pool_cameras=24, rounds=3, priced_cameras=4, camera_renders_max=110)
    states = searched(settings=settings)
    assert states[-1].camera_renders <= 110
    assert states[-1].objective <= states[0].objective


def test_whatever_was_rendered_joins_the_pool():
    for state in small_states():
        assert state.camera_renders == len(state.pool.mount_pose) * len(streets())
    pool, cameras = state.pool, cameras_of(mount=mount_of(free=None))
    again = np.concatenate([cameras.detection_probability(pool.mount_pose, scene) for scene in streets()], axis=1)
    np.testing.assert_allclose(pool.detection_probability, again, atol=1e-5)


def assert_same(one, other):
    """Two states are the same, bit for bit, and their pools are."""
    for name in ("mount_pose", "objective", "bound", "stage", "camera_renders", "pool_cameras", "round"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.pool.mount_pose, other.pool.mount_pose)
    np.testing.assert_array_equal(one.pool.detection_probability, other.pool.detection_probability)


@pytest.mark.parametrize("is_frozen", [False, True])
def test_the_start_comes_before_the_pool_is_drawn_and_changes_nothing_that_follows(monkeypatch, is_frozen):
    mount = mount_of(free=None)
    start, constraints, settings = poses_of(3, mount, seed=5), zone_of(mount), replace(SMALL, rounds=0)
    if is_frozen:
        rig = mount.rig(start)
        mount = mount.freezing(rig, [rig.cameras[1].name])
        constraints = zone_of(mount, frozen=mount.frozen)
    cameras, scenes, drawn = cameras_of(mount=mount), streets(), []
    chunk = pool_module._draw
    monkeypatch.setattr(pool_module, "_draw", lambda task: (drawn.append(len(task.mount_pose)), chunk(task))[1])
    states = pool_search(cameras, scenes, constraints, 3, start=start, settings=settings)
    first = next(states)
    assert (first.stage, first.bound, first.pool_cameras, first.camera_renders) == ("start", 0.0, 3, 3 * len(scenes))
    assert drawn == [3] * len(scenes)
    found = np.concatenate([cameras.detection_probability(first.mount_pose, scene) for scene in scenes], axis=1)
    assert first.objective == pytest.approx(value(found, 0.0), abs=1e-12)
    rest = list(states)
    assert drawn == [3] * len(scenes) + [settings.pool_cameras] * len(scenes)
    assert (rest[0].stage, rest[0].pool_cameras) == ("selection", 3 + settings.pool_cameras)
    assert rest[0].camera_renders == (3 + settings.pool_cameras) * len(scenes)
    # all at once: the cameras of the start, the frozen one first, and behind them the others
    others = spread_mount_poses(mount, constraints, settings.pool_cameras, seed=0)
    pose = np.concatenate([first.pool.mount_pose, others])
    np.testing.assert_array_equal(pose[0], first.mount_pose[int(is_frozen)])
    known = draw(pose, scenes=scenes, cameras=cameras)
    at_once = list(pool_search(cameras, scenes, constraints, 3, start=start, settings=settings, pool=known))
    assert at_once[0].objective == first.objective
    for one, other in zip(rest, at_once[1:], strict=True):
        assert_same(one, other)


def test_a_second_search_draws_neither_the_start_nor_the_pool(tmp_path, monkeypatch):
    options = {"start": poses_of(3, mount_of(free=None), seed=5), "cache": tmp_path}
    options["settings"] = replace(SMALL, polishes=False)
    once = searched(**options)
    assert len(list(tmp_path.glob("pool_*.npz"))) == 2 * len(streets())
    monkeypatch.setattr(pool_module, "_draw", None)
    again = searched(**options)
    assert [state.stage for state in again] == ["start", "selection", "settled"]
    for one, other in zip(once, again, strict=True):
        assert_same(one, other)
    assert (again[-1].pool.drawn_count, once[-1].pool.cached_count) == (0, 0)
    assert again[-1].camera_renders == 27 * len(streets())


def test_refinement_spends_what_rounds_leave_and_finds_better_rigs():
    plain = mount_of(free=None)
    rig = plain.rig(poses_of(3, plain))
    mount = plain.freezing(rig, [rig.cameras[1].name])
    settings = PoolSearchSettings(pool_cameras=24, rounds=1, priced_cameras=4, camera_renders_max=720)
    *_, without = searched(mount, settings=settings, frozen=mount.frozen)
    states = searched(mount, settings=replace(settings, refinements=20), frozen=mount.frozen)
    objectives = [state.objective for state in states]
    assert objectives == sorted(objectives, reverse=True)
    assert without.camera_renders < 500
    assert 500 < states[-1].camera_renders <= 720
    assert objectives[-1] < without.objective
    for state in states:
        np.testing.assert_array_equal(state.mount_pose[1], mount.frozen.mount_pose[1])


def test_constraints_that_no_rig_of_the_pool_satisfies_are_named():
    with pytest.raises(
        InputError, match=r"^no rig of the pool satisfies count = 3 and conflict; loosen one of them, .*$"
    ):
        searched(min_spacing_m=1.5)
