"""The INTERACTION data set: ``vehicle_tracks_NNN.csv``, the people of ``pedestrian_tracks_NNN.csv``, a lanelet2 map.

The map is ``maps/LOCATION.osm`` of a folder above, LOCATION the name of the folder of the tracks. Who walks and who
cycles is not told there: whoever is faster than people run cycles.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpav.scene.traffic.formats._lanelet2 import maps_near, read_map
from warpav.scene.traffic.formats._rows import grouped, read_columns, steps_of, with_people
from warpav.scene.traffic.recording import CLASSES, Recording, recording_of

_NUMBERS = ("timestamp_ms", "x", "y", "vx", "vy")
_BOX = ("psi_rad", "length", "width")
_CYCLING_M_S = 3.0
_CLASS_OF_TYPE = {name: name for name in CLASSES} | {"van": "car"}


def files_of(file: Path) -> list[Path]:
    """The tracks of vehicles and of people, and the map of their place."""
    people = file.with_name(file.name.replace("vehicle", "pedestrian"))
    maps = [each for each in maps_near(file) if each.stem == file.absolute().parent.name]
    return [file, *([people] if people.is_file() else []), *maps[:1]]


def read(file: Path) -> Recording:
    files = files_of(file)
    csv = [(each, _NUMBERS if each != file else (*_NUMBERS, *_BOX)) for each in files if each.suffix == ".csv"]
    tables = [read_columns(each, numbers, ("track_id", "agent_type"), harmless="frame_id") for each, numbers in csv]
    strange = {key for each in tables for key in each.unread}
    for people in tables[1:]:
        people |= {name: np.full(len(people["x"]), np.nan) for name in _BOX}
        people["track_id"] = np.char.add("person ", people["track_id"])
    table = {name: np.concatenate([each[name] for each in tables]) for name in tables[0]}
    step, step_ms = steps_of(table["timestamp_ms"], "timestamp_ms")
    velocity_m_s = np.stack([table["vx"], table["vy"]], axis=1)
    rows = {
        "id": table["track_id"], "type": _told(table["agent_type"], table["track_id"], step, velocity_m_s),
        "step": step, "x_m": table["x"], "y_m": table["y"], "yaw_rad": table["psi_rad"],
        "length_m": table["length"], "width_m": table["width"],
    }  # fmt: skip
    users, others = with_people(rows, _CLASS_OF_TYPE, velocity_m_s)
    maps = [each for each in files if each.suffix == ".osm"]
    place = f"{file.absolute().parent.name} {file.stem.rsplit('_', 1)[-1]}"
    lanelets = [lane for each in maps for lane in read_map(each, strange=strange)]
    return recording_of(
        place, "INTERACTION", 1e-3 * step_ms, lanelets, users, passed_over=others, unread=strange,
        found_map=maps[0].name if maps else "",
    )  # fmt: skip


def _told(kind: np.ndarray, key: np.ndarray, step: np.ndarray, velocity_m_s: np.ndarray) -> np.ndarray:
    """Types in which ``pedestrian/bicycle`` is one of both."""
    told = kind.astype("U20")
    for row in grouped(key, step) if (kind == "pedestrian/bicycle").any() else ():
        if kind[row[0]] == "pedestrian/bicycle":
            fast = np.percentile(np.linalg.norm(velocity_m_s[row], axis=1), 90.0) > _CYCLING_M_S
            told[row] = "bicycle" if fast else "pedestrian"
    return told
