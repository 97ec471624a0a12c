"""Motion scenes of Waymo as the JSON of GPUDrive and Nocturne: objects at 10 Hz, centre lines of lanes, crossings.

Files differ in what they hold besides (heights, ids, who carried the sensors), and in the unit of headings, which the
motion of vehicles tells. Samples that are not valid hold a fill value, sizes of 0 are none. All vehicles are cars here.
"""

from __future__ import annotations

import gzip
import math
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, DATA_SET_NODES_MAX, parse_json, read_bytes
from warpav.core.errors import InputError
from warpav.core.records import Record, Word, read_record, unread
from warpav.scene.traffic.formats._rows import USUAL_SIZE_M, speed_along
from warpav.scene.traffic.recording import LANE_WIDTH_M, Fault, Lanelet, RecordedUser, Recording, recording_of

_HEAD = re.compile(rb'"(?:objects|roads)"\s*:\s*\[')
_HEAD_BYTES = 65_536
_STEP_S, _FILL = 0.1, -10_000.0
_TYPES = {"0": "unset", "1": "vehicle", "2": "pedestrian", "3": "cyclist", "4": "other"}
_CLASS_OF_TYPE = {"vehicle": "car", "pedestrian": "pedestrian", "cyclist": "bicycle"}
_CYCLE_LANE, _CYCLE_LANE_WIDTH_M = 3, 1.5  # the map_element_id of a lane for bicycles, and a usual width
_CORNERS = 4  # of a crossing
_HARMLESS = {
    "tl_states",
    "roads.id",
    *(f"objects.{key}" for key in ("id", "type", "is_sdc", "goalPosition", "mark_as_expert")),
}
# samples over which a way of more than so much tells a direction, and how many directions tell the unit of headings
_SPAN, _MOVING_M, _MOVING_SHARE_MIN = 5, 0.75, 20


class _Point(Record):
    model_config = ConfigDict(extra="ignore")  # heights, of very many

    x: float
    y: float


class _Object(Record):
    position: list[_Point]
    heading: list[float]
    velocity: list[_Point] | None = None
    valid: list[bool | int]
    length: float
    width: float
    height: float = math.nan


class _Road(Record):
    type: Any = None
    map_element_id: Any = None
    geometry: Annotated[list[_Point], BeforeValidator(lambda line: [line] if isinstance(line, dict) else line)]


class _Scene(Record):
    name: Word = ""
    scenario_id: Word = ""
    objects: list[dict[str, Any]]
    roads: list[_Road] = Field(default_factory=list)
    metadata: dict[str, Any] = Field(default_factory=dict)


def is_scene(path: Path) -> bool:
    """Whether a path is a JSON file that begins as these scenes do."""
    if not path.name.endswith((".json", ".json.gz")) or not path.is_file():
        return False
    try:
        with gzip.open(path) if path.name.endswith(".gz") else path.open("rb") as stream:
            return _HEAD.search(stream.read(_HEAD_BYTES)) is not None
    except (OSError, EOFError, zlib.error):  # whoever reads it says so
        return False


