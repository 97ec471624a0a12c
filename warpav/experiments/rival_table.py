"""What came of the rivals at equal terms: objectives of every arm, where the default's come from, goals, a figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpav.evaluation.statistics import RESAMPLES, Difference, compare_arms
from warpav.experiments.goals import TOLERANCE, Goal
from warpav.experiments.result_folder import objective_of_tests, objective_on_tests
from warpav.experiments.tables import Results
from warpav.runs.terminal import Group, TerminalTable, shown

REFERENCE = "default"
OURS = ("default", "pool_only", "descent_only", "descent")
"""Arms of our own; all others are rivals."""

CHANCE = ("random", "random_selected", "sobol", "sobol_selected")
"""Arms that none of ours must be behind."""

GAINS_MIN = {False: 0.03, True: 0.05}
"""Least share by which the polish and the prices lower the objective of the pool alone, by whether pitch is free."""

STAGES = ("selection", "descent", "pricing")
"""Where the improvement over the start comes from: the first selection, its polish, all later rounds."""


@dataclass(frozen=True)
class ArmRow:
    """An arm of a setting.

    Attributes:
        seconds: Of a search, mean [s].
    """

    arm: str
    seeds: tuple[int, ...]
    seen: tuple[float, ...]
    unseen: tuple[float, ...]
    camera_renders: float
    seconds: float
    violation_m: float
    bound: float | None
    gap: float | None
    recall: float | None
    difference: Difference | None
    wins: int
    compared: int


@dataclass(frozen=True)
class RivalTable:
    """All arms of a setting."""

    rows: tuple[ArmRow, ...]
    missing: tuple[str, ...]
    shares: dict[str, float]
    goals: tuple[Goal, ...]
    figure: str | None = None

    def with_figure(self, results: Results, path: Path, *, title: str) -> RivalTable:
        """The same, with its figure drawn."""
        from warpav.view.figures.convergence import objective_over_renders

        curves = {
            arm: [(run["history"]["camera_renders"], run["history"]["best_value"]) for run in runs if run["history"]]
            for arm, runs in results.items()
        }
        curves = {arm: found for arm, found in curves.items() if found}
        level = {row.arm: float(np.median(row.seen)) for row in self.rows if row.arm not in curves}
        level = {arm: value for arm, value in level.items() if math.isfinite(value)}
        if not curves:
            return self
        return replace(self, figure=objective_over_renders(curves, path, level=level, title=title).name)

    def markdown(self) -> str:
        """The table as Markdown."""
        lines = ["| " + " | ".join(_HEADINGS) + " |", "| --- |" + " ---: |" * (len(_HEADINGS) - 1)]
        lines += ["| " + " | ".join(_cells(row)) + " |" for row in self.rows]
        figure = ["", f"![Objective over camera renders]({self.figure})"] if self.figure else []
        seeds = ["", "| seed | " + " | ".join(row.arm for row in self.rows) + " |"]
        seeds.append("| ---: |" + " ---: |" * len(self.rows))
        every = sorted({seed for row in self.rows for seed in row.seeds})
        for seed in every:
            found = [dict(zip(row.seeds, row.unseen, strict=True)).get(seed) for row in self.rows]
            cells = ("-" if each is None or math.isnan(each) else f"{each:.4f}" for each in found)
            seeds.append(f"| {seed} | " + " | ".join(cells) + " |")
        return "\n".join([*lines, "", *(f"- {note}" for note in self.notes), *figure, *seeds, ""])

    def terminal(self) -> Group:
        """The table for the console."""
        table = TerminalTable(has_frame=False)
        for heading in _HEADINGS:
            table.add_column(heading, justify="left" if heading == "arm" else "right", overflow="fold")
        for row in self.rows:
            table.add_row(*_cells(row), style="bold" if row.arm == REFERENCE else None)
        return Group(table, *map(shown, self.notes))

    def data(self) -> dict[str, Any]:
        """For a JSON file."""
        return asdict(self)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the reader."""
        shares = ", ".join(f"{stage} {share:.0%}" for stage, share in self.shares.items())
        return (
            "Objective: expected miss rate, mean ± standard deviation over runs; seen: the scenes that all searches "
            f"choose on. Difference: {REFERENCE} - arm on the unseen scenes [95 % interval, BCa over scenes and runs].",
            f"Wins: runs in which {REFERENCE} is at most as high on the unseen scenes. Camera renders (one scene, one "
            "camera, with or without a gradient) and seconds: mean of a search. Gap: objective on the seen scenes less "
            "the proven bound of the arm's own pool; below 0 where the polish went below what the pool can reach.",
            *((f"Improvement of {REFERENCE} over its start on the seen scenes: {shares}.",) if shares else ()),
            *((f"No result: {', '.join(self.missing)}.",) if self.missing else ()),
        )


