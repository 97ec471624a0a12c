"""CARLA, in two dialects with equal keys and different conventions.

``carla-ros-bridge`` is the bridge's ``objects.json``: right-handed, y left, pitch nose down. ``carla-python`` is a list
of sensors as agents of the leaderboard give it: left-handed, y right, yaw to the right, pitch nose up. The user states
which one it is; no file does. Both know a lens by its field of view alone, and a LiDAR by evenly spread lines over a
sector around straight ahead.
"""

from __future__ import annotations

import ast
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.bounded_files import check_nesting, parse_json, read_text
from warpav.core.errors import InputError
from warpav.core.frames import carla_from_ego_pose, ego_from_carla_pose
from warpav.raster.camera import CameraModel
from warpav.rig.formats._format import (
    LEAST_RANGE_M,
    Found,
    FoundCamera,
    Losses,
    Optics,
    PlacedCamera,
    Record,
    RigFormat,
    even_beams,
    lidar_model,
    link_of_transform,
    pinhole_of,
    read_json_record,
    transform_of_link,
    unread_note,
)

_CAMERA, _LIDAR = "sensor.camera.rgb", "sensor.lidar.ray_cast"
_NUMBER = re.compile(r"[-+]?\d{1,9}(\.\d{0,9})?")
_ANY_CAMERA = "sensor.camera."
_ORIGIN = "the vehicle actor's, which CARLA puts near the centre of the vehicle"
_PICTURE = (
    *("gamma", "iso", "fstop", "shutter_speed", "exposure_mode", "exposure_compensation", "sensor_tick"),
    *("enable_postprocess_effects", "role_name", "bloom_intensity", "lens_flare_intensity"),
    *("motion_blur_intensity", "temp", "tint", "noise_seed", "attached_objects"),
)
"""Attributes of a sensor that change how its images look and come, not what they show."""
_DEFAULTS = (800, 600, 90.0)  # of the blueprint sensor.camera.rgb
_BEAMS = {"channels": 32, "range": 10.0, "points_per_second": 56000, "rotation_frequency": 10.0, "upper_fov": 10.0}
_BEAMS |= {"lower_fov": -30.0, "horizontal_fov": 360.0}
"""Attributes of the blueprint sensor.lidar.ray_cast, and their defaults; the last one came later than the others."""
_Sensor = tuple[np.ndarray, Optics | CameraModel | None, bool]
"""Its transform, its optics, and whether the image is CARLA's default."""


def _read_bridge(path: Path, part: str | None) -> Found:
    """The cameras of the only vehicle that has some, or of the one whose id is ``part``."""
    objects = read_json_record(path, "the ros-bridge's objects.json").at("objects")
    with_cameras: dict[str, list[Record]] = {}
    for item in objects.items("the ros-bridge's list of objects; carla-python reads a plain list of sensors"):
        sensors = item.at("sensors")
        if sensors.value is not None and (found := sensors.items()) and any(map(_is_read, found)):
            with_cameras[item.at("id").text("vehicle")] = found
    if part is not None and part not in with_cameras:
        raise InputError(f"{path}: expected a vehicle {part!r} with cameras, got {', '.join(with_cameras) or 'none'}")
    if part is None and len(with_cameras) > 1:
        raise InputError(f"{path}: expected one vehicle with cameras, got {', '.join(with_cameras)}; choose by `part`")
    sensors = with_cameras[part] if part is not None else next(iter(with_cameras.values()), [])
    return _found(path, sensors, _bridge_camera)


def _bridge_camera(sensor: Record) -> _Sensor:
    spawn_point = sensor.at("spawn_point")
    spawn_point.mapping("a mapping with x, y, z, roll, pitch, yaw")
    angle = {f"{key}_rad": math.radians(spawn_point.at(key).number(0.0)) for key in ("yaw", "pitch", "roll")}
    transform = transform_of_link([spawn_point.at(key).number() for key in "xyz"], **angle)
    return transform, *_optics(sensor, "image_size_x", "image_size_y")


def _read_python(path: Path) -> Found:
    """The cameras of a list of sensors: JSON, or the list as Python writes it."""
    data = Record(path, _literal(path))
    if isinstance(data.value, dict) and "objects" in data.value:
        raise data.error(
            "a list of sensors", "objects, which is the ros-bridge's dialect: `format_name` carla-ros-bridge"
        )
    sensors = data.at("sensors") if isinstance(data.value, dict) else data
    if isinstance(sensors.value, list):
        sensors = Record(path, [_with_numbers(each) for each in sensors.value])
    return _found(path, sensors.items("a list of sensors"), _python_camera)


def _literal(file: Path) -> Any:  # noqa: ANN401
    kind = "a list of sensors, as JSON or as Python writes it"
    text = read_text(file, kind)
    check_nesting(text, str(file), quotes="\"'")
    try:
        return parse_json(text, str(file), kind)
    except InputError as error:
        try:
            return ast.literal_eval(text.strip())
        except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError):
            pass
        try:  # of an agent's module what its method gives
            found = [ast.literal_eval(node) for each in ast.walk(ast.parse(text)) for node in _lists_given(each)]
        except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError):
            found = []
        found = [each for each in found if any(isinstance(sensor, dict) for sensor in each)]
        if len(found) != 1:
            raise error from None
        return found[0]


