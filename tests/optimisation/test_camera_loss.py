"""The robust objective: value, slope, exchange and bound against all rigs of tiny pools, put together one by one."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.optimisation.calls import pool_search, select_robust
from tests.optimisation.test_modules import SMALL as SMALL_MIX
from tests.optimisation.test_modules import symmetric_cameras, symmetric_chart, symmetric_mount
from tests.optimisation.test_polish import polished, zone_of
from tests.optimisation.test_pool import cameras_of, mount_of, poses_of, streets
from tests.optimisation.test_pool_search import SMALL
from warpav.core.errors import InputError
from warpav.optimisation import RigLimits, ZoneAndSpacing, highest_mount_pose, rows_of
from warpav.optimisation._camera_loss import RobustObjective
from warpav.optimisation._mount import MIRROR
from warpav.optimisation._replacements import Replacements
from warpav.optimisation.selection._problem import Row

MEAN, WORST = RobustObjective("mean", 0.5), RobustObjective("worst", 0.4)


def pool(seed, cameras=9, objects=14):
    """Cameras each of which sees some of the objects."""
    rng = np.random.default_rng(seed)
    found = rng.uniform(0.0, 0.99, (cameras, objects))
    return np.where(rng.uniform(size=found.shape) < 0.5, found, 0.0), rng.uniform(0.1, 2.0, objects)


def by_hand(objective, found, share, size):
    """The definition, camera by camera: a pair that loses one camera counts as lost."""
    whole = sum(share[o] * np.prod([1.0 - p[o] for p in found]) for o in range(len(share)))
    losses = []
    for lost, count in enumerate(size):
        left = [p for k, p in enumerate(found) if k != lost]
        losses += [sum(share[o] * np.prod([1.0 - p[o] for p in left]) for o in range(len(share)))] * count
    without = np.mean(losses) if objective.camera_loss == "mean" else np.max(losses)
    return (1.0 - objective.weight) * whole + objective.weight * without


@pytest.mark.parametrize("objective", [MEAN, WORST, RobustObjective("worst", 1.0)])
@pytest.mark.parametrize("size", [(1, 1, 1), (2, 1, 1), (2, 2, 0)])
def test_the_value_is_that_of_the_rigs_without_each_camera(objective, size):
    found, weight = pool(1, cameras=3)
    found[size.index(0) if 0 in size else 0] *= 0.0 if 0 in size else 1.0
    share = weight / weight.sum()
    value = objective.of_rig(found, share, np.array(size))
    assert value.objective == pytest.approx(by_hand(objective, found, share, size), abs=1e-12)
    assert value.expected_miss_rate < value.without_camera
    in_parts = (1.0 - objective.weight) * value.expected_miss_rate + objective.weight * value.without_camera
    assert value.objective == pytest.approx(in_parts, abs=1e-15)


@pytest.mark.parametrize("softness", [0.0, 0.02])
@pytest.mark.parametrize("objective", [MEAN, WORST])
def test_the_slope_is_that_of_differences(objective, softness):
    found, weight = pool(3, cameras=4)
    missed, share, size = 1.0 - found, weight / weight.sum(), np.array([1, 2, 1, 1])
    value, slope = objective.value_and_slope(missed, share, size, softness=softness)
    exact = by_hand(objective, found, share, size)
    if softness == 0.0 or objective is MEAN:
        assert value == pytest.approx(exact, abs=1e-12)
    else:
        assert exact < value <= exact + objective.weight * softness * np.log(4)
    for camera, seen in np.ndindex(missed.shape):
        ends = []
        for sign in (-1.0, 1.0):
            moved = missed.copy()
            moved[camera, seen] += sign * 1e-6
            ends.append(objective.value_and_slope(moved, share, size, softness=softness)[0])
        assert slope[camera, seen] == pytest.approx((ends[1] - ends[0]) / 2e-6, abs=1e-8)


@pytest.mark.parametrize("objective", [MEAN, WORST])
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(2, 6))])
def test_exchange_finds_the_best_rig_and_no_rig_is_below_the_bound(objective, seed):
    """Conflicts, a required camera, a limit on modules, pairs, and cameras that are not there."""
    found, weight = pool(seed)
    found[-1] = 0.0
    share, size = weight / weight.sum(), np.array([1, 1, 2, 2, 1, 1, 1, 1, 0])
    conflict = np.zeros((9, 9), bool)
    conflict[1, 4] = conflict[2, 6] = True
    required = [3] if seed % 2 else [0, 3]
    rows = [Row("price", np.array([3.0, 1.0, 2.0, 2.0, 1.0, 4.0, 1.0, 2.0, 0.0]), low=3.0, high=8.0)]
    chosen = select_robust(
        found, 4, objective=objective, size=size, conflict=conflict, required=required, rows=rows, weight=weight
    )
    values = {}
    for rig in itertools.combinations(range(9), 4):
        each = np.array(rig)
        is_allowed = set(required) <= set(rig) and not conflict[np.ix_(each, each)].any()
        if is_allowed and 3.0 <= rows[0].coefficient[each].sum() <= 8.0:
            values[rig] = by_hand(objective, found[each], share, size[each])
    best = min(values, key=values.__getitem__)
    assert len(values) > 5
    assert tuple(chosen.cameras) == best
    assert chosen.objective == pytest.approx(values[best], abs=1e-9)
    assert chosen.bound <= values[best] + 1e-9
    assert chosen.bound > 0.5 * values[best]


def test_the_bound_is_the_sum_of_the_best_of_all_cameras_and_of_one_less():
    found, _ = pool(7)
    chosen = select_robust(found, 3, objective=MEAN, size=np.ones(9, int), gap=0.0)
    least = [
        min(np.prod(1.0 - found[list(rig)], axis=0).mean() for rig in itertools.combinations(range(9), count))
        for count in (3, 2)
    ]
    assert chosen.bound == pytest.approx(0.5 * sum(least), abs=1e-8)
    assert chosen.objective > chosen.bound
    assert chosen.ended == "exchange"


@pytest.mark.parametrize(("count", "required"), [(1, []), (2, [4]), (3, [2, 6])])
def test_of_rigs_within_rows_the_best_is_found_and_others_apart(count, required):
    """Against all rigs, of as many cameras and of one less: what is kept with all need not be kept without one."""
    found, weight = pool(12)
    rows = [Row("few", np.arange(9.0) % 3, high=3.0), Row("some", np.arange(9.0) - 2.0, low=1.0)]
    size, share = np.ones(9, int), weight / weight.sum()
    options = {"required": required, "rows": rows, "weight": weight, "objective": WORST, "size": size, "gap": 0.0}
    chosen = select_robust(found, count, **options)

    def is_kept(rig):
        return set(required) <= set(rig) and all(r.low <= r.coefficient[list(rig)].sum() <= r.high for r in rows)

    value = {
        rig: by_hand(WORST, found[list(rig)], share, (1,) * count)
        for rig in itertools.combinations(range(9), count)
        if is_kept(rig)
    }
    assert chosen.objective == pytest.approx(min(value.values()), abs=1e-9)
    assert value[tuple(chosen.cameras)] == min(value.values())
    nominal = min(float(np.prod(1.0 - found[list(rig)], axis=0) @ share) for rig in value)
    fewer = [np.delete(rig, k) for rig in value for k in range(count)]
    without = min(float(np.prod(1.0 - found[rig], axis=0) @ share) for rig in fewer)
    assert (1.0 - WORST.weight) * nominal <= chosen.bound + 1e-9
    assert chosen.bound <= (1.0 - WORST.weight) * nominal + WORST.weight * without + 1e-9
    for one, other in itertools.combinations([chosen.cameras, *chosen.others], 2):
        assert len(set(one) - set(other)) > 1
        assert tuple(sorted(other)) in value


def test_what_is_no_robust_objective_is_refused():
    for given, message in (
        (("median",), "camera_loss: expected mean or worst"),
        (("mean", 0.0), "weight: expected more"),
    ):
        with pytest.raises(InputError, match=message):
            RobustObjective(*given)
    assert RobustObjective("mean", 1.0).weight == 1.0
    with pytest.raises(InputError, match=r"weight: expected more than 0, at most 1, got 1\.5"):
        RobustObjective("worst", 1.5)
    alike = MEAN.of_rig(pool(4)[0][:3])
    assert alike.objective == pytest.approx(by_hand(MEAN, pool(4)[0][:3], np.full(14, 1 / 14), (1, 1, 1)))


def test_every_replacement_is_a_rig_put_together():
    found, weight = pool(9)
    rig, pose, size = np.array([1, 5, 7]), np.arange(63.0).reshape(9, 7), np.array([1, 2, 1, 1, 1, 2, 1, 1, 1])
    cameras, fits = SimpleNamespace(mount_pose=pose, detection_probability=found), np.ones((9, 3), bool)
    options = {"unit": np.ones(7), "weight": weight, "robust": (WORST, size)}
    replacements = Replacements(cameras, rig[:1], rig[1:], fits, fits, **options)
    for camera, slot in np.ndindex(9, 2):
        other = rig.copy()
        other[1 + slot] = camera
        expected = by_hand(WORST, found[other], weight / weight.sum(), size[other])
        assert replacements.miss_rate[camera, slot] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("objective", [MEAN, WORST])
def test_the_polish_lowers_the_robust_objective(objective):
    mount = mount_of(free=None)
    cameras, constraints = cameras_of(mount=mount), zone_of(mount)
    steps = polished(cameras, poses_of(3, mount), constraints, robust=objective)
    for step in steps:
        found = np.concatenate([cameras.detection_probability(step.mount_pose, scene) for scene in streets()], axis=1)
        assert objective.of_rig(found).objective == pytest.approx(step.objective, abs=1e-6)
    assert steps[-1].objective < 0.95 * steps[0].objective


@pytest.mark.parametrize("objective", [MEAN, pytest.param(WORST, marks=pytest.mark.nightly)])
def test_a_search_ends_with_the_best_robust_rig_that_it_knows(objective):
    mount = mount_of(free=None)
    cameras, constraints = cameras_of(mount=mount), zone_of(mount)
    weight = np.linspace(0.5, 2.0, 10)
    options = {"settings": replace(SMALL, rounds=1, refinements=1, camera_renders_max=600), "object_weight": weight}
    states = list(pool_search(cameras, streets(), constraints, 3, robust=objective, **options))
    nominal = next(pool_search(cameras, streets(), constraints, 3, **options))
    assert states[-1].camera_renders <= 600
    values = [state.objective for state in states]
    assert values == sorted(values, reverse=True)
    assert states[-1].objective < states[0].objective
    for state in (states[0], states[-1]):
        row = rows_of(state.mount_pose + np.float32(0.0), state.pool.mount_pose)
        expected = by_hand(objective, state.pool.detection_probability[row], weight / weight.sum(), (1, 1, 1))
        assert state.robust.objective == pytest.approx(state.objective, abs=1e-12)
        assert state.objective == pytest.approx(expected, abs=1e-4)
        assert state.bound <= state.objective
    assert nominal.robust is None


@pytest.mark.parametrize("objective", [WORST, pytest.param(MEAN, marks=pytest.mark.nightly)])
def test_of_mixed_modules_and_pairs_the_objective_is_never_below_what_is_missed(objective):
    """Rows that stand for two cameras, rows that are not there, and the same rig with all of its cameras one by one."""
    mount, surface, cameras, scenes = symmetric_mount(), symmetric_chart(), symmetric_cameras(), streets()[:1]
    kinds = [(name, 1 + pair) for name, pair in zip(surface.modules, surface.pairs, strict=True)]
    limits = RigLimits.of({"narrow": (0, 1), "wide": (2, 2), "fisheye": (0, 2)}, count=(3, 5), kinds=kinds)
    constraints = ZoneAndSpacing(surface, camera_count=1, margin_m=0.02, module=limits.first_kinds())
    start = highest_mount_pose(constraints, len(limits.first_kinds()))
    options = {"start": start, "settings": replace(SMALL_MIX, pool_cameras=18, rounds=0), "limits": limits}
    *_, last = pool_search(cameras, scenes, constraints, 5, robust=objective, **options)
    pose = last.mount_pose
    is_pair = mount.is_pair(pose)
    assert is_pair.any()
    found = np.concatenate([cameras.detection_probability(pose, scene) for scene in scenes], axis=1)
    share = np.full(found.shape[1], 1.0 / found.shape[1])
    assert last.objective == pytest.approx(by_hand(objective, found, share, 1 + is_pair), abs=1e-3)
    image = np.concatenate([cameras._mirrored.detection_probability(pose * MIRROR, scene) for scene in scenes], axis=1)
    own = np.where(is_pair[:, None], 1.0 - (1.0 - found) / (1.0 - np.minimum(image, 0.9999)), found)
    single = np.concatenate([own, image[is_pair]])
    truth = by_hand(objective, single, share, (1,) * len(single))
    assert truth <= last.objective + 1e-3
    assert last.bound <= last.objective
    assert limits.holds(mount.module_of(pose))