_HEADINGS = ("arm", "runs", "unseen", "seen", "difference", "wins", "gap", "recall", "camera renders", "seconds")


def _cells(row: ArmRow) -> list[str]:
    difference = "-"
    if row.difference is not None and row.difference.mean is not None:
        difference = f"{row.difference.mean:+.4f}"
        if row.difference.low is not None:
            difference += f" [{row.difference.low:+.4f}, {row.difference.high:+.4f}]"
    return [
        row.arm,
        str(len(row.seeds)),
        _spread(row.unseen),
        _spread(row.seen),
        difference,
        f"{row.wins} of {row.compared}" if row.difference is not None else "-",
        "-" if row.gap is None else f"{row.gap:+.4f}",
        "-" if row.recall is None else f"{row.recall:.4f}",
        f"{row.camera_renders:.0f}",
        f"{row.seconds:.1f}",
    ]


def _spread(values: Sequence[float]) -> str:
    if np.isnan(values).any():
        return "-"
    spread = f" ±{np.std(values, ddof=1):.4f}" if len(values) > 1 else ""
    return f"{np.mean(values):.4f}{spread}"


def rival_table(results: Results, *, pitch_is_free: bool, resamples: int = RESAMPLES) -> RivalTable:
    """The table of a setting."""
    there = {arm: runs for arm, runs in results.items() if runs}
    if not there:
        raise ValueError("expected results of at least one arm, got none")
    differences: dict[str, Difference] = {}
    if REFERENCE in there:
        tables = {arm: np.array([objective_of_tests(run) for run in runs], np.float64) for arm, runs in there.items()}
        differences = compare_arms(
            tables[REFERENCE],
            {arm: table for arm, table in tables.items() if arm != REFERENCE},
            weight=there[REFERENCE][0]["objects_of_scene"],
            resamples=resamples,
        )
    ours = {run["seed"]: _unseen(run) for run in there.get(REFERENCE, ())}
    rows = tuple(_row(arm, runs, ours, differences.get(arm)) for arm, runs in there.items())
    return RivalTable(
        rows,
        tuple(arm for arm in results if arm not in there),
        _shares(there.get(REFERENCE, ())),
        _goals({row.arm: row for row in rows}, pitch_is_free=pitch_is_free),
    )


def _unseen(run: Mapping[str, Any]) -> float:
    return _or_nan(objective_on_tests(run))


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value


def _row(
    arm: str, runs: Sequence[Mapping[str, Any]], ours: Mapping[int, float], difference: Difference | None
) -> ArmRow:
    unseen = tuple(_unseen(run) for run in runs)
    pairs = _pairs(ours, dict(zip((run["seed"] for run in runs), unseen, strict=True)))
    pairs = [pair for pair in pairs if not np.isnan(pair).any()]
    judged = [run["metrics"]["tp_detection_rate"] for run in runs if "metrics" in run]
    return ArmRow(
        arm,
        tuple(run["seed"] for run in runs),
        tuple(_or_nan(next(iter(run["validation_objectives"].values()))) for run in runs),
        unseen,
        float(np.mean([run["camera_renders"] for run in runs])),
        float(np.mean([run["seconds"]["search"] for run in runs])),
        max(_violation_m(run) for run in runs),
        _mean([run.get("bound") for run in runs]),
        _mean([run.get("gap") for run in runs]),
        _mean(judged),
        difference,
        sum(mine <= theirs + TOLERANCE for mine, theirs in pairs),
        len(pairs),
    )


