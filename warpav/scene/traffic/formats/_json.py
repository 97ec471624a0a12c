"""warpav's own JSON: lanelets or centre lines, and a track for every road user."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, DATA_SET_NODES_MAX, parse_json, read_bytes
from warpav.core.errors import InputError
from warpav.core.records import Point2, Positive, Record, Word, read_record, unread
from warpav.core.yaml_file import Location
from warpav.scene.traffic.recording import (
    LANE_WIDTH_M,
    Fault,
    Lanelet,
    RecordedUser,
    Recording,
    check_step,
    recording_of,
)

_Kinds = Annotated[list[Word], BeforeValidator(lambda kinds: [kinds] if isinstance(kinds, str) else kinds or [])]
_Sample = float | None  # a number of a track; ``null`` and NaN where a road user was not seen


class _Lanelet(Record):
    left: list[Point2]
    right: list[Point2]
    type: _Kinds = Field(default_factory=list)


class _Lane(Record):
    centre: Annotated[list[Point2], Field(min_length=2)]
    width_m: Positive = LANE_WIDTH_M
    type: _Kinds = Field(default_factory=list)


class _User(Record):
    type: Literal["car", "truck", "bus", "motorcycle", "bicycle", "pedestrian"]
    length_m: float
    width_m: float
    height_m: float | None = None
    t: list[float]
    x_m: list[_Sample]
    y_m: list[_Sample]
    yaw_rad: list[_Sample]
    v_mps: list[_Sample] | None = None


class _Recording(Record):
    id: Word = ""
    source: Word = ""
    dt_s: float
    lanelets: list[_Lanelet] = Field(default_factory=list)
    lanes: list[_Lane] = Field(default_factory=list)
    road_users: list[Any]  # each is read by itself, so that a bad one costs no other
    ego: Any = None  # the id of a road user, or an object with it


def read(file: Path) -> Recording:
    content = read_bytes(file, "recorded traffic", bytes_max=DATA_SET_BYTES_MAX)
    data = parse_json(content, "", "recorded traffic", nodes_max=DATA_SET_NODES_MAX)

    def name_of(location: Location) -> tuple[str, int]:
        return (f"{str(location[0])[:-1]} {location[1]}", 2) if len(location) > 2 else ("", 0)

    found = read_record(_Recording, data, "", name_of=name_of)
    lanelets = [Lanelet(_line(each.left), _line(each.right), tuple(each.type)) for each in found.lanelets]
    lanelets += [Lanelet.along(_line(each.centre), each.width_m, tuple(each.type)) for each in found.lanes]
    users, faults = [], []
    for number, each in enumerate(found.road_users):
        name = str(each.get("id", number) if isinstance(each, dict) else number)
        try:
            users.append(_user(each, name))
        except InputError as error:
            faults.append(Fault.of(error, f"road user {name}"))
    ego = found.ego.get("id") if isinstance(found.ego, dict) else found.ego
    own = {"id", *_User.model_fields}
    strange = {f"road_users.{key}" for each in found.road_users if isinstance(each, dict) for key in each.keys() - own}
    ego_id = None if ego is None else str(ego)
    return recording_of(
        found.id, found.source, found.dt_s, lanelets, users, ego_id, faults=faults, unread=[*unread(found), *strange]
    )


def _line(points: list[Point2]) -> np.ndarray:
    return np.array(points, np.float64).reshape(-1, 2)


def _user(data: object, name: str) -> RecordedUser:
    place = f"road user {name}"
    found = read_record(_User, data, place)
    track = [np.array(each, np.float64) for each in (found.t, found.x_m, found.y_m, found.yaw_rad)]
    if len({len(each) for each in track}) > 1:
        counts = [len(each) for each in track]
        raise InputError(f"{place}: t: expected as many x_m, y_m and yaw_rad as t, got {counts}")
    for value in found.t:
        check_step(value, f"{place}: t")
    size_m = (found.length_m, found.width_m, math.nan if found.height_m is None else found.height_m)
    speed_m_s = None if found.v_mps is None else np.array(found.v_mps, np.float64)
    return RecordedUser(name, found.type, size_m, track[0].astype(np.int64), np.stack(track[1:], axis=1), speed_m_s)
