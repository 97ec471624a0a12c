"""Tables of an experiment's results: the thesis's with its own numbers beside ours, and arms against each other."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from warpav.evaluation.metrics import EQUAL_FALSE_ALARMS_PER_FRAME
from warpav.evaluation.statistics import RESAMPLES, Difference, compare_arms, paired_difference, run_spread
from warpav.experiments.gradient_magnitude import LOSS_OF, pooled_magnitudes
from warpav.runs.terminal import Group, TerminalTable, shown
from warpav.thesis.tables import WARNING, thesis_table

Results = Mapping[str, Sequence[Mapping[str, Any]]]
"""Results by arm, and of each arm by run seed (`warpav.experiments.experiment.read_results`)."""

_METRICS = {
    "avg_map50": ("map50_average", "average mAP@50"),
    "min_camera_map50": ("map50_min_camera", "min camera mAP@50"),
    "max_camera_map50": ("map50_max_camera", "max camera mAP@50"),
    "tp_detection_rate": ("tp_detection_rate", "TP detection rate"),
    "tp_in_frame_rate": ("tp_in_frame_rate", "TP in-frame rate"),
    "detection_confidence": ("detection_confidence", "detection confidence"),
    "optimisable_loss": ("objective", "optimisable loss"),
}
"""Columns of tables II and IV: the thesis's name, the field of our metrics, the heading."""

_CONSTRAINTS = {"constraint_loss": "constraint loss", "min_pair_distance_m": "min camera pair distance (m)"}
_GRADIENTS = {"positional": "positional", "rotational": "rotational"}

NOTES = {
    "I": "Ours: mean over all non-zero gradient values of all runs, ± standard deviation of the means of the runs. "
    "That of IFR includes vehicles already in frame, whose gradient equation 12 multiplies by epsilon.",
    "II": "± standard deviation over runs (none for a single run); all numbers are on the test scenes.",
    "III": "The thesis prints table I's caption above it. The constraint loss of SGD is that of its last iterate, as "
    "in the thesis; the returned rig is the nearest feasible one.",
    "IV": "± standard deviation over runs (none for a single run); all numbers are on the test scenes.",
    "V": "As table I, with all losses optimised.",
}
"""Notes on our numbers, by table."""


@dataclass(frozen=True)
class Cell:
    """A number of a table."""

    mean: float | None
    std: float | None

    def __str__(self) -> str:
        if self.mean is None:
            return "-"
        return f"{self.mean:.3f}" + ("" if self.std is None else f" ±{self.std:.3f}")


@dataclass(frozen=True)
class Row:
    """A row of a table."""

    labels: tuple[str, ...]
    runs: int
    ours: dict[str, Cell]
    thesis: dict[str, Cell]


@dataclass(frozen=True)
class ThesisTable:
    """A table in the thesis's layout."""

    number: str
    caption: str
    label_headings: tuple[str, ...]
    columns: dict[str, str]
    rows: tuple[Row, ...]
    notes: tuple[str, ...]

    def markdown(self) -> str:
        """The table as Markdown; every row of ours has the thesis's below."""
        head = [*self.label_headings, "", "runs", *self.columns.values()]
        lines = [f"**Table {self.number}. {self.caption}**", "", _markdown_row(head)]
        left = len(self.label_headings) + 1
        lines.append(_markdown_row(["---"] * left + ["---:"] * (len(head) - left)))
        for row in self.rows:
            lines += [_markdown_row(cells) for cells in self._lines(row)]
        return "\n".join([*lines, "", *self.notes, ""])

    def terminal(self) -> Group:
        """The table for the console."""
        table = TerminalTable(has_frame=False)
        for heading in (*self.label_headings, ""):
            table.add_column(heading, no_wrap=True)
        for heading in ("runs", *self.columns.values()):
            table.add_column(heading, justify="right", overflow="fold")
        for row in self.rows:
            for k, cells in enumerate(self._lines(row)):
                table.add_row(*cells, style="dim" if k else None)
        return Group(shown(f"Table {self.number}. {self.caption}", "bold"), table, *map(shown, self.notes))

    def data(self) -> dict[str, Any]:
        """The table for a JSON file."""
        return asdict(self)

    def _lines(self, row: Row) -> list[list[str]]:
        ours = [*row.labels, "ours", str(row.runs), *(str(row.ours[key]) for key in self.columns)]
        if not row.thesis:
            return [ours]
        blank = [""] * len(row.labels)
        return [ours, [*blank, "thesis", "", *(str(row.thesis[key]) for key in self.columns)]]


