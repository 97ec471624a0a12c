"""Scenes of nuScenes: boxes at key frames, 2 Hz, and the poses of the vehicle that carried the sensors.

Tables such as those in ``v1.0-mini`` hold all scenes of a data set together, so a scene is addressed as FOLDER/NAME, a
path that does not exist. Tables are read some thousand rows at a time, once for all scenes, and little more than
numbers of them is kept. Maps are not read: the road follows the tracks.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.scene.traffic.formats._json_rows import json_rows
from warpav.scene.traffic.formats._rows import stamp_of, steps_of, users_of
from warpav.scene.traffic.recording import RecordedUser, Recording, recording_of

_TABLES = ("scene", "category", "attribute", "instance", "sample", "ego_pose", "sample_annotation")
_COLUMNS = {
    *("token", "timestamp", "translation", "rotation", "size", "sample_token", "instance_token", "attribute_tokens"),
    *("visibility_token", "prev", "next", "num_lidar_pts", "num_radar_pts"),
}
"""Of the tables with numbers, read or of no meaning here."""
_EGO, _RIDERLESS = "ego", "cycle.without_rider"
_EGO_SIZE_M, _EGO_CENTRE_M = (4.084, 1.730, 1.562), 1.385  # a Renault Zoe, and how far it lies ahead of its rear axle
_POSE_AWAY_US = 250_000.0  # half the time between key frames
_CATEGORIES = {
    "car": ("vehicle.car", "vehicle.emergency.police"),
    "truck": ("vehicle.truck", "vehicle.trailer", "vehicle.construction", "vehicle.emergency.ambulance"),
    "bus": ("vehicle.bus.rigid", "vehicle.bus.bendy"),
    "motorcycle": ("vehicle.motorcycle",),
    "bicycle": ("vehicle.bicycle",),
    "pedestrian": tuple(
        f"human.pedestrian.{each}"
        for each in ("adult", "child", "construction_worker", "personal_mobility", "police_officer", "wheelchair")
    ),
}
_CLASS_OF_CATEGORY = {category: name for name, categories in _CATEGORIES.items() for category in categories}


@dataclass(frozen=True, eq=False)
class _Tables:
    """What is kept of the tables of a folder, for all its scenes."""

    time_us: np.ndarray  # of every key frame, float64 [sample]
    scene: np.ndarray  # the name of its scene, [sample]
    ego: np.ndarray  # x, y [m] and yaw [rad] of the vehicle's frame then, float64 [sample, 3]; NaN without a pose
    instance: list[tuple[str, str]]  # token and category
    unread: set[str]  # columns that are not known
    box: np.ndarray  # sample, instance, whether a rider lacks, x, y, yaw, width, length, height, float64 [box, 9]


def is_scene(path: Path) -> bool:
    """Whether a path is a folder of tables and the name of a scene in them."""
    return path.name in _scenes(path.parent)


def recordings_of(folder: Path) -> list[Path]:
    """The scenes of a folder of tables, or of the folders of tables in a folder."""
    return [each / name for each in (folder, *sorted(folder.glob("v1.0-*"))) for name in _scenes(each)]


def _scenes(folder: Path) -> list[str]:
    file = folder / "scene.json"
    if not (folder / "sample_annotation.json").is_file():
        return []
    names = [name for _, name in _texts(file, stamp_of(file), "name") if re.fullmatch(r"[\w.-]*\w", name)]
    if len(set(names)) < len(names):
        raise InputError(f"{file}: name: expected every name once, got {max(names, key=names.count)} twice")
    return names


def files_of(path: Path) -> list[Path]:
    """What a scene is read from, together with all others of its folder."""
    return [path.parent / f"{name}.json" for name in _TABLES]


def read(path: Path) -> Recording:
    """The recording of a scene; its ego vehicle is the one that carried the sensors."""
    tables = _tables(*((file, stamp_of(file)) for file in files_of(path)))
    sample = np.flatnonzero(tables.scene == path.name)
    step = np.full(len(tables.time_us), -1)
    step[sample], step_us = steps_of(tables.time_us[sample], "sample.json")
    seen = sample[np.isfinite(tables.ego[sample]).all(axis=1)]
    if not len(seen):
        raise InputError("ego_pose.json: expected poses at the times of the key frames, got none")
    seen = seen[np.argsort(step[seen])]
    yaw = tables.ego[seen, 2]
    centre_m = tables.ego[seen, :2] + _EGO_CENTRE_M * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    ego = RecordedUser(_EGO, "car", _EGO_SIZE_M, step[seen], np.c_[centre_m, yaw])
    box = tables.box[np.isin(tables.box[:, 0], sample)]
    columns = ("x_m", "y_m", "yaw_rad", "width_m", "length_m", "height_m")
    rows = {"step": step[box[:, 0].astype(int)], **dict(zip(columns, box[:, 3:].T, strict=True))}
    for k, name in enumerate(("id", "type")):  # who has no rider for a time is somebody else then
        rows[name] = np.array([tables.instance[i][k] + " without rider" * bare for i, bare in box[:, 1:3].astype(int)])
    users, others = users_of(rows, _CLASS_OF_CATEGORY)
    step_s, everybody = 1e-6 * step_us, [ego, *users]
    return recording_of(path.name, "nuScenes", step_s, (), everybody, _EGO, passed_over=others, unread=tables.unread)


@lru_cache(maxsize=2)
def _tables(*stamped: tuple[Path, tuple[int, int]]) -> _Tables:
    keys = ("name", "name", "name", "category_token")
    scenes, categories, attributes, instances = (_texts(*each, key) for each, key in zip(stamped, keys, strict=False))
    sample, ego_pose, annotation = (file for file, _ in stamped[len(keys) :])
    moments = [
        *chain(*json_rows(sample, lambda row: (str(row["token"]), str(row["scene_token"]), int(row["timestamp"]))))
    ]
    sample_of = {token: k for k, (token, *_) in enumerate(moments)}
    instance_of = {token: k for k, (token, _) in enumerate(instances)}
    riderless = {token for token, name in attributes if name == _RIDERLESS}

    strange: set[str] = set()

    def pose(row: dict[str, Any]) -> tuple[float, ...]:
        strange.update(row.keys() - _COLUMNS)
        x, y, _ = map(float, row["translation"])
        return float(int(row["timestamp"])), x, y, _yaw(row["rotation"])

    def box(row: dict[str, Any]) -> tuple[float, ...]:
        strange.update(row.keys() - _COLUMNS)
        x, y, _ = map(float, row["translation"])
        width, length, height = map(float, row["size"])
        when, who = sample_of.get(str(row["sample_token"]), -1), instance_of.get(str(row["instance_token"]), -1)
        bare = not riderless.isdisjoint(map(str, row["attribute_tokens"]))
        return when, who, bare, x, y, _yaw(row["rotation"]), width, length, height

    poses = np.concatenate(
        [[[-math.inf] * 4, [math.inf] * 4], *(np.reshape(rows, (-1, 4)) for rows in json_rows(ego_pose, pose))]
    )
    poses = poses[np.argsort(poses[:, 0])]
    time_us = np.array([float(moment) for *_, moment in moments])
    after = np.clip(np.searchsorted(poses[:, 0], time_us), 1, len(poses) - 1)
    near = after - (time_us - poses[after - 1, 0] < poses[after, 0] - time_us)
    category, name = dict(categories), dict(scenes)
    return _Tables(
        time_us,
        np.array([name.get(scene, "") for _, scene, _ in moments], str),
        np.where((np.abs(poses[near, 0] - time_us) <= _POSE_AWAY_US)[:, None], poses[near, 1:], math.nan),
        [*((token, category.get(each, "no category")) for token, each in instances), ("", "no instance")],
        strange,
        np.concatenate([np.zeros((0, 9)), *(np.reshape(rows, (-1, 9)) for rows in json_rows(annotation, box))]),
    )


def _yaw(rotation: list[float]) -> float:
    w, x, y, z = map(float, rotation)
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


@lru_cache(maxsize=64)
def _texts(file: Path, stamp: tuple[int, int], key: str) -> list[tuple[str, str]]:
    """Token and another text of every row of a table."""
    del stamp
    return list(chain(*json_rows(file, lambda row: (str(row["token"]), str(row[key])))))
