"""What the terminal shows of a run: what was found, and on request every table and statement."""

from __future__ import annotations

import math
import shlex

from warpav.core.errors import one_line
from warpav.core.table import Table
from warpav.runs._drawn_run import heading_of
from warpav.runs._terminal import Group, Terminal, drawn, shown
from warpav.runs.config import load_config, overrides_from
from warpav.runs.report._content import RunContent
from warpav.runs.report._statements import (
    MINUS,
    NONE,
    SPACE,
    Statement,
    cautions,
    compared_with,
    gain,
    headline,
    number,
    percent,
    rigs_of_run,
    summary,
)

_STYLE = {"good": "green", "bad": "red", "open": ""}


_METRICS = ("misses_at_equal_false_alarms", "weighted_misses_per_100", "objective")
_MOST_CAMERAS, _MOST_CAUTIONS, _MOST_ARMS = 6, 2, 4
"""Of a rig, of what a reader should know, and of rigs beside each other, what is shown at most."""


def show_run(console: Terminal, run: RunContent) -> None:
    """Print what a run, or a comparison of rigs, has come to: a sentence, a table, the rig, and what to know of it."""
    evaluation = run.evaluation
    assert evaluation is not None
    _show(console, headline(run))
    for line in str(comparison_table(run)).splitlines():
        console.print(shown(line))
    (name, rig), _ = rigs_of_run(run)
    if rig is not None:
        if rig is not run.result:
            console.print(shown(f"{name}, which is the rig of this run (rig_best.yaml):"))
        for camera in rig.cameras[:_MOST_CAMERAS]:
            x_m, y_m, z_m = camera.position_m
            angles = (math.degrees(each) for each in (camera.yaw_rad, camera.pitch_rad))
            yaw_deg, pitch_deg = (round(each, 2) + 0.0 for each in angles)
            place = f"x {x_m:6.3f}  y {y_m:6.3f}  z {z_m:6.3f} m   yaw {yaw_deg:6.1f}  pitch {pitch_deg:5.1f} deg"
            console.print(shown(f"  {camera.name:<16} {place}"))
        if len(rig.cameras) > _MOST_CAMERAS:
            console.print(shown(f"  and {len(rig.cameras) - _MOST_CAMERAS} more, see the rig's file"))
    for asked in (evaluation.soiling, evaluation.load_states):
        if asked is not None:
            console.print(drawn(asked.table()))
    for statement in cautions(run)[:_MOST_CAUTIONS]:
        _show(console, statement, before="! ")


def comparison_table(run: RunContent) -> Table:
    """What rigs miss, and what they do not see near the vehicle; last, how many fewer than the start."""
    evaluation = run.evaluation
    assert evaluation is not None
    arms, other = list(evaluation.arms)[:_MOST_ARMS], compared_with(evaluation)
    columns, blank = [heading_of(name) for name in arms], [] if other is None else [""]
    rows, known = list[tuple[str, ...]](), evaluation.rows
    for metric, (text, factor, digits) in ((name, known[name]) for name in _METRICS if name in known):
        values = [getattr(evaluation.arms[name], metric) for name in arms]
        found = None if other is None else evaluation.paired.get(other, {}).get(metric)
        difference = [] if other is None else ["" if found is None else gain(found, metric, factor, digits)]
        cells = (number(None if each is None else factor * each, digits) for each in values)
        rows.append((text, *cells, *difference))
    ground = evaluation.ground
    if ground is not None:
        cells = (percent(ground.worst_near(name)[0], 0) for name in arms)
        rows.append(("near ground blind for a child, worst", *cells, *blank))
    for k, each in enumerate(evaluation.met.get(evaluation.first, [])):
        met = [evaluation.met[name][k] for name in arms]
        rows.append((f"points of {each.name} seen", *(percent(one.share, 0) for one in met), *blank))
    last = [] if other is None else [f"fewer than {heading_of(other)} [95 %]"]
    counted = f"{evaluation.scene_count} " + ("unseen scenes" if evaluation.training_objective else "scenes")
    first, *others = (tuple(map(_plain, row)) for row in ((counted, *columns, *last), *rows))
    return Table(first, tuple(others))


def next_commands(run: RunContent, folder: str) -> list[str]:
    """What to do with a run, and after it."""
    folder = shlex.quote(folder)
    if run.evaluation is None:
        return [f"warpav optimise --resume {folder}", f"warpav evaluate {folder}"]
    config = run.config
    if config is None or config.scenes.source != "town" or config.scenes.level not in (None, ("easy",)):
        return [f"warpav view {folder}"]
    given = [each for each in overrides_from(load_config("quick"), config) if not each.startswith("run.out=")]
    again = f"{folder}/config.yaml scenes.level=dense run.out={folder}_dense" if given else "scenes.level=dense"
    return [f"warpav view {folder}", f"warpav optimise {again}"]


def show_everything(console: Terminal, run: RunContent) -> None:
    """Print every table and every statement of a run, or of a comparison of rigs."""
    evaluation = run.evaluation
    assert evaluation is not None
    _show(console, headline(run))
    _print_arms(console, evaluation.metric_table(), 1)
    for table, fixed in ((evaluation.group_table(), 2), (evaluation.requirement_table(), 1)):
        if table is not None:
            _print_arms(console, table, fixed)
    robustness = (each and each.table() for each in (evaluation.soiling, evaluation.load_states))
    outages = evaluation.camera_outage.get(evaluation.first)
    for table in (outages and outages.table(heading_of(evaluation.first)), *robustness):
        if table is not None:
            console.print(drawn(table, has_frame=True))
    for statement in (*summary(run), *cautions(run)):
        _show(console, statement)


def _show(console: Terminal, statement: Statement, before: str = "") -> None:
    about = f"{before}{statement.about}: " if statement.about else before
    console.print(shown(about, _STYLE[statement.tone] or "bold").append(shown(_plain(statement.text), "default")))


def _plain(text: str) -> str:
    return one_line(text).replace(MINUS, "-").replace(NONE, "-").replace(SPACE, " ").replace("°", " deg")


def _print_arms(console: Terminal, table: Table, fixed: int) -> None:
    """Print a table with a column for each arm, in parts where the console is too narrow; each has the first arm."""
    others = range(fixed + 1, len(table.columns))

    def parts(size: int) -> list[Group]:
        chosen = [[*range(fixed + 1), *others[k : k + size]] for k in range(0, max(1, len(others)), size)]
        cells = [tuple(map(heading_of, table.columns)), *table.rows]
        columns = [[tuple(row[k] for k in part) for row in cells] for part in chosen]
        return [drawn(Table(first, tuple(rows)), has_frame=True) for first, *rows in columns]

    size = max(1, len(others))
    while size > 1 and any(console.width_of(part) > console.width for part in parts(size)):
        size -= 1
    for part in parts(size):
        console.print(part)