def result_table(number: str, results: Results, labels: Mapping[str, tuple[str, str]]) -> ThesisTable:
    """One of the thesis's tables."""
    if number in ("I", "V"):
        return _gradient_table(number, results)
    thesis = thesis_table(number)
    printed = {(row["method"], row["loss"]): row for row in thesis["rows"]}
    columns = _CONSTRAINTS if number == "III" else {key: heading for key, (_, heading) in _METRICS.items()}
    rows = []
    for arm, found in results.items():
        row_labels = labels.get(arm, (arm, "as configured"))
        row = printed.get(row_labels)
        rows.append(
            Row(
                row_labels,
                len(found),
                {key: _cell([_value(key, result) for result in found]) for key in columns},
                {} if row is None else {key: Cell(row[key]["mean"], row[key]["std"]) for key in columns},
            )
        )
    caption = "Constraint results" if number == "III" else thesis["caption"]  # it is printed as table I's
    notes = (*_notes(number, thesis), *_same_rigs(results, labels))
    return ThesisTable(number, caption, ("method", "loss"), dict(columns), tuple(rows), notes)


def _same_rigs(results: Results, labels: Mapping[str, tuple[str, str]]) -> tuple[str, ...]:
    """A note for arms that found the same rigs, which are one measurement."""
    arms_of: dict[str, list[str]] = {}
    for arm, found in results.items():
        rigs = [(result["seed"], result["rig"]["cameras"]) for result in found if "rig" in result]
        if len(rigs) > 1:
            arms_of.setdefault(json.dumps(rigs), []).append(" ".join(labels.get(arm, (arm,))))
    return tuple(
        f"Ours hold the same rigs, so they are one measurement: {' and '.join(arms)}."
        for arms in arms_of.values()
        if len(arms) > 1
    )


def _gradient_table(number: str, results: Results) -> ThesisTable:
    thesis = thesis_table(number)
    runs = [result["gradients"] for found in results.values() for result in found if "gradients" in result]
    pooled = pooled_magnitudes(runs)
    rows = []
    for row in thesis["rows"]:
        name = LOSS_OF[row["loss"]]
        ours = {
            key: Cell(
                None if name not in pooled else getattr(pooled[name], key),
                run_spread([run[name][key] for run in runs]).value if name in pooled else None,
            )
            for key in _GRADIENTS
        }
        rows.append(Row((row["loss"],), len(runs), ours, {key: Cell(row[key], None) for key in _GRADIENTS}))
    return ThesisTable(number, thesis["caption"], ("loss",), dict(_GRADIENTS), tuple(rows), _notes(number, thesis))


def _value(key: str, result: Mapping[str, Any]) -> float | None:
    """The number of one run in a column of tables II to IV."""
    if key == "constraint_loss":
        return result.get("unprojected_constraint_loss", result["constraint_loss"])
    if key == "min_pair_distance_m":
        return result["metrics"]["min_camera_distance_m"]
    return result["metrics"][_METRICS[key][0]]


def _cell(numbers: Sequence[float | None]) -> Cell:
    finite = [number for number in numbers if number is not None and math.isfinite(number)]
    return Cell(float(np.mean(finite)) if finite else None, run_spread(finite).value)


def _notes(number: str, thesis: Mapping[str, Any]) -> tuple[str, ...]:
    printed = () if number == "III" else (f"Thesis: {thesis['note']}.",)
    return (*printed, NOTES[number], WARNING)


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


COMPARED = {
    "tp_detection_rate": "recall of the rig",
    "misses_per_100": "misses per 100",
    "recall_at_equal_false_alarms": f"recall at {EQUAL_FALSE_ALARMS_PER_FRAME:g} false alarms per frame",
    "ap50_pooled": "AP50",
    "tp_in_frame_rate": "in frame",
    "detection_confidence": "confidence",
    "false_alarms_per_frame": "false alarms per frame",
    "objective": "objective",
}
"""Metrics in which arms are compared, and their headings; all of them exist scene by scene."""

RATES_OF_OBJECTS = ("tp_detection_rate", "misses_per_100", "recall_at_equal_false_alarms", "tp_in_frame_rate")
"""Those whose scenes weigh by their objects."""


