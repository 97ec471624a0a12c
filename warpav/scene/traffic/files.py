"""Files of recorded traffic: JSON, CommonRoad XML, logs of Argoverse 2, and the recordings that ship with warpav."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal
from xml.etree import ElementTree

import numpy as np
from pydantic import BeforeValidator, Field

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, DATA_SET_NODES_MAX, parse_json, parse_xml, read_bytes
from warpav.core.cache import digest
from warpav.core.errors import InputError
from warpav.core.records import Point2, Record, Word, read_record
from warpav.core.yaml_file import Location
from warpav.scene.traffic._argoverse2 import ANNOTATIONS, read_log
from warpav.scene.traffic.recording import Lanelet, RecordedUser, Recording, check_step

_SUFFIXES = (".json", ".json.gz", ".xml", ".xml.gz")
_SHIPPED = Path(__file__).parent / "sind"  # SinD, CC0; its README says more


def is_recording(path: Path) -> bool:
    """Whether a path looks like a recording: a file of these suffixes, or the folder of a log."""
    return (path.is_file() and path.name.endswith(_SUFFIXES)) or (path / ANNOTATIONS).is_file()


def recordings_in(paths: Iterable[Path]) -> list[Path]:
    """The recordings that paths mean, each once, in the order of their names, in which 2 stands before 10."""
    found: dict[Path, None] = {}
    for path in paths:
        if is_recording(path):
            found[path.absolute()] = None
            continue
        if path.is_file():
            raise InputError(
                f"{path}: expected recorded traffic ({', '.join(_SUFFIXES)}, or the folder of an Argoverse 2 log), got "
                f"another file"
            )
        inside = [each for each in path.rglob("*") if is_recording(each)] if path.is_dir() else []
        logs = {each for each in inside if each.is_dir()}  # their maps are JSON too
        inside = [each for each in inside if logs.isdisjoint(each.parents)]
        if not inside:
            text = "a folder without any" if path.is_dir() else "no such file"
            raise InputError(
                f"{path}: expected recorded traffic ({', '.join(_SUFFIXES)}, Argoverse 2 logs), got {text}"
            )
        found.update(dict.fromkeys(each.absolute() for each in inside))
    return sorted(found, key=natural_order)


def shipped_recordings() -> list[Path]:
    """The recordings that ship with warpav, in the order of time."""
    return recordings_in([_SHIPPED])


def content_digest(path: Path) -> str:
    """Hash of what a recording is made of."""
    files = [path]
    if path.is_dir():  # of a log's folder what is looked at: sensors are not
        inside = (each for each in path.rglob("*") if each.name.endswith((".feather", ".json")))
        files = sorted(each for each in inside if "sensors" not in each.parts)
    return _digest_of(tuple((file, _stamp(file)) for file in files))


@lru_cache(maxsize=1024)
def _digest_of(files: tuple[tuple[Path, tuple[int, int]], ...]) -> str:
    return digest(*(file.read_bytes() for file, _ in files))


def read_recording(path: Path) -> Recording:
    """The recording of a file or a log's folder, checked; kept while the file stays as it is."""
    return _read(path, _stamp(path))


@lru_cache(maxsize=256)
def _read(path: Path, stamp: tuple[int, int]) -> Recording:
    del stamp
    try:
        if path.is_dir():
            return read_log(path)
        content = read_bytes(path, "recorded traffic", bytes_max=DATA_SET_BYTES_MAX)
        return _read_xml(content) if ".xml" in path.name else _from_json(content)
    except InputError as error:
        raise InputError(*(line if line.startswith(str(path)) else f"{path}: {line}" for line in error.args)) from None


def _stamp(path: Path) -> tuple[int, int]:
    try:
        about = path.stat()
    except OSError as error:
        raise InputError(f"{path}: expected recorded traffic, got: {error.strerror}") from None
    return about.st_mtime_ns, about.st_size


def natural_order(path: Path) -> list[tuple[str, int]]:
    """Sort key of a path in which numbers count by their value."""
    return [(text, int(digits or -1)) for text, digits in re.findall(r"(\D*)(\d*)", str(path))]


