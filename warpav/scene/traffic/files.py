"""Files of recorded traffic: JSON, CommonRoad XML, logs of Argoverse 2, and the recordings that ship with warpav."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, DATA_SET_NODES_MAX, parse_json, read_bytes
from warpav.core.cache import digest
from warpav.core.errors import InputError
from warpav.scene.traffic.argoverse2 import ANNOTATIONS, read_log
from warpav.scene.traffic.commonroad import read_xml
from warpav.scene.traffic.recording import CLASSES, Lanelet, RecordedUser, Recording, check_step

SUFFIXES = (".json", ".json.gz", ".xml", ".xml.gz")
SHIPPED = Path(__file__).parent / "sind"
"""SinD, CC0; its README says more."""


def is_recording(path: Path) -> bool:
    """Whether a path looks like a recording: a file of these suffixes, or the folder of a log."""
    return (path.is_file() and path.name.endswith(SUFFIXES)) or (path / ANNOTATIONS).is_file()


def recordings_in(paths: Iterable[Path]) -> list[Path]:
    """The recordings that paths mean, each once, in the order of their names, in which 2 stands before 10."""
    found: dict[Path, None] = {}
    for path in paths:
        if is_recording(path):
            found[path.absolute()] = None
            continue
        if path.is_file():
            raise InputError(
                f"{path}: expected recorded traffic ({', '.join(SUFFIXES)}, or the folder of an Argoverse 2 log), got "
                f"another file"
            )
        inside = [each for each in path.rglob("*") if is_recording(each)] if path.is_dir() else []
        logs = {each for each in inside if each.is_dir()}  # their maps are JSON too
        inside = [each for each in inside if logs.isdisjoint(each.parents)]
        if not inside:
            text = "a folder without any" if path.is_dir() else "no such file"
            raise InputError(f"{path}: expected recorded traffic ({', '.join(SUFFIXES)}, Argoverse 2 logs), got {text}")
        found.update(dict.fromkeys(each.absolute() for each in inside))
    return sorted(found, key=_natural_order)


def shipped_recordings() -> list[Path]:
    """The recordings that ship with warpav, in the order of time."""
    return recordings_in([SHIPPED])


def content_digest(path: Path) -> str:
    """Hash of what a recording is made of."""
    files = [path] if path.is_file() else sorted(each for each in path.rglob("*") if _is_read(each))
    return _digest_of(tuple((file, _stamp(file)) for file in files))


def read_recording(path: Path) -> Recording:
    """The recording of a file or a log's folder, checked; kept while the file stays as it is."""
    stamp = _stamp(path)
    return _read(path, stamp)


@lru_cache(maxsize=256)
def _read(path: Path, stamp: tuple[int, int]) -> Recording:
    del stamp
    try:
        if path.is_dir():
            return read_log(path)
        content = read_bytes(path, "recorded traffic", bytes_max=DATA_SET_BYTES_MAX)
        return read_xml(content) if ".xml" in path.name else _from_json(content)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None


@lru_cache(maxsize=1024)
def _digest_of(files: tuple[tuple[Path, tuple[int, int]], ...]) -> str:
    return digest(*(file.read_bytes() for file, _ in files))


def _is_read(file: Path) -> bool:
    """Whether a file of a log's folder is looked at: sensors are not."""
    return file.name.endswith((".feather", ".json")) and "sensors" not in file.parts


def _stamp(path: Path) -> tuple[int, int]:
    try:
        about = path.stat()
    except OSError as error:
        raise InputError(f"{path}: expected recorded traffic, got: {error.strerror}") from None
    return about.st_mtime_ns, about.st_size


def _natural_order(path: Path) -> list[tuple[str, int]]:
    return [(text, int(digits or -1)) for text, digits in re.findall(r"(\D*)(\d*)", str(path))]


def _from_json(content: bytes) -> Recording:
    data = parse_json(content, "", "recorded traffic", nodes_max=DATA_SET_NODES_MAX)
    if not isinstance(data, dict):
        raise InputError(f"expected an object with lanelets and road_users, got {type(data).__name__}")
    lanelets = []
    for number, each in enumerate(_list_of(data, "lanelets")):
        kinds = each.get("type") or () if isinstance(each, dict) else ()
        kinds = [kinds] if isinstance(kinds, str) else kinds
        place = f"lanelet {number}"
        lanelets.append(
            Lanelet(
                _numbers(each, "left", place, 2), _numbers(each, "right", place, 2), tuple(str(kind) for kind in kinds)
            )
        )
    users = [_user(each, number) for number, each in enumerate(_list_of(data, "road_users"))]
    ego = data.get("ego")
    return Recording(
        str(data.get("id", "")),
        str(data.get("source", "")),
        _number(data, "dt_s", "recording"),
        tuple(lanelets),
        tuple(users),
        None if ego is None else str(ego.get("id") if isinstance(ego, dict) else ego),
    )


def _user(data: Any, number: int) -> RecordedUser:  # noqa: ANN401
    if not isinstance(data, dict):
        raise InputError(f"road_users[{number}]: expected an object, got {type(data).__name__}")
    user_id = str(data.get("id", number))
    place = f"road user {user_id}"
    category = str(data.get("type"))
    if category not in CLASSES:
        near = difflib.get_close_matches(category, CLASSES, 1, 0.6)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"{place}: type: expected one of {', '.join(CLASSES)}, got {category!r}{hint}")
    height = data.get("height_m")
    size = (
        _number(data, "length_m", place),
        _number(data, "width_m", place),
        math.nan if height is None else _number(data, "height_m", place),
    )
    track = [_numbers(data, name, place, 1) for name in ("t", "x_m", "y_m", "yaw_rad")]
    speed = None if data.get("v_mps") is None else _numbers(data, "v_mps", place, 1)
    if len({len(each) for each in track}) > 1:
        raise InputError(f"{place}: expected as many x_m, y_m and yaw_rad as t, got {[len(each) for each in track]}")
    for value in track[0].tolist():
        check_step(value, f"{place}: t")
    return RecordedUser(user_id, category, size, track[0].astype(np.int64), np.stack(track[1:], axis=1), speed)


def _list_of(data: dict[str, Any], name: str) -> Sequence[Any]:
    value = data.get(name)
    if not isinstance(value, list):
        raise InputError(f"{name}: expected a list, got {'nothing' if value is None else type(value).__name__}")
    return value


def _number(data: dict[str, Any], name: str, place: str) -> float:
    value = data.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{place}: {name}: expected a number, got {'nothing' if value is None else repr(value)}")
    return float(value)


def _numbers(data: Any, name: str, place: str, dimensions: int) -> np.ndarray:  # noqa: ANN401
    value = data.get(name) if isinstance(data, dict) else None
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if value is None or array.ndim != dimensions:
        raise InputError(f"{place}: {name}: expected a list of {'numbers' if dimensions == 1 else 'points'}")
    return array
