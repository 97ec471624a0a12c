"""What the terminal shows of a run: warnings, tables, statements."""

from __future__ import annotations

from warpav.core.table import Table
from warpav.runs._terminal import Group, Terminal, drawn, shown
from warpav.runs.report._content import RunContent
from warpav.runs.report._statements import (
    MINUS,
    NONE,
    SPACE,
    Statement,
    headline,
    summary,
    warnings,
)

_STYLE = {"good": "green", "bad": "red", "open": ""}


def show_run(console: Terminal, run: RunContent) -> None:
    """Print what a run, or a comparison of rigs, has come to: warnings, tables, statements."""
    evaluation = run.evaluation
    assert evaluation is not None
    for statement in warnings(evaluation):
        _show(console, statement)
    _print_arms(console, evaluation.metric_table(), 1)
    for table, fixed in ((evaluation.recall_table(), 2), (evaluation.requirement_table(), 1)):
        if table is not None:
            _print_arms(console, table, fixed)
    robustness = (each and each.table() for each in (evaluation.soiling, evaluation.load_states))
    outages = evaluation.camera_outage.get(evaluation.first)
    for table in (outages and outages.table(evaluation.first), *robustness):
        if table is not None:
            console.print(drawn(table, has_frame=True))
    for statement in (headline(run), *summary(run)):
        _show(console, statement)


def _show(console: Terminal, statement: Statement) -> None:
    about = f"{statement.about}: " if statement.about else ""
    text = statement.text.replace(MINUS, "-").replace(NONE, "-").replace(SPACE, " ").replace("°", " deg")
    console.print(shown(about, _STYLE[statement.tone] or "bold").append(shown(text, "default")))


def _print_arms(console: Terminal, table: Table, fixed: int) -> None:
    """Print a table with a column for each arm, in parts where the console is too narrow; each has the first arm."""
    others = range(fixed + 1, len(table.columns))

    def parts(size: int) -> list[Group]:
        chosen = [[*range(fixed + 1), *others[k : k + size]] for k in range(0, max(1, len(others)), size)]
        cells = [table.columns, *table.rows]
        columns = [[tuple(row[k] for k in part) for row in cells] for part in chosen]
        return [drawn(Table(first, tuple(rows)), has_frame=True) for first, *rows in columns]

    size = max(1, len(others))
    while size > 1 and any(console.width_of(part) > console.width for part in parts(size)):
        size -= 1
    for part in parts(size):
        console.print(part)
