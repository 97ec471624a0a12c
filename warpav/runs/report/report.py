"""From a run folder to its report: tables, plots and images into the page's template."""

from __future__ import annotations

import base64
import io
import math
import shlex
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from warpav.core.errors import InputError
from warpav.core.table import Table
from warpav.optimisation.evaluation.metrics import ObjectOutcome
from warpav.optimisation.evaluation.statistics import Difference
from warpav.runs._mounts import free_ranges, has_zones
from warpav.runs._rig_evaluation import LOWER_IS_BETTER, TABLE_ROWS, RigEvaluation
from warpav.runs._run_folder import RunFolder
from warpav.runs.config import config_names, load_config, overrides_from
from warpav.runs.report import _statements as words
from warpav.runs.report._content import RunContent, read_content
from warpav.sight.requirement import SECTORS, sectors_of
from warpav.view import OUTCOME_RGB, hex_colour
from warpav.view.figures import figure_bytes, loss_figure, search_figure

if TYPE_CHECKING:
    from jinja2 import Template

_MAX_BYTES = 5_000_000
"""No report is larger."""

_IMAGE_BYTES = 3_200_000
"""All images together, before they are written as text."""

_SIZES: Sequence[tuple[int, int]] = ((1280, 84), (960, 80), (640, 75), (480, 65), (320, 50), (200, 35))
"""Longer side [px] and quality of images: the first at which all of them fit."""

_ROWS_SHOWN = 30
"""Vehicles that are listed at once; the others follow folded."""

_MOST_ROWS = 1000
"""Vehicles that are listed at all."""

_FURTHER_SHOWN = 5
"""Places of a further camera that are listed, as many as carry ranks in the figure."""

_FIGURES = {
    "rig": "The rig at the start and the one that was found, in a test scene",
    "plan": "How far each camera's image of a car is large enough, and the ground that the own body hides",
    "range": "Up to which distance road users of each class are detected, by direction",
    "near_field": "How far from the body the first visible point is, by direction and height",
    "redundancy": "How many cameras see a road user, by direction and distance, and without the camera whose loss "
    "leaves most ground to no camera, whatever traffic is there",
    "rig_top_view": "From above: where the cameras started, how they moved, where they ended",
    "detections": "A test scene through the cameras, before and after",
    "loss_curves": "Loss, loss terms, multipliers and the smallest camera distance over the iterations",
    "sensitivity": "What it costs to mount a camera off its place, by degree of freedom, and to lose it",
    "search": "Best rig and bound over the camera renders",
    "requirements_start": "From above: points that have to be seen, and how many cameras of the start see enough there",
    "requirements_by_hand": "The same of the rig by hand",
    "requirements_optimised": "The same of the rig that was found",
    "recall": "Recall of every rig by distance, sector and class; the table holds the numbers",
    "differences": "Differences of recall and AP50 to the other rigs with 95 % intervals; the table holds the numbers",
    "blind_ground": "From above: share of the scenes in which no camera of a rig sees someone of a height",
    "further_cameras": "From above: what each camera of the pool would add to the rig that was found",
}
"""Figures of a run in the order of the report; others follow by name."""

_FITTING = ("plan", "range", "near_field", "redundancy")
_ELSEWHERE = (*_FITTING, *(name for name in _FIGURES if name not in (*_FITTING, "rig_top_view")))
"""Figures that have places of their own."""


SHOWN_SCENES = {
    "first_scene": "The first test scene",
    "hardest_scene": "Of the other test scenes that with most objects not detected at the end",
}
"""Whose images every camera has a figure of: how the names of these figures begin."""


class _PageImage(NamedTuple):
    caption: str
    address: str
    size_px: tuple[int, int]


