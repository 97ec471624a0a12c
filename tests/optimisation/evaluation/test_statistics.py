"""Intervals, p-values and spreads: closed forms, scipy's answers, symmetries, and how often an interval is right."""

import dataclasses
import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from warpav.optimisation import (
    PAIRED_METRICS,
    ArmMetrics,
    Difference,
    Estimate,
    paired_difference,
    paired_differences,
    rank_correlation,
)

# recalls of scenes of eight objects
recalls = st.integers(2, 12).flatmap(
    lambda count: st.tuples(*[arrays(np.float64, count, elements=st.integers(0, 8).map(lambda n: n / 8))] * 2)
)
quick = settings(max_examples=25)


def test_the_interval_is_that_of_scipy(rng):
    one, other = rng.exponential(size=30), rng.exponential(size=30)
    found = paired_difference(one, other, seed=4)
    expected = scipy.stats.bootstrap((one - other,), np.mean, rng=np.random.default_rng(4)).confidence_interval
    # the same resamples, as both draw indices of scenes first
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_equal_differences_give_that_number_and_no_more_confidence_than_the_scenes_allow():
    found = paired_difference([1.5, 2.5, 3.5], [1.0, 2.0, 3.0])
    assert (found.mean, found.low, found.high, found.scenes) == (0.5, 0.5, 0.5, 3)
    assert found.p_value == pytest.approx(0.25, rel=0.02)  # three scenes agree by chance in a quarter of all cases
    none = paired_difference([1.0, 2.0, 3.0], [1.0, 2.0, 3.0])
    assert (none.mean, none.low, none.high) == (0.0, 0.0, 0.0)
    assert none.p_value == pytest.approx(1.0, rel=0.02)


def test_rounding_is_no_difference():
    found = paired_difference([0.1 + 0.2] * 8, [0.3] * 8)  # 5.6e-17 apart
    assert (found.mean, found.low, found.high, found.p_value) == (0.0, 0.0, 0.0, 1.0)
    assert paired_difference([0.3 + 1e-9] * 8, [0.3] * 8).low > 0.0


def test_scenes_without_a_number_on_either_side_are_left_out():
    found = paired_difference([1.0, None, 3.0, 4.0], [0.0, 0.0, math.nan, 2.0])
    assert (found.mean, found.scenes) == (1.5, 2)
    runs = paired_difference([[1.0, 5.0, 3.0], [1.0, None, 5.0]], [0.0, 0.0, 2.0])
    assert (runs.mean, runs.scenes) == (1.5, 2)
    assert paired_difference([None, 1.0], [1.0, None]) == Difference(None, None, None, 0)
    assert paired_difference([], []) == Difference(None, None, None, 0)
    assert paired_difference([1.0], [0.5]) == Difference(0.5, None, None, 1)


def test_objects_as_weights_give_the_recall_of_all_objects(rng):
    objects = rng.integers(0, 9, 30)
    found, other = (rng.binomial(objects, share) for share in (0.7, 0.5))
    with np.errstate(invalid="ignore"):
        result = paired_difference(found / objects, other / objects, weight=objects)
    assert result.mean == pytest.approx((found.sum() - other.sum()) / objects.sum(), abs=1e-12)
    assert result.scenes == (objects > 0).sum()
    # the linearised error of a ratio of sums
    residual = found - other - result.mean * objects
    error = math.sqrt(30) * residual.std(ddof=1) / objects.sum()
    assert (result.high - result.low) / (2 * 1.96 * error) == pytest.approx(1.0, abs=0.1)  # 0.97


@pytest.mark.parametrize(
    ("one", "other", "weight"), [([1, 2], [1, 2, 3], None), ([1, 2], [1, 2], [1]), ([1, 2], [2, 3], [1, -1])]
)
def test_arms_of_other_scenes_and_wrong_weights_are_refused(one, other, weight):
    with pytest.raises(ValueError, match=r"must have the same scenes|weights must be 0 or more"):
        paired_difference(one, other, weight=weight)


@quick
# such that nothing is rounded: resamples that tie stay ties
@given(recalls, st.sampled_from([0.125, 0.5, 2.0, 8.0]), st.integers(-5, 5))
def test_units_and_what_both_arms_share_do_not_count(both, scale, shift):
    one, other = both
    found = paired_difference(one, other, resamples=299)
    moved = paired_difference(scale * one + shift, scale * other + shift, resamples=299)
    assert (moved.mean, moved.low, moved.high) == pytest.approx(
        (scale * found.mean, scale * found.low, scale * found.high), abs=1e-9
    )


@quick
@given(recalls)
def test_the_interval_leaves_zero_out_where_the_p_value_is_small(both):
    found = paired_difference(*both, resamples=299)
    assert found.low <= found.mean <= found.high
    assert 0.0 < found.p_value <= 1.0
    if not 0.049 < found.p_value < 0.051:
        assert (found.p_value < 0.05) <= (not found.low <= 0.0 <= found.high)
    if len(both[0]) > 6:  # fewer scenes cannot say as much, whatever the interval
        assert (found.p_value < 0.0505) >= (not found.low <= 0.0 <= found.high)


def test_p_values_are_those_of_students_test_for_many_normal_numbers(rng):
    for shift in (0.0, 0.05, 0.1, 0.15):
        difference = rng.normal(shift, 1.0, 500)
        expected = scipy.stats.ttest_1samp(difference, 0.0).pvalue
        found = paired_difference(difference, np.zeros(500)).p_value
        assert found == pytest.approx(expected, rel=0.2, abs=0.002)  # worst seen: 0.06 of the larger ones


