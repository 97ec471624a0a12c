"""Logs of Argoverse 2 (extra ``av2``): boxes, the vehicle's own poses, the map of the log.

A log is a folder with ``annotations.feather`` (a row for a box in the vehicle's frame at a sweep),
``city_SE3_egovehicle.feather`` (poses), and ``map/log_map_archive_*.json`` (lane segments, crossings). Two-wheelers
have boxes of their own there besides their riders': the rider's counts. Whoever has none, and what is no road user
(cones, signs, animals, prams), is not taken.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from warpav.core.bounded_files import DATA_SET_NODES_MAX, read_json
from warpav.core.errors import InputError
from warpav.scene.traffic.formats._rows import Columns, grouped, read_columns, steps_of, users_of
from warpav.scene.traffic.recording import Lanelet, RecordedUser, Recording, recording_of

_ANNOTATIONS, _POSES = "annotations.feather", "city_SE3_egovehicle.feather"
_EGO = "ego"
EGO_SIZE_M = (4.87, 1.85, 1.48)  # length, width and height of the Ford Fusion that carries the sensors [m]
EGO_CENTRE_M = 1.42
"""How far its centre lies ahead of the origin of its frame, which is the middle of its rear axle [m]."""

_CLASS_OF_CATEGORY = {
    "REGULAR_VEHICLE": "car",
    "LARGE_VEHICLE": "truck",
    "BOX_TRUCK": "truck",
    "TRUCK": "truck",
    "TRUCK_CAB": "truck",
    "VEHICULAR_TRAILER": "truck",
    "BUS": "bus",
    "SCHOOL_BUS": "bus",
    "ARTICULATED_BUS": "bus",
    "MOTORCYCLIST": "motorcycle",
    "BICYCLIST": "bicycle",
    "PEDESTRIAN": "pedestrian",
    "OFFICIAL_SIGNALER": "pedestrian",
}
_RIDDEN = {"MOTORCYCLIST": "MOTORCYCLE", "BICYCLIST": "BICYCLE"}
_RIDDEN_REACH_M = 1.5
_BOX = ("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz", "length_m", "width_m", "height_m")
_POSE = ("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz")


def is_log(path: Path) -> bool:
    return (path / _ANNOTATIONS).is_file()


def files_of(folder: Path) -> list[Path]:
    """What a log is read from, and the poses of its cameras; the sensors' data is not looked at."""
    inside = (each for each in folder.rglob("*") if each.name.endswith((".feather", ".json")))
    return sorted(each for each in inside if "sensors" not in each.parts)


def read(folder: Path) -> Recording:
    """The recording of a log; its ego vehicle is the one that carried the sensors."""
    texts = ("track_uuid", "category")
    boxes = read_columns(folder / _ANNOTATIONS, ("timestamp_ns", *_BOX), texts, harmless="num_interior_pts")
    poses = read_columns(folder / _POSES, ("timestamp_ns", *_POSE))
    strange = {*boxes.unread, *poses.unread}
    order = np.argsort(poses["timestamp_ns"])
    poses = Columns({name: column[order] for name, column in poses.items()})
    step, step_s = steps_of(boxes["timestamp_ns"].astype(np.int64), _ANNOTATIONS)
    step_s *= 1e-9
    at = np.clip(np.searchsorted(poses["timestamp_ns"], boxes["timestamp_ns"]), 0, len(order) - 1)
    if np.abs(poses["timestamp_ns"][at] - boxes["timestamp_ns"]).max() > 0.5e9 * step_s:
        raise InputError(f"{_POSES}: expected a pose at the time of every box, got none for some")
    rotation = _rotations({name: column[at] for name, column in poses.items()})
    origin_m = np.stack([poses[name][at] for name in ("tx_m", "ty_m")], axis=1)
    # near the first place, so that no number is large
    shift_m = origin_m[np.argmin(step)].copy()
    origin_m -= shift_m
    heading = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    ahead_m = EGO_CENTRE_M * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    first = np.unique(step, return_index=True)[1]
    ego = RecordedUser(_EGO, "car", EGO_SIZE_M, step[first], np.c_[origin_m + ahead_m, heading][first])
    place_m = np.stack([boxes["tx_m"], boxes["ty_m"], boxes["tz_m"]], axis=1)
    centre_m = np.einsum("ijk,ik->ij", rotation, place_m)[:, :2] + origin_m
    turned = rotation @ _rotations(boxes)
    rows = {
        "id": boxes["track_uuid"], "type": boxes["category"], "step": step, "x_m": centre_m[:, 0],
        "y_m": centre_m[:, 1], "yaw_rad": np.arctan2(turned[:, 1, 0], turned[:, 0, 0]),
        **{name: boxes[name].astype(np.float64) for name in ("length_m", "width_m", "height_m")},
    }  # fmt: skip
    _seat(rows)
    users, others = users_of(rows, _CLASS_OF_CATEGORY)
    lanelets = lanelets_of(folder.glob("map/log_map_archive_*.json"), shift_m, strange)
    everybody = [ego, *users]
    return recording_of(
        folder.name, "Argoverse 2", step_s, lanelets, everybody, _EGO, passed_over=others, unread=strange
    )


