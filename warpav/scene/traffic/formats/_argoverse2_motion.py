"""Scenarios of Argoverse 2 motion forecasting (extra ``av2``): tracks of all road users, and the map around them.

A scenario is a folder with ``scenario_*.parquet`` (a row for a road user at a step of 0.1 s) and
``log_map_archive_*.json``. No sizes were recorded: everybody is as large as usual in the class. ``vehicle`` means cars
and lorries alike, which are cars here. What stands by itself (``static``, ``riderless_bicycle`` and the like) is not
taken.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.scene.traffic.formats._argoverse2 import EGO_SIZE_M, lanelets_of
from warpav.scene.traffic.formats._rows import USUAL_SIZE_M, read_columns, speed_along, users_of
from warpav.scene.traffic.recording import Recording, recording_of

_STEP_S = 0.1
_MAPS = "log_map_archive_*.json"
_EGO = "AV"  # the track of the vehicle that carried the sensors
_HARMLESS = (
    "observed|object_category|scenario_id|(start|end)_timestamp|num_timestamps|focal_track_id|city|map_id|slice_id"
)
_CLASS_OF_TYPE = {
    "vehicle": "car",
    "bus": "bus",
    "motorcyclist": "motorcycle",
    "cyclist": "bicycle",
    "pedestrian": "pedestrian",
}


def is_scenario(path: Path) -> bool:
    return path.is_dir() and next(path.glob("scenario_*.parquet"), None) is not None


def files_of(folder: Path) -> list[Path]:
    return sorted([*folder.glob("scenario_*.parquet"), *folder.glob(_MAPS)])


def read(folder: Path) -> Recording:
    """The recording of a scenario, near the first place of the vehicle that carried the sensors."""
    file, *more = sorted(folder.glob("scenario_*.parquet"))
    if more:
        raise InputError(f"expected one scenario in a folder, got {file.name} and {more[0].name}")
    numbers = ("timestep", "position_x", "position_y", "heading", "velocity_x", "velocity_y")
    columns = read_columns(file, numbers, ("track_id", "object_type"), harmless=_HARMLESS)
    strange = set(columns.unread)
    step = columns["timestep"]
    if len(step) == 0:
        raise InputError(f"{file.name}: expected a row for every road user and step, got none")
    if (bad := step[step % 1 != 0]).size:
        raise InputError(f"{file.name}: timestep: expected whole steps from 0, got {bad[0]:g}")
    track_id, kind = columns["track_id"].astype(str), columns["object_type"].astype(str)
    place_m = np.stack([columns["position_x"], columns["position_y"]], axis=1)
    rank = np.lexsort((step, track_id != _EGO, ~np.isfinite(place_m).all(axis=1)))
    shift_m = place_m[rank[0]].copy()  # where the ego vehicle is first
    size = np.array([EGO_SIZE_M if name == _EGO else USUAL_SIZE_M[_CLASS_OF_TYPE.get(word, "car")]
                     for name, word in zip(track_id, kind, strict=True)])  # fmt: skip
    rows = {
        "id": track_id, "type": kind, "step": step, "x_m": place_m[:, 0] - shift_m[0],
        "y_m": place_m[:, 1] - shift_m[1], "yaw_rad": columns["heading"],
        "length_m": size[:, 0], "width_m": size[:, 1], "height_m": size[:, 2],
    }  # fmt: skip
    speed_m_s = speed_along(columns["heading"], np.stack([columns["velocity_x"], columns["velocity_y"]], axis=1))
    users, others = users_of(rows, _CLASS_OF_TYPE, speed_m_s)
    ego_id = _EGO if any(user.user_id == _EGO for user in users) else None
    source, lanelets = "Argoverse 2 motion forecasting", lanelets_of(folder.glob(_MAPS), shift_m, strange)
    return recording_of(folder.name, source, _STEP_S, lanelets, users, ego_id, passed_over=others, unread=strange)
