"""The experiments of the thesis: which arms its tables compare, and the command that runs them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from warpav.core.files import write_json, write_text
from warpav.core.progress import Progress
from warpav.experiments.arms import Arm
from warpav.experiments.experiment import GRADIENTS, Experiment, Finished, run_experiment
from warpav.experiments.gradient_magnitude import LOSS_OF, THESIS_RUNS
from warpav.experiments.summary import write_summary
from warpav.experiments.tables import result_table
from warpav.optimisation.losses.registry import LOSSES
from warpav.runs.config import Config
from warpav.thesis.tables import TABLES, thesis_table

RUNS = 5
"""Runs of an arm in the thesis's tables II to IV."""

UNPRINTED = ("SGD", "IFR+DOA+SB+OV")
"""What the text above table IV announces and the table does not print."""

_METHOD_OF = {"SGD": "optimiser", "Random": "random_batches", "Highest": "highest"}
_QUICK = ("scenes.train_seeds=0..11", "scenes.test_seeds=1000..1007", "run.iterations=10")


def loss_overrides(expression: str) -> tuple[str, ...]:
    """The weights of a combination of losses as the thesis writes it, such as ``IFR+10*DOA``; all others are 0."""
    weights: dict[str, float] = dict.fromkeys(LOSSES, 0.0)
    for term in expression.removesuffix("*").split("+"):  # the mark of a footnote
        factor, _, name = term.rpartition("*")
        if name not in LOSS_OF or LOSS_OF[name] not in weights:
            raise ValueError(f"expected losses out of {', '.join(LOSS_OF)}, got {name!r} in {expression!r}")
        weights[LOSS_OF[name]] = float(factor or 1.0)
    return tuple(f"losses.{name}={weight}" for name, weight in weights.items())


def _row_arm(method: str, loss: str) -> Arm:
    name = re.sub(r"[^a-z0-9]+", "_", f"{method} {loss}".lower().replace("*", ""))
    return Arm(name, _METHOD_OF[method], loss_overrides(loss))


def _rows(number: str) -> list[tuple[str, str]]:
    """Method and loss of every row of a table."""
    rows = [(row["method"], row["loss"]) for row in thesis_table(number)["rows"]]
    return [*rows, UNPRINTED] if number == "IV" else rows


def _labels(number: str) -> dict[str, tuple[str, str]]:
    """Method and loss by arm; none for tables of gradients."""
    return {} if number in ("I", "V") else {_row_arm(*row).name: row for row in _rows(number)}


def _gradient_arm(*losses: str) -> Arm:
    return Arm(GRADIENTS, GRADIENTS, loss_overrides("+".join(losses)))


def _experiments() -> dict[str, Experiment]:
    def of_rows(name: str, number: str) -> Experiment:
        return Experiment(name, "thesis", tuple(_row_arm(*row) for row in _rows(number)), RUNS, quick=_QUICK)

    def of_gradients(name: str, *losses: str) -> Experiment:
        return Experiment(
            name,
            "thesis",
            (_gradient_arm(*losses),),
            THESIS_RUNS,
            options=("run.batch_size=1",),
            quick=(*_QUICK, "run.iterations=30"),
            quick_runs=3,
        )

    return {
        "table1": of_gradients("table1", "IFR", "DOA"),
        "table2": of_rows("table2", "II"),
        "table3": of_rows("table2", "II"),  # the constraints of the same runs
        "table4": of_rows("table4", "IV"),
        "table5": of_gradients("table5", "IFR", "DOA", "SB", "AC", "OV"),
    }


TABLES_OF = {
    "table1": ("I",),
    "table2": ("II", "III"),
    "table3": ("III", "II"),
    "table4": ("IV",),
    "table5": ("V",),
}
"""Tables that come from the runs of an experiment; the first one is shown, all are written."""

EXPERIMENTS = _experiments()
"""By the name of the command; table 3 shows the runs of table 2."""


def run_table(
    name: str,
    config: Config,
    *,
    arms: Sequence[Arm] | None = None,
    runs: int | None = None,
    camera_renders_max: int | None = None,
    out: Path | None = None,
    quick: bool = False,
    progress: Progress,
) -> Finished:
    """Do what is missing of an experiment of the thesis, show its table, and write it as Markdown and JSON."""
    experiment = EXPERIMENTS[name]
    if quick:
        experiment = experiment.made_quick()
    done = run_experiment(
        experiment, config, arms=arms, runs=runs, camera_renders_max=camera_renders_max, out=out, progress=progress
    )
    texts = []
    for number in TABLES_OF[name]:
        table = result_table(number, done.results, _labels(number))
        stem = f"table{TABLES.index(number) + 1}"
        texts.append(table.markdown())
        write_text(done.folder / f"{stem}.md", texts[-1])
        write_json(done.folder / f"{stem}.json", table.data())
        if number == TABLES_OF[name][0]:
            progress.show(table.terminal())
    write_summary(done.folder, done.results, "\n".join(texts), goals=[])
    for failure in done.failed:
        progress.say(f"failed: {failure}")
    progress.say(f"{done.done} new results; tables and results: {done.folder}")
    return done
