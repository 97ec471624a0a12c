"""From a run folder to its report: tables, plots and images into the page's template."""

from __future__ import annotations

import base64
import io
import math
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from warpav.core.cores import available_cores
from warpav.core.errors import InputError
from warpav.core.files import atomic_write, writing
from warpav.core.table import Table
from warpav.optimisation import ObjectOutcome
from warpav.rig import Rig
from warpav.runs._drawn_run import heading_of
from warpav.runs._mounts import has_zones
from warpav.runs._rig_evaluation import LOWER_IS_BETTER, RigEvaluation
from warpav.runs._run_folder import RunFolder
from warpav.runs.config import config_names, load_config, overrides_from
from warpav.runs.report import _statements as words
from warpav.runs.report._content import RunContent, read_content
from warpav.runs.report.tables import next_commands
from warpav.sight import SECTORS, sectors_of
from warpav.view import figure_bytes, loss_figure, search_figure

if TYPE_CHECKING:
    from jinja2 import Template

_MAX_BYTES = 2_000_000
"""No report is larger."""

_IMAGE_BYTES = 1_250_000
"""All images together, before they are written as text."""

_SIZES: Sequence[tuple[int, int]] = ((1280, 84), (960, 80), (640, 75), (480, 65), (320, 50), (200, 35))
"""Longer side [px] and quality of images: the first at which all of them fit."""

_MOST_ROWS = 200
"""Road users that are listed at most."""

_FURTHER_SHOWN = 5
"""Places of a further camera that are listed, as many as carry ranks in the figure."""

_FIGURES = {
    "rig": "Left the rig it is compared with, right the one found",
    "recall": "Share detected at equal false alarms, by distance, sector and class",
    "differences": "How many fewer of 100 it misses than other rigs, at equal false alarms",
    "ground": "Ground near the vehicle that cameras see, that the body hides, and that is in no image",
    "plan": "How far a car is large enough in an image",
    "near_field": "How far from the body the first visible point is, by height",
    "requirements_start": "Points that have to be seen, and how many cameras see them: at the start",
    "requirements_by_hand": "Points that have to be seen, and how many cameras see them: by hand",
    "requirements_found": "Points that have to be seen, and how many cameras see them: found",
    "detections": "A test scene, with boxes at the detector's own threshold; violet: the own body",
    "range": "Up to which distance road users are detected",
    "redundancy": "How many cameras see a road user, and without the worst camera to lose",
    "sensitivity": "What errors of mounting and the loss of a camera cost",
    "further_cameras": "What each further camera would add; of a symmetric pair the left one is drawn",
    "rig_top_view": "How the cameras moved, and where they ended; of a symmetric place to mount the left half is drawn",
    "search": "The best rig so far, and the bound (dashed), over camera renders",
    "loss_curves": "Loss, terms, multipliers and closest cameras over the iterations",
}
"""Figures of a run and their captions; others come last, by name."""

_COMPARED = {
    "rig": "The rigs on the vehicle in the first test scene, in the order of the title",
    "recall": _FIGURES["recall"],
    "differences": _FIGURES["differences"],
    "alone": "Left: level ground that one rig alone sees. Right: road users of the test scenes that one alone finds",
    "ground": _FIGURES["ground"],
    "plan": _FIGURES["plan"],
}
"""Figures of rigs side by side and their captions."""

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


def write_comparison(run: RunContent, figures: Mapping[str, io.BytesIO], out: Path, again: str) -> Path:
    """Write the page of rigs side by side, at most 2 MB, from their evaluation and figures by name."""
    evaluation = run.evaluation
    assert evaluation is not None
    shown = {
        name: _PageImage(_COMPARED[name], *image)
        for name, image in zip(figures, _images(list(figures.values())), strict=True)
    }
    alone, listed = _alone(evaluation, words.objects_name(run))
    tables = {
        "groups": evaluation.group_table(),
        "near": evaluation.requirement_table(),
        "rules": words.rule_table(evaluation, evaluation.arms),
        "alone": alone,
        "listed_alone": listed,
    }
    page = _template("compare").render(
        evaluation=evaluation,
        headline=words.verdict(run),
        cautions=words.cautions(run),
        pictures=lambda *names: [shown[name] for name in names if name in shown],
        metrics=_metrics(run),
        heading_of=heading_of,
        rigs={name: _poses(rig) for name, rig in evaluation.rigs.items()},
        again=again,
        **{name: _typeset(table) for name, table in tables.items()},
    )
    with writing(out), atomic_write(out) as draft:
        draft.write_text(page, encoding="utf-8", errors="backslashreplace")
    return out


