"""The rig file of NVIDIA DriveWorks (``rig.json``): its cameras, f-theta or pinhole.

``nominalSensor2Rig_FLU`` is the pose in the rig of the camera's body, whose x points forward; corrections turn the body
and shift it in the rig. Older files have ``sensor2Rig`` or ``nominalSensor2Rig`` instead, of the camera as its image
lies: x right, y down, z forward. Quaternions are x y z w, angles in degrees about fixed axes, most numbers texts.
Principal points count from the centre of the first pixel.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.raster.lens import Lens
from warpav.rig.formats._alpasim import WRITE_PX, FTheta, ftheta_optics, max_angle_rad
from warpav.rig.formats._format import (
    Found,
    FoundCamera,
    Losses,
    Optics,
    PlacedCamera,
    Record,
    RigFormat,
    camera_matrix,
    is_number,
    link_of_transform,
    optics_of,
    read_json_record,
    rigid_transform,
    unread_note,
)

_DIRECTIONS = {"pixeldistance-to-angle": False, "angle-to-pixeldistance": True}
_POWERS = np.arange(1, 6)  # DriveWorks keeps six coefficients, the first of which is 0
_SAMPLES = 4001
_VERSION = 7
_HARMLESS = ("protocol", "parameter", "car-mask", "nominalSensor2Rig", "self-calibration")


def _read(path: Path) -> Found:
    rig = read_json_record(path, "DriveWorks' rig").at("rig")
    rig.mapping("DriveWorks' rig with sensors")
    sensors = rig.at("sensors").items("a list of sensors")
    rows = [row for row in sensors if "camera" in (_kind(row.at("protocol")), _kind(row.at("name")))]
    if not rows:
        raise rig.at("sensors").error("at least one camera", f"{len(sensors)} other sensors")
    notes: list[str] = []
    cameras, unread = [], [f"rig.{key}" for key in rig.mapping() if key != "sensors"]
    for row in rows:
        name = row.at("name").text()
        cameras.append(FoundCamera(name, _rig_from_camera(row), _optics(row.at("properties"), name, notes)))
        unread += row.unread(*_HARMLESS)
    if len(rows) < len(sensors):
        notes.append(f"{path}: {len(sensors) - len(rows)} sensors that are no cameras are not read")
    return Found(tuple(cameras), (*notes, *unread_note(path, unread)))


def _kind(record: Record) -> str:
    """The beginning of a protocol such as camera.gmsl, or of a name such as camera:front:wide:120fov."""
    return record.value.replace(":", ".").partition(".")[0] if isinstance(record.value, str) else ""


def _rig_from_camera(row: Record) -> np.ndarray:
    body = row.at("nominalSensor2Rig_FLU")
    if body.value is not None:
        turn, correction = _rotation(body), row.at("correction_sensor_R_FLU")
        if correction.value is not None:
            turn = turn @ _rotation(correction)
        shift = row.at("correction_rig_T")
        shift_m = [0.0] * 3 if shift.value is None else _numbers(shift, 3)
        position_m = np.array(_numbers(body.at("t"), 3)) + shift_m
        return rigid_transform(turn @ FLU_FROM_RDF, position_m, body)
    image = row.first_of("sensor2Rig", "nominalSensor2Rig")
    if image.value is None:
        raise body.error("the pose of the camera, roll-pitch-yaw and t")
    return rigid_transform(_rotation(image), _numbers(image.at("t"), 3), image)


def _rotation(record: Record) -> np.ndarray:
    turn = record.at("quaternion")
    if turn.value is not None:
        x, y, z, w = _numbers(turn, 4)
        return turn.unit_quaternion((w, x, y, z))
    roll, pitch, yaw = map(math.radians, _numbers(record.at("roll-pitch-yaw"), 3))
    return rotation_from_yaw_pitch_roll(yaw, pitch, roll)


def _numbers(record: Record, *counts: int) -> list[float]:
    """As many numbers as one of ``counts`` says, in a list, in a text with spaces, or alone."""
    value = record.value
    words = value.split() if isinstance(value, str) else value if isinstance(value, list) else [value]
    try:
        numbers = [float(word) for word in words]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) not in counts or not all(map(is_number, numbers)):
        wanted = f"{counts[0]} to {counts[-1]} finite numbers" if counts[1:] else f"{counts[0]} finite number(s)"
        raise record.error(wanted)
    return numbers


def _optics(properties: Record, name: str, notes: list[str]) -> Optics | None:
    if properties.peek("Model").value is None:
        return None
    model = properties.at("Model").one_of(("ftheta", "pinhole"))
    width_px, height_px, cx, cy = (_numbers(properties.at(key), 1)[0] for key in ("width", "height", "cx", "cy"))
    size = (int(width_px), int(height_px))
    if size != (width_px, height_px):
        raise properties.at("width").error("whole pixels of width and height")
    if model == "pinhole":
        k1, k2, k3 = (
            [0.0] * 3 if properties.at("distortion").value is None else _numbers(properties.at("distortion"), 3)
        )
        fx, fy = (_numbers(properties.at(key), 1)[0] for key in ("fx", "fy"))
        lens = {"lens": Lens.BROWN_CONRADY, "distortion": (k1, k2, 0.0, 0.0, k3)}
        return optics_of(properties, fx, fy, cx, cy, width_px=size[0], height_px=size[1], **lens)
    polynomial, direction = properties.first_of("polynomial", "bw-poly"), properties.at("polynomial-type")
    is_forward = direction.value is not None and _DIRECTIONS[direction.one_of(_DIRECTIONS)]
    linear = [properties.at(f"linear-{key}") for key in "cde"]
    cde = [0.0 if each.value is None else _numbers(each, 1)[0] for each in linear]
    cde = tuple(cde) if any(cde) else (1.0, 0.0, 0.0)
    if not 0.01 < cde[0] < 100.0:
        raise linear[0].error("the proportions of a pixel, near 1")
    numbers = _numbers(polynomial, *range(2, 7))
    return ftheta_optics(FTheta(polynomial, numbers, is_forward, cde, math.pi), (cx, cy), size, name, notes)


def _write(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    sensors = []
    for camera in cameras:
        position_m, angle = link_of_transform(camera.file_from_camera)
        turn = [math.degrees(angle[f"{key}_rad"]) for key in ("roll", "pitch", "yaw")]
        pose = {"roll-pitch-yaw": turn, "t": position_m}
        properties = {key: str(value) for key, value in _lens(camera, losses).items()}
        about = {"nominalSensor2Rig_FLU": pose, "parameter": "", "properties": properties, "protocol": "camera.virtual"}
        sensors.append({"name": camera.name, **about})
    losses.notes.append("DriveWorks wants rig.vehicle too, which warpav does not know: copy that of your rig.json")
    return {target: json.dumps({"rig": {"sensors": sensors}, "version": _VERSION}, indent=2).encode()}


def _text(*numbers: float) -> str:
    return " ".join(str(number + 0.0) for number in numbers)  # files need no -0.0


def _lens(camera: PlacedCamera, losses: Losses) -> dict[str, Any]:
    model = camera.model
    (fx, _, cx), (_, fy, cy), _ = camera_matrix(model)
    shared = {"cx": cx, "cy": cy, "width": int(model.width_px), "height": int(model.height_px)}
    if model.lens in (Lens.PINHOLE, Lens.BROWN_CONRADY):
        k1, k2, p1, p2, k3, *higher = model.shape.coefficients.tolist()
        if any((p1, p2, *higher)):
            losses.leave_out(camera.name, "tangential distortion, and k4 to k6")
        return {"Model": "pinhole", **shared, "fx": fx, "fy": fy, "distortion": _text(k1, k2, k3)}
    if not model.shape.is_by_angle:
        raise losses.unsupported(camera.name, f"the {model.lens} lens")
    end_rad = max_angle_rad(model)
    if (1.0 - 1e-9) * model.shape.limit <= end_rad < math.pi:
        raise losses.unsupported(camera.name, "a lens that ends before the image's corners")
    k1, k2, *higher = model.shape.coefficients.tolist()
    if model.lens is Lens.FISHEYE and not any(higher):
        polynomial = np.array([1.0, 0.0, k1, 0.0, k2])
    else:
        angle = np.linspace(0.0, end_rad, _SAMPLES)
        radius = model.shape.radius(angle)[0]
        basis = (angle[:, None] / angle[-1]) ** _POWERS
        scaled = np.linalg.lstsq(basis, radius, rcond=None)[0]
        off_px = float(np.abs(basis @ scaled - radius).max()) * max(fx, fy)
        if off_px >= WRITE_PX:
            losses.leave_out(camera.name, f"a {model.lens} lens to better than {off_px:.2g} px; the rest")
        else:
            losses.notes.append(f"camera {camera.name!r}: {model.lens} is written as f-theta, off by {off_px:.1g} px")
        polynomial = scaled / angle[-1] ** _POWERS
    text = _text(0.0, *(fy * polynomial).tolist())
    linear = {"linear-c": fx / fy, "linear-d": 0.0, "linear-e": 0.0}
    return {"Model": "ftheta", **shared, "polynomial": text, "polynomial-type": "angle-to-pixeldistance", **linear}


FORMATS = (
    RigFormat(
        "driveworks",
        frame="camera's body to rig, both x forward, y left, z up, right-handed, metres; angles in degrees about fixed "
        "axes, roll first",
        origin="on the ground below the centre of the rear axle, as warpav's",
        is_ego_origin=True,
        files=("rig.json",),
        suffixes=(".json",),
        read=_read,
        write=_write,
    ),
)
