"""Autoware: ``sensors_calibration.yaml`` (kit at base_link), ``sensor_kit_calibration.yaml`` (cameras at the kit)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.core.yaml_file import yaml_number
from warpav.rig.formats.camera_info import FOLDER, camera_info_files
from warpav.rig.formats.format import Found, FoundCamera, Losses, PlacedCamera, RigFormat, link_of_transform
from warpav.rig.formats.record import Record, read_yaml_record

_SENSORS, _KIT = "sensors_calibration.yaml", "sensor_kit_calibration.yaml"
_BASE_LINK, _KIT_LINK = "base_link", "sensor_kit_base_link"
_NAME = re.compile(r"(.+?)(?:[/_]camera)?(?:_optical)?_(?:link|frame)")


def read(path: Path, part: str | None) -> Found:
    """The cameras of both files: those of the kit, and those that hang at base_link directly."""
    del part
    folder = path if path.is_dir() else path.parent
    if not (folder / _SENSORS).is_file() and not (folder / _KIT).is_file():
        raise InputError(f"{path}: expected a folder with {_SENSORS} and {_KIT}, or one of them, got neither")
    sensors, kits = (read_yaml_record(folder / name) for name in (_SENSORS, _KIT))
    base = sensors.at(_BASE_LINK)
    base.mapping(f"a mapping of the links at {_BASE_LINK}")
    base_from_kit = _transform(base.at(_KIT_LINK))
    kit = kits.at(_KIT_LINK)
    kit.mapping(f"a mapping of the links at {_KIT_LINK}")
    cameras = [
        *_cameras(kit, base_from_kit),
        *_cameras(base, np.eye(4)),
    ]
    if not cameras:
        raise InputError(f"{folder / _KIT}: {_KIT_LINK}: expected links such as camera0/camera_link, got none")
    return Found(tuple(cameras))


def _cameras(links: Record, base_from_parent: np.ndarray) -> list[FoundCamera]:
    found = []
    for link, record in links.mapping().items():
        match = _NAME.fullmatch(link)
        if match is None or "camera" not in link:
            continue
        transform = base_from_parent @ _transform(record)
        if "optical" not in link:
            transform[:3, :3] = transform[:3, :3] @ FLU_FROM_RDF
        found.append(FoundCamera(match[1], transform))
    return found


def _transform(record: Record) -> np.ndarray:
    record.mapping("a mapping with x, y, z, roll, pitch, yaw")
    x, y, z, roll, pitch, yaw = (record.at(key).number() for key in ("x", "y", "z", "roll", "pitch", "yaw"))
    transform = np.eye(4)
    transform[:3, :3] = rotation_from_yaw_pitch_roll(yaw, pitch, roll)
    transform[:3, 3] = x, y, z
    return transform


def write(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """Both files, the kit at base_link itself, and camera_info files in a folder beside them."""
    if target.suffix in (".yaml", ".yml") and not target.is_dir():
        raise InputError(f"{target}: autoware: expected a folder for {_SENSORS} and {_KIT}, got a file's name")
    kit = [f"{_KIT_LINK}:"]
    for camera in cameras:
        position_m, angle = link_of_transform(camera.file_from_camera)
        numbers = [*position_m, angle["roll_rad"], angle["pitch_rad"], angle["yaw_rad"]]
        kit += _lines(f"{camera.name}/camera_link", numbers)
    sensors = [f"{_BASE_LINK}:", *_lines(_KIT_LINK, [0.0] * 6)]
    return {
        target / _SENSORS: ("\n".join(sensors) + "\n").encode(),
        target / _KIT: ("\n".join(kit) + "\n").encode(),
        **camera_info_files(cameras, target / FOLDER, losses),
    }


def _lines(link: str, numbers: Sequence[float]) -> list[str]:
    keys = ("x", "y", "z", "roll", "pitch", "yaw")
    return [f"  {link}:", *(f"    {key}: {yaml_number(value)}" for key, value in zip(keys, numbers, strict=True))]


FORMAT = RigFormat(
    "autoware",
    frame="camera_link to sensor_kit_base_link to base_link, x forward, y left, z up, right-handed, metres; roll, "
    "pitch, yaw in radians about fixed axes",
    origin="base_link's, on the ground below the centre of the rear axle",
    is_ego_origin=True,
    read=read,
    write=write,
)