def read(file: Path) -> Recording:
    content = read_bytes(file, "recorded traffic", bytes_max=DATA_SET_BYTES_MAX)
    scene = read_record(_Scene, parse_json(content, "", "recorded traffic", nodes_max=DATA_SET_NODES_MAX), "")
    names = [str(each.get("id", number)) for number, each in enumerate(scene.objects)]
    tracks, faults, others = [], [], []
    for name, each in zip(names, scene.objects, strict=True):
        kind = _TYPES.get(str(each.get("type", 0)), str(each.get("type")))
        if kind not in _CLASS_OF_TYPE:
            others.append(kind)
            continue
        try:
            tracks.append(_track(each, name, _CLASS_OF_TYPE[kind]))
        except InputError as error:
            faults.append(Fault.of(error, f"road user {name}"))
    unit = math.radians(1.0) if _are_degrees([user for user, _ in tracks]) else 1.0
    users = []
    for user, velocity in tracks:
        yaw = unit * user.pose[:, 2]
        speed = None if velocity is None else speed_along(yaw, velocity)
        users.append(replace(user, pose=np.c_[user.pose[:, :2], yaw], speed_m_s=speed))
    index = scene.metadata.get("sdc_track_index")
    ego = {name for k, name in enumerate(names) if k == index or scene.objects[k].get("is_sdc") is True}
    ego_id = next((user.user_id for user in users if user.user_id in ego), None)
    own = _Object.model_fields.keys()
    lanelets = [lanelet for road in scene.roads if (lanelet := _lanelet(road)) is not None]
    return recording_of(
        scene.scenario_id or scene.name, "Waymo", _STEP_S, lanelets, users, ego_id, faults=faults, passed_over=others,
        unread={*unread(scene), *(f"objects.{key}" for each in scene.objects for key in each.keys() - own)} - _HARMLESS,
    )  # fmt: skip


def _track(data: dict[str, Any], name: str, category: str) -> tuple[RecordedUser, np.ndarray | None]:
    """A road user, its yaw in the unit of the file, and its velocity [m/s], float64 [sample, 2]."""
    place = f"road user {name}"
    found = read_record(_Object, data, place)
    velocity = found.position if found.velocity is None else found.velocity
    counts = [len(each) for each in (found.position, found.heading, velocity, found.valid)]
    if len(set(counts)) > 1:
        raise InputError(f"{place}: valid: expected as many positions, headings and velocities, got {counts}")
    samples = zip(found.position, found.heading, velocity, strict=True)
    table = np.array([(p.x, p.y, heading, v.x, v.y) for p, heading, v in samples], np.float64).reshape(-1, 5)
    step = np.flatnonzero(np.array(found.valid, bool) & np.isfinite(table).all(axis=1) & (table != _FILL).all(axis=1))
    size_m = (found.length, found.width, found.height) if found.length or found.width else USUAL_SIZE_M[category]
    user = RecordedUser(name, category, size_m, step, table[step, :3])
    return user, None if found.velocity is None else table[step, 3:]


def _are_degrees(users: list[RecordedUser]) -> bool:
    """Whether headings are degrees: which unit agrees with where vehicles go; if too few move, by their range."""
    way, heading = [np.zeros((0, 2))], [np.zeros(0)]
    for user in users:
        moved = user.pose[_SPAN:, :2] - user.pose[:-_SPAN, :2]
        is_moving = np.linalg.norm(moved, axis=1) > (math.inf if user.category == "pedestrian" else _MOVING_M)
        way.append(moved[is_moving])
        heading.append(user.pose[_SPAN // 2 :, 2][: len(moved)][is_moving])
    x, y = np.concatenate(way).T
    along = np.concatenate(heading)
    if len(along) < _MOVING_SHARE_MIN:
        return any(np.abs(user.pose[:, 2]).max(initial=0.0) > 2.0 * math.pi for user in users)
    by_radians, by_degrees = (
        np.median(np.abs(np.angle((x + 1j * y) * np.exp(-1j * unit * along)))) for unit in (1.0, math.radians(1.0))
    )
    return bool(by_degrees < by_radians)


def _lanelet(road: _Road) -> Lanelet | None:
    """A lane, or a crossing between the two longer sides of its outline, along which people walk."""
    line = np.array([(point.x, point.y) for point in road.geometry]).reshape(-1, 2)
    if road.type == "lane" and len(line) > 1:
        return Lanelet.along(line, _CYCLE_LANE_WIDTH_M if road.map_element_id == _CYCLE_LANE else LANE_WIDTH_M)
    if road.type != "crosswalk" or len(line) != _CORNERS:
        return None
    if np.linalg.norm(line[1] - line[0]) < np.linalg.norm(line[2] - line[1]):
        line = np.roll(line, 1, axis=0)
    return Lanelet(line[:2], line[:1:-1], ("crosswalk",))
