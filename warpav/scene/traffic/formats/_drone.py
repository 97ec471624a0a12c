"""Data sets that drones recorded in Germany: inD, rounD, exiD and uniD, and highD, whose columns differ.

A recording is ``XX_tracks.csv`` with ``XX_tracksMeta.csv`` (classes) and ``XX_recordingMeta.csv`` (rate, place) beside
it; five frames a second are kept. Lanes are those of a lanelet2 map of the place, if one lies near; those of highD are
its markings. highD measures in the image: y points down, and a position is the upper left corner of a box.
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.scene.traffic.formats._lanelet2 import maps_near, read_map
from warpav.scene.traffic.formats._rows import Columns, read_columns, steps_of, with_people
from warpav.scene.traffic.recording import CLASSES, Fault, Lanelet, Recording, recording_of

_RATE_HZ = 5.0
_REACH_M, _AHEAD_M = 1e4, 30.0  # of highD's positions, and of its lanes beyond the tracks
_PLACE, _ORIGIN = ("locationId", "upperLaneMarkings", "lowerLaneMarkings"), ("xUtmOrigin", "yUtmOrigin")
_BOX = ("frame", "xCenter", "yCenter", "heading", "width", "length", "xVelocity", "yVelocity")
_IMAGE_BOX = ("frame", "x", "y", "width", "height", "xVelocity", "yVelocity")
_OF_ABOUT = (
    r"id|recordingId|locationName|speedLimit|month|week[dD]ay|startTime|duration|totalDriv\w+|num\w+|\w+Location|fileName"
    r"|weather|orthoPxToMeter|scaleDownFactor|backgroundScaleFactor"
)
_OF_TRACKS = (
    r"recordingId|trackLifetime|num\w+|(initial|final)Frame|width|length|height|[dt]hw|ttc|odrSectionNo"
    r"|\w*(Acceleration|Velocity|Distance|[DT]HW|TTC|Ids?|ID)|(lane|lead|rear|alongside|left|right|cur|lat|lon)\w+"
)
"""Columns that are not needed: patterns of names."""
_CLASS_OF_TYPE = {name: name for name in CLASSES} | {"van": "car", "truck_bus": "truck", "trailer": "truck"}


def files_of(file: Path) -> list[Path]:
    """The three tables of a recording, and the maps near it."""
    number = file.name.partition("_")[0]
    return [file, *(file.with_name(f"{number}_{name}Meta.csv") for name in ("tracks", "recording")), *maps_near(file)]


def read(file: Path) -> Recording:
    _, tracks_file, about_file, *maps = files_of(file)
    about = read_columns(about_file, ("frameRate",), _PLACE, optional=(*_PLACE, *_ORIGIN), harmless=_OF_ABOUT)
    rate_hz = float(about["frameRate"][0]) if len(about["frameRate"]) else 0.0
    if not 0.0 < rate_hz < 1e4:
        raise InputError(f"{about_file}: frameRate: expected frames a second, got {rate_hz:g}")
    is_image = _PLACE[1] in about
    key = "id" if is_image else "trackId"
    table = read_columns(file, _IMAGE_BOX if is_image else _BOX, (key,), harmless=_OF_TRACKS)
    direction = ("drivingDirection",) if is_image else ()
    tracks = read_columns(tracks_file, direction, (key, "class"), harmless=_OF_TRACKS)
    strange = {*about.unread, *table.unread, *tracks.unread}
    names, first, count = np.unique(tracks[key], return_index=True, return_counts=True)
    if (count != 1).any():
        raise InputError(f"{tracks_file}: {key}: expected every id once, got {names[count > 1][0]} twice")
    strangers = sorted({*np.unique(table[key]).tolist()} - {*names.tolist()})
    text = f"class: expected a row with its {key} in {tracks_file.name}, got none"
    with np.errstate(invalid="ignore"):
        kept = (np.mod(table["frame"], max(1, round(rate_hz / _RATE_HZ))) == 0) & np.isin(table[key], names)
    table = Columns({name: column[kept] for name, column in table.items()})
    if strangers and not kept.any():
        raise InputError(f"road user {strangers[0]}: {text}")
    track = first[np.searchsorted(names, table[key])]
    step, frames = steps_of(table["frame"], f"{file}: frame")
    velocity_m_s = np.stack([table["xVelocity"], table["yVelocity"]], axis=1)
    rows = {"id": table[key], "type": np.char.lower(tracks["class"][track]), "step": step}
    if is_image:
        velocity_m_s[:, 1] *= -1.0
        rows |= {"x_m": table["x"] + 0.5 * table["width"], "y_m": -table["y"] - 0.5 * table["height"]}
        rows |= {"length_m": table["width"], "width_m": table["height"]}
        direction = tracks["drivingDirection"][track]  # 1 is to the left
        rows["yaw_rad"] = np.select([direction == 1, direction == 2], [np.pi, 0.0], np.nan)
        lanelets, maps = _lanes(about, rows["x_m"], about_file), []
    else:
        rows |= {"x_m": table["xCenter"], "y_m": table["yCenter"], "yaw_rad": np.radians(table["heading"])}
        rows |= {"length_m": table["length"], "width_m": table["width"]}
        place, origin_m = about.get(_PLACE[0], [""])[0], [float(about[name][0]) for name in _ORIGIN if name in about]
        maps = [each for each in maps if place in re.findall(r"\d+", each.stem)] if len(origin_m) == 2 else []
        maps = sorted(maps, key=lambda each: len(each.stem))[:1]  # others are variants
        lanelets = [lanelet for each in maps for lanelet in read_map(each, origin_m, strange)]
    users, others = with_people(rows, _CLASS_OF_TYPE, velocity_m_s)
    return recording_of(
        file.stem.partition("_")[0], "highD" if is_image else "inD, rounD, exiD or uniD", frames / rate_hz, lanelets,
        users, faults=[Fault("class", f"road user {name}: {text}") for name in strangers], passed_over=others,
        unread=strange,
        found_map=maps[0].name if maps else "",
    )  # fmt: skip


def _lanes(about: dict[str, np.ndarray], x_m: np.ndarray, place: Path) -> list[Lanelet]:
    """Lanes of highD: the upper ones lead to the left, the lower ones to the right."""
    x = np.r_[0.0, x_m[np.abs(x_m) < _REACH_M]]
    x = np.array([x.min() - _AHEAD_M, x.max() + _AHEAD_M])
    found = []
    for name, is_upper in ((_PLACE[1], True), (_PLACE[2], False)):
        text = str(about[name][0]) if name in about else ""
        try:
            y = [-float(part) for part in text.split(";") if part]
        except ValueError:
            raise InputError(f"{place}: {name}: expected y separated by ;, got {text!r}") from None
        lines = [np.stack([x, np.full(2, each)], axis=1) for each in y]
        found += [Lanelet(b[::-1], a[::-1]) if is_upper else Lanelet(a, b) for a, b in pairwise(lines)]
    return found
