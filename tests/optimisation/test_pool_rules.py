"""Design rules of pools and polishes: every rig that is found keeps them, and none that keeps them is better."""

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest

from tests.driving_scene import street
from tests.optimisation.test_modules import columns, symmetric_cameras, symmetric_mount
from tests.optimisation.test_polish import zone_of
from tests.optimisation.test_pool import cameras_of, mount_of, streets
from warpav.detection import expected_miss_rate
from warpav.optimisation import CameraPool, FreeRanges, PoolRules, PoolSearchSettings, PoolTask
from warpav.optimisation import _pool_search as pool_search
from warpav.optimisation._pool import spread_mount_poses
from warpav.optimisation._pool_rules import ALONE
from warpav.optimisation._pool_search import PoolSearch
from warpav.optimisation._single_cameras import SingleCameras
from warpav.optimisation.selection._problem import SelectionProblem
from warpav.optimisation.selection._select import select
from warpav.raster.camera import CameraModel
from warpav.rig import Rig
from warpav.sight import NEAR_M, SPARED, RuleCheck, Rules, level_ground, near_ring_m, ring_m, sight
from warpav.sight._rules import housing_shares

MODEL = CameraModel(64, 64, math.radians(100.0), near_m=0.05)
RULES = Rules(own_body=0.35, azimuth_gap_rad=None, near_ground=False, housing=0.004)


@functools.cache
def mount():
    return mount_of(free=FreeRanges(pitch_rad=(-0.1, 0.4)), model=MODEL)


def rules_of(rules=RULES):
    return PoolRules(rules, cameras_of(mount=mount()), street().ego)


@functools.cache
def spread(count=40):
    return spread_mount_poses(mount(), zone_of(mount()), count, seed=3)


def kept_by(pose, rules=RULES):
    """Whether a rig keeps the rules, by its margins as any rig's."""
    return all(each.is_kept for each in RuleCheck(mount().rig(pose), street().ego, rules).margins)


def test_what_a_camera_keeps_alone_is_what_its_margins_say():
    found = rules_of().allowed(spread())
    assert 5 < found.sum() < len(found) - 5
    np.testing.assert_array_equal(found, [kept_by(each[None]) for each in spread()])
    one = spread()[found][:1]
    share = RuleCheck(mount().rig(one), street().ego, RULES).margins[0].value
    for over in (0.5, 1.5):
        tight = dataclasses.replace(RULES, own_body=share - over * SPARED)
        assert rules_of(tight).allowed(one)[0] == kept_by(one, tight) == (over < 1.0)


def test_pairs_in_conflict_are_those_of_all_pairs():
    conflict = rules_of().conflict(spread()).toarray()
    alone = Rules(None, None, None, None, near_ground=False, housing=RULES.housing, crossing_rad=None)
    for one, other in itertools.combinations(range(len(spread())), 2):
        assert conflict[one, other] == conflict[other, one]
        assert conflict[one, other] != kept_by(spread()[[one, other]], alone)
    assert conflict.any()
    pair = spread()[np.argwhere(conflict)[0]]
    for frozen in itertools.product([False, True], repeat=2):  # only two that stay may be in each other's way
        assert rules_of(alone).keeps(pair, frozen=np.array(frozen)) == all(frozen)


def test_the_selection_is_the_best_of_all_rigs_that_keep_the_rules():
    pose = spread(18)
    pool = CameraPool.empty(streets(), cameras_of(mount=mount())).extended(pose)
    rules = rules_of()
    limits = {"conflict": rules.conflict(pose), "rows": rules.rows(pose)}
    found = select(SelectionProblem.create(pool.detection_probability, 2, **limits), gap=0.0)
    share = np.full(pool.detection_probability.shape[1], 1.0 / pool.detection_probability.shape[1])
    value = {
        rig: expected_miss_rate(pool.detection_probability[list(rig)], share)
        for rig in itertools.combinations(range(len(pose)), 2)
        if kept_by(pose[list(rig)])
    }
    assert found.objective == pytest.approx(min(value.values()), abs=1e-9)
    assert len(value) < 18 * 17 / 2


@pytest.mark.parametrize("gap_steps", [1, 3])
def test_margins_are_kept_where_rules_are_and_their_slopes_are_those_of_differences(gap_steps):
    rules = rules_of()
    rules.gap_steps, rules.near_level = gap_steps, 3
    pose = spread()[[0, 7]]
    value, slope = rules.margins(pose)
    breaks = rules._measured(pose).breaks[:, : len(ALONE) - 1]
    np.testing.assert_array_equal(value[:, :3] < 1.0, breaks)
    assert value.shape == (2, len(rules.needed))
    for number, step in ((0, 0.02), (2, 0.01), (3, 0.01)):
        ends = []
        for sign in (1.0, -1.0):
            moved = pose.copy()
            moved[:, number] += sign * step
            ends.append(rules.margins(moved)[0])
        difference = (ends[0] - ends[1]) / (2.0 * step)
        smooth = (value[:, 1:] > 0.02) & (ends[0][:, 1:] > 0.0) & (ends[1][:, 1:] > 0.0)
        error = np.abs(slope[:, 1:, number] - difference[:, 1:])[smooth]
        assert np.median(error) < 0.02
        assert np.quantile(error, 0.9) < 0.6  # an edge of an image changes places within a step
        assert slope[:, 0, number] == pytest.approx(difference[:, 0], abs=0.6)  # a hard image of 160 px