def write_report(folder: RunFolder, run: RunContent | None = None) -> Path:
    """Write ``report.html`` of a run, from what its folder holds so far; nothing is rendered."""
    run = read_content(folder) if run is None else run
    page = _template().render(_content(folder, run))
    page = page.encode("utf-8", "backslashreplace").decode()  # of paths that are not UTF-8
    if len(page.encode()) > _MAX_BYTES:
        raise InputError(
            f"{folder.path}: report: expected at most {_MAX_BYTES / 1e6:g} MB, got {len(page.encode()) / 1e6:.1f}; "
            "move images out of its figures folder"
        )
    return folder.write_report(page)


@cache
def _template() -> Template:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("warpav.runs.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": words.number,
        "signed": words.signed,
        "percent": words.percent,
        "interval": words.interval,
    }
    return environment.get_template("page.html.jinja")


def _content(folder: RunFolder, run: RunContent) -> dict[str, Any]:
    evaluation = run.evaluation
    outages = evaluation and evaluation.camera_outage.get(evaluation.first)
    files: dict[str, Path | io.BytesIO] = {file.stem: file for file in folder.figures()}
    curves = "loss_curves" if run.certificate is None else "search"
    if curves not in files and not _draws_nothing(run):
        figure = _curves(run)
        files |= {} if figure is None else {curves: io.BytesIO(figure_bytes(figure, ".png"))}
    if any(name.startswith(tuple(SHOWN_SCENES)) for name in files):
        files.pop("detections", None)
    order = list(_FIGURES)
    named = sorted(files, key=lambda name: (order.index(name) if name in order else len(order), name))
    shown = {
        name: _PageImage(_FIGURES.get(name, name.partition("_scene_")[2] or name), *image)
        for name, image in zip(named, _images([files[name] for name in named]), strict=True)
    }
    objects = words.objects_name(run)
    return {
        "run": run,
        "evaluation": evaluation,
        "pictures": lambda *names: [shown[name] for name in names if name in shown],
        "fitting": [shown[name] for name in _FITTING if name in shown],
        "images": [
            image
            for name, image in shown.items()
            if name not in _ELSEWHERE and not name.startswith(tuple(SHOWN_SCENES))
        ],
        "draws_nothing": _draws_nothing(run),
        "views": {
            scene: [image for name, image in shown.items() if name.startswith(which)]
            for which, scene in SHOWN_SCENES.items()
        },
        "lead": _lead(run),
        "headline": words.headline(run),
        "statements": words.summary(run),
        "sensitivity": words.sensitivity(run),
        "free": _free(run),
        "cards": _cards(run),
        "objects": objects,
        "is_weighted": run.config is not None and run.config.importance.is_set,
        "metrics": _typeset(evaluation and evaluation.metric_table()),
        "paired": _paired(evaluation) if evaluation else [],
        "cameras": _cameras(run),
        "outage": _typeset(outages.table(evaluation.first) if evaluation and outages else None),
        "further": _further(run, objects),
        "near": _typeset(evaluation and evaluation.requirement_table()),
        "recall": _typeset(evaluation and evaluation.recall_table()),
        "ground": _ground(evaluation) if evaluation and evaluation.ground else [],
        "left": _left(evaluation) if evaluation and evaluation.outcomes is not None else None,
        "rows_shown": _ROWS_SHOWN,
        "most_rows": _MOST_ROWS,
        "margin_name": words.margin_name,
        "seconds": _seconds(run),
        "versions": _versions(run.environment),
        "command": run.environment.get("command"),
        "again": _command(run),
        "options": _flat(run.options),
        "colours": {outcome.replace(" ", "-"): hex_colour(rgb) for outcome, rgb in OUTCOME_RGB.items()},
    }


def _lead(run: RunContent) -> str:
    environment = run.environment
    parts = [
        f"{run.options['method']} method" if "method" in run.options else "",
        f"{len(run.events)} iterations" if run.events else "",
        f"on {environment['device']}" if environment.get("device") else "",
        f"warpav {environment['warpav']}" if environment.get("warpav") else "",
        f"started {environment['started']}" if environment.get("started") else "",
    ]
    lead = ", ".join(part for part in parts if part)
    return lead if run.evaluation else f"{lead} (stopped before the evaluation)"


