"""Statistics of arms over scenes and runs: 95 % intervals, p-values, rank correlations, standard deviations.

The scene is the sampling unit: every arm is evaluated on the same test scenes, so arms are compared scene by scene, and
scenes are resampled. An arm with several runs has a second source of variance, its run seeds, which are resampled as
well. All bootstrap intervals are bias-corrected and accelerated (BCa).
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from warpav.evaluation.metrics import OPTIONAL_METRICS, PAIRED_METRICS, ArmMetrics

RESAMPLES = 9999
LEVEL = 0.95
"""Confidence level of the intervals."""

_BATCH = 1000  # resamples at a time, for memory

Numbers = Sequence[float | None] | Sequence[Sequence[float | None]] | np.ndarray
"""A metric by scene, shape [scene], or by run and scene, [run, scene]; None or NaN where it is not defined."""


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval."""

    value: float | None
    low: float | None
    high: float | None
    count: int


@dataclass(frozen=True)
class Difference:
    """Difference of two arms on the same scenes."""

    mean: float | None
    low: float | None
    high: float | None
    p_value: float | None
    p_holm: float | None
    scenes: int


def paired_difference(
    one: Numbers,
    other: Numbers,
    *,
    weight: Sequence[float] | np.ndarray | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Difference:
    """Mean difference of a metric, one - other, over the same scenes.

    The scenes are resampled, together for both arms; so are the runs of an arm that has several, each arm's by
    themselves. As every run sees the same scenes, runs and scenes are crossed, not nested: a resampled run keeps the
    resampled scenes. Resampling the scenes separately for every run would attribute the difficulty of a scene to chance
    of a run, and make the interval too short.
    """

    def difference(ours: np.ndarray, theirs: np.ndarray, weights: np.ndarray) -> np.ndarray:
        return np.average(ours - theirs, weights=weights, axis=-1)

    return _paired(one, other, difference, weight=weight, seed=seed, resamples=resamples)


def relative_reduction(
    one: Numbers,
    other: Numbers,
    *,
    weight: Sequence[float] | np.ndarray | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Difference:
    """By which share the mean of a metric is lower than that of another arm: 1 - one / other, over the same scenes.

    Scenes and runs are resampled as by `paired_difference`, whose arguments these are; the means are divided, not the
    scenes. The p-value is that of no reduction.
    """

    def reduction(ours: np.ndarray, theirs: np.ndarray, weights: np.ndarray) -> np.ndarray:
        mean, of_other = (np.average(each, weights=weights, axis=-1) for each in (ours, theirs))
        return 1.0 - np.divide(mean, of_other, out=np.ones_like(mean), where=of_other > 0.0)

    return _paired(one, other, reduction, weight=weight, seed=seed, resamples=resamples, is_share=True)


def _paired(
    one: Numbers,
    other: Numbers,
    combine: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    *,
    weight: Sequence[float] | np.ndarray | None,
    seed: int,
    resamples: int,
    is_share: bool = False,
) -> Difference:
    """A number of two arms on the same scenes with its interval, as `paired_difference` gives it."""
    tables = [np.atleast_2d(np.array(numbers, np.float64)) for numbers in (one, other)]
    scene_count = tables[0].shape[1]
    weights = np.ones(scene_count) if weight is None else np.asarray(weight, np.float64)
    if tables[1].shape[1] != scene_count or weights.shape != (scene_count,):
        raise ValueError(
            f"arms must have the same scenes and a weight for each, got {scene_count} and {tables[1].shape[1]} scenes "
            f"and {weights.size} weights"
        )
    if not (weights >= 0.0).all():
        raise ValueError("weights must be 0 or more")
    kept = np.isfinite(np.concatenate(tables)).all(axis=0) & (weights > 0.0)
    first, second = (table[:, kept] for table in tables)
    weights = weights[kept]
    count = len(weights)
    if not count or (is_share and not second.any()):
        return Difference(None, None, None, None, None, count)

    noise = _NOISE * (1.0 if is_share else max(float(np.abs(table).max()) for table in (first, second)))

    def combined(scenes: np.ndarray, *runs: np.ndarray, axis: int = -1) -> np.ndarray:
        """Of resampled indices, [..., scene] and, for every arm of several runs, [..., run]."""
        del axis  # always the last
        runs_left = iter(runs)
        by_scene = []
        for table in (first, second):
            if len(table) > 1:
                by_scene.append(table[next(runs_left)[..., :, None], scenes[..., None, :]].mean(axis=-2))
            else:
                by_scene.append(table[0, scenes])
        found = combine(by_scene[0], by_scene[1], weights[scenes])
        return np.where(np.abs(found) <= noise, 0.0, found)  # sums in another order are no difference

    units = [np.arange(count), *(np.arange(len(table)) for table in (first, second) if len(table) > 1)]
    mean = float(combined(*units))
    if count < 2:
        return Difference(mean, None, None, None, None, count)
    interval_at = _interval_at(units, combined, seed=seed, resamples=resamples)
    p_value = _p_value(interval_at, max(1.0 / (resamples + 1), 2.0 ** (1 - count)))
    return Difference(mean, *interval_at(LEVEL), p_value, None, count)


def mean_over_scenes(numbers: Numbers, weight: Sequence[float] | np.ndarray) -> float:
    """Mean of a metric over its runs and the scenes that have a weight; NaN where one of these has no number."""
    table, weights = np.atleast_2d(np.array(numbers, np.float64)), np.asarray(weight, np.float64)
    kept = weights > 0.0
    return float(np.average(table[:, kept].mean(axis=0), weights=weights[kept]))


def compare_arms(
    one: Numbers,
    others: Mapping[str, Numbers],
    *,
    weight: Sequence[float] | np.ndarray | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> dict[str, Difference]:
    """`paired_difference` of an arm to every other, with p-values corrected by Holm's method."""
    found = {
        name: paired_difference(one, numbers, weight=weight, seed=seed, resamples=resamples)
        for name, numbers in others.items()
    }
    corrected = holm({name: each.p_value for name, each in found.items() if each.p_value is not None})
    return {name: replace(each, p_holm=corrected.get(name)) for name, each in found.items()}


def holm(p_values: Mapping[str, float]) -> dict[str, float]:
    """Holm's correction: among those below 0.05, the probability of any false positive is at most 5 %."""
    corrected, largest = {}, 0.0
    for rank, name in enumerate(sorted(p_values, key=p_values.__getitem__)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[name]))
        corrected[name] = largest
    return {name: corrected[name] for name in p_values}


def paired_differences(
    optimised: ArmMetrics, other: ArmMetrics, *, seed: int = 0
) -> dict[str, dict[str, float | int | None]]:
    """`paired_difference` of the metrics of two rigs on the same scenes, all scenes alike."""
    result: dict[str, dict[str, Any]] = {}
    has_both = [name in optimised.per_scene and name in other.per_scene for name in OPTIONAL_METRICS]
    for name in (*PAIRED_METRICS, *itertools.compress(OPTIONAL_METRICS, has_both)):
        found = asdict(paired_difference(optimised.per_scene[name], other.per_scene[name], seed=seed))
        result[name] = {key: found[key] for key in ("mean", "low", "high", "scenes")}
    return result


def rank_correlation(
    one: Sequence[float | None] | np.ndarray,
    other: Sequence[float | None] | np.ndarray,
    *,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Spearman's rank correlation of two metrics over rigs; rigs are resampled."""
    if len(one) != len(other):
        raise ValueError(f"both must have as many numbers, got {len(one)} and {len(other)}")
    pairs = np.array([one, other], np.float64)
    pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
    count = pairs.shape[1]
    if count < 2 or not np.ptp(pairs, axis=1).all():
        return Estimate(None, None, None, count)

    def correlation(rigs: np.ndarray, axis: int = -1) -> np.ndarray:
        """Of resampled rigs, [..., rig]; 0 where all are the same."""
        del axis  # always the last
        return _spearman(pairs[0][rigs], pairs[1][rigs])

    value = float(correlation(np.arange(count)))
    if count < 4:
        return Estimate(value, None, None, count)
    interval_at = _interval_at([np.arange(count)], correlation, seed=seed, resamples=resamples)
    return Estimate(value, *interval_at(LEVEL), count)


@dataclass(frozen=True)
class OrderAgreement:
    """Whether two judges put the same items in the same order; 1 if so, -1 in the opposite order."""

    spearman: Estimate
    kendall: Estimate


def order_agreement(
    one: Sequence[Numbers],
    other: Sequence[Numbers],
    *,
    weight: Sequence[float] | np.ndarray | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> OrderAgreement:
    """Rank correlations of two metrics of the same items, such as arms that two detectors judge on the same scenes.

    The items stay; the scenes are resampled, together for all items and both metrics, and so are the runs of an item
    that has several. An item that leads by chance of the scenes changes its rank in the resamples.
    """
    tables = [[np.atleast_2d(np.array(numbers, np.float64)) for numbers in items] for items in (one, other)]
    shapes = [[table.shape for table in each] for each in tables]
    scene_count = shapes[0][0][1] if shapes[0] else 0
    if shapes[0] != shapes[1] or any(shape[1] != scene_count for shape in shapes[0]):
        raise ValueError(f"both must have the same items, runs and scenes, got {shapes[0]} and {shapes[1]}")
    weights = np.ones(scene_count) if weight is None else np.asarray(weight, np.float64)
    if weights.shape != (scene_count,) or not (weights >= 0.0).all():
        raise ValueError(f"expected a weight of at least 0 for each of {scene_count} scenes, got {weights}")
    count = len(tables[0])
    kept = weights > 0.0
    for table in (*tables[0], *tables[1]):
        kept &= np.isfinite(table).all(axis=0)
    weights = weights[kept]
    tables = [[table[:, kept] for table in each] for each in tables]
    nothing = Estimate(None, None, None, count)
    if count < 2 or not len(weights):
        return OrderAgreement(nothing, nothing)

    def means(items: Sequence[np.ndarray], scenes: np.ndarray, runs: Sequence[np.ndarray]) -> np.ndarray:
        """Of resampled indices, [..., item]."""
        runs_left = iter(runs)
        of_item = [
            table[next(runs_left)[..., :, None], scenes[..., None, :]].mean(axis=-2)
            if len(table) > 1
            else table[0, scenes]
            for table in items
        ]
        return np.stack([np.average(numbers, weights=weights[scenes], axis=-1) for numbers in of_item], axis=-1)

    units = [np.arange(len(weights)), *(np.arange(len(table)) for table in tables[0] if len(table) > 1)]

    def estimate(correlation: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Estimate:
        def statistic(scenes: np.ndarray, *runs: np.ndarray, axis: int = -1) -> np.ndarray:
            del axis  # always the last
            return correlation(*(_without_rounding(means(items, scenes, runs)) for items in tables))

        values = [_without_rounding(means(items, units[0], units[1:])) for items in tables]
        if not all(np.ptp(numbers) for numbers in values):
            return nothing
        value = float(correlation(*values))
        if len(weights) < 2:
            return Estimate(value, None, None, count)
        # BCa would take it for bias that resamples of a correlation of 1 are all below: [1, 1] however close the items
        interval_at = _interval_at(units, statistic, seed=seed, resamples=resamples, methods=("percentile",))
        return Estimate(value, *interval_at(LEVEL), count)

    return OrderAgreement(estimate(_spearman), estimate(_kendall))


def _without_rounding(means: np.ndarray) -> np.ndarray:
    """Means whose sums differ by rounding alone are level."""
    return means.round(12)


def _spearman(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Spearman's rank correlation along the last axis, 0 where all of one are level."""
    from scipy.stats import rankdata

    ranks = [rankdata(numbers, axis=-1) for numbers in (one, other)]
    x, y = (rank - rank.mean(axis=-1, keepdims=True) for rank in ranks)
    scale = np.sqrt((x * x).sum(axis=-1) * (y * y).sum(axis=-1))
    return np.divide((x * y).sum(axis=-1), scale, out=np.zeros_like(scale), where=scale > 0.0)


def _kendall(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Kendall's tau-b along the last axis, 0 where all of one are level."""
    first, second = np.triu_indices(one.shape[-1], 1)
    x, y = (np.sign(numbers[..., first] - numbers[..., second]) for numbers in (one, other))
    scale = np.sqrt((x * x).sum(axis=-1) * (y * y).sum(axis=-1))
    return np.divide((x * y).sum(axis=-1), scale, out=np.zeros_like(scale), where=scale > 0.0)


def run_spread(numbers: Sequence[float | None] | np.ndarray) -> Estimate:
    """Standard deviation of a metric over runs, with the interval of a normal distribution (chi-squared)."""
    from scipy.stats import chi2

    finite = np.array(numbers, np.float64)
    finite = finite[np.isfinite(finite)]
    count = len(finite)
    if count < 2:
        return Estimate(None, None, None, count)
    value = float(finite.std(ddof=1))
    tail = (1.0 - LEVEL) / 2.0
    low, high = (value * math.sqrt((count - 1) / chi2.ppf(share, count - 1)) for share in (1.0 - tail, tail))
    return Estimate(value, low, high, count)


def _interval_at(
    units: Sequence[np.ndarray],
    statistic: Callable[..., np.ndarray],
    *,
    seed: int,
    resamples: int,
    methods: Sequence[Literal["BCa", "percentile"]] = ("BCa", "percentile"),
) -> Callable[[float], tuple[float, float]]:
    """Resample, and return a function that gives the statistic's interval at a level."""
    from scipy.stats import DegenerateDataWarning, bootstrap

    # the resamples are drawn once; an interval at another level takes them from the first one's result
    drawn = bootstrap(
        units,
        statistic,
        n_resamples=resamples,
        batch=_BATCH,
        vectorized=True,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    distribution = drawn.bootstrap_distribution
    if np.ptp(distribution) <= 1e-12 * np.abs(distribution).max():  # but for rounding, all are the same number
        return lambda _: (float(distribution[0]), float(distribution[0]))

    def interval_at(level: float) -> tuple[float, float]:
        low = high = math.nan
        for method in methods:  # BCa has none where leaving out any one unit changes nothing
            with (
                warnings.catch_warnings(action="ignore", category=DegenerateDataWarning),
                np.errstate(invalid="ignore"),
            ):
                low, high = bootstrap(
                    units,
                    statistic,
                    n_resamples=0,
                    bootstrap_result=drawn,
                    confidence_level=level,
                    batch=_BATCH,
                    vectorized=True,
                    method=method,
                ).confidence_interval
            if math.isfinite(low) and math.isfinite(high):
                break
        return float(low), float(high)

    return interval_at


def _p_value(interval_at: Callable[[float], tuple[float, float]], least: float) -> float:
    """1 - the highest level at which the interval excludes 0, to 1 %; not below ``least``."""
    leaves_out, holds = 1.0, least
    while leaves_out > 1.01 * holds:
        middle = math.sqrt(leaves_out * holds)
        low, high = interval_at(1.0 - middle)
        if low <= 0.0 <= high:
            holds = middle
        else:
            leaves_out = middle
    return leaves_out


_NOISE = 1e-12
"""Of the greatest number: a difference up to which is rounding."""
