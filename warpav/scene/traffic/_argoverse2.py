"""Logs of Argoverse 2 (extra ``av2``): boxes, the vehicle's own poses, the map of the log.

A log is a folder with ``annotations.feather`` (a row for a box in the vehicle's frame at a sweep),
``city_SE3_egovehicle.feather`` (poses), and ``map/log_map_archive_*.json`` (lane segments, crossings). Two-wheelers
have boxes of their own there besides their riders': the rider's counts. Whoever has none, and what is no road user
(cones, signs, animals, prams), is not taken.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from warpav.core.bounded_files import DATA_SET_NODES_MAX, read_feather, read_json
from warpav.core.errors import InputError
from warpav.scene.traffic.recording import Lanelet, RecordedUser, Recording

ANNOTATIONS, POSES = "annotations.feather", "city_SE3_egovehicle.feather"
EGO = "ego"
EGO_SIZE_M = (4.87, 1.85, 1.48)  # the Ford Fusion that carries the sensors
EGO_CENTRE_M = 1.42
"""How far its centre lies ahead of the origin of its frame, which is the middle of its rear axle [m]."""

_CLASS_OF_CATEGORY = {
    "REGULAR_VEHICLE": "car",
    "LARGE_VEHICLE": "truck",
    "BOX_TRUCK": "truck",
    "TRUCK": "truck",
    "TRUCK_CAB": "truck",
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
_BOX = ("tx_m", "ty_m", "qw", "qx", "qy", "qz", "length_m", "width_m", "height_m")
_POSE = ("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz")


def read_log(folder: Path) -> Recording:
    """The recording of a log; its ego vehicle is the one that carried the sensors."""
    boxes = _columns(folder / ANNOTATIONS, ("timestamp_ns", "track_uuid", "category", *_BOX))
    poses = _columns(folder / POSES, ("timestamp_ns", *_POSE))
    sweep_ns = np.unique(boxes["timestamp_ns"])
    if len(sweep_ns) < 2:
        raise InputError(f"{ANNOTATIONS}: expected boxes at two moments or more, got {len(sweep_ns)}")
    step_s = float(np.median(np.diff(sweep_ns))) * 1e-9
    step = np.round((sweep_ns - sweep_ns[0]) * 1e-9 / step_s).astype(np.int64)
    order = np.argsort(poses["timestamp_ns"])
    at = order[np.clip(np.searchsorted(poses["timestamp_ns"][order], sweep_ns), 0, len(order) - 1)]
    if np.abs(poses["timestamp_ns"][at] - sweep_ns).max() > 0.5e9 * step_s:
        raise InputError(f"{POSES}: expected a pose at the time of every box, got none for some")
    rotation = _rotations({name: column[at] for name, column in poses.items()})
    origin_m = np.stack([poses[name][at] for name in ("tx_m", "ty_m", "tz_m")], axis=1)
    # near the first place, so that no number is large
    shift_m = origin_m[0, :2].copy()
    origin_m[:, :2] -= shift_m
    heading = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    ahead_m = EGO_CENTRE_M * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    ego = RecordedUser(EGO, "car", EGO_SIZE_M, step, np.c_[origin_m[:, :2] + ahead_m, heading])
    users = [ego, *_users(boxes, sweep_ns, step, rotation, origin_m)]
    return Recording(folder.name, "Argoverse 2", step_s, _lanelets(folder, shift_m), tuple(users), EGO)


def _users(
    boxes: Mapping[str, np.ndarray], sweep_ns: np.ndarray, step: np.ndarray, rotation: np.ndarray, origin_m: np.ndarray
) -> list[RecordedUser]:
    sweep = np.searchsorted(sweep_ns, boxes["timestamp_ns"])
    place_m = np.stack([boxes["tx_m"], boxes["ty_m"], np.zeros(len(sweep))], axis=1)
    centre_m = np.einsum("ijk,ik->ij", rotation[sweep], place_m)[:, :2] + origin_m[sweep, :2]
    turned = rotation[sweep] @ _rotations(boxes)
    pose = np.c_[centre_m, np.arctan2(turned[:, 1, 0], turned[:, 0, 0])]
    size = np.stack([boxes[name] for name in ("length_m", "width_m", "height_m")], axis=1)
    users = []
    for track in dict.fromkeys(boxes["track_uuid"].tolist()):
        row = np.flatnonzero(boxes["track_uuid"] == track)
        row = row[np.argsort(sweep[row], kind="stable")]
        category = str(boxes["category"][row[0]])
        if category not in _CLASS_OF_CATEGORY:
            continue
        extent = np.median(size[row], axis=0)
        ridden = _RIDDEN.get(category)
        if ridden is not None:
            # boxes of two-wheelers below the rider at the first moment
            same = np.flatnonzero((sweep == sweep[row[0]]) & (boxes["category"] == ridden))
            below = same[np.linalg.norm(pose[same, :2] - pose[row[0], :2], axis=1) < _RIDDEN_REACH_M]
            extent = np.maximum(extent, np.median(size[below], axis=0)) if len(below) else extent
        number = step[sweep[row]]
        users.append(
            RecordedUser(
                track, _CLASS_OF_CATEGORY[category], (float(extent[0]), float(extent[1]), float(extent[2])),
                number, pose[row],
            )
        )  # fmt: skip
    return users


def _lanelets(folder: Path, shift_m: np.ndarray) -> tuple[Lanelet, ...]:
    files = sorted(folder.glob("map/log_map_archive_*.json"))
    if not files:
        raise InputError("lanelets: expected map/log_map_archive_*.json in the log's folder, got none")
    data = read_json(files[0], "Argoverse 2's map", nodes_max=DATA_SET_NODES_MAX)
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
        lanelets += [
            Lanelet(_line(each["edge1"], shift_m), _line(each["edge2"], shift_m), ("crosswalk",)) for each in crossings
        ]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{files[0].name}: expected lane_segments with boundaries, got: {type(error).__name__}: {error}"
        ) from None
    return tuple(lanelets)


def _line(points: list[dict[str, float]], shift_m: np.ndarray) -> np.ndarray:
    return np.array([[point["x"], point["y"]] for point in points], np.float64) - shift_m


def _columns(file: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    table = read_feather(file, "a feather file")
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise InputError(f"{file.name}: expected a column {missing[0]}, got {', '.join(table.column_names)}")
    columns = {name: np.asarray(table[name].to_numpy(zero_copy_only=False)) for name in names}
    for name, column in columns.items():
        if name not in ("track_uuid", "category") and not (column.dtype.kind in "iuf" and np.isfinite(column).all()):
            raise InputError(f"{file.name}: {name}: expected finite numbers")
    return columns


def _rotations(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Rotations of the quaternions in a table, of any length but 0, float64 [row, 3, 3]."""
    from scipy.spatial.transform import Rotation

    try:
        return Rotation.from_quat(np.stack([columns[name] for name in ("qx", "qy", "qz", "qw")], axis=1)).as_matrix()
    except ValueError:
        raise InputError("quaternions: expected a length of 1, got 0") from None
