"""Argoverse 2: ``calibration/egovehicle_SE3_sensor.feather`` and ``calibration/intrinsics.feather`` (extra ``av2``)."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from warpav.core.bounded_files import feather_library, read_feather
from warpav.core.errors import InputError
from warpav.core.frames import quaternion_from_rotation
from warpav.rig.formats.format import (
    Found,
    FoundCamera,
    Losses,
    PlacedCamera,
    RigFormat,
    camera_matrix,
    optics_of_matrix,
    pinhole_of,
)
from warpav.rig.formats.record import Record, rigid_transform

_POSES, _INTRINSICS = "egovehicle_SE3_sensor.feather", "intrinsics.feather"
_QUATERNION, _POSITION = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")
_DISTORTION = ("k1", "k2", "k3")


def read(path: Path, part: str | None) -> Found:
    """The cameras of a log's calibration: its folder, the folder above it, or the file of poses."""
    del part
    folder = path if path.is_dir() else path.parent
    if path.is_dir() and (path / "calibration").is_dir():
        folder = path / "calibration"
    lenses = {row.at("sensor_name").text(): row for row in _rows(folder / _INTRINSICS)}
    cameras = []
    is_distorted = False
    for row in _rows(folder / _POSES):
        name = row.at("sensor_name").text()
        if name not in lenses:
            continue  # a lidar
        quaternion = [row.at(column).number() for column in _QUATERNION]
        transform = rigid_transform(
            row.unit_quaternion(quaternion), [row.at(column).number() for column in _POSITION], row
        )
        lens = lenses[name]
        fx, fy, cx, cy = (lens.at(column).number() for column in ("fx_px", "fy_px", "cx_px", "cy_px"))
        matrix = Record(f"{lens.location}: fx_px, fy_px, cx_px, cy_px", [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
        optics = optics_of_matrix(matrix, width_px=lens.at("width_px").whole(), height_px=lens.at("height_px").whole())
        is_distorted |= any(lens.at(column).number(0.0) for column in _DISTORTION)
        cameras.append(FoundCamera(name, transform, optics))
    if not cameras:
        raise InputError(f"{folder / _POSES}: expected a sensor that {_INTRINSICS} names, got none")
    note = "k1, k2, k3 are not read: Argoverse 2 publishes undistorted images, they belong to the lens before that"
    return Found(tuple(cameras), (note,) if is_distorted else ())


def _rows(file: Path) -> list[Record]:
    return Record(file, read_feather(file, "Argoverse 2's feather file").to_pylist()).items()


def write(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """Both files; k1 to k3 are 0, because they describe a lens before its images are undistorted."""
    arrow, feather = feather_library()
    if target.suffix and not target.is_dir():
        raise InputError(f"{target}: argoverse2: expected a folder for {_POSES} and {_INTRINSICS}, got a file's name")
    poses: dict[str, list] = {"sensor_name": [], **{name: [] for name in (*_QUATERNION, *_POSITION)}}
    columns = ("fx_px", "fy_px", "cx_px", "cy_px", *_DISTORTION)
    lenses: dict[str, list] = {"sensor_name": [], **{name: [] for name in (*columns, "height_px", "width_px")}}
    for camera in cameras:
        model = pinhole_of(camera, losses)
        quaternion = quaternion_from_rotation(camera.file_from_camera[:3, :3])
        pose = [camera.name, *quaternion.tolist(), *camera.file_from_camera[:3, 3].tolist()]
        (fx, _, cx), (_, fy, cy), _ = camera_matrix(model)
        lens = [camera.name, fx, fy, cx, cy, 0.0, 0.0, 0.0, model.height_px, model.width_px]
        for table, row in ((poses, pose), (lenses, lens)):
            for column, value in zip(table.values(), row, strict=True):
                column.append(value)
    kinds = {"sensor_name": arrow.string(), "height_px": arrow.uint16(), "width_px": arrow.uint16()}
    folder = target if target.name == "calibration" else target / "calibration"
    files = {}
    for name, table in ((_POSES, poses), (_INTRINSICS, lenses)):
        schema = arrow.schema([(column, kinds.get(column, arrow.float64())) for column in table])
        stream = io.BytesIO()
        feather.write_feather(arrow.table(table, schema=schema), stream)
        files[folder / name] = stream.getvalue()
    return files


FORMAT = RigFormat(
    "argoverse2",
    frame="sensor to vehicle, x forward, y left, z up, right-handed, metres; quaternions w x y z; cameras x right, "
    "y down, z forward",
    origin="the centre of the rear axle itself, a wheel's radius above the ground (0.33 m on the Ford Fusion)",
    is_ego_origin=False,
    read=read,
    write=write,
)