class _JsonLanelet(Record):
    left: list[Point2]
    right: list[Point2]
    type: Annotated[list[Word], BeforeValidator(lambda kinds: [kinds] if isinstance(kinds, str) else kinds or [])] = (
        Field(default_factory=list)
    )


class _JsonUser(Record):
    id: Word | None = None  # None: its number in the list
    type: Literal["car", "truck", "bus", "motorcycle", "bicycle", "pedestrian"]
    length_m: float
    width_m: float
    height_m: float | None = None
    t: list[float]
    x_m: list[float]
    y_m: list[float]
    yaw_rad: list[float]
    v_mps: list[float] | None = None


class _JsonRecording(Record):
    id: Word = ""
    source: Word = ""
    dt_s: float
    lanelets: list[_JsonLanelet]
    road_users: list[_JsonUser]
    ego: Any = None  # the id of a road user, or an object with it


def _from_json(content: bytes) -> Recording:
    data = parse_json(content, "", "recorded traffic", nodes_max=DATA_SET_NODES_MAX)

    def name_of(location: Location) -> tuple[str, int]:
        if len(location) < 3:
            return "", 0
        each = data[location[0]][int(location[1])]
        user_id = each.get("id", location[1]) if isinstance(each, dict) else location[1]
        return (f"road user {user_id}" if location[0] == "road_users" else f"lanelet {location[1]}"), 2

    found = read_record(_JsonRecording, data, "", name_of=name_of)
    ego = found.ego.get("id") if isinstance(found.ego, dict) else found.ego
    return Recording(
        found.id,
        found.source,
        found.dt_s,
        tuple(
            Lanelet(np.array(each.left).reshape(-1, 2), np.array(each.right).reshape(-1, 2), tuple(each.type))
            for each in found.lanelets
        ),
        tuple(_json_user(each, number) for number, each in enumerate(found.road_users)),
        None if ego is None else str(ego),
    )


def _json_user(data: _JsonUser, number: int) -> RecordedUser:
    user_id = str(number) if data.id is None else data.id
    place = f"road user {user_id}"
    track = [np.array(each, np.float64) for each in (data.t, data.x_m, data.y_m, data.yaw_rad)]
    if len({len(each) for each in track}) > 1:
        raise InputError(f"{place}: expected as many x_m, y_m and yaw_rad as t, got {[len(each) for each in track]}")
    for value in data.t:
        check_step(value, f"{place}: t")
    size_m = (data.length_m, data.width_m, math.nan if data.height_m is None else data.height_m)
    speed_m_s = None if data.v_mps is None else np.array(data.v_mps, np.float64)
    return RecordedUser(user_id, data.type, size_m, track[0].astype(np.int64), np.stack(track[1:], axis=1), speed_m_s)


_VERSIONS = ("2018b", "2020a")
_CLASS_OF_TYPE = {
    "car": "car",
    "taxi": "car",
    "priorityVehicle": "car",
    "parkedVehicle": "car",
    "truck": "truck",
    "bus": "bus",
    "motorcycle": "motorcycle",
    "bicycle": "bicycle",
    "pedestrian": "pedestrian",
}


def _read_xml(content: bytes) -> Recording:
    """The recording of a scenario."""
    root = parse_xml(content, "", "a whole CommonRoad scenario", nodes_max=DATA_SET_NODES_MAX)
    if root.tag != "commonRoad":
        raise InputError(f"expected a CommonRoad scenario, got <{root.tag}>")
    version = root.get("commonRoadVersion", "")
    if version not in _VERSIONS:
        raise InputError(f"commonRoadVersion: expected {' or '.join(_VERSIONS)}, got {version!r}")
    obstacles = [each for tag in ("obstacle", "dynamicObstacle", "staticObstacle") for each in root.findall(tag)]
    users = [user for element in obstacles if (user := _obstacle(element)) is not None]
    last = max((int(user.step[-1]) for user in users), default=0)
    static_ids = {
        each.get("id", "")
        for each in obstacles
        if each.tag == "staticObstacle" or (each.tag == "obstacle" and each.findtext("role", "").strip() == "static")
    }
    if last * len(static_ids) > DATA_SET_NODES_MAX:
        raise InputError(f"expected at most {DATA_SET_NODES_MAX:,} samples of static obstacles, got {last:,} steps")
    standing = [
        user
        if len(user.step) > 1 or user.user_id not in static_ids
        else RecordedUser(
            user.user_id, user.category, user.size_m, np.arange(last + 1), np.repeat(user.pose, last + 1, axis=0),
            np.zeros(last + 1),
        )
        for user in users
    ]  # fmt: skip
    return Recording(
        root.get("benchmarkID", ""),
        root.get("source", ""),
        _float(root.get("timeStepSize"), "timeStepSize"),
        tuple(_lanelet(element) for element in root.iter("lanelet") if element.find("leftBound") is not None),
        tuple(standing),
    )


