"""CommonRoad XML, 2018b and 2020a: lanelets, static and dynamic obstacles with rectangles or circles, exact states."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, DATA_SET_NODES_MAX, parse_xml, read_bytes
from warpav.core.errors import InputError
from warpav.scene.traffic.recording import Fault, Lanelet, RecordedUser, Recording, check_step, recording_of

_VERSIONS = ("2018b", "2020a")
_KNOWN = {
    *("lanelet", "obstacle", "dynamicObstacle", "staticObstacle", "planningProblem", "location", "scenarioTags"),
    *("trafficSign", "trafficLight", "intersection", "environmentObstacle", "phantomObstacle"),
    *("role", "type", "shape", "initialState", "trajectory", "initialSignalState", "signalSeries"),
}
"""Elements of a scenario and of an obstacle that are read, or say nothing of who is where."""
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


def read(file: Path) -> Recording:
    content = read_bytes(file, "recorded traffic", bytes_max=DATA_SET_BYTES_MAX)
    root = parse_xml(content, "", "a whole CommonRoad scenario", nodes_max=DATA_SET_NODES_MAX)
    if root.tag != "commonRoad":
        raise InputError(f"expected a CommonRoad scenario, got <{root.tag}>")
    version = root.get("commonRoadVersion", "")
    if version not in _VERSIONS:
        raise InputError(f"commonRoadVersion: expected {' or '.join(_VERSIONS)}, got {version!r}")
    obstacles = [each for tag in ("obstacle", "dynamicObstacle", "staticObstacle") for each in root.findall(tag)]
    users, faults, others = [], [], []
    strange = {f"<{below.tag}>" for each in (root, *obstacles) for below in each if below.tag not in _KNOWN}
    for element in obstacles:
        name, kind = element.get("id", ""), element.findtext("type", "").strip()
        if kind not in _CLASS_OF_TYPE:
            others.append(kind)
            continue
        try:
            users.append(_obstacle(element, name, _CLASS_OF_TYPE[kind]))
        except InputError as error:
            faults.append(Fault.of(error, f"obstacle {name}"))
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
    return recording_of(
        root.get("benchmarkID", ""),
        root.get("source", ""),
        _float(root.get("timeStepSize"), "timeStepSize"),
        [_lanelet(element) for element in root.iter("lanelet") if element.find("leftBound") is not None],
        standing,
        faults=faults,
        passed_over=others,
        unread=strange,
    )


def _obstacle(element: ElementTree.Element, user_id: str, category: str) -> RecordedUser:
    place = f"obstacle {user_id}"
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
