"""Kalibr's camchain: cameras in a chain, or at an IMU; to be read only."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF
from warpav.raster.lens import Lens
from warpav.rig.formats.format import Found, FoundCamera, Optics, RigFormat, optics_of_matrix
from warpav.rig.formats.record import Record, read_yaml_record

_DISTORTION = {
    "none": (Lens.PINHOLE, 0),
    "radtan": (Lens.BROWN_CONRADY, 4),
    "equidistant": (Lens.FISHEYE, 4),
}
_UNIFIED = {"eucm": Lens.EUCM, "ds": Lens.DOUBLE_SPHERE}
_CAMERA = re.compile(r"cam(\d+)")


def read(path: Path, part: str | None) -> Found:
    """The cameras, in the IMU's frame where the file has one, else in that of cam0 with x along its optical axis."""
    del part
    record = read_yaml_record(path)
    entries = record.mapping("a camchain with cam0, cam1, ...")
    numbers = sorted(int(match[1]) for key in entries if (match := _CAMERA.fullmatch(key)))
    if not numbers or numbers != list(range(len(numbers))):
        raise InputError(f"{path}: expected cam0, cam1, ... without gaps, got {', '.join(entries) or 'nothing'}")
    has_imu = record.at("cam0").at("T_cam_imu").value is not None
    cameras = []
    camera_from_body = np.eye(4)
    camera_from_body[:3, :3] = FLU_FROM_RDF.T
    for i in numbers:
        entry = record.at(f"cam{i}")
        if entry.at("T_cam_imu").value is not None and has_imu:
            camera_from_body = entry.at("T_cam_imu").transform()
        elif i > 0:
            camera_from_body = entry.at("T_cn_cnm1").transform() @ camera_from_body
        cameras.append(FoundCamera(f"cam{i}", np.linalg.inv(camera_from_body), _optics(entry)))
    note = (
        "poses are in the IMU's frame, whose axes are assumed to be x forward, y left, z up"
        if has_imu
        else "poses are relative to cam0, which is assumed to point forward"
    )
    return Found(tuple(cameras), (f"{note}; `origin_rpy_deg` turns them",))


def _optics(entry: Record) -> Optics:
    model, distortion = entry.at("camera_model"), entry.at("distortion_model")
    model.one_of(("pinhole", *_UNIFIED))
    known = _DISTORTION if model.value == "pinhole" else {"none": (_UNIFIED[model.value], 0)}
    lens, count = known[distortion.one_of(known)]
    size = entry.at("resolution")
    sides = [each.whole() for each in size.items("[width, height]")]
    if len(sides) != 2:
        raise size.error("[width, height]")
    values = entry.at("intrinsics")
    *own, fx, fy, cx, cy = values.numbers(4 if model.value == "pinhole" else 6)
    matrix = Record(values.location, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
    coefficients = entry.at("distortion_coeffs").numbers(count) if count else own
    return optics_of_matrix(matrix, lens=lens, distortion=coefficients, width_px=sides[0], height_px=sides[1])


FORMAT = RigFormat(
    "kalibr",
    frame="IMU to camera, and each camera to the next; right-handed, metres; cameras x right, y down, z forward",
    origin="the IMU's, or cam0's where there is no IMU",
    is_ego_origin=False,
    read=read,
    write=None,
)