def arm(**per_scene):
    """Metrics of which only the lists per scene matter."""
    scene_count = len(next(iter(per_scene.values())))
    lists = {name: per_scene.get(name, [None] * scene_count) for name in PAIRED_METRICS}
    fields = {field.name: None for field in dataclasses.fields(ArmMetrics)}
    return ArmMetrics(**{**fields, "per_scene": lists})


def test_the_metrics_of_two_rigs_are_compared_one_by_one():
    found = paired_differences(arm(objective=[1.0, None, 3.0, 4.0]), arm(objective=[0.0, 0.0, None, 2.0]))
    assert tuple(found) == PAIRED_METRICS
    expected = paired_difference([1.0, 4.0], [0.0, 2.0])
    assert found["objective"].to_json() == {"mean": 1.5, "low": expected.low, "high": expected.high, "scenes": 2}
    assert found["ap50_pooled"] == Difference(None, None, None, 0)


def test_rank_correlation_is_that_of_scipy(rng):
    one = rng.normal(size=60).round(1)  # with ties
    other = one + rng.normal(size=60).round(1)
    found = rank_correlation(one, other)
    assert found.value == pytest.approx(scipy.stats.spearmanr(one, other).statistic, abs=1e-12)
    assert found.low < found.value < found.high
    # close to the interval of Bonett and Wright's formula
    half = 1.96 * math.sqrt((1.0 + found.value**2 / 2.0) / 57)
    expected = np.tanh(np.arctanh(found.value) + np.array([-half, half]))
    assert (found.low, found.high) == pytest.approx(expected, abs=0.06)  # worst seen 0.03


def test_a_perfect_order_is_1_and_too_few_rigs_say_nothing():
    assert rank_correlation(range(20), np.arange(20) ** 3) == Estimate(1.0, 1.0, 1.0, 20)
    assert rank_correlation(range(20), range(0, -20, -1)) == Estimate(-1.0, -1.0, -1.0, 20)
    assert rank_correlation([1, 2, 3], [1, 2, 3]) == Estimate(1.0, None, None, 3)
    assert rank_correlation([1, 2, None, 4], [1, None, 3, 3]) == Estimate(1.0, None, None, 2)
    assert rank_correlation([1, 1, 1, 1], [1, 2, 3, 4]) == Estimate(None, None, None, 4)
    assert rank_correlation([], []) == Estimate(None, None, None, 0)
    with pytest.raises(ValueError, match="as many numbers, got 1 and 2"):
        rank_correlation([1], [1, 2])


def simulate_recall(rng):
    """Recalls of two arms in 50 scenes of four objects, which are hard and easy for both; their true difference."""
    ease = rng.beta(2.0, 1.0, 50)
    one, other = (rng.binomial(4, 0.05 + share * ease) / 4 for share in (0.9, 0.8))
    return one, other, 0.1 * 2.0 / 3.0


def simulate_runs(rng, one_count, other_count, run_sd=0.04):
    """Recalls of arms of several runs; scenes, runs and what is left of chance all count; their true difference."""
    scene = rng.normal(0.0, 0.2, 50)
    liking = rng.normal(0.05, 0.1, 50)  # how much more one arm finds in a scene than the other

    def runs(count):  # an arm of one run is a rig of no chance, such as Highest
        run = rng.normal(0.0, run_sd, (count, 1)) if count > 1 else 0.0
        return 0.5 + scene + run + rng.normal(0.0, 0.1, (count, 50))

    return runs(one_count) + liking, runs(other_count), 0.05


def test_intervals_of_scenes_are_right_about_as_often_as_they_say():
    rng = np.random.default_rng(8)
    held = 0
    for seed in range(100):
        one, other, truth = simulate_recall(rng)
        found = paired_difference(one, other, seed=seed, resamples=499)
        held += found.low <= truth <= found.high
    assert 88 <= held <= 99  # 94


@pytest.mark.slow
@pytest.mark.parametrize(("one_count", "other_count"), [(10, 10), (10, 1), (5, 10), (1, 1)])
def test_intervals_of_runs_are_right_about_as_often_as_they_say(one_count, other_count):
    rng = np.random.default_rng(3)
    held, refused, repeats = 0, 0, 400
    for seed in range(repeats):
        one, other, truth = simulate_runs(rng, one_count, other_count)
        held += (found := paired_difference(one, other, seed=seed, resamples=999)).low <= truth <= found.high
        refused += paired_difference(one - truth, other, seed=seed, resamples=999).p_value < 0.05
    assert 0.92 <= held / repeats <= 0.98
    assert 0.02 <= refused / repeats <= 0.08


@pytest.mark.slow
def test_intervals_of_rank_correlations_are_right_about_as_often_as_they_say():
    rng = np.random.default_rng(5)

    def rigs(count):
        objective = rng.exponential(size=count)
        return objective, np.round(1.0 - np.exp(-objective) + rng.normal(0.0, 0.1, count), 2)

    truth = scipy.stats.spearmanr(*rigs(200_000)).statistic
    repeats, held = 400, 0
    for seed in range(repeats):
        found = rank_correlation(*rigs(100), seed=seed, resamples=999)
        held += found.low <= truth <= found.high
    assert 0.91 <= held / repeats <= 0.98
