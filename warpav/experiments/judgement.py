"""What became of the hypotheses of the protocol: every one is decided by its rule and reported, failed ones as well."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.evaluation.statistics import RESAMPLES, holm, paired_difference
from warpav.experiments.protocol import Hypothesis, protocol, seal_of
from warpav.experiments.result_folder import (
    DESCRIPTION,
    objective_of_tests,
    objective_on_tests,
    read_description,
    results_in,
)
from warpav.experiments.tables import Results
from warpav.experiments.traffic_judgement import traffic_text
from warpav.experiments.traffic_protocol import holds_traffic_protocol
from warpav.experiments.traffic_settings import traffic_settings
from warpav.runs.config import read_seeds

TOLERANCE = 1e-6
"""Objectives that differ by less are the same: rounding of float32."""

RENDERS_TOLERANCE = 0.05
"""Share by which an arm may spend more renders than a rival before a comparison says so."""

SIGNIFICANT = 0.05


@dataclass(frozen=True)
class Comparison:
    """An arm against a rival in one setting."""

    setting: str
    arm: str
    rival: str
    holds: bool | None
    seeds: int = 0
    not_above: int = 0
    change: float | None = None
    low: float | None = None
    high: float | None = None
    p_value: float | None = None
    renders: float | None = None


@dataclass(frozen=True)
class Judgement:
    """What became of a hypothesis."""

    name: str
    text: str
    comparisons: tuple[Comparison, ...]
    p_value: float | None
    p_holm: float | None = None

    @property
    def holds(self) -> bool | None:
        """Whether every comparison holds; False if one fails, None if none fails and some are missing."""
        found = [each.holds for each in self.comparisons]
        return False if False in found else None if None in found else True

    @property
    def verdict(self) -> str:
        """In words."""
        if self.holds is None:
            return "not decided"
        if not self.holds:
            return "failed"
        return "holds" if self.p_holm is not None and self.p_holm < SIGNIFICANT else "holds, but may be chance"


def judge(results_of: Mapping[str, Results], *, resamples: int = RESAMPLES) -> list[Judgement]:
    """Decide all hypotheses of the protocol."""
    found = []
    for name, hypothesis in protocol().hypotheses.items():
        comparisons = tuple(
            _compared(hypothesis, setting, arm, rival, results_of.get(setting, {}), resamples)
            for setting in protocol().settings_of(hypothesis)
            for arm in hypothesis.arms
            for rival in hypothesis.rivals
        )
        p_values = [each.p_value for each in comparisons]
        known = [value for value in p_values if value is not None]
        found.append(Judgement(name, hypothesis.text, comparisons, max(known) if len(known) == len(p_values) else None))
    # hypotheses without a p-value still count among those that were asked
    corrected = holm({each.name: 1.0 if each.p_value is None else each.p_value for each in found})
    return [replace(each, p_holm=None if each.p_value is None else corrected[each.name]) for each in found]


def _compared(
    hypothesis: Hypothesis, setting: str, arm: str, rival: str, results: Results, resamples: int
) -> Comparison:
    """An arm against a rival, on the runs of the protocol's seeds that both have."""
    wanted = protocol().seeds
    runs_of = [{run["seed"]: run for run in results.get(name, ()) if run["seed"] in wanted} for name in (arm, rival)]
    ours, theirs = runs_of
    if theirs and rival in protocol().seedless:  # its one run stands against all
        theirs = dict.fromkeys(ours, next(iter(theirs.values())))
    seeds = [seed for seed in wanted if seed in ours and seed in theirs]
    if len(seeds) < 2:
        return Comparison(setting, arm, rival, None, len(seeds))
    values = np.array([[objective_on_tests(runs[seed]) for seed in seeds] for runs in (ours, theirs)], np.float64)
    scale = 1.0 - hypothesis.margin
    paired = (
        [ours[seed] for seed in seeds],
        [theirs[seed] for seed in seeds[: 1 if rival in protocol().seedless else None]],
    )
    tables = [np.array([objective_of_tests(run) for run in runs], np.float64) for runs in paired]
    difference = paired_difference(
        tables[0], scale * tables[1], weight=paired[0][0]["objects_of_scene"], resamples=resamples
    )
    mean = values.mean(axis=1)
    not_above = int((values[0] <= values[1] + TOLERANCE).sum())
    change, p_value = float(mean[0] / mean[1] - 1.0), _one_sided(difference.mean, difference.p_value)
    if hypothesis.claim == "not_above":
        holds = not_above == len(seeds)
    elif hypothesis.claim == "below":
        holds = bool(mean[0] <= scale * mean[1] + TOLERANCE)
    else:
        spread = values.std(axis=1, ddof=1)
        change, holds = float(spread[0] / spread[1] - 1.0), bool(spread[0] <= hypothesis.ratio * spread[1] + TOLERANCE)
        p_value = _smaller_spread(values[0] / hypothesis.ratio, values[1])
    return Comparison(
        setting,
        arm,
        rival,
        # fewer runs than asked cannot confirm a claim; that of every single run they can refute
        holds if len(seeds) == len(wanted) or (hypothesis.claim == "not_above" and not holds) else None,
        len(seeds),
        not_above,
        change,
        difference.low,
        difference.high,
        p_value,
        _renders_ratio(*paired),
    )