def _seat(rows: dict[str, np.ndarray]) -> None:
    """Make riders as large as they and the two-wheelers below them at their first moment."""
    for row in grouped(rows["id"], rows["step"]):
        ridden = _RIDDEN.get(str(rows["type"][row[0]]))
        if ridden is None:
            continue
        same = np.flatnonzero((rows["step"] == rows["step"][row[0]]) & (rows["type"] == ridden))
        away = np.hypot(*(rows[name][same] - rows[name][row[0]] for name in ("x_m", "y_m")))
        below = same[away < _RIDDEN_REACH_M]
        for name in ("length_m", "width_m", "height_m") if len(below) else ():
            rows[name][row] = max(np.median(rows[name][row]), np.median(rows[name][below]))


_OF_LANES = {
    *("id", "is_intersection", "lane_type", "predecessors", "successors", "left_neighbor_id", "right_neighbor_id"),
    *("left_lane_boundary", "right_lane_boundary", "left_lane_mark_type", "right_lane_mark_type", "edge1", "edge2"),
    *("lane_segments", "pedestrian_crossings", "drivable_areas"),
}
"""Keys of a map, its lanes and crossings that are read, or say nothing of where these are."""


def lanelets_of(maps: Iterable[Path], shift_m: np.ndarray, strange: set[str]) -> tuple[Lanelet, ...]:
    """Lanes and crossings of the first map of Argoverse 2, less ``shift_m`` [2]; none without a map.

    Keys that are not known there are added to ``strange``.
    """
    file = min(maps, default=None)
    if file is None:  # then the road follows the tracks
        return ()
    data = read_json(file, "Argoverse 2's map", nodes_max=DATA_SET_NODES_MAX)
    try:
        lanelets = [
            Lanelet(
                _line(segment["left_lane_boundary"], shift_m),
                _line(segment["right_lane_boundary"], shift_m),
                ("intersection",) if segment.get("is_intersection") else (),
            )
            for segment in data["lane_segments"].values()
        ]
        crossings = data.get("pedestrian_crossings", {}).values()
        for each in (data, *data["lane_segments"].values(), *crossings):
            strange |= each.keys() - _OF_LANES
        lanelets += [
            Lanelet(_line(each["edge1"], shift_m), _line(each["edge2"], shift_m), ("crosswalk",)) for each in crossings
        ]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{file.name}: expected lane_segments with boundaries, got: {type(error).__name__}: {error}"
        ) from None
    return tuple(lanelets)


def _line(points: list[dict[str, float]], shift_m: np.ndarray) -> np.ndarray:
    return np.array([[point["x"], point["y"]] for point in points], np.float64) - shift_m


def _rotations(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Rotations of the quaternions in a table, of any length but 0, float64 [row, 3, 3]."""
    from scipy.spatial.transform import Rotation

    try:
        return Rotation.from_quat(np.stack([columns[name] for name in ("qx", "qy", "qz", "qw")], axis=1)).as_matrix()
    except ValueError:
        raise InputError("quaternions: expected a length of 1, got 0") from None
