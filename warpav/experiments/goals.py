"""Goals of the default method, checked on the results of an experiment and reported whether reached or not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from warpav.evaluation.statistics import RESAMPLES, Difference, paired_difference
from warpav.experiments.tables import COMPARED, ArmsTable, Results

RIVALS = ("highest", "random", "cma")
"""Arms that the default method must not lose to in any of the detection metrics."""

BASELINES = ("highest", "random", "sobol")
"""Arms whose rig, of the same run seed, it must not lose to on its own objective."""

SPREADS_MAX = {"tp_detection_rate": 0.02, "ap50_pooled": 0.015}
"""Largest standard deviation over runs."""

PRESET_GAIN_MIN = 0.10
"""Least relative gain of recall above a preset with as many cameras."""

ELSEWHERE = ("thesis_gradient", "thesis_as_printed")
"""Arms whose search uses other constraints than their evaluation."""

TOLERANCE = 1e-6
"""Objectives that differ by less are the same: rounding of float32."""

_ABOVE = ("tp_detection_rate", "ap50_pooled", "tp_in_frame_rate")


@dataclass(frozen=True)
class Goal:
    """Something to reach."""

    text: str
    reached: bool | None
    numbers: str

    @property
    def verdict(self) -> str:
        """The answer in words."""
        return {True: "reached", False: "not reached", None: "not measured"}[self.reached]

    def __str__(self) -> str:
        return f"{self.verdict}: {self.text} ({self.numbers})"

    def data(self) -> dict[str, Any]:
        """For a JSON file."""
        return asdict(self)


def goals_text(goals: Sequence[Goal]) -> str:
    """The goals as a list in Markdown."""
    return "\n".join(["**Goals**", "", *(f"- **{goal.verdict}**: {goal.text} ({goal.numbers})" for goal in goals), ""])


def goals_of(results: Results, table: ArmsTable, presets: Sequence[str], *, resamples: int = RESAMPLES) -> list[Goal]:
    """The goals of the open experiment."""
    reference = results[table.reference]
    return [
        _no_violation(results),
        _below_baselines("validation", results, reference),
        _below_baselines("test", results, reference),
        *(_above_rivals(metric, table) for metric in _ABOVE),
        *(_interval_above(rival, table) for rival in RIVALS),
        *(_small_spread(metric, table) for metric in SPREADS_MAX),
        *(_above_preset(preset, results, resamples) for preset in presets),
    ]


def _no_violation(results: Results) -> Goal:
    by_arm = {arm: max(run["metrics"]["constraint_violation"] for run in runs) for arm, runs in results.items() if runs}
    elsewhere = {arm: by_arm.pop(arm) for arm in ELSEWHERE if arm in by_arm}
    count = sum(len(results[arm]) for arm in by_arm)
    if not by_arm:
        return Goal("constraint violation 0 on every run", None, "no other arm has run")
    worst = max(by_arm, key=by_arm.__getitem__)
    numbers = f"worst of {count} runs {by_arm[worst]:g} m" + (f", by {worst}" if by_arm[worst] else "")
    text = "constraint violation 0 on every run of every arm"
    if elsewhere:
        text += f" except {' and '.join(elsewhere)}, searched in the thesis's bounding rectangle"
        numbers += "".join(f"; {arm} up to {far:.3f} m outside the mount zone" for arm, far in elsewhere.items())
    return Goal(text, by_arm[worst] == 0.0, numbers)


def _below_baselines(scenes: str, results: Results, reference: Sequence[Mapping[str, Any]]) -> Goal:
    """No run ends above the best baseline of the same run seed, on the objective of its own."""
    baselines = [arm for arm in BASELINES if results.get(arm)]
    best_of = ", ".join(baselines or BASELINES)
    text = f"objective on the {scenes} scenes at most that of the best of {best_of} in every run"
    gaps = []
    for run in reference:
        ours = _objective(run, scenes)
        others = [
            _objective(other, scenes)
            for arm in baselines
            for other in results[arm]
            if other["seed"] == run["seed"] or len(results[arm]) == 1
        ]
        others = [value for value in others if value is not None]
        if ours is not None and others:
            gaps.append(ours - min(others))
    if not gaps:
        return Goal(text, None, "no objectives of baselines")
    above = sum(gap > TOLERANCE for gap in gaps)
    numbers = f"{len(gaps) - above} of {len(gaps)} runs; difference {min(gaps):+.4f} to {max(gaps):+.4f}"
    return Goal(text, above == 0, numbers)


def _objective(run: Mapping[str, Any], scenes: str) -> float | None:
    if scenes == "test":
        return run["metrics"]["objective"]
    return next(iter(run.get("validation_objectives", {}).values()), None)


def _above_rivals(metric: str, table: ArmsTable) -> Goal:
    ours = table.numbers[metric][table.reference].mean
    rivals = {arm: table.numbers[metric][arm].mean for arm in RIVALS if arm in table.numbers[metric]}
    text = f"{COMPARED[metric]} at least that of {', '.join(RIVALS)}"
    known = {arm: value for arm, value in rivals.items() if value is not None}
    if ours is None or not known:
        return Goal(text, None, "no baseline has run")
    numbers = f"{ours:.4f} against " + ", ".join(f"{arm} {value:.4f}" for arm, value in known.items())
    lost = [arm for arm, value in known.items() if ours < value]
    for arm in lost:
        numbers += f"; paired difference to {arm} {_interval(table.differences[metric][arm])}"
    missing = [arm for arm in RIVALS if arm not in known]
    if missing:
        numbers += f"; no result of {', '.join(missing)}"
    return Goal(text, False if lost else None if missing else True, numbers)


def _interval_above(rival: str, table: ArmsTable) -> Goal:
    text = f"interval of recall's paired difference to {rival} above 0"
    difference = table.differences["tp_detection_rate"].get(rival)
    if difference is None or difference.low is None:
        return Goal(text, None, "no interval")
    return Goal(text, difference.low > 0.0, _interval(difference))


def _interval(difference: Difference) -> str:
    if difference.mean is None:
        return "-"
    if difference.low is None or difference.high is None:
        return f"{difference.mean:+.4f}"
    return f"{difference.mean:+.4f} [{difference.low:+.4f}, {difference.high:+.4f}]"


def _small_spread(metric: str, table: ArmsTable) -> Goal:
    limit = SPREADS_MAX[metric]
    text = f"standard deviation of {COMPARED[metric]} over runs at most {limit:g}"
    cell = table.numbers[metric][table.reference]
    if cell.std is None:
        return Goal(text, None, f"{table.runs[table.reference]} run")
    return Goal(text, cell.std <= limit, f"{cell.std:.4f} over {table.runs[table.reference]} runs")


def _above_preset(preset: str, results: Results, resamples: int) -> Goal:
    ours, theirs = results.get(f"default_as_{preset}"), results.get(preset)
    text = f"recall at least {PRESET_GAIN_MIN:.0%} above {preset}'s with the same number of cameras (relative)"
    if not ours or not theirs:
        return Goal(text, None, "not among the arms")
    recall = [float(np.mean([run["metrics"]["tp_detection_rate"] for run in runs])) for runs in (ours, theirs)]
    gain = recall[0] / recall[1] - 1.0 if recall[1] > 0.0 else math.inf
    difference = paired_difference(
        *([run["metrics"]["per_scene"]["tp_detection_rate"] for run in runs] for runs in (ours, theirs)),
        weight=ours[0]["objects_of_scene"],
        resamples=resamples,
    )
    numbers = f"{recall[0]:.4f} against {recall[1]:.4f}, {gain:+.1%}; difference {_interval(difference)}"
    if (1.0 + PRESET_GAIN_MIN) * recall[1] > 1.0:
        numbers += f"; impossible: {1.0 + PRESET_GAIN_MIN:.0%} of it exceeds 1"
    return Goal(text, gain >= PRESET_GAIN_MIN, numbers)