def _cards(run: RunContent) -> list[words.Statement]:
    """Numbers to see at once: label, value, tone."""
    evaluation = run.evaluation
    if evaluation is None:
        return [words.Statement("last loss", words.number(run.events[-1].loss, 4))]
    first, arm = evaluation.first, evaluation.best
    before = evaluation.arms[evaluation.start].tp_detection_rate if evaluation.start in evaluation.arms else None
    cards = [
        words.Statement(
            f"recall of the rig, {first}"
            + ("" if before is None else f" ({evaluation.start.replace('_', ' ')} {words.number(before)})"),
            words.number(arm.tp_detection_rate),
        ),
        words.Statement(f"AP50 of all images, {first}", words.number(arm.ap50_pooled)),
    ]
    training = evaluation.training_objective
    if training is not None and training.start and training.optimised is not None:
        change = round(100.0 * (training.optimised - training.start) / abs(training.start), 1)
        text = f"{words.signed(change, 1)}{words.SPACE}%" if change else words.percent(0.0)
        tone = "good" if change < 0.0 else "bad" if change > 0.0 else "open"
        cards.append(words.Statement(f"objective, {words.search_scenes(run)} scenes", text, tone))
    if evaluation.ground is not None:
        text = f"of the ground is blind for {evaluation.ground.heights_m[0]:g} m (a child)"
        cards.append(words.Statement(text, words.percent(evaluation.ground.share(first, 0))))
    for each in evaluation.met.get(first, []):
        text = f"of the points of {each.name} are met" + ("" if each.is_met else ", too few")
        cards.append(words.Statement(text, words.percent(each.share), "good" if each.is_met else "bad"))
    violation_m = arm.constraint_violation
    if violation_m is not None:
        is_kept = violation_m == 0.0
        cards.append(
            words.Statement("constraints of spacing and mount met", "yes", "good")
            if is_kept
            else words.Statement("constraint violation", f"{words.number(violation_m, 4)} m", "bad")
        )
    return cards


def _typeset(table: Table | None) -> Table | None:
    """A table with the signs that pages have for minus and for nothing."""
    if table is None:
        return None
    rows = (
        (first, *(words.NONE if each == "-" else each.replace("-", words.MINUS) for each in cells))
        for first, *cells in table.rows
    )
    return Table(table.columns, tuple(rows))


def _paired(evaluation: RigEvaluation) -> list[tuple[str, list[tuple[str, str]]]]:
    """Rows of differences with intervals: a metric, and for every other arm the text and its tone."""

    def cell(found: Mapping[str, Difference], name: str) -> tuple[str, str]:
        if name not in found:
            return words.NONE, "open"
        return words.interval(found[name]), words.tone_of(found[name], lower_is_better=name in LOWER_IS_BETTER)

    return [
        (
            heading + (" (lower is better)" if name in LOWER_IS_BETTER else ""),
            [cell(found, name) for found in evaluation.paired.values()],
        )
        for name, heading in TABLE_ROWS.items()
        if any(name in found for found in evaluation.paired.values())
    ]


def _draws_nothing(run: RunContent) -> bool:
    return run.config is not None and run.config.run.pictures == "none"


def _curves(run: RunContent) -> Any:  # noqa: ANN401 (matplotlib)
    """The course of a search or of a descent; None for events that know neither."""
    records = [event.model_dump() for event in run.events]
    if all({"terms", "multipliers"} <= event.model_fields_set for event in run.events):
        spacing_m = None if run.config is None else run.config.rig.min_spacing_m
        return search_figure(records) or loss_figure(records, min_distance_m=spacing_m)
    return search_figure(records)