def _obstacle(element: ElementTree.Element) -> RecordedUser | None:
    """An obstacle as a road user; None where it is none."""
    user_id = element.get("id", "")
    place = f"obstacle {user_id}"
    category = _CLASS_OF_TYPE.get(element.findtext("type", "").strip())
    if category is None:
        return None
    length, width, along, across, turn = _rectangle(element, place)
    states = [*element.findall("initialState"), *element.findall("trajectory/state")]
    if not states:
        raise InputError(f"{place}: expected an initialState and a trajectory of states, got neither")
    sample = sorted((_state(state, place) for state in states), key=lambda each: each[0])
    step = np.array([each[0] for each in sample], np.int64)
    pose = np.array([each[1:4] for each in sample], np.float64)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    pose[:, :2] += np.stack([c * along - s * across, s * along + c * across], axis=1)
    pose[:, 2] += turn
    speed = np.array([each[4] for each in sample])
    return RecordedUser(
        user_id, category, (length, width, math.nan), step, pose, None if np.isnan(speed).any() else speed
    )


def _rectangle(element: ElementTree.Element, place: str) -> tuple[float, float, float, float, float]:
    """Length and width [m], and where its centre lies from the position: along, across [m], turned [rad]."""
    shape = element.find("shape")
    parts = [] if shape is None else list(shape)
    if len(parts) != 1 or parts[0].tag not in ("rectangle", "circle"):
        found = ", ".join(part.tag for part in parts) or "nothing"
        raise InputError(f"{place}: shape: expected one rectangle or circle, got {found}")
    part = parts[0]
    along = _float(part.findtext("center/x", "0"), f"{place}: shape")
    across = _float(part.findtext("center/y", "0"), f"{place}: shape")
    if part.tag == "circle":
        size = 2.0 * _float(part.findtext("radius"), f"{place}: radius")
        return size, size, along, across, 0.0
    turn = _float(part.findtext("orientation", "0"), f"{place}: shape")
    size = tuple(_float(part.findtext(name), f"{place}: {name}") for name in ("length", "width"))
    return size[0], size[1], along, across, turn


def _state(element: ElementTree.Element, place: str) -> tuple[int, float, float, float, float]:
    """Step, x, y [m], yaw [rad], speed [m/s] or NaN."""
    time = _exact(element, "time", place)
    check_step(time, f"{place}: time")
    point = element.find("position/point")
    if point is None:
        raise InputError(f"{place}: position: expected a point, got none; uncertain positions are not taken")
    x, y = (_float(point.findtext(axis), f"{place}: position") for axis in ("x", "y"))
    speed = math.nan if element.find("velocity") is None else _exact(element, "velocity", place)
    return int(time), x, y, _exact(element, "orientation", place), speed


def _exact(element: ElementTree.Element, name: str, place: str) -> float:
    return _float(element.findtext(f"{name}/exact"), f"{place}: {name}")


def _lanelet(element: ElementTree.Element) -> Lanelet:
    lines = []
    for name in ("leftBound", "rightBound"):
        place = f"lanelet {element.get('id', '')}: {name}"
        points = [
            [_float(point.findtext(axis), place) for axis in ("x", "y")] for point in element.findall(f"{name}/point")
        ]
        lines.append(np.array(points, np.float64).reshape(-1, 2))
    kinds = tuple((each.text or "").strip() for each in element.findall("laneletType"))
    return Lanelet(lines[0], lines[1], kinds)


def _float(text: str | None, place: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        raise InputError(f"{place}: expected a number, got {'nothing' if text is None else repr(text)}") from None
    if not math.isfinite(value):
        raise InputError(f"{place}: expected a finite number, got {text!r}")
    return value
