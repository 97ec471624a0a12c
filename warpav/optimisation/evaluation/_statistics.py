"""Statistics of arms over scenes and runs: 95 % intervals, p-values, rank correlations, standard deviations.

The scene is the sampling unit: every arm is evaluated on the same test scenes, so arms are compared scene by scene, and
scenes are resampled. An arm with several runs has a second source of variance, its run seeds, which are resampled as
well. All bootstrap intervals are bias-corrected and accelerated (BCa).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from warpav.optimisation.evaluation._metrics import OPTIONAL_METRICS, PAIRED_METRICS, ArmMetrics

RESAMPLES = 9999
LEVEL = 0.95
"""Confidence level of the intervals."""

_BATCH = 1000  # resamples at a time, for memory

_Numbers = Sequence[float | None] | Sequence[Sequence[float | None]] | np.ndarray
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
    p_value: float | None = field(default=None, kw_only=True)
    scenes: int

    def to_json(self) -> dict[str, float | int | None]:
        return {"mean": self.mean, "low": self.low, "high": self.high, "scenes": self.scenes}


def paired_difference(
    one: _Numbers,
    other: _Numbers,
    *,
    weight: Sequence[float | None] | np.ndarray | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Difference:
    """Mean difference of a metric, one - other, over the same scenes.

    The scenes are resampled, together for both arms; so are the runs of an arm that has several, each arm's by
    themselves. As every run sees the same scenes, runs and scenes are crossed, not nested: a resampled run keeps the
    resampled scenes. Resampling the scenes separately for every run would attribute the difficulty of a scene to chance
    of a run, and make the interval too short.
    """
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
    if not count:
        return Difference(None, None, None, count)

    noise = _NOISE * max(float(np.abs(table).max()) for table in (first, second))

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
        found = np.average(by_scene[0] - by_scene[1], weights=weights[scenes], axis=-1)
        return np.where(np.abs(found) <= noise, 0.0, found)  # sums in another order are no difference

    units = [np.arange(count), *(np.arange(len(table)) for table in (first, second) if len(table) > 1)]
    mean = float(combined(*units))
    if count < 2:
        return Difference(mean, None, None, count)
    interval_at = _interval_at(units, combined, seed=seed, resamples=resamples)
    p_value = _p_value(interval_at, max(1.0 / (resamples + 1), 2.0 ** (1 - count)))
    return Difference(mean, *interval_at(LEVEL), count, p_value=p_value)


def paired_differences(optimised: ArmMetrics, other: ArmMetrics, *, seed: int = 0) -> dict[str, Difference]:
    """`paired_difference` of the metrics of two rigs on the same scenes, weighted as `ArmMetrics.scene_weights`."""
    one, two = optimised.per_scene, other.per_scene
    names = (*PAIRED_METRICS, *(name for name in OPTIONAL_METRICS if name in one and name in two))
    return {
        name: paired_difference(one[name], two[name], weight=optimised.scene_weights(name), seed=seed) for name in names
    }


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


def _spearman(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Spearman's rank correlation along the last axis, 0 where all of one are level."""
    from scipy.stats import rankdata

    ranks = [rankdata(numbers, axis=-1) for numbers in (one, other)]
    x, y = (rank - rank.mean(axis=-1, keepdims=True) for rank in ranks)
    scale = np.sqrt((x * x).sum(axis=-1) * (y * y).sum(axis=-1))
    return np.divide((x * y).sum(axis=-1), scale, out=np.zeros_like(scale), where=scale > 0.0)


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


_NOISE = 1e-12  # of the greatest number: a difference up to which is rounding