def _one_sided(mean: float | None, two_sided: float | None) -> float | None:
    """The p-value of a difference that is not below 0."""
    if mean is None or two_sided is None:
        return None
    return two_sided / 2.0 if mean < 0.0 else 1.0 - two_sided / 2.0


def _smaller_spread(ours: np.ndarray, theirs: np.ndarray) -> float | None:
    """One-sided p-value of ours not varying less than theirs, paired by seed (Pitman 1939, Morgan 1939)."""
    from scipy.stats import t

    freedom = len(ours) - 2
    if freedom < 1 or not np.std(ours) or not np.std(theirs):
        return None
    correlation = np.corrcoef(ours + theirs, ours - theirs)[0, 1]
    return float(t.cdf(correlation * np.sqrt(freedom / max(1.0 - correlation**2, 1e-12)), freedom))


def _renders_ratio(ours: Sequence[Mapping[str, Any]], theirs: Sequence[Mapping[str, Any]]) -> float | None:
    means = [float(np.mean([run["camera_renders"] for run in runs])) for runs in (ours, theirs)]
    return means[0] / means[1] if min(means) > 0.0 else None


def judged_text(folders: Sequence[Path]) -> str:
    """Decide the hypotheses by the experiments in folders, and say on which scenes, as Markdown."""
    results_of: dict[str, Results] = {}
    on_traffic: dict[str, Path] = {}
    scenes = []
    for folder in folders:
        described = read_description(folder)
        name = described["experiment"].removeprefix("rivals_")
        if name in traffic_settings() and name not in on_traffic:
            on_traffic[name] = folder
            seal = seal_of(read_seeds(json.dumps(described["options"]["scenes.test_seeds"]), str(folder)))
            seal = seal if seal is not None and holds_traffic_protocol(seal) else None
            scenes.append(_seal_text(name, seal))
            continue
        if name not in protocol().settings or name in results_of:
            raise InputError(
                f"{folder / DESCRIPTION}: experiment: expected a setting of the protocol, each once, out of "
                f"{', '.join(protocol().settings)}, got {name}; leave the folder out"
            )
        results_of[name] = results_in(folder)
        seal = seal_of(read_seeds(json.dumps(described["options"]["scenes.test_seeds"]), str(folder)))
        scenes.append(_seal_text(name, seal))
    if not results_of and not on_traffic:
        raise InputError("experiment judge: expected folders of experiments such as runs/rivals_4x90, got none")
    parts = [judgements_text(judge(results_of))] if results_of else []
    if on_traffic:
        parts.append(traffic_text(on_traffic))
    return "\n".join([*parts, *scenes, ""])


def _seal_text(name: str, seal: str | None) -> str:
    return f"- {name}: " + ("test scenes that nobody sealed: no evidence" if seal is None else f"sealed by {seal}")


def judgements_text(judgements: Sequence[Judgement]) -> str:
    """The verdicts and their numbers as Markdown."""
    lines = ["| hypothesis | verdict | p, Holm |", "| --- | --- | ---: |"]
    for each in judgements:
        p_holm = "-" if each.p_holm is None else f"{each.p_holm:.2g}"
        lines.append(f"| {each.name}: {each.text} | **{each.verdict}** | {p_holm} |")
    lines += ["", "| hypothesis | setting | arm | rival | seeds not above | change | 95 % interval | p | renders |"]
    lines.append("| --- " * 4 + "| ---: " * 5 + "|")
    lines += [_comparison_line(each.name, one) for each in judgements for one in each.comparisons]
    notes = (
        "Change: mean objective of the arm over that of the rival, less 1 (of a spread: of the standard deviations). "
        "Interval: arm - (1 - margin) rival, BCa bootstrap over test scenes and runs. p: one-sided; that of a "
        "hypothesis is the largest of its comparisons, corrected by Holm's method for the number of hypotheses. "
        f"Renders: those of the arm over those of the rival, ! above {1.0 + RENDERS_TOLERANCE:g}. ✗: fails here.",
    )
    return "\n".join([*lines, "", *notes, ""])


def _comparison_line(name: str, one: Comparison) -> str:
    if one.change is None:
        return f"| {name} | {one.setting} | {one.arm} | {one.rival} | no results | | | | |"
    interval = "-" if one.low is None else f"[{one.low:+.4f}, {one.high:+.4f}]"
    p_value = "-" if one.p_value is None else f"{one.p_value:.2g}"
    renders = "-" if one.renders is None else f"{one.renders:.2f}{'!' if one.renders > 1.0 + RENDERS_TOLERANCE else ''}"
    failed = " ✗" if one.holds is False else ""
    cells = (name, one.setting, one.arm, one.rival, f"{one.not_above} of {one.seeds}{failed}", f"{one.change:+.1%}")
    return "| " + " | ".join([*cells, interval, p_value, renders]) + " |"