def _images(files: Sequence[Path | io.BytesIO]) -> list[tuple[str, tuple[int, int]]]:
    """Images as ``data:`` addresses with their sizes [px], made smaller until all of them fit."""
    from PIL import Image, UnidentifiedImageError

    originals = []
    for file in files:
        try:
            with Image.open(file) as image:
                originals.append(image.convert("RGB"))
        except (OSError, UnidentifiedImageError, Image.DecompressionBombError, SyntaxError) as error:
            text = " ".join(str(error).split())
            raise InputError(f"{file}: expected an image, got: {text}; was the file changed?") from None
    found: list[tuple[bytes, tuple[int, int]]] = []
    for side_px, quality in _SIZES:
        found = []
        for original in originals:
            image, encoded = original.copy(), io.BytesIO()
            image.thumbnail((side_px, side_px))
            image.save(encoded, "WEBP", quality=quality, method=2)  # the default takes twice as long, for 3 %
            found.append((encoded.getvalue(), image.size))
        if sum(len(encoded) for encoded, _ in found) <= _IMAGE_BYTES:
            break
    return [("data:image/webp;base64," + base64.b64encode(encoded).decode(), size) for encoded, size in found]


def _further(run: RunContent, objects: str) -> Table | None:
    """The best places of a further camera: rank, gain, place and direction."""
    if run.further is None:
        return None
    best = run.further[run.further.best_places()[:_FURTHER_SHOWN]].rows()
    rows = [
        (str(rank), *(words.number(value, 1 if "[deg]" in name else 2) for name, value in row.items()))
        for rank, row in enumerate(best, 1)
    ]
    weighted = ", weighted" if run.config is not None and run.config.importance.is_set else ""
    places = ("x [m]", "y [m]", "z [m]", "yaw [deg]", "pitch [deg]", "fov [deg]")
    return Table(("place", f"further {objects} of 100{weighted}", *places), tuple(rows)) if rows else None


def _cameras(run: RunContent) -> Table | None:
    """Start and end of every camera, and how far it has moved."""
    if run.result is None:
        return None
    start = run.start if run.start and len(run.start.cameras) == len(run.result.cameras) else None
    moved = words.moves(start, run.result) if start else []
    rows = []
    for k, camera in enumerate(run.result.cameras):
        for stage, each in {"start": start.cameras[k], "end": camera}.items() if start else [("end", camera)]:
            angles = (each.yaw_rad, each.pitch_rad, each.roll_rad, each.model.fov_rad)
            rows.append(
                (
                    "" if start and stage == "end" else camera.name,
                    stage,
                    *(words.number(float(value)) for value in each.position_m),
                    *(words.number(math.degrees(value), 1) for value in angles),
                )
            )
            if start:
                text = f"{words.number(moved[k][1])} m, {words.signed(moved[k][2], 1)} deg"
                rows[-1] += (text if stage == "end" else "",)
    places = ("x [m]", "y [m]", "z [m]", "yaw [deg]", "pitch [deg]", "roll [deg]", "fov [deg]")
    return Table(("camera", "", *places, *(["moved"] if start else [])), tuple(rows))


def _free(run: RunContent) -> str:
    """What was free, in words."""
    if run.config is None:
        return ""
    free = run.config.rig.free
    ranges = (
        ("pitch", None if has_zones(run.config) else free.pitch_deg, "deg"),
        ("height above the surface", None if has_zones(run.config) else free.height_m, "m"),
        ("field of view", free.fov_deg, "deg"),
    )
    given = [f", {name} from {pair[0]:g} to {pair[1]:g} {unit}" for name, pair, unit in ranges if pair is not None]
    text = f"Free were x, y, yaw{''.join(given)}."
    if has_zones(run.config):
        text += f" Each zone gives its own ranges of yaw, pitch and distance from the surface{_pitches(run)}."
    frozen = run.config.rig.freeze
    return text + (f" Frozen: {', '.join(frozen)}." if frozen else "")


def _pitches(run: RunContent) -> str:
    """The ranges of pitch of the zones of a file, in words."""
    usual_rad = None if run.config is None else free_ranges(run.config).pitch_rad
    named: dict[tuple[float, float], list[str]] = {}
    for zone in run.zones:
        pitch_rad = zone.pitch_rad or usual_rad
        if pitch_rad is not None:
            named.setdefault(pitch_rad, []).append(zone.name)
    told = [
        f"{math.degrees(low_rad):g} to {math.degrees(high_rad):g} deg in {', '.join(names)}"
        for (low_rad, high_rad), names in named.items()
    ]
    return f": pitch {'; '.join(told)}" if told else ""