def write_check(rig: str, items: Sequence[Any], figures: Mapping[str, io.BytesIO], out: Path) -> Path:
    """Write the page of a rig that is checked, from what was checked and figures by name."""
    images = zip(figures, _images(list(figures.values())), strict=True)
    judged = [each for each in items if each.is_kept is not None]
    failed = [each.about for each in judged if each.is_hard and not each.is_kept]
    missed = sum(not each.is_hard and not each.is_kept for each in judged)
    text = f"{len(failed)} of {len(judged)} fail: {'; '.join(failed)}." if failed else f"{len(judged)} were checked."
    text += (
        f" {missed} that {'is' if missed == 1 else 'are'} not hard {'is' if missed == 1 else 'are'} not met."
        if missed
        else ""
    )
    page = _template("check").render(
        rig=rig,
        headline=words.Statement("FAIL" if failed else "PASS", text, "bad" if failed else "good"),
        items=items,
        pictures=[_PageImage(_FIGURES[name], *image) for name, image in images],
    )
    with writing(out), atomic_write(out) as draft:
        draft.write_text(page, encoding="utf-8", errors="backslashreplace")
    return out


def _alone(evaluation: RigEvaluation, objects: str) -> tuple[Table, Table | None]:
    """How many road users one rig alone finds, in all and by class and sector, and which they are."""
    counts = {name: Counter[str]() for name in evaluation.arms}
    rows = []
    for seen in sorted(evaluation.objects, key=lambda seen: seen.distance_m):
        name = seen.found_alone_by
        if name is not None:
            sector = SECTORS[round(seen.bearing_deg / 45.0) % len(SECTORS)]
            counts[name].update(("all", seen.category, sector))
            others = (str(each) for arm, each in seen.outcome.items() if arm != name)
            place = words.number(seen.distance_m, 1), words.signed(seen.bearing_deg, 0), sector
            rows.append((seen.scene, seen.category, *place, name, ", ".join(others)))
    categories = sorted({seen.category for seen in evaluation.objects})
    groups = [each for each in ("all", *categories, *SECTORS) if any(count[each] for count in counts.values())]
    table = Table(
        (f"of {len(evaluation.objects)} {objects} found by one alone", *evaluation.arms),
        tuple((group, *(str(count[group]) for count in counts.values())) for group in groups or ["all"]),
    )
    columns = ("scene", "class", "distance [m]", "bearing [°]", "sector", "found by", "to the others")
    return table, Table(columns, tuple(rows[:_MOST_ROWS])) if rows else None