def _lists_given(node: ast.AST) -> list[ast.List]:
    value = node.value if isinstance(node, (ast.Return, ast.Assign)) else None
    return [value] if isinstance(value, ast.List) else []


def _with_numbers(sensor: object) -> object:
    """A sensor whose numbers are numbers, which agents write as texts as well."""
    if not isinstance(sensor, dict):
        return sensor
    is_text = {
        key: isinstance(value, str) and _NUMBER.fullmatch(value) and key != "id" for key, value in sensor.items()
    }
    return {key: float(value) if is_text[key] else value for key, value in sensor.items()}


def _python_camera(sensor: Record) -> _Sensor:
    location_m = [sensor.at(key).number() for key in "xyz"]
    pitch_deg, yaw_deg, roll_deg = (sensor.at(key).number(0.0) for key in ("pitch", "yaw", "roll"))
    position_m, yaw_rad, pitch_rad, roll_rad = ego_from_carla_pose(
        np.array(location_m), pitch_deg=pitch_deg, yaw_deg=yaw_deg, roll_deg=roll_deg
    )
    is_long = any(sensor.at(key).value is not None for key in ("image_size_x", "image_size_y"))
    keys = ("image_size_x", "image_size_y") if is_long else ("width", "height")
    transform = transform_of_link(position_m, yaw_rad=yaw_rad, pitch_rad=pitch_rad, roll_rad=roll_rad)
    return transform, *_optics(sensor, *keys)


def _found(path: Path, sensors: Sequence[Record], camera_of: Any) -> Found:  # noqa: ANN401
    cameras, notes, defaulted, others, unread = [], [], [], set(), []
    for sensor in sensors:
        if not _is_read(sensor):
            kind = sensor.peek("type").value
            others |= {kind} if isinstance(kind, str) and kind.startswith(_ANY_CAMERA) else set()
            continue
        name = sensor.at("id").text(f"{'lidar' if _is_lidar(sensor) else 'camera'}_{len(cameras)}")
        transform, optics, is_defaulted = camera_of(sensor)
        defaulted += [name] if is_defaulted else []
        if isinstance(optics, CameraModel):
            left_out = [f"{key} {_BEAMS[key]:g}" for key in [*_BEAMS][:-1] if sensor.peek(key).value is None]
            notes += [f"{name}: CARLA's defaults, {', '.join(left_out)}"] if left_out else []
        unread += sensor.unread("type", *_PICTURE)
        cameras.append(FoundCamera(name, transform, optics, lacks_beams=optics is None))
    if not cameras:
        raise InputError(f"{path}: expected sensors of type {_CAMERA}, got none")
    notes += unread_note(path, unread)
    if others:
        notes.append(f"only {_CAMERA} is read, not {', '.join(sorted(others))}")
    if defaulted:
        width, height, fov = _DEFAULTS
        notes.append(f"{', '.join(defaulted)}: the image is CARLA's default, {width} x {height} px, {fov:g} deg")
    return Found(tuple(cameras), tuple(notes))


def _is_read(sensor: Record) -> bool:
    return sensor.peek("type").value == _CAMERA or _is_lidar(sensor)


def _is_lidar(sensor: Record) -> bool:
    return sensor.peek("type").value in (_LIDAR, f"{_LIDAR}_semantic")


def _optics(sensor: Record, width_key: str, height_key: str) -> tuple[Optics | CameraModel | None, bool]:
    if _is_lidar(sensor):
        return _beams(sensor), False
    multiplier = sensor.at("lens_circle_multiplier")
    if multiplier.number(0.0) != 0.0:
        raise multiplier.error("0, because warpav has no model of CARLA's lens distortion")
    width, height, fov = _DEFAULTS
    fields = [sensor.at(key) for key in (width_key, height_key, "fov")]
    fov_deg = fields[2].number(fov)
    if not 0.0 < fov_deg < 180.0:
        raise fields[2].error("a field of view between 0 and 180 degrees")
    optics = Optics(fields[0].whole(width), fields[1].whole(height), fov_rad=math.radians(fov_deg))
    return optics, any(field.value is None for field in fields)


