"""What a run has shown: its metrics as tables, and whether the rig that it found is worth taking."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from warpav.evaluation.metrics import (
    EQUAL_FALSE_ALARMS_PER_FRAME,
    OPTIONAL_METRICS,
    REDUNDANT_CAMERAS,
    REDUNDANT_WITHIN_M,
)
from warpav.evaluation.rig_evaluation import outage_rows, requirement_rows
from warpav.runs.terminal import Terminal, TerminalTable, shown

ARM_ROWS = {
    "map50_average": "AP50, mean of the cameras",
    "map50_min_camera": "AP50, worst camera",
    "map50_max_camera": "AP50, best camera",
    "ap50_pooled": "AP50, all images",
    "ap50_small": "AP50, up to 32 x 32 px",
    "ap50_medium": "AP50, to 96 x 96 px",
    "ap50_large": "AP50, larger",
    "ap50_95_pooled": "AP50:95, all images",
    "tp_detection_rate": "recall of the rig",
    "weighted_recall": "weighted recall",
    "misses_per_100": "misses per 100",
    "weighted_misses_per_100": "weighted misses per 100",
    "attainable_rate": "attainable by any camera",
    "attainable_recall": "recall of the attainable",
    "attainable_misses_per_100": "attainable misses per 100",
    "recall_at_equal_false_alarms": f"recall at {EQUAL_FALSE_ALARMS_PER_FRAME:g} false alarms",
    "visible_rate": "visible to the rig",
    "rig_recall_visible": "recall of the visible",
    "redundant_rate": f"seen by {REDUNDANT_CAMERAS} cameras within {REDUNDANT_WITHIN_M:g} m",
    "false_alarms_per_frame": "false alarms a frame",
    "tp_in_frame_rate": "in frame",
    "detection_confidence": "confidence",
    "objective": "objective",
    "constraint_violation": "violation [m]",
    "min_camera_distance_m": "closest [m]",
    "body_share_max": "own body, largest share",
}
"""Fields of an arm's metrics and the headings they are shown under; of `OPTIONAL_METRICS` those that are known."""


RECALL_GROUPS = {"road_user": "", "distance_m": " m", "sector": "", "category": ""}
"""Groupings of the objects in ``recall_by``, in the order in which they are shown, and the unit of their names."""


MIN_SCENES = 6
"""With fewer, no difference can have a p-value below 0.05: all scenes agree by chance in 2^(1 - scenes) of cases."""

_ENDS = ("start", "optimised")

_HIDING_BODY = 0.5
"""Share of an image from which on the own body is named as the reason why a rig detects nothing."""


def recall_rows(arms: Mapping[str, Mapping[str, Any]]) -> list[list[list[str]]]:
    """The rig's recall by group as text: for every grouping its rows of group, number of objects, and recall by arm."""
    tables = [arm["recall_by"] for arm in arms.values() if arm.get("recall_by")]
    if not tables or len(tables) < len(arms):
        return []
    blocks = [
        [
            [f"{name}{unit}", str(group["objects"]), *(f"{table[by][name]['recall']:.3f}" for table in tables)]
            for name, group in tables[0].get(by, {}).items()
            if group["objects"]
        ]
        for by, unit in RECALL_GROUPS.items()
    ]
    return [block for by, block in zip(RECALL_GROUPS, blocks, strict=True) if len(block) > (by == "road_user")]


def arm_table(arms: Mapping[str, Mapping[str, Any]], *, title: str = "") -> TerminalTable:
    """A table with one row per metric and one column per arm."""
    table = TerminalTable(title)
    table.add_column("", no_wrap=True)
    for name in arms:
        table.add_column(name, justify="right", style="bold" if name == "optimised" else None)
    for field, heading in ARM_ROWS.items():
        if field in OPTIONAL_METRICS and not any(field in metrics for metrics in arms.values()):
            continue
        table.add_row(heading, *(_metric(metrics.get(field)) for metrics in arms.values()))
    return table