@cache
def _template(name: str = "page") -> Template:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("warpav.runs.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(f"{name}.html.jinja")


def _content(folder: RunFolder, run: RunContent) -> dict[str, Any]:
    evaluation = run.evaluation
    files: dict[str, Path | io.BytesIO] = {file.stem: file for file in folder.figures()}
    curves = "loss_curves" if run.certificate is None else "search"
    draws_nothing = run.config is not None and run.config.run.pictures == "none"
    if curves not in files and not draws_nothing:
        figure = _curves(run)
        files |= {} if figure is None else {curves: io.BytesIO(figure_bytes(figure, ".png"))}
    views = {name for name in files if name.startswith(tuple(SHOWN_SCENES))}
    if views:
        files.pop("detections", None)
    shown = {
        name: _PageImage(_FIGURES.get(name, name.partition("_scene_")[2] or name), *image)
        for name, image in zip(sorted(files), _images([files[name] for name in sorted(files)]), strict=True)
    }
    statements = words.summary(run)
    return {
        "run": run,
        "evaluation": evaluation,
        "pictures": lambda *names: [shown[name] for name in names if name in shown],
        "others": [image for name, image in shown.items() if name not in _FIGURES and name not in views],
        "views": {
            scene: [image for name, image in shown.items() if name.startswith(which)]
            for which, scene in SHOWN_SCENES.items()
        },
        "headline": words.headline(run),
        "cautions": words.cautions(run),
        "next": next_commands(run, str(folder.path)),
        "told": lambda *abouts: [each for each in statements if each.about in abouts],
        "heading_of": heading_of,
        "rigs": [(name, _poses(rig)) for name, rig in words.rigs_of_run(run)],
        "free": _free(run),
        "metrics": _metrics(run),
        "sensitivity": words.sensitivity(run),
        **{name: _typeset(table) for name, table in _tables(run).items()},
        "again": _command(run),
        "command": run.environment.get("command"),
        "options": Table(("option", "value"), tuple(_flat(run.options).items())),
    }


def _tables(run: RunContent) -> dict[str, Table | None]:
    """The tables that are the same for terminal and page, and those of the page alone."""
    evaluation = run.evaluation
    found: dict[str, Table | None] = {"further": _further(run), "seconds": _seconds(run)}
    found["versions"] = _versions(run.environment)
    names = ("groups", "near", "ground", "left", "rules", "constraints", "outage")
    if evaluation is None:
        return found | dict.fromkeys(names)
    outages = evaluation.camera_outage.get(evaluation.first)
    return found | {
        "groups": evaluation.group_table(),
        "near": evaluation.requirement_table(),
        "ground": _ground(evaluation),
        "left": _left(evaluation),
        "rules": words.rule_table(evaluation),
        "constraints": _constraints(evaluation),
        "outage": None if outages is None else outages.table(heading_of(evaluation.first)),
    }


def _typeset(table: Table | None) -> Table | None:
    """A table with the signs that pages have for minus and for nothing, and the headings of rigs."""
    if table is None:
        return None
    minus = re.compile(r"(?<![\w.])-(?=[\d.])")

    def cell(text: str) -> str:
        return words.NONE if text == "-" else minus.sub(words.MINUS, re.sub(r"(?<=\d)%", f"{words.SPACE}%", text))

    rows = tuple((first, *map(cell, cells)) for first, *cells in table.rows)
    return Table(tuple(map(heading_of, table.columns)), rows)


def _metrics(run: RunContent) -> list[tuple[str, list[tuple[str, str, str]]]]:
    """Rows of a metric: for every rig the number, the difference of the first to it with its interval, and a tone."""
    evaluation = run.evaluation
    if evaluation is None:
        return []
    rows = []
    for metric, (heading, factor, digits) in evaluation.rows.items():
        cells = []
        for name, arm in evaluation.arms.items():
            value, found = getattr(arm, metric), evaluation.paired.get(name, {}).get(metric)
            text = words.number(None if value is None else factor * value, digits)
            if found is None or found.mean is None:
                cells.append((text, "", "open"))
            else:
                tone = words.tone_of(found, lower_is_better=metric in LOWER_IS_BETTER)
                cells.append((text, words.gain(found, metric, factor, digits), tone))
        rows.append((heading, cells))
    return rows


def _curves(run: RunContent) -> Any:  # noqa: ANN401 (matplotlib)
    records = [event.model_dump() for event in run.events]
    if all({"terms", "multipliers"} <= event.model_fields_set for event in run.events):
        spacing_m = None if run.config is None else run.config.rig.min_spacing_m
        return search_figure(records) or loss_figure(records, min_distance_m=spacing_m)
    return search_figure(records)


def _images(files: Sequence[Path | io.BytesIO]) -> list[tuple[str, tuple[int, int]]]:
    """Images as ``data:`` addresses with their sizes [px], made smaller until all of them fit."""
    from PIL import Image, UnidentifiedImageError

    def opened(file: Path | io.BytesIO) -> Image.Image:
        try:
            with Image.open(file) as image:
                return image.convert("RGB")
        except (OSError, UnidentifiedImageError, Image.DecompressionBombError, SyntaxError) as error:
            text = " ".join(str(error).split())
            raise InputError(f"{file}: expected an image, got: {text}; was the file changed?") from None

    def encoded(side_px: int, quality: int, original: Image.Image) -> tuple[bytes, tuple[int, int]]:
        image, stream = original.copy(), io.BytesIO()
        image.thumbnail((side_px, side_px))
        image.save(stream, "WEBP", quality=quality, method=2)  # the default takes twice as long, for 3 %
        return stream.getvalue(), image.size

    found: list[tuple[bytes, tuple[int, int]]] = []
    with ThreadPoolExecutor(available_cores()) as threads:
        originals = list(threads.map(opened, files))
        for size in _SIZES:
            found = list(threads.map(partial(encoded, *size), originals))
            if sum(len(each) for each, _ in found) <= _IMAGE_BYTES:
                break
    return [("data:image/webp;base64," + base64.b64encode(each).decode(), size) for each, size in found]


def _further(run: RunContent) -> Table | None:
    if run.further is None:
        return None
    best = run.further[run.further.best_places()[:_FURTHER_SHOWN]].rows()
    rows = [
        (
            str(rank),
            *(words.number(value, 1 if "[deg]" in name or name == "gain" else 2) for name, value in row.items()),
        )
        for rank, row in enumerate(best, 1)
    ]
    weighted = ", weighted" if run.config is not None and run.config.importance.is_set else ""
    places = ("x [m]", "y [m]", "z [m]", "yaw [deg]", "pitch [deg]", "fov [deg]")
    return Table(("place", f"found in addition per 100{weighted}", *places), tuple(rows)) if rows else None


def _poses(rig: Rig | None) -> Table | None:
    if rig is None:
        return None
    rows = [
        (
            camera.name,
            *(words.number(float(value)) for value in camera.position_m),
            *(words.number(math.degrees(angle_rad), 1) for angle_rad in (camera.yaw_rad, camera.pitch_rad)),
            camera.module or f"{math.degrees(camera.model.fov_rad):.0f}°",
        )
        for camera in rig.cameras
    ]
    lens = "module" if any(camera.module for camera in rig.cameras) else "view"
    return Table(("camera", "x [m]", "y [m]", "z [m]", "yaw [°]", "pitch [°]", lens), tuple(rows))


def _free(run: RunContent) -> str:
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
        text += " Each zone gives its own ranges of yaw, pitch and distance from the surface."
    frozen = run.config.rig.freeze
    return text.replace(" -", f" {words.MINUS}") + (f" Frozen: {', '.join(frozen)}." if frozen else "")


def _ground(evaluation: RigEvaluation) -> Table | None:
    """The share of the ground on which no camera of the first rig sees a child, by sector and band, and the other's."""
    ground, other = evaluation.ground, words.compared_with(evaluation)
    if ground is None:
        return None
    names = [evaluation.first, *([other] if other in ground.blind else [])]

    def cell(sector: int, band: int) -> str:
        shares = [words.percent(ground.share(name, 0, sector, band), 0) for name in names]
        return shares[0] if len(shares) == 1 or words.NONE in shares else f"{shares[0]} ({shares[1]})"

    bands = range(len(ground.bands_m))
    rows = tuple((name, *(cell(k, band) for band in bands)) for k, name in enumerate(ground.sectors))
    return Table(("ground blind for a child", *(f"{band} m" for band in ground.bands_m)), rows)


def _constraints(evaluation: RigEvaluation) -> Table | None:
    margins = None if evaluation.constraints is None else evaluation.constraints[evaluation.first]
    if not margins:
        return None
    rows = tuple(
        (words.margin_name(each), *(words.number(value) for value in (each.value_m, each.limit_m, each.slack_m)))
        for each in sorted(margins, key=lambda each: each.slack_m)
    )
    return Table(("constraint", "value [m]", "at least [m]", "to spare [m]"), rows)


def _left(evaluation: RigEvaluation) -> Table | None:
    left = [seen for seen in evaluation.outcomes or () if seen.outcome[evaluation.first] != ObjectOutcome.DETECTED]
    rows = []
    for seen in sorted(left, key=lambda seen: seen.distance_m)[:_MOST_ROWS]:
        bearing_rad = math.radians(seen.bearing_deg)
        sector = SECTORS[int(sectors_of(np.array([math.cos(bearing_rad), math.sin(bearing_rad)])))]
        place = words.number(seen.distance_m, 1), words.signed(seen.bearing_deg, 0), sector
        rows.append((seen.scene, seen.category, *place, *(str(seen.outcome[arm]) for arm in evaluation.arms)))
    columns = ("scene", "class", "distance [m]", "bearing [°]", "sector", *evaluation.arms)
    return Table(columns, tuple(rows)) if rows else None


def _seconds(run: RunContent) -> Table | None:
    stages = list((run.evaluation.seconds if run.evaluation else {}).items())
    parts = [name for name in (run.events[0].seconds if run.events else {}) if name != "total"]
    means = [
        (f"one iteration: {name}, mean", float(np.mean([event.seconds.get(name, 0.0) for event in run.events])))
        for name in (*parts, "total")
        if run.events and name in run.events[0].seconds
    ]
    rows = tuple((stage, words.number(value, 3 if value < 1.0 else 1)) for stage, value in stages + means)
    return Table(("stage", "seconds"), rows) if rows else None


def _versions(environment: Mapping[str, Any]) -> Table | None:
    flat = _flat(environment)
    known = ("warpav", "git_commit", "python", "platform", "device", "cpu_count")
    rows = [(name, flat[name]) for name in known if name in flat]
    rows += [(name.partition(".")[2], value) for name, value in flat.items() if name.startswith("packages.")]
    return Table(("", "version"), tuple(rows)) if rows else None


def _command(run: RunContent) -> list[str]:
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