@dataclass(frozen=True)
class ArmsTable:
    """Arms on the same test scenes, and how one of them differs from all others.

    Attributes:
        seconds: Mean time of a search, by arm [s].
    """

    reference: str
    runs: dict[str, int]
    numbers: dict[str, dict[str, Cell]]
    intervals: dict[str, dict[str, Difference]]
    violation_m: dict[str, float | None]
    camera_renders: dict[str, float | None]
    seconds: dict[str, float | None]
    differences: dict[str, dict[str, Difference]]
    missing: tuple[str, ...]
    remarks: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the reader."""
        gone = (f"No result: {', '.join(self.missing)}.",) if self.missing else ()
        return (
            "First line of an arm: mean over runs ± standard deviation over runs. Second line: 95 % interval. Third "
            f"line: {self.reference} - arm [95 % interval], p-value corrected by Holm's method, * if p < 0.05.",
            "Intervals: paired bootstrap (BCa) over test scenes and runs. Rates of objects weight each scene by its "
            "number of objects; other metrics are means over scenes, printed before the interval if they differ from "
            "the first line.",
            "Violation: worst run. Camera renders (one scene, one camera) and seconds: mean per search.",
            *self.remarks,
            *gone,
        )

    def markdown(self) -> str:
        """The table as Markdown."""
        head = ["arm", "runs", *self._headings]
        lines = [_markdown_row(head), _markdown_row(["---"] + ["---:"] * (len(head) - 1))]
        lines += [_markdown_row(cells) for arm in self.runs for cells in self._lines(arm)]
        return "\n".join([*lines, "", *(f"- {note}" for note in self.notes), ""])

    def terminal(self) -> Group:
        """The table for the console."""
        table = TerminalTable(has_frame=False)
        table.add_column("arm", no_wrap=True)
        for heading in ("runs", *self._headings):
            table.add_column(heading, justify="right", overflow="fold")
        for arm in self.runs:
            for k, cells in enumerate(self._lines(arm)):
                table.add_row(*cells, style="dim" if k else "bold" if arm == self.reference else None)
            table.add_section()
        return Group(table, *map(shown, self.notes))

    def data(self) -> dict[str, Any]:
        """The table for a JSON file."""
        return asdict(self)

    @property
    def _headings(self) -> list[str]:
        return [*(COMPARED[metric] for metric in self.numbers), "violation m", "camera renders", "seconds"]

    def _lines(self, arm: str) -> list[list[str]]:
        ends = ["-" if end is None else form.format(end) for end, form in self._ends(arm)]
        numbers = [arm, str(self.runs[arm]), *(str(self.numbers[metric][arm]) for metric in self.numbers), *ends]
        blank = [""] * len(ends)
        lines = [numbers, ["", "", *(self._interval_text(metric, arm) for metric in self.numbers), *blank]]
        if arm != self.reference:
            found = [_difference_text(self.differences[metric][arm]) for metric in self.numbers]
            lines.append(["", "", *found, *blank])
        return lines

    def _interval_text(self, metric: str, arm: str) -> str:
        interval, number = self.intervals[metric][arm], self.numbers[metric][arm].mean
        if interval.mean is None or interval.low is None or number is None:
            return ""
        mean = f"{interval.mean:.3f} " if abs(interval.mean - number) > 5e-4 else ""
        return f"{mean}[{interval.low:.3f}, {interval.high:.3f}]"

    def _ends(self, arm: str) -> list[tuple[float | None, str]]:
        return [(self.violation_m[arm], "{:g}"), (self.camera_renders[arm], "{:.0f}"), (self.seconds[arm], "{:.0f}")]


def compare_results(
    results: Results, reference: str, *, metrics: Sequence[str] = tuple(COMPARED), resamples: int = RESAMPLES
) -> ArmsTable:
    """How an arm differs from all others on the same test scenes."""
    there = {arm: runs for arm, runs in results.items() if runs}
    if reference not in there:
        raise ValueError(f"reference must be an arm with results, out of {', '.join(there)}, got {reference!r}")
    objects = there[reference][0]["objects_of_scene"]
    numbers, intervals, differences = {}, {}, {}
    for metric in metrics:
        tables = {
            arm: np.array([run["metrics"]["per_scene"][metric] for run in runs], np.float64)
            for arm, runs in there.items()
        }
        numbers[metric] = {arm: _cell([run["metrics"][metric] for run in runs]) for arm, runs in there.items()}
        weight = objects if metric in RATES_OF_OBJECTS else None
        nothing = np.zeros(len(objects))
        intervals[metric] = {
            arm: paired_difference(table, nothing, weight=weight, resamples=resamples) for arm, table in tables.items()
        }
        differences[metric] = compare_arms(
            tables[reference],
            {arm: table for arm, table in tables.items() if arm != reference},
            weight=weight,
            resamples=resamples,
        )
    return ArmsTable(
        reference=reference,
        runs={arm: len(runs) for arm, runs in there.items()},
        numbers=numbers,
        intervals=intervals,
        violation_m={
            arm: max(_each(runs, "metrics", "constraint_violation"), default=None) for arm, runs in there.items()
        },
        camera_renders={arm: _cell([run.get("camera_renders") for run in runs]).mean for arm, runs in there.items()},
        seconds={arm: _cell(_each(runs, "seconds", "search")).mean for arm, runs in there.items()},
        differences=differences,
        missing=tuple(arm for arm in results if arm not in there),
    )


def _each(runs: Sequence[Mapping[str, Any]], part: str, name: str) -> list[float]:
    """A number of every run that has it."""
    found = [run.get(part, {}).get(name) for run in runs]
    return [number for number in found if number is not None]


def _difference_text(difference: Difference) -> str:
    if difference.mean is None:
        return "-"
    text = f"{difference.mean:+.3f}"
    if difference.low is not None and difference.high is not None:
        text += f" [{difference.low:+.3f}, {difference.high:+.3f}]"
    if difference.p_holm is None:
        return text
    return f"{text} p={difference.p_holm:.2g}" + ("*" if difference.p_holm < 0.05 else "")
