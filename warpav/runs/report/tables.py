"""The tables of an evaluation, for terminal and page alike, and what the terminal shows of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from warpav.core.table import Table
from warpav.evaluation.rig_evaluation import TABLE_ROWS, outage_rows
from warpav.runs.report.evaluation import Evaluation, RunContent
from warpav.runs.report.statements import MINUS, NONE, SPACE, Statement, headline, summary, warnings
from warpav.runs.terminal import Terminal, TerminalTable, shown

RECALL_GROUPS = {"road_user": "", "distance_m": " m", "sector": "", "category": ""}
"""Groupings of the objects in ``recall_by``, in the order in which they are shown, and the unit of their names."""

_STYLE = {"good": "green", "bad": "red", "open": ""}


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:z.4f}"


def metric_table(evaluation: Evaluation) -> Table:
    """Metrics of every arm."""
    arms = evaluation.arms
    rows = [
        (heading, *(_number(arm.numbers[name]) for arm in arms.values()))
        for name, heading in TABLE_ROWS.items()
        if any(arm.numbers[name] is not None for arm in arms.values())
    ]
    return Table((f"{evaluation.scenes['test']} test scenes", *arms), tuple(rows))


def recall_table(evaluation: Evaluation) -> Table | None:
    """The rig's recall by road user, distance, sector and class; None where it is not known of all arms.

    Groups without objects, and road users where there is only one kind of them, are left out.
    """
    tables = [arm.recall_by for arm in evaluation.arms.values() if arm.recall_by]
    if len(tables) < len(evaluation.arms):
        return None
    rows: list[tuple[str, ...]] = []
    for by, unit in RECALL_GROUPS.items():
        block = [
            (f"{name}{unit}", str(group.objects), *(f"{table[by][name].recall:.3f}" for table in tables))
            for name, group in tables[0].get(by, {}).items()
            if group.objects
        ]
        rows += block if len(block) > (by == "road_user") else []
    return Table(("recall of the rig", "objects", *evaluation.arms), tuple(rows)) if rows else None


def requirement_table(evaluation: Evaluation) -> Table | None:
    """What every arm meets of what has to be seen near the vehicle; None where nothing has to."""
    found = list(evaluation.requirements.values())
    rows = [
        (
            f"{each.name}, {each.points} points" + (" (hard)" if each.hard else ""),
            *(f"{arm[k].share:.1%}" + ("" if arm[k].is_met else " (not met)") for arm in found),
        )
        for k, each in enumerate(found[0] if found else ())
    ]
    return Table(("points met near the vehicle", *evaluation.requirements), tuple(rows)) if rows else None


def outage_table(evaluation: Evaluation) -> Table | None:
    """What the first arm is expected to miss without each of its cameras; None where that is not known."""
    outage = evaluation.camera_outage.get(evaluation.first)
    if outage is None:
        return None
    columns, rows = outage_rows(outage.model_dump(exclude_none=True))
    return Table((f"{evaluation.first} without", *columns), tuple(tuple(row) for row in rows))


def _robustness_tables(evaluation: Evaluation) -> list[Table]:
    """What dirt and loads cost the rig, as far as that was asked for."""
    tables = []
    if soiling := evaluation.soiling:
        part = soiling["part"]
        (column, row), shape = part["place"], part["shape"]
        what = "disc" if shape == "disc" else f"band of {shape}"
        caption = f"Soiled: a {what} around {column:.0%} of the width, {row:.0%} of the height."
        rows = [(each["camera"], f"{each['covered_share']:.0%}", each) for each in soiling["cameras"]]
        tables.append(_cost_table(("soiled camera", "covered"), rows, soiling, caption))
    if loads := evaluation.load_states:
        rows = [
            (each["name"], f"{each['state']['pitch_deg']:+g} deg, {100.0 * each['state']['height_m']:+g} cm", each)
            for each in loads["states"]
        ]
        tables.append(_cost_table(("load", "nose down, up by"), rows, loads, ""))
    return tables


def _cost_table(
    columns: tuple[str, str], rows: Sequence[tuple[str, str, Any]], found: Mapping[str, Any], caption: str
) -> Table:
    cells = [
        (name, what, f"{each['expected_misses_per_100']:.2f}", f"{each['difference_per_100']:+z.2f}")
        for name, what, each in rows
    ]
    first = ("none", "", f"{found['expected_misses_per_100']:.2f}", "")
    return Table((*columns, "expected misses per 100", "difference"), (first, *cells), caption)


def show_run(console: Terminal, run: RunContent) -> None:
    """Print what a run, or a comparison of rigs, has come to: warnings, tables, statements."""
    evaluation = run.evaluation
    assert evaluation is not None
    for statement in warnings(evaluation):
        _show(console, statement)
    _print_arms(console, metric_table(evaluation), 1)
    for table, fixed in ((recall_table(evaluation), 2), (requirement_table(evaluation), 1)):
        if table is not None:
            _print_arms(console, table, fixed)
    for table in (outage_table(evaluation), *_robustness_tables(evaluation)):
        if table is not None:
            console.print(_drawn(table))
            if table.caption:
                console.print(shown(table.caption))
    for statement in (headline(run), *summary(run)):
        _show(console, statement)


def _show(console: Terminal, statement: Statement) -> None:
    about = f"{statement.about}: " if statement.about else ""
    text = statement.text.replace(MINUS, "-").replace(NONE, "-").replace(SPACE, " ").replace("°", " deg")
    console.print(shown(about, _STYLE[statement.tone] or "bold").append(shown(text, "default")))


def _drawn(table: Table) -> TerminalTable:
    drawn = TerminalTable()
    for k, name in enumerate(table.columns):
        style = "bold" if name == "optimised" else None
        drawn.add_column(name, no_wrap=k == 0, justify="right" if k else "left", style=style)
    for row in table.rows:
        drawn.add_row(*row)
    return drawn


def _print_arms(console: Terminal, table: Table, fixed: int) -> None:
    """Print a table with a column for each arm, in parts where the console is too narrow; each has the first arm."""
    others = range(fixed + 1, len(table.columns))

    def parts(size: int) -> list[TerminalTable]:
        chosen = [[*range(fixed + 1), *others[k : k + size]] for k in range(0, max(1, len(others)), size)]
        cells = [table.columns, *table.rows]
        columns = [[tuple(row[k] for k in part) for row in cells] for part in chosen]
        return [_drawn(Table(first, tuple(rows))) for first, *rows in columns]

    size = max(1, len(others))
    while size > 1 and any(console.width_of(part) > console.width for part in parts(size)):
        size -= 1
    for part in parts(size):
        console.print(part)
