"""Tidy rows of studies, one a run, and the tables that are computed from them and from nothing else.

Columns that a study has no number for are empty. Rows without a seed are differences from another arm, ``reference``,
with their 95 % interval: ``more``, ``low`` and ``high`` of the quantity ``of``. They are taken over scenes and runs
together (BCa), and rows of runs alone cannot give them again.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.core.files import write_text
from warpav.core.table import Table
from warpav.experiments._gradient_magnitude import LOSS_OF
from warpav.experiments._result_folder import objective_of_tests, objective_on_tests
from warpav.optimisation import RESAMPLES, paired_difference
from warpav.thesis import WARNING, thesis_table

_Row = dict[str, str]

ROWS = "rows.csv"
"""The file of rows in the folder of a study."""
OWN_JUDGE = "builtin"  # the judge of rows that come from the study itself: its own detector, or its objective
MARK = re.compile(r"(<!-- rows: ([\w ]+) -->\n).*?(<!-- end -->)", re.DOTALL)
"""What stands between such marks on a page is a table: its kind, and of which study and judge."""
_COLUMNS = (
    *("study", "judge", "arm", "seed", "objective", "objective_seen", "gap", "misses_per_100"),
    *("misses_at_equal_false_alarms", "false_alarms_per_image", "ap50", "near_ground_m", "rules_broken"),
    *("map50_average", "map50_min_camera", "map50_max_camera", "detection_rate", "in_frame_rate", "confidence"),
    *("constraint_violation_m", "constraint_loss", "min_camera_distance_m", "camera_renders", "search_seconds"),
    *("positional", "rotational", "of", "reference", "more", "low", "high", "cost", "required_share"),
    "attainable_misses_per_100",
)
_METRICS = {
    **{name: name for name in _COLUMNS if name.startswith("map50_")},
    **{name: name for name in ("misses_per_100", "misses_at_equal_false_alarms", "attainable_misses_per_100")},
    "false_alarms_per_frame": "false_alarms_per_image",
    "ap50_pooled": "ap50",
    "tp_detection_rate": "detection_rate",
    "tp_in_frame_rate": "in_frame_rate",
    "detection_confidence": "confidence",
    "constraint_violation": "constraint_violation_m",
    "min_camera_distance_m": "min_camera_distance_m",
}
"""Metrics of a rig by the column that has them."""

_OF_RUN = ("objective_seen", "gap", "constraint_loss", "cost", "required_share")
_ARM_COLUMNS = {
    "missed per 100, equal false alarms": ("misses_at_equal_false_alarms", 1.0, 1),
    "missed, own threshold": ("misses_per_100", 1.0, 1),
    "expected misses per 100": ("objective", 100.0, 2),
    "false alarms there": ("false_alarms_per_image", 1.0, 1),
    "AP50": ("ap50", 100.0, 1),
    "rules broken": ("rules_broken", 1.0, 1),
    "on the scenes of the search": ("objective_seen", 100.0, 2),
    "renders": ("camera_renders", 1.0, 0),
    "search [s]": ("search_seconds", 1.0, 1),
}
_COMPARED = {"attainable_misses_per_100": 1.0, "misses_at_equal_false_alarms": 1.0, "objective": 100.0}
"""What is compared with the reference, per 100 road users: the first that there is."""
_MISSED = "misses_at_equal_false_alarms"
_BY_HAND = {"corners", "cross", "edge", "highest", "nuscenes_layout", "nuscenes_as_built"}
_PARTS = {"dense": "dense streets", "ngsim": "NGSIM motorway", "sind": "SinD crossing", "all": "all road users"}
_OBJECTIVE_COLUMNS = ("objective", "objective_seen")  # shown only where no detector judged
_THESIS_COLUMNS = {
    "avg_map50": ("average mAP@50", "map50_average"),
    "min_camera_map50": ("min camera mAP@50", "map50_min_camera"),
    "max_camera_map50": ("max camera mAP@50", "map50_max_camera"),
    "tp_detection_rate": ("TP detection rate", "detection_rate"),
    "tp_in_frame_rate": ("TP in-frame rate", "in_frame_rate"),
    "detection_confidence": ("detection confidence", "confidence"),
    "optimisable_loss": ("optimisable loss", "objective"),
    "constraint_loss": ("constraint loss", "constraint_loss"),
    "min_pair_distance_m": ("min camera pair distance (m)", "min_camera_distance_m"),
}
"""Columns of tables II to IV of the thesis by its names: the heading, and our column."""


def rows_of(
    results: Mapping[str, Sequence[Mapping[str, Any]]],
    study: str,
    judge: str,
    references: Mapping[str, str],
    *,
    resamples: int = RESAMPLES,
) -> list[_Row]:
    """Every run of a study, by arm, those of ``streets_4_draw_2`` as ``streets_4``, and differences from references."""
    joined: dict[str, list[Mapping[str, Any]]] = {}
    for name, runs in results.items():
        arm, _, draw = name.partition("_draw_")
        joined.setdefault(arm, []).extend({**run, "arm": arm, "seed": draw or run["seed"]} for run in runs)
    rows = [row for runs in joined.values() for run in runs for row in _run_rows(run, study, judge)]
    for arm, reference in dict.fromkeys(tuple(n.partition("_draw_")[0] for n in pair) for pair in references.items()):
        ours, theirs = joined.get(arm), joined.get(reference)
        if not ours or not theirs or arm == reference:
            continue
        for of, scale in _COMPARED.items():
            one, other = _of_scenes(ours, of), _of_scenes(theirs, of)
            if one is None or other is None:
                continue
            found = paired_difference(one, other, weight=ours[0]["objects_of_scene"], resamples=resamples)
            ends = {"more": found.mean, "low": found.low, "high": found.high}.items()
            which = {"study": study, "judge": judge, "arm": arm, "of": of, "reference": reference}
            rows.append({**which, **{name: _text(end, scale) for name, end in ends}})
            break
    return rows


def _run_rows(run: Mapping[str, Any], study: str, judge: str) -> list[_Row]:
    which = {"study": study, "judge": judge, "arm": run["arm"], "seed": str(run["seed"])}
    renders = {"camera_renders": _text(run["camera_renders"])}
    if "gradients" in run:
        kinds = ("positional", "rotational")
        found = run["gradients"].items()
        return [{**which, "arm": loss, **renders, **{each: _text(of[each]) for each in kinds}} for loss, of in found]
    metrics = run.get("metrics", {"constraint_violation": run.get("constraint_violation_m")})
    return [
        {
            **which,
            "objective": _text(metrics["objective"] if "metrics" in run else objective_on_tests(run)),
            **{name: _text(run.get(name)) for name in _OF_RUN},
            **{column: _text(metrics.get(name)) for name, column in _METRICS.items()},
            **_rules(run),
            **renders,
            "search_seconds": _text(run["seconds"]["search"]),
        }
    ]


def _rules(run: Mapping[str, Any]) -> dict[str, str]:
    """From how near the ground is seen all round [m], inf for nowhere, and how many rules are broken."""
    if "rules_broken" not in run:
        return {}
    near_m = run["near_ground_m"]
    return {"near_ground_m": "inf" if near_m is None else _text(near_m), "rules_broken": str(len(run["rules_broken"]))}


def _of_scenes(runs: Sequence[Mapping[str, Any]], of: str) -> np.ndarray | None:
    """What `paired_difference` takes, [run, scene]; None where it is not known."""
    if of == "objective":
        found = np.array([objective_of_tests(run) for run in runs], np.float64)
    elif all("metrics" in run and of in run["metrics"]["per_scene"] for run in runs):
        found = np.array([run["metrics"]["per_scene"][of] for run in runs], np.float64)
    else:
        return None
    return found if np.isfinite(found).any(axis=1).all() else None


def _text(value: float | None, scale: float = 1.0) -> str:
    return "" if value is None else f"{scale * value:.6g}"


def write_rows(rows: Sequence[_Row], path: Path) -> None:
    lines = [",".join(_COLUMNS), *(",".join(row.get(column, "") for column in _COLUMNS) for row in rows)]
    write_text(path, "\n".join([*lines, ""]))


def read_rows(path: Path) -> list[_Row]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: expected rows of studies as CSV, got: {error}") from None
    lacking = [column for column in _COLUMNS if not rows or column not in rows[0]]
    if lacking:
        raise InputError(f"{path}: expected rows of studies with the column {lacking[0]}, got none")
    return rows


def filled_page(text: str, rows: Sequence[_Row]) -> str:
    """A page whose marked tables are computed from the rows."""
    return MARK.sub(lambda found: f"{found[1]}\n{table_of(found[2], rows).markdown()}\n{found[3]}", text)


def table_of(marked: str, rows: Sequence[_Row]) -> Table:
    """A table by its kind, the study and the judge, such as ``arms open builtin``, ``thesis II table2 builtin``."""
    kind, *words = marked.split()
    return _KINDS[kind](rows, *words)


def _values(rows: Sequence[_Row], column: str, scale: float = 1.0) -> list[float]:
    return [scale * float(row[column]) for row in rows if row.get(column)]


def _mean(rows: Sequence[_Row], column: str, scale: float, digits: int) -> str:
    values = _values(rows, column, scale)
    return f"{fmean(values):.{digits}f}" if values else ""


def _spread(rows: Sequence[_Row], column: str, digits: int = 3) -> str:
    values = _values(rows, column)
    if not values:
        return ""
    return f"{fmean(values):.{digits}f}" + (f" ±{stdev(values):.{digits}f}" if len(values) > 1 else "")


def _runs(rows: Sequence[_Row], study: str, judge: str) -> dict[str, list[_Row]]:
    """The rows of runs by arm, in the order of the file."""
    arms: dict[str, list[_Row]] = {}
    for row in rows:
        if (row["study"], row["judge"]) == (study, judge) and row.get("seed"):
            arms.setdefault(row["arm"], []).append(row)
    return arms


def _difference(rows: Sequence[_Row], study: str, judge: str, arm: str) -> str:
    for row in rows:
        if (row["study"], row["judge"], row["arm"]) == (study, judge, arm) and row.get("of"):
            ends = f" [{float(row['low']):+.1f}, {float(row['high']):+.1f}]" if row["low"] else ""
            return f"{float(row['more']):+.1f}{ends}"
    return ""


def _arms(rows: Sequence[_Row], study: str, judge: str = OWN_JUDGE) -> Table:
    """Every arm of a study: means over runs, and how many more it misses than its reference."""
    arms = _runs(rows, study, judge)
    has = {row[0]: any(_values(runs, row[0]) for runs in arms.values()) for row in _ARM_COLUMNS.values()}
    if has["misses_per_100"]:
        has |= dict.fromkeys(_OBJECTIVE_COLUMNS, False)
    first, *others = (title for title, column in _ARM_COLUMNS.items() if has[column[0]])
    differences = {arm: _difference(rows, study, judge, arm) for arm in arms}
    more = "more than the reference [95 %]"
    lines = [
        [
            *(arm, str(len(runs)), _mean(runs, *_ARM_COLUMNS[first])),
            *([differences[arm]] if any(differences.values()) else []),
            *(_mean(runs, *_ARM_COLUMNS[title]) for title in others),
        ]
        for arm, runs in arms.items()
    ]
    return Table.of(["arm", "runs", first, *([more] if any(differences.values()) else []), *others], lines)


def _best_by_hand(arms: Mapping[str, list[_Row]]) -> str:
    return min((arm for arm in arms if arm in _BY_HAND), key=lambda arm: fmean(_values(arms[arm], _MISSED)))


def _settings(rows: Sequence[_Row], *shown: str) -> Table:
    """The search beside the best rig by hand, in some settings of rivals or in all."""
    lines = []
    for study in shown or _rival_studies(rows):
        arms = _runs(rows, study, OWN_JUDGE)
        missed = {arm: _mean(runs, _MISSED, 1.0, 1) for arm, runs in arms.items()}
        hand = _best_by_hand(arms)
        name = ", ".join(_PARTS.get(part, part) for part in study.removeprefix("rivals_").split("_"))
        others = (missed.get(arm, "") for arm in ("without_rules", "random_selected", "highest_raised"))
        fewer = _difference(rows, study, OWN_JUDGE, hand)
        near = " / ".join(filter(None, (_near(arms[arm]) for arm in (hand, "default"))))
        lines.append([name, f"{missed[hand]} ({hand.replace('_', '-')})", missed["default"], fewer, *others, near])
    heads = ["best by hand", "warpav", "fewer [95 %]", "without rules", "random, selected", "25 cm higher"]
    table = ["traffic, cameras, mount", *heads, "ground seen from [m]"]
    kept = [k for k in range(len(table)) if any(line[k] for line in lines)]
    return Table.of([table[k] for k in kept], [[line[k] for k in kept] for line in lines])


def _near(runs: Sequence[_Row]) -> str:
    """From how far off the body on the ground is seen all round [m], the median of runs; nothing where nowhere."""
    near_m = _values(runs, "near_ground_m")
    return f"{np.median(near_m):g}" if np.isfinite(near_m).any() else ""


def _rival_studies(rows: Sequence[_Row]) -> list[str]:
    return list(dict.fromkeys(row["study"] for row in rows if row["arm"] == "edge"))


def _rivals(rows: Sequence[_Row], *studies: str) -> Table:
    """How many more every arm misses than the search, by setting."""
    studies = studies or tuple(_rival_studies(rows))
    arms = dict.fromkeys(row["arm"] for row in rows if row["study"] in studies and row.get("of"))
    lines = [
        [study.removeprefix("rivals_"), *(_difference(rows, study, OWN_JUDGE, arm) for arm in arms)]
        for study in studies
    ]
    return Table.of(["setting", *arms], lines)


def _costs(rows: Sequence[_Row], of: str = "at_cost", judge: str = OWN_JUDGE) -> Table:
    """Known layouts as built beside the best rig by hand of their modules and what a search finds for their cost."""
    lines = []
    for study in dict.fromkeys(row["study"] for row in rows if f"{row['study']}_".startswith(f"{of}_")):
        arms = {arm: runs for arm, runs in _runs(rows, study, judge).items() if arm in _AT_COST}
        name = ", ".join(_PARTS.get(part, part) for part in study.removeprefix("at_cost_").split("_"))
        cells = [[_mean(arms.get(arm, ()), *column) for arm in _AT_COST] for column in _COST_COLUMNS]
        costs, missed, seen = (" / ".join(each) for each in cells)
        fewer = [_difference(rows, study, judge, arm) for arm in ("as_built", "by_hand")]
        lines.append([name, costs, missed, *fewer, seen])
    heads = [
        "layout, traffic",
        "cost",
        "missed of 100 attainable",
        "fewer than as built [95 %]",
        "fewer than by hand [95 %]",
    ]
    return Table.of([*heads, "near field seen [%]"], lines, "Three numbers: as built / by hand / warpav.")


_AT_COST = ("as_built", "by_hand", "default")
_COST_COLUMNS = (("cost", 1.0, 1), ("attainable_misses_per_100", 1.0, 1), ("required_share", 100.0, 0))


def _networks(rows: Sequence[_Row]) -> Table:
    """What networks that no search knew miss: of the search, of the best rig by hand, and how many fewer it is."""
    studies = _rival_studies(rows)
    judges = list(dict.fromkeys(row["judge"] for row in rows if row["study"] in studies and row["judge"] != OWN_JUDGE))

    def cell(study: str, judge: str) -> str:
        arms = _runs(rows, study, judge)
        if not arms:
            return ""
        hand = _best_by_hand(arms)
        missed = " / ".join(_mean(arms[arm], _MISSED, 1.0, 1) for arm in ("default", hand))
        fewer = _difference(rows, study, judge, hand)
        return f"{missed}: {fewer}" if fewer else missed

    lines = [[study.removeprefix("rivals_"), *(cell(study, judge) for judge in judges)] for study in studies]
    return Table.of(["setting", *judges], [line for line in lines if any(line[1:])])


def _thesis(rows: Sequence[_Row], number: str, study: str, judge: str = OWN_JUDGE) -> Table:
    """A table of the thesis: ours above what it prints."""
    printed = thesis_table(number)["rows"]
    columns = [key for key in _THESIS_COLUMNS if any(key in row for row in printed)]
    arms = list(_runs(rows, study, judge).items())
    columns = [key for key in columns if any(_values(runs, _THESIS_COLUMNS[key][1]) for _, runs in arms)]
    rows_of_thesis = {arm_name(row["method"], row["loss"]): row for row in printed}
    lines = []
    for arm, runs in arms:
        row = rows_of_thesis.get(arm, {})
        lines.append([f"`{arm}`", str(len(runs)), *(_spread(runs, _THESIS_COLUMNS[key][1]) for key in columns)])
        if row:
            lines.append(["thesis", "", *(_printed(row.get(key)) for key in columns)])
    return Table.of(["arm", "runs", *(_THESIS_COLUMNS[key][0] for key in columns)], lines, WARNING)


def arm_name(method: str, loss: str) -> str:
    """The name of the arm that is a row of a table of the thesis."""
    return re.sub(r"[^a-z0-9]+", "_", f"{method} {loss}".lower().replace("*", ""))


def _printed(cell: Mapping[str, float] | None) -> str:
    if cell is None:
        return ""
    return f"{cell['mean']:.3f}" + (f" ±{cell['std']:.3f}" if cell["std"] is not None else "")


def _gradients(rows: Sequence[_Row], study: str, judge: str = OWN_JUDGE) -> Table:
    """Mean magnitudes of the gradients of every loss, and those that the thesis prints in tables I and V."""
    printed = {row["loss"]: row for number in ("I", "V") for row in thesis_table(number)["rows"]}
    of_loss = {loss: printed[name] for name, loss in LOSS_OF.items() if name in printed}
    lines = []
    for loss, runs in _runs(rows, study, judge).items():
        cells = [_spread(runs, kind, 4) for kind in ("positional", "rotational")]
        theirs = [f"{of_loss[loss][kind]:.3f}" if loss in of_loss else "" for kind in ("positional", "rotational")]
        lines.append([loss, *cells, *theirs])
    heads = ["loss", "positional [1/m]", "rotational [1/rad]", "thesis, positional", "thesis, rotational"]
    return Table.of(heads, lines)


def _correlation(rows: Sequence[_Row], study: str = "correlation", judge: str = OWN_JUDGE) -> Table:
    """Spearman's rank correlation of the objective with what the detector finds on unseen scenes, over random rigs."""
    from warpav.optimisation import rank_correlation

    drawn = {arm: runs for arm, runs in _runs(rows, study, judge).items() if arm.startswith("random")}
    drawn["all of these"] = [run for runs in drawn.values() for run in runs]
    lines = []
    for arm, runs in drawn.items():
        expected, found = _values(runs, "objective_seen", -1.0), _values(runs, "detection_rate")
        estimate = rank_correlation(expected, found)
        ends = "" if estimate.low is None else f" [{estimate.low:.3f}, {estimate.high:.3f}]"
        lines.append([arm, str(len(runs)), "-" if estimate.value is None else f"{estimate.value:.3f}{ends}"])
    return Table.of(["rigs", "number", "rank correlation [95 %]"], lines)


_KINDS: dict[str, Callable[..., Table]] = {
    "arms": _arms,
    "settings": _settings,
    "rivals": _rivals,
    "costs": _costs,
    "networks": _networks,
    "thesis": _thesis,
    "gradients": _gradients,
    "correlation": _correlation,
}
