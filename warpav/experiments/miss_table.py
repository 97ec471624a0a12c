"""What arms miss of all road users and of those that can be found, beside the arm of reference, and goals about it.

The numbers are those of one judge: the detector of the search, or a network of a panel. `miss_table` makes the table of
a judge from results, `miss_goals` says what all judges together make of the goals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpav.evaluation.statistics import (
    RESAMPLES,
    Difference,
    compare_arms,
    mean_over_scenes,
    paired_difference,
    relative_reduction,
)
from warpav.experiments.goals import Goal
from warpav.experiments.result_folder import ATTAINABLE
from warpav.experiments.tables import Results
from warpav.experiments.traffic_protocol import traffic_protocol
from warpav.runs.terminal import TextTable

OWN_JUDGE = "the detector of the search"
REFERENCE = "default"
PRACTICE = ("highest", "roof_edge")
"""Arms that are the practice to beat: around the highest point, and at the edge of the roof."""
BEATEN = (*PRACTICE, "random_selected", "cma")
"""Arms that the reference is to miss less than."""
REDUCTION_MIN = next(each.reduction for each in traffic_protocol().hypotheses.values() if each.reduction is not None)
"""Least share by which the reference is to lower what the practice misses of what can be found."""
OUTSIDE_MIN = traffic_protocol().outside
"""Outside networks that have to agree."""

EXPECTED, ALL, FOUND = "expected_misses", "misses", "attainable_misses"
"""Per 100 road users: what is expected to be missed, what the judge misses, and that of what can be found."""
_PER_SCENE = {
    EXPECTED: ("objective", 100.0),
    ALL: ("misses_per_100", 1.0),
    FOUND: ("attainable_misses_per_100", 1.0),
}
_EQUAL = 1e-9
_WORDS = {
    EXPECTED: "expected misses per 100",
    ALL: "misses per 100",
    FOUND: "misses per 100 attainable",
}


@dataclass(frozen=True)
class MissRow:
    """An arm."""

    arm: str
    seeds: tuple[int, ...]
    misses: dict[str, Difference]
    less: dict[str, Difference]
    reductions: dict[str, Difference]
    wins: int
    compared: int


@dataclass(frozen=True)
class MissTable:
    """What a judge says of all arms."""

    judge: str
    scenes: int
    objects: int
    attainable: int
    practice: str | None
    reduction_p: float | None
    rows: tuple[MissRow, ...]

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> MissTable:
        """The table that a JSON file holds."""
        rows = [
            MissRow(
                **{
                    **row,
                    "seeds": tuple(row["seeds"]),
                    "misses": {name: Difference(**each) for name, each in row["misses"].items()},
                    "less": {name: Difference(**each) for name, each in row["less"].items()},
                    "reductions": {name: Difference(**each) for name, each in row["reductions"].items()},
                }
            )
            for row in data["rows"]
        ]
        return cls(**{**data, "rows": tuple(rows)})

    def row(self, arm: str) -> MissRow | None:
        """The arm of this name; None if it has no results."""
        return next((row for row in self.rows if row.arm == arm), None)

    @property
    def text(self) -> TextTable:
        """The table."""
        metrics = [metric for metric in _WORDS if any(metric in row.misses for row in self.rows)]
        practice = [arm for arm in PRACTICE if self.row(arm) is not None]
        lines = []
        for row in self.rows:
            cells = [row.arm, str(len(row.seeds))]
            for metric in metrics:
                cells.append(number_text(row.misses.get(metric), 1.0, ".2f"))
                if metric != EXPECTED:
                    cells.append(number_text(row.less.get(metric), 1.0, "+.2f", with_p=True))
            cells += [number_text(row.reductions.get(arm), 100.0, "+.1f") for arm in practice]
            cells.append(f"{row.wins} of {row.compared}" if row.compared else "-")
            lines.append(cells)
        headings = ["arm", "runs"]
        for metric in metrics:
            headings.append(_WORDS[metric])
            if metric != EXPECTED:
                headings.append(f"less {REFERENCE}")
        return TextTable(
            f"Misses by {self.judge}",
            [*headings, *(f"% fewer attainable than {arm}" for arm in practice), "wins"],
            lines,
            f"{self.objects} road users in {self.scenes} unseen scenes, {self.attainable} of them attainable: some "
            "single camera on the mount is likely to detect them. Brackets: 95 % interval, BCa over scenes and runs; "
            "p: of no difference, corrected by Holm's method for the arms, * below 0.05. Wins: runs in which "
            f"{REFERENCE} misses at most as many of all as the run of the same seed.",
        )


def miss_table(judge: str, results: Results, *, resamples: int = RESAMPLES) -> MissTable | None:
    """The table of a judge; None where no result says what can be found."""
    there = {arm: runs for arm, runs in results.items() if runs and all(ATTAINABLE in run for run in runs)}
    if not there:
        return None
    first = next(iter(there.values()))[0]
    objects = np.array(first["objects_of_scene"], np.float64)
    attainable = np.array([sum(each) for each in first[ATTAINABLE]], np.float64)
    weights = {EXPECTED: objects, ALL: objects, FOUND: attainable}
    tables: dict[str, dict[str, np.ndarray]] = {}
    for metric, (name, factor) in _PER_SCENE.items():
        found = {
            arm: factor * np.array([run["metrics"]["per_scene"].get(name) for run in runs], np.float64)
            for arm, runs in there.items()
            if all(run["metrics"]["per_scene"].get(name) is not None for run in runs)
        }
        tables[metric] = {arm: table for arm, table in found.items() if np.isfinite(table).any()}
    nothing = np.zeros(len(objects))
    less: dict[str, dict[str, Difference]] = {}
    for metric, of_arm in tables.items():
        less[metric] = {}
        if REFERENCE in of_arm:
            others = {arm: table for arm, table in of_arm.items() if arm != REFERENCE}
            compared = compare_arms(of_arm[REFERENCE], others, weight=weights[metric], resamples=resamples)
            less[metric] = {arm: _turned(each) for arm, each in compared.items()}
    practice = min(
        (arm for arm in PRACTICE if arm in tables[FOUND]),
        key=lambda arm: mean_over_scenes(tables[FOUND][arm], attainable),
        default=None,
    )
    reduction_p = None
    if practice is not None and REFERENCE in tables[FOUND]:
        beyond = paired_difference(
            tables[FOUND][REFERENCE],
            (1.0 - REDUCTION_MIN) * tables[FOUND][practice],
            weight=attainable,
            resamples=resamples,
        )
        if beyond.mean is not None and beyond.p_value is not None:
            reduction_p = beyond.p_value / 2.0 if beyond.mean < 0.0 else 1.0 - beyond.p_value / 2.0
    ours = {} if REFERENCE not in there else _missed(there[REFERENCE])
    rows = []
    for arm, runs in there.items():
        reductions = {
            rival: relative_reduction(tables[FOUND][arm], tables[FOUND][rival], weight=attainable, resamples=resamples)
            for rival in PRACTICE
            if rival != arm and {arm, rival} <= tables[FOUND].keys()
        }
        pairs = [] if arm == REFERENCE else _pairs(ours, _missed(runs))
        rows.append(
            MissRow(
                arm,
                tuple(run["seed"] for run in runs),
                {
                    metric: paired_difference(table[arm], nothing, weight=weights[metric], resamples=resamples)
                    for metric, table in tables.items()
                    if arm in table
                },
                {metric: each[arm] for metric, each in less.items() if arm in each},
                reductions,
                sum(mine <= theirs + _EQUAL for mine, theirs in pairs),
                len(pairs),
            )
        )
    return MissTable(judge, len(objects), int(objects.sum()), int(attainable.sum()), practice, reduction_p, tuple(rows))


def miss_goals(own: MissTable, outside: Sequence[MissTable] | None = None) -> list[Goal]:
    """What the reference is to reach, and whether it does."""
    goals = []
    for rival in BEATEN:
        text = f"fewer misses than {rival}, the interval of the difference above 0"
        numbers, reached = _beats(own, rival)
        goals.append(Goal(f"{text}, by {own.judge}", reached, numbers))
        if outside is not None:
            judged = {table.judge: _beats(table, rival) for table in outside}
            agreeing = [name for name, (_, is_less) in judged.items() if is_less]
            known = [name for name, (_, is_less) in judged.items() if is_less is not None]
            goals.append(
                Goal(
                    f"{text}, by at least {OUTSIDE_MIN} outside networks",
                    len(agreeing) >= OUTSIDE_MIN if len(known) >= OUTSIDE_MIN else None,
                    "; ".join(f"{name} {numbers}" for name, (numbers, _) in judged.items()) or "no outside network",
                )
            )
    for table in (own, *(outside or ())):
        row = table.row(REFERENCE)
        for practice in PRACTICE:
            reduction = None if row is None else row.reductions.get(practice)
            known = None if reduction is None else reduction.mean
            goals.append(
                Goal(
                    f"attainable misses at least {REDUCTION_MIN:.0%} below those of {practice}, by {table.judge}",
                    None if known is None else known >= REDUCTION_MIN,
                    f"{number_text(reduction, 100.0, '+.1f')} %" if known is not None else "not among the arms",
                )
            )
    return goals


def _beats(table: MissTable, rival: str) -> tuple[str, bool | None]:
    row = table.row(rival)
    difference = None if row is None else row.less.get(ALL)
    if difference is None or difference.low is None:
        return "no interval", None
    return number_text(difference, 1.0, "+.2f"), difference.low > 0.0


def _turned(one: Difference) -> Difference:
    """The arm less the reference, from the reference less the arm."""
    ends = [None if each is None else -each for each in (one.mean, one.high, one.low)]
    return Difference(ends[0], ends[1], ends[2], one.p_value, one.p_holm, one.scenes)


def _missed(runs: Sequence[Mapping[str, Any]]) -> dict[int, float]:
    return {run["seed"]: run["metrics"]["misses_per_100"] for run in runs}


def _pairs(ours: Mapping[int, float], theirs: Mapping[int, float]) -> list[tuple[float, float]]:
    """Values of the same run seed; an arm that needs one run alone is compared with every run."""
    if len(theirs) == 1:
        return [(value, next(iter(theirs.values()))) for value in ours.values()]
    return [(value, theirs[seed]) for seed, value in ours.items() if seed in theirs]


def number_text(number: Difference | None, factor: float, form: str, *, with_p: bool = False) -> str:
    """A number with its interval, scaled and formatted, maybe with its p-value; ``-`` where there is none."""
    if number is None or number.mean is None:
        return "-"
    text = f"{factor * number.mean:{form}}"
    if number.low is not None and number.high is not None:
        text += f" [{factor * number.low:{form}}, {factor * number.high:{form}}]"
    if with_p and number.p_holm is not None:
        text += f" p={number.p_holm:.2g}" + ("*" if number.p_holm < 0.05 else "")
    return text