def test_a_search_ends_with_a_rig_that_keeps_the_rules(monkeypatch):
    monkeypatch.setattr(pool_search, "_PRICE", 10.0)
    monkeypatch.setattr(pool_search, "_LOOSER_GAP_PRICE", 10.0)
    rules = Rules(own_body=0.35, housing=0.004, azimuth_gap_rad=math.radians(3.0))
    ends = {}
    for name, kept in (("none", None), ("rules", rules)):
        asked = None if kept is None else rules_of(kept)
        task = PoolTask(cameras_of(mount=mount()), streets(), zone_of(mount(), 4), 4, rules=asked)
        for found in PoolSearch(task, PoolSearchSettings(pool_cameras=40, rounds=1, priced_cameras=2)):
            if asked is not None:
                assert asked.keeps(found.mount_pose)
            if found.stage == "settled":
                break
        ends[name] = found
    assert asked.gap_steps is not None
    check = RuleCheck(mount().rig(ends["rules"].mount_pose), street().ego, rules)
    assert all(each.is_kept for each in check.margins if each.rule != "azimuth_gap")
    assert check.azimuth_gap_rad <= asked.gap_steps * math.radians(3.0)
    assert ends["rules"].objective >= ends["none"].objective - 0.02


def test_without_rules_nothing_is_in_the_way():
    rules = rules_of(Rules(None, None, None, None, near_ground=False, housing=None, crossing_rad=None))
    assert rules.allowed(spread()).all()
    assert rules.rows(spread()) == []
    assert rules.conflict(spread()).nnz == 0


def test_a_step_that_would_bring_a_housing_into_view_is_told_before():
    """One camera stands just outside of the left edge of another's image: only moves away from it are left."""
    rules = rules_of(Rules(None, None, None, None, near_ground=False, housing=0.001, crossing_rad=None))
    pose = np.zeros((2, 7), np.float32)
    pose[0, :2] = [0.3, 0.0]
    half = math.radians(50.0)
    pose[1, :2] = [0.3 + 0.6 * math.cos(half + 0.15), 0.6 * math.sin(half + 0.15)]
    assert rules.conflict(pose).nnz == 0
    reach = np.zeros((2, 7))
    reach[:, :3] = 0.15
    spare, slope = rules.pair_edges(pose, reach)
    assert len(spare) >= 1
    towards, away = np.zeros((2, 7)), np.zeros((2, 7))
    towards[0, 2], away[0, 2] = 0.12, -0.12  # turning to the left looks at it
    assert (spare + np.einsum("rck,ck->r", slope, towards)).min() < 0.0
    assert (spare + np.einsum("rck,ck->r", slope, away)).min() >= 0.0
    turned = pose.copy()
    turned[0, 2] = 0.4
    assert rules.conflict(turned).nnz > 0


# --- pairs of a symmetric mount, against their single cameras -----------------------------------------------------


ALL = Rules(own_body=0.3, own_body_wide=0.41, horizon=0.1, azimuth_gap_rad=0.5, housing=0.002, crossing_rad=0.6)


@functools.cache
def apart():
    """The single cameras of the columns, and the column that each is of."""
    return symmetric_mount().rig(columns()).cameras, symmetric_mount().rows_of_cameras(columns())


def by_column(of_camera):
    """Whether any camera of each column is so, bool [column, ...]."""
    return np.array([of_camera[apart()[1] == column].any(axis=0) for column in range(len(columns()))])


@functools.cache
def housings_in_the_way():
    """Whether the cameras of two columns, or the two of a pair, are in each other's way, bool [column, column]."""
    cameras, _ = apart()
    pose = np.stack([camera.ego_from_camera for camera in cameras])
    share, meets = housing_shares(pose, [each.model for each in cameras], [each.housing for each in cameras])
    found = by_column(by_column((share > ALL.housing) | meets).T)
    return found | found.T