def _beams(sensor: Record) -> CameraModel | None:
    """The model of a LiDAR, None where the file says nothing of its beams."""
    is_given = any(sensor.peek(key).value is not None for key in _BEAMS)
    lines = sensor.at("channels").whole(_BEAMS["channels"])
    if not is_given or lines == 1:  # which is no LiDAR of warpav
        return None
    points, rate_hz, sector_deg, range_m, low_deg, high_deg = (
        sensor.at(key).number(_BEAMS[key])
        for key in ("points_per_second", "rotation_frequency", "horizontal_fov", "range", "lower_fov", "upper_fov")
    )
    if not (points > 0.0 and lines > 0 and rate_hz > 0.0 and 0.0 < sector_deg <= 360.0):
        raise sensor.error(
            "positive channels, points_per_second and rotation_frequency, and a horizontal_fov up to 360",
            f"{lines}, {points:g}, {rate_hz:g} and {sector_deg:g}",
        )
    half_rad = 0.5 * math.radians(sector_deg)
    return lidar_model(
        sensor.location,
        elevation_rad=(math.radians(low_deg), math.radians(high_deg)),
        lines=lines,
        step_rad=2.0 * half_rad * lines * rate_hz / points,
        azimuth_rad=(-half_rad, half_rad),
        range_m=range_m,
        rate_hz=rate_hz,
    )


def _attributes(camera: PlacedCamera, losses: Losses, size_keys: tuple[str, str]) -> dict[str, Any]:
    """What a sensor says of image and lens, or of beams."""
    if camera.model.beams is None:
        model = pinhole_of(camera, losses, is_centred=True)
        sizes = dict(zip(size_keys, (model.width_px, model.height_px), strict=True))
        return sizes | {"fov": _written(math.degrees(model.fov_rad))}
    beams = even_beams(camera, losses)
    right_deg, left_deg = map(math.degrees, beams.azimuth_rad)
    if abs(right_deg + left_deg) > 1e-6:
        raise losses.unsupported(camera.name, f"a LiDAR's sector from {right_deg:g} to {left_deg:g} deg")
    if camera.model.near_m != LEAST_RANGE_M:
        losses.leave_out(camera.name, f"a LiDAR's least range, {camera.model.near_m:g} m")
    lines = len(beams.elevation_rad)
    return {
        "channels": lines,
        "range": _written(beams.range_m[0]),
        "points_per_second": round(lines * beams.sector_rad / beams.step_rad * beams.rate_hz),
        "rotation_frequency": _written(beams.rate_hz),
        "upper_fov": _written(math.degrees(beams.elevation_rad[-1])),
        "lower_fov": _written(math.degrees(beams.elevation_rad[0])),
        "horizontal_fov": _written(left_deg - right_deg),
    }


def _written(value: float) -> float:
    """A number without the last digits of floats, nor a negative zero."""
    return round(float(value), 9) + 0.0


def _write_bridge(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    sensors = []
    for camera in cameras:
        position_m, angle = link_of_transform(camera.file_from_camera)
        numbers = *position_m, *(math.degrees(angle[key]) for key in ("roll_rad", "pitch_rad", "yaw_rad"))
        spawn_point = dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), map(_written, numbers), strict=True))
        kind = _LIDAR if camera.model.beams else _CAMERA
        sensors.append({"type": kind, "id": camera.name, "spawn_point": spawn_point})
        sensors[-1] |= _attributes(camera, losses, ("image_size_x", "image_size_y"))
    vehicle = {"type": "vehicle.tesla.model3", "id": "ego_vehicle", "sensors": sensors}
    losses.notes.append("the vehicle is called vehicle.tesla.model3; put in the one that you drive")
    return {target: (json.dumps({"objects": [vehicle]}, indent=2) + "\n").encode()}


def _write_python(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    sensors = []
    for camera in cameras:
        position_m, angle = link_of_transform(camera.file_from_camera)
        location_m, pitch, yaw, roll = carla_from_ego_pose(np.array(position_m), **angle)
        numbers = dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), (*location_m, roll, pitch, yaw), strict=True))
        sensors.append({"type": _LIDAR if camera.model.beams else _CAMERA, "id": camera.name})
        sensors[-1] |= {key: _written(each) for key, each in numbers.items()}
        sensors[-1] |= _attributes(camera, losses, ("width", "height"))
    return {target: (json.dumps(sensors, indent=2) + "\n").encode()}


FORMATS = (
    RigFormat(
        "carla-ros-bridge",
        frame="camera link to vehicle, x forward, y left, z up, right-handed, metres, degrees, pitch nose down",
        origin=_ORIGIN,
        is_ego_origin=False,
        files=("objects.json",),
        suffixes=(".json",),
        read=_read_bridge,
        write=_write_bridge,
        lidars="beams",
        parts="a vehicle's id, such as ego_vehicle",
        mirrored_hint="is the file CARLA's own left-handed dialect (`format_name` carla-python)?",
    ),
    RigFormat(
        "carla-python",
        frame="camera to vehicle, x forward, y right, z up, left-handed, metres, degrees, yaw to the right, pitch nose "
        "up",
        origin=_ORIGIN,
        is_ego_origin=False,
        files=("sensors.json",),
        suffixes=(".json", ".py", ".txt"),
        read=_read_python,
        write=_write_python,
        lidars="beams",
        mirrored_hint="is the file right-handed, with y to the left (`format_name` carla-ros-bridge)?",
    ),
)