def _ground(evaluation: RigEvaluation) -> list[dict[str, Any]]:
    """For every height the share of the ground that no camera sees, by sector and band, and the start's."""
    ground = evaluation.ground
    assert ground is not None
    first = evaluation.first
    has_start = evaluation.start in ground.blind and first != evaluation.start
    return [
        {
            "height_m": height_m,
            "arms": [(arm, ground.share(arm, height), ground.area_m2(arm, height)) for arm in ground.blind],
            "rows": [
                (
                    sector,
                    [
                        (
                            ground.share(first, height, s, b),
                            ground.share(evaluation.start, height, s, b) if has_start else None,
                        )
                        for b in range(len(ground.bands_m))
                    ],
                )
                for s, sector in enumerate(ground.sectors)
            ],
        }
        for height, height_m in enumerate(ground.heights_m)
    ]


def _left(evaluation: RigEvaluation) -> list[dict[str, Any]]:
    """The objects that the first arm does not detect, the nearest first."""
    left = [seen for seen in evaluation.outcomes or () if seen.outcome[evaluation.first] != ObjectOutcome.DETECTED]
    rows = []
    for seen in sorted(left, key=lambda seen: seen.distance_m):
        bearing_rad = math.radians(seen.bearing_deg)
        sector = SECTORS[int(sectors_of(np.array([math.cos(bearing_rad), math.sin(bearing_rad)])))]
        rows.append(
            {
                "scene": seen.scene,
                "category": seen.category,
                "distance_m": seen.distance_m,
                "bearing_deg": seen.bearing_deg,
                "sector": sector,
                "outcomes": [str(seen.outcome[arm]) for arm in evaluation.arms],
            }
        )
    return rows


def _seconds(run: RunContent) -> Table | None:
    """Wall time of the stages, and of the parts of an iteration."""
    stages = list((run.evaluation.seconds if run.evaluation else {}).items())
    parts = [name for name in (run.events[0].seconds if run.events else {}) if name != "total"]
    means = [
        (f"one iteration: {name}, mean", float(np.mean([event.seconds.get(name, 0.0) for event in run.events])))
        for name in (*parts, "total")
        if run.events and name in run.events[0].seconds
    ]
    rows = tuple((stage, words.number(value, 3 if value < 1.0 else 1)) for stage, value in stages + means)
    return Table(("stage", "seconds"), rows) if rows else None


def _versions(environment: Mapping[str, Any]) -> list[tuple[str, str]]:
    flat = _flat(environment)
    known = ("warpav", "git_commit", "python", "platform", "device", "cpu_count")
    named = {name: flat[name] for name in known if name in flat}
    packages = {name.partition(".")[2]: value for name, value in flat.items() if name.startswith("packages.")}
    return [*named.items(), *packages.items()]


def _command(run: RunContent) -> list[str]:
    """Commands that repeat the run: from a shipped configuration, or from the folder's own."""
    own = "warpav optimise config.yaml run.out=again"
    if run.config is None:
        return [own]
    shipped = {name: load_config(name) for name in config_names()}
    given = {
        name: [each for each in overrides_from(base, run.config) if not each.startswith("run.out=")]
        for name, base in shipped.items()
    }
    name = min(given, key=lambda name: (len(given[name]), name != "quick"))
    words_ = ["warpav", "optimise", *([] if name == "quick" else [name]), *given[name]]
    return [shlex.join(words_), own]


def _flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    options: dict[str, str] = {}
    for name, value in data.items():
        if isinstance(value, dict):
            options |= _flat(value, f"{prefix}{name}.")
        else:
            options[f"{prefix}{name}"] = "" if value is None else str(value)
    return options
