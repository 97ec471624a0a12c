"""Whether a training objective ranks rigs as the detector does on scenes that no objective has seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from warpav.evaluation.statistics import RESAMPLES, Estimate, rank_correlation
from warpav.experiments.goals import Goal
from warpav.experiments.tables import COMPARED, Results
from warpav.runs.terminal import Group, TerminalTable, shown

RANDOM_GROUPS = ("random_rig", "random_place")
"""Arms of random feasible rigs: with random directions, and with the directions of the segregation."""

HELD_OUT = ("tp_detection_rate", "ap50_pooled")
"""Metrics on the test scenes that an objective should predict."""

CORRELATION_MIN = 0.9
"""Minimum rank correlation of the default method's objective with recall."""

RIGS_MIN = 100
"""Minimum number of random rigs for the goal to be measured."""

ALL_RANDOM = "all random rigs"
EVERY = "all rigs"


@dataclass(frozen=True)
class Correlations:
    """Rank correlations of objectives on the validation scenes with metrics on the test scenes, over rigs."""

    rigs: tuple[dict[str, Any], ...]
    spearman: dict[str, dict[str, dict[str, Estimate]]]
    figure: str | None

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the reader."""
        return (
            "Spearman's rank correlation of -objective on all validation scenes with metrics on the test scenes, "
            "[95 % interval over rigs, BCa]; 1: the objective ranks rigs like the detector.",
            "random_rig: random positions and directions. random_place: random positions, directions from the "
            f"segregation. {EVERY}: including the highest rig and rigs of the default method.",
        )

    def markdown(self) -> str:
        """The table as Markdown, and the figure."""
        head = ["rigs", "number", "objective", *(COMPARED[metric] for metric in HELD_OUT)]
        lines = ["| " + " | ".join(head) + " |", "| --- | ---: | --- | ---: | ---: |"]
        lines += ["| " + " | ".join(cells) + " |" for cells in self._lines()]
        figure = ["", f"![Objective and held-out metrics of every rig]({self.figure})"] if self.figure else []
        return "\n".join([*lines, *figure, "", *(f"- {note}" for note in self.notes), ""])

    def terminal(self) -> Group:
        """The table for the console."""
        table = TerminalTable(has_frame=False)
        for heading in ("rigs", "number", "objective", *(COMPARED[metric] for metric in HELD_OUT)):
            table.add_column(heading, justify="left" if heading in ("rigs", "objective") else "right")
        for cells in self._lines():
            table.add_row(*cells)
        return Group(table, *map(shown, self.notes))

    def data(self) -> dict[str, Any]:
        """For a JSON file."""
        return asdict(self)

    def _lines(self) -> list[list[str]]:
        return [
            [group, str(max(each.count for each in found.values())), objective, *map(_text, found.values())]
            for group, objectives in self.spearman.items()
            for objective, found in objectives.items()
        ]


def correlate(results: Results, figure: Path | None = None, *, resamples: int = RESAMPLES) -> Correlations:
    """Rank correlations over the rigs of an experiment."""
    rigs = tuple(_row(run) for runs in results.values() for run in runs)
    groups = {
        ALL_RANDOM: [rig for rig in rigs if rig["arm"] in RANDOM_GROUPS],
        **{arm: [rig for rig in rigs if rig["arm"] == arm] for arm in RANDOM_GROUPS},
        EVERY: list(rigs),
    }
    names = list(dict.fromkeys(name for rig in rigs for name in rig["objectives"]))
    spearman = {
        group: {
            name: {
                metric: rank_correlation(
                    [_turned(rig["objectives"].get(name)) for rig in members],
                    [rig[metric] for rig in members],
                    resamples=resamples,
                )
                for metric in HELD_OUT
            }
            for name in names
        }
        for group, members in groups.items()
        if members
    }
    drawn = None
    if figure is not None and rigs and names:
        from warpav.view.figures.statistics import objective_scatter

        drawn = objective_scatter(rigs, spearman.get(ALL_RANDOM, {}), figure, objectives=names, metrics=HELD_OUT).name
    return Correlations(rigs, spearman, drawn)


def correlation_goal(found: Correlations) -> Goal:
    """Whether the evaluation objective ranks random rigs like their recall."""
    text = f"rank correlation of objective and held-out recall over {RIGS_MIN} random rigs at least {CORRELATION_MIN:g}"
    objectives = found.spearman.get(ALL_RANDOM, {})
    estimate = next(iter(objectives.values()), {}).get("tp_detection_rate")
    if estimate is None or estimate.value is None:
        return Goal(text, None, "no random rigs")
    numbers = f"{_text(estimate)} over {estimate.count} rigs"
    return Goal(text, None if estimate.count < RIGS_MIN else estimate.value >= CORRELATION_MIN, numbers)


def _row(run: Mapping[str, Any]) -> dict[str, Any]:
    metrics = {metric: run["metrics"][metric] for metric in HELD_OUT}
    return {"arm": run["arm"], "seed": run["seed"], "objectives": run.get("validation_objectives", {}), **metrics}


def _turned(value: float | None) -> float | None:
    return None if value is None else -value


def _text(estimate: Estimate) -> str:
    if estimate.value is None:
        return "-"
    if estimate.low is None or estimate.high is None:
        return f"{estimate.value:.3f}"
    return f"{estimate.value:.3f} [{estimate.low:.3f}, {estimate.high:.3f}]"