def _violation_m(run: Mapping[str, Any]) -> float:
    return run["metrics"]["constraint_violation"] if "metrics" in run else run["constraint_violation_m"]


def _pairs(one: Mapping[int, float], other: Mapping[int, float]) -> list[tuple[float, float]]:
    """Values of the same run seed; an arm that needs one run alone is compared with every run."""
    if len(other) == 1:
        return [(value, next(iter(other.values()))) for value in one.values()]
    return [(value, other[seed]) for seed, value in one.items() if seed in other]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _shares(runs: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Where a search by a pool has its improvement from, the shares of `STAGES`."""
    gains = np.zeros(len(STAGES))
    for run in runs:
        history = run["history"]
        value = history["best_value"]
        for before, after, stage, number in zip(
            value, value[1:], history["stage"][1:], history["round"][1:], strict=False
        ):
            place = 2 if number > 0 else 1 if stage == "polish" else 0
            gains[place] += before - after
    if not gains.sum() > 0.0:
        return {}
    return dict(zip(STAGES, (gains / gains.sum()).tolist(), strict=True))


def _goals(rows: Mapping[str, ArmRow], *, pitch_is_free: bool) -> tuple[Goal, ...]:
    return (_not_beaten(rows), _gains_on_pool(rows, GAINS_MIN[pitch_is_free]), _not_behind_chance(rows))


def _not_beaten(rows: Mapping[str, ArmRow]) -> Goal:
    text = f"{REFERENCE} at most as high as every other arm in every run, on the unseen scenes"
    others = [row for arm, row in rows.items() if arm != REFERENCE and row.compared]
    if REFERENCE not in rows or not others:
        return Goal(text, None, "no arms to compare")
    numbers = ", ".join(f"{row.arm} {row.wins} of {row.compared}" for row in others)
    return Goal(text, all(row.wins == row.compared for row in others), numbers)


def _gains_on_pool(rows: Mapping[str, ArmRow], least: float) -> Goal:
    text = f"{REFERENCE} below pool_only by at least {least:.0%} on the unseen scenes"
    if REFERENCE not in rows or "pool_only" not in rows:
        return Goal(text, None, "not among the arms")
    ours, theirs = (float(np.mean(rows[arm].unseen)) for arm in (REFERENCE, "pool_only"))
    return Goal(text, ours <= (1.0 - least) * theirs, f"{ours:.4f} against {theirs:.4f}, {ours / theirs - 1.0:+.1%}")


def _not_behind_chance(rows: Mapping[str, ArmRow]) -> Goal:
    text = f"no arm of ours ({', '.join(OURS)}) above {', '.join(CHANCE)} in any run, on the unseen scenes"
    behind, count = [], 0
    for mine in (rows[arm] for arm in OURS if arm in rows):
        for other in (rows[arm] for arm in CHANCE if arm in rows):
            values = (dict(zip(row.seeds, row.unseen, strict=True)) for row in (mine, other))
            pairs = _pairs(*values)
            count += len(pairs)
            lost = sum(own > theirs + TOLERANCE for own, theirs in pairs)
            if lost:
                behind.append(f"{mine.arm} behind {other.arm} in {lost} of {len(pairs)}")
    if not count:
        return Goal(text, None, "not among the arms")
    return Goal(text, not behind, ", ".join(behind) or f"in none of {count} comparisons")