def test_a_pair_keeps_alone_what_both_of_its_cameras_keep():
    found = PoolRules(ALL, symmetric_cameras(), street().ego).allowed(columns())
    lone = dataclasses.replace(ALL, housing=None, azimuth_gap_rad=None, near_ground=False)
    margins = [RuleCheck(Rig([camera]), street().ego, lone).margins for camera in apart()[0]]
    breaks = by_column(np.array([[not margin.is_kept for margin in each] for each in margins]))
    blocked = np.diag(housings_in_the_way()) & symmetric_mount().is_pair(columns())
    np.testing.assert_array_equal(found, ~(breaks.any(axis=1) | blocked))
    assert 3 < found.sum() < len(found) - 3
    assert (breaks.sum(axis=0) > 0).all()


def test_columns_conflict_where_any_two_of_their_cameras_do():
    expected = housings_in_the_way() & ~np.eye(len(columns()), dtype=bool)
    found = PoolRules(ALL, symmetric_cameras(), street().ego).conflict(columns(), absent=2).toarray()
    np.testing.assert_array_equal(found, np.pad(expected, (0, 2)))
    assert expected.any()


@pytest.mark.parametrize(("gap_steps", "near_level"), [(1, 0), (4, 3), (60, 5)])
def test_rows_say_which_columns_see_each_direction_and_place(gap_steps, near_level):
    rules, ego = PoolRules(ALL, symmetric_cameras(), street().ego), street().ego
    assert {row.name for row in rules.rows(columns())} <= {f"rules.{name}" for name in ALONE}
    rules.gap_steps, rules.near_level = gap_steps, near_level
    near_m = near_ring_m(ego, NEAR_M[near_level])
    seen = by_column(sight(apart()[0], np.concatenate([ring_m(ego), near_m]), level_ground(ego)).seen)
    ring, near = seen[:, :120], seen[:, 120:]
    wanted = {}
    for k in range(120):
        window = [(k + step) % 120 for step in range(gap_steps)]
        azimuth = 3 * k if k < 60 else 3 * k - 360
        wanted[f"rules.azimuth_gap at {azimuth} deg"] = ring[:, window].any(axis=1)
    wanted |= {f"rules.near_ground at ({x:.1f}, {y:.1f}) m": near[:, k] for k, (x, y, _) in enumerate(near_m)}
    rows = {row.name: row for row in rules.rows(columns(), absent=1, free_from=2)}
    told = {np.append(each, 0.0).tobytes() for each in wanted.values()}
    assert told == {row.coefficient.tobytes() for name, row in rows.items() if name in wanted}
    for name, row in rows.items():
        if name in wanted:
            np.testing.assert_array_equal(row.coefficient, np.append(wanted[name], 0.0))
            assert (row.low, row.high) == (1.0, math.inf)
        else:
            alone = rules._measured(columns()).breaks[:, ALONE.index(name.removeprefix("rules."))]
            np.testing.assert_array_equal(row.coefficient, np.concatenate([[0.0, 0.0], alone[2:], [0.0]]))
            assert row.high == 0.0
    names = list(wanted)[::17]
    np.testing.assert_array_equal(rules.coefficients(columns(), names), [wanted[name] for name in names])
    allowed = np.flatnonzero(rules.allowed(columns()))
    for rig in itertools.combinations(allowed[:6], 3):
        kept = all(each[list(rig)].any() for each in wanted.values())
        kept &= not housings_in_the_way()[np.ix_(rig, rig)][~np.eye(3, dtype=bool)].any()
        assert rules.keeps(columns()[list(rig)]) == kept


@pytest.mark.parametrize(("gap_steps", "share"), [(1, 0.98), (5, 0.85)])  # a window may have several points as far in
def test_margins_of_a_pair_are_the_worse_alone_and_the_better_together(gap_steps, share):
    """Its right camera is the left one in a world that is mirrored, where directions run the other way round."""
    pair = columns()[symmetric_mount().is_pair(columns())][:10]
    own = SingleCameras(symmetric_mount(), symmetric_cameras().probability, is_mirrored=True)
    found, left, image = (PoolRules(ALL, each, street().ego) for each in (symmetric_cameras(), own, own))
    for rules in (found, left, image):
        rules.gap_steps, rules.near_level = gap_steps, 4
    (value, slope), (one, one_slope), (two, two_slope) = (rules.margins(pair) for rules in (found, left, image))
    turned = (1 - gap_steps - np.arange(120)) % 120
    order = np.concatenate([[0, 1, 2], 3 + turned, 123 + (2 - np.arange(24)) % 24])
    two, two_slope = two[:, order], two_slope[:, order]
    alone = np.arange(len(order)) < 3
    np.testing.assert_allclose(value, np.where(alone, np.minimum(one, two), np.maximum(one, two)), atol=2e-3)
    assert found.needed.tolist() == [10**6] * 3 + [1] * 144
    clear = (np.abs(one - two) > 0.01) & ~alone
    expected = np.where((two > one)[..., None], two_slope, one_slope)
    assert (np.abs(slope - expected).max(axis=2)[clear] < 0.05).mean() > share
    assert clear.sum() > 500