def recall_table(arms: Mapping[str, Mapping[str, Any]]) -> TerminalTable | None:
    """The rig's recall by distance, sector and class, one column per arm; None where the metrics do not hold it."""
    blocks = recall_rows(arms)
    if not blocks:
        return None
    table = TerminalTable("recall of the rig")
    table.add_column("", no_wrap=True)
    table.add_column("objects", justify="right")
    for name in arms:
        table.add_column(name, justify="right", style="bold" if name == "optimised" else None)
    for block in blocks:
        for row in block:
            table.add_row(*row)
        table.add_section()
    return table


def outage_table(evaluation: Mapping[str, Any]) -> TerminalTable | None:
    """What the first arm is expected to miss without each of its cameras; None where that is not known."""
    name, outage = next(iter((evaluation.get("camera_outage") or {}).items()), ("", None))
    if outage is None:
        return None
    columns, rows = outage_rows(outage)
    table = TerminalTable(f"{name} without one camera")
    table.add_column("without", no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right")
    for row in rows:
        table.add_row(*row)
    return table


def robustness_tables(evaluation: Mapping[str, Any]) -> list[TerminalTable]:
    """What dirt and loads cost the rig, as far as ``evaluation.json`` says so."""
    tables = []
    soiling, loads = evaluation.get("soiling"), evaluation.get("load_states")
    if soiling:
        part = soiling["part"]
        (column, row), shape = part["place"], part["shape"]
        what = "disc" if shape == "disc" else f"band of {shape}"
        title = f"one camera soiled: a {what} around {column:.0%} of the width, {row:.0%} of the height"
        rows = [(each["camera"], f"{each['covered_share']:.0%}", each) for each in soiling["cameras"]]
        tables.append(_cost_table(title, ("soiled", "covered"), rows, soiling))
    if loads:
        rows = [
            (each["name"], f"{each['state']['pitch_deg']:+g} deg, {100.0 * each['state']['height_m']:+g} cm", each)
            for each in loads["states"]
        ]
        tables.append(_cost_table("vehicle under a load", ("load", "nose down, up by"), rows, loads))
    return tables


def _cost_table(
    title: str, columns: tuple[str, str], rows: Sequence[tuple[str, str, Any]], found: Mapping[str, Any]
) -> TerminalTable:
    table = TerminalTable(title)
    table.add_column(columns[0], no_wrap=True)
    for column in (columns[1], "expected misses per 100", "difference"):
        table.add_column(column, justify="right")
    table.add_row("none", "", f"{found['expected_misses_per_100']:.2f}", "")
    for name, what, each in rows:
        numbers = f"{each['expected_misses_per_100']:.2f}", f"{each['difference_per_100']:+z.2f}"
        table.add_row(name, what, *numbers)
    return table


def robust_text(robust: Mapping[str, Any]) -> str:
    """What a robust objective is made of at the start and at the end, in a sentence."""

    def change(name: str) -> str:
        return " -> ".join("-" if each is None else f"{100.0 * each[name]:.2f}" for each in map(robust.get, _ENDS))

    errors = mount_errors_text(robust)
    if robust.get("camera_loss") is None:
        return (
            f"the objective is the expected misses in the mean over errors of mounting of {errors}; per 100, start -> "
            f"end: {change('expected_miss_rate')} with errors, {change('as_designed')} as designed"
        )
    lost = "the camera that is worst to lose" if robust["camera_loss"] == "worst" else "one camera, in the mean"
    weight = robust["weight"]
    text = (
        f"the objective is {1.0 - weight:g} x expected misses + {weight:g} x those without {lost}; per 100, start -> "
        f"end: {change('expected_miss_rate')} with all cameras, {change('without_camera')} without {lost}"
    )
    if errors is None:
        return text
    return f"{text}; all in the mean over errors of mounting of {errors}, as designed {change('as_designed')}"


def mount_errors_text(robust: Mapping[str, Any]) -> str | None:
    """The errors of mounting that an objective is the mean over, such as ``+-2 cm and +-1 deg``; None: none."""
    position_m, angle_deg = robust.get("mount_error_m"), robust.get("mount_error_deg")
    parts = [] if position_m is None else [f"+-{100.0 * position_m:g} cm"]
    parts += [] if angle_deg is None else [f"+-{angle_deg:g} deg"]
    return " and ".join(parts) or None


def worse_than_start(evaluation: Mapping[str, Any]) -> list[str]:
    """In what the rig that a run has found is worse than the rig that it started from, a sentence each."""
    found = []
    training = evaluation.get("training_objective") or {}
    start, end = training.get("start"), training.get("optimised")
    if "optimised" in training and start is not None and (end is None or end > start):
        found.append(
            f"WORSE THAN ITS START: the optimised rig has objective {_number(end)}, its start {_number(start)}; the "
            "rig of the run, rig_best.yaml, is the start"
        )
    recall = (evaluation.get("paired", {}).get("start") or {}).get("tp_detection_rate") or {}
    high, arms = recall.get("high"), evaluation["arms"]
    if high is not None and high < 0.0 and "start" in arms:
        first = next(iter(arms))
        before, after = (arms[name]["tp_detection_rate"] for name in ("start", first))
        found.append(
            f"WORSE THAN ITS START: the {first} rig has recall {after:.4f} on the test scenes, its start {before:.4f}"
        )
    return found


def unmet_requirements(evaluation: Mapping[str, Any]) -> list[str]:
    """Which requirements the rig that a run has found does not meet, how far and where, a sentence each."""
    _, outcomes = next(iter((evaluation.get("requirements") or {}).items()), ("", []))
    found = []
    for each in outcomes:
        if each["is_met"]:
            continue
        text = f"REQUIREMENT NOT MET: {each['name']} at {each['share']:.1%} of {each['points']} points"
        if each["need"]["share"] not in (None, 1.0):
            text += f", asked {each['need']['share']:.0%}"
        if each["worst"]:
            x, y = each["worst"][0]["position_m"]
            text += f"; worst at x = {x:.1f} m, y = {y:.1f} m"
        if gap := each.get("gap"):  # runs of before have none
            text += f"; largest gap: {gap['area_m2']:.2f} m², {gap['sector']}"
        found.append(text)
    return found


def requirement_table(requirements: Mapping[str, Any]) -> TerminalTable:
    """What every arm meets of the requirements, one column per arm."""
    table = TerminalTable("seen near the vehicle")
    table.add_column("", no_wrap=True)
    for name in requirements:
        table.add_column(name, justify="right", style="bold" if name == "optimised" else None)
    for row in requirement_rows(requirements):
        table.add_row(*row)
    return table


def blind_arms(arms: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Which rigs detect nothing as the vehicle's own body fills their images, a sentence each."""
    return [
        f"{name} detects nothing: the vehicle's own body covers up to {metrics['body_share_max']:.0%} of an image"
        for name, metrics in arms.items()
        if metrics["tp_detection_rate"] == 0.0 and (metrics.get("body_share_max") or 0.0) >= _HIDING_BODY
    ]


def _print_arms(
    console: Terminal,
    arms: Mapping[str, Any],
    table_of: Callable[[Mapping[str, Any]], TerminalTable | None],
) -> None:
    """Print a table with a column for each arm, in parts where the console is too narrow; each has the first arm."""
    first, *others = arms

    def tables(size: int) -> list[TerminalTable]:
        parts = [[first, *others[k : k + size]] for k in range(0, max(1, len(others)), size)]
        found = [table_of({name: arms[name] for name in part}) for part in parts]
        return [table for table in found if table is not None]

    size = max(1, len(others))
    while size > 1 and any(console.width_of(table) > console.width for table in tables(size)):
        size -= 1
    for table in tables(size):
        console.print(table)


def show_verdict(console: Terminal, evaluation: Mapping[str, Any]) -> None:
    """Print the arms' metrics, whether the constraints are met, and what the run has changed."""
    arms = evaluation["arms"]
    for text in worse_than_start(evaluation):
        console.print(shown(text, "bold red"))
    for text in unmet_requirements(evaluation):
        console.print(shown(text, "yellow"))
    for text in blind_arms(arms):
        console.print(shown(text, "yellow"))
    scenes = evaluation["scenes"]["test"]
    _print_arms(console, arms, lambda part: arm_table(part, title=f"{scenes} test scenes"))
    _print_arms(console, arms, recall_table)
    if requirements := evaluation.get("requirements"):
        _print_arms(console, requirements, requirement_table)
    outage = outage_table(evaluation)
    if outage is not None:
        console.print(outage)
    for table in robustness_tables(evaluation):
        console.print(table)
    name, metrics = next(iter(arms.items()))
    violation, closest = metrics["constraint_violation"], metrics["min_camera_distance_m"]
    if violation == 0.0:
        # what stands near the vehicle is another matter
        kept = "constraints of spacing and mount met" if unmet_requirements(evaluation) else "constraints met"
        text = shown(kept, "green").append(f": closest cameras {_number(closest)} m apart", "default")
    else:
        worst = _worst_margin((evaluation.get("constraints") or {}).get(name) or [])
        text = shown("constraints broken", "red").append(f" by {_number(violation)} m{worst}", "default")
    console.print(text)
    training = evaluation.get("training_objective")
    if training:
        where = "the scenes of the search" if evaluation.get("certificate") else "the training scenes"
        console.print(shown(f"objective on {where}: {_objective_change(evaluation)}"))
    if evaluation.get("robust"):
        console.print(shown(robust_text(evaluation["robust"])))
    certificate = evaluation.get("certificate")
    if certificate:
        scenes, count = certificate["scenes"], certificate["pool_cameras"]
        text = (
            f"objective {certificate['objective']:.4f} on the {scenes} scenes of the search; there no rig of the "
            f"pool's {count} cameras is below {certificate['bound']:.4f} (bound)"
        )
        console.print(shown(text))
    paired = evaluation.get("paired", {})
    for other, differences in paired.items():
        _show_difference(console, f"recall of the rig, {name} - {other}", differences["tp_detection_rate"], digits=4)
    if certificate and not evaluation.get("robust"):  # then the objective is what is expected to be missed
        for other, differences in paired.items():
            if "objective" in differences:
                found = {key: 100.0 * value for key, value in differences["objective"].items() if value is not None}
                _show_difference(console, f"expected misses per 100, {name} - {other}", found, digits=2)
    if paired and scenes < MIN_SCENES:
        text = f"with fewer than {MIN_SCENES} test scenes no difference can be proven; scenes.test_seeds=5000..5049"
        console.print(shown(text, "yellow"))


def margin_text(kind: str, cameras: Sequence[str]) -> str:
    """What a constraint is about, in words; arguments as of `warpav.optimisation.constraints.Margin`."""
    if kind == "border":
        return f"the distance from {cameras[0]} to the border of where it may stand"
    return f"the distance between {' and '.join(cameras)}"


def length_text(length_m: float) -> str:
    """A length in millimetres, or in metres where it is long."""
    return f"{1000.0 * length_m:.0f} mm" if length_m < 0.1 else f"{length_m:.2f} m"


def _worst_margin(margins: Sequence[Mapping[str, Any]]) -> str:
    worst = min(margins, key=lambda margin: margin["slack_m"], default=None)
    if worst is None or worst["is_kept"]:
        return ""
    return f" in all; {margin_text(worst['kind'], worst['cameras'])} is {length_text(-worst['slack_m'])} too short"


def _objective_change(evaluation: Mapping[str, Any]) -> str:
    start, end = (evaluation["training_objective"][name] for name in _ENDS)
    if start is not None and math.isfinite(start):
        change = f" ({(end - start) / start:+.1%})" if start and end is not None and math.isfinite(end) else ""
        return f"{start:.4f} at the start, {_metric(end)} at the end{change}"
    outcomes = (evaluation.get("requirements") or {}).get("start") or []
    unmet = [each["name"] for each in outcomes if each["hard"] and not each["is_met"]]
    reason = f", as it does not meet {', '.join(unmet)}" if unmet else ""
    return f"{_metric(end)} at the end; the start is not allowed{reason}"


def _show_difference(console: Terminal, what: str, found: Mapping[str, Any], *, digits: int) -> None:
    if found.get("low") is not None:
        text = f"{what}: {found['mean']:+z.{digits}f} "
        text += f"(95 % of resampled scene sets: {found['low']:+z.{digits}f} to {found['high']:+z.{digits}f})"
        console.print(shown(text))


def _metric(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.4f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{float(value):.4g}"
