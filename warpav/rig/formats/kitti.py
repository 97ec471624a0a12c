"""KITTI's object calibration: ``P0`` to ``P3``, ``R0_rect`` and ``Tr_velo_to_cam``, from the lidar's frame to cameras.

One file holds cameras with one orientation (they are rectified together), so a rig is written as a folder with one
file a camera, whose four matrices are equal; such a folder is read as a rig, and so is a single file of the data set.
KITTI keeps no image sizes here; exports add them as ``S_rect_00`` to ``S_rect_03``, the key of its raw calibration,
behind everything that its readers look for.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpav.core.bounded_files import read_text
from warpav.core.errors import InputError
from warpav.rig.formats.format import (
    Found,
    FoundCamera,
    Losses,
    PlacedCamera,
    RigFormat,
    camera_matrix,
    file_for_each,
    optics_of_matrix,
    pinhole_of,
)
from warpav.rig.formats.record import Record, rigid_transform

_COUNT = 4


def read(path: Path, part: str | None) -> Found:
    """The cameras of one calibration file, or of a folder with one file per camera."""
    del part
    if not path.is_dir():
        return Found(tuple(_cameras(path)))
    files = sorted(path.glob("*.txt"))
    if not files:
        raise InputError(f"{path}: expected KITTI calibration files (*.txt), got none in this folder")
    cameras = []
    for file in files:
        found = _cameras(file)
        if len(found) > 1:
            raise InputError(
                f"{file}: expected one camera per file in a folder (P0 to P3 equal), got {len(found)}; name this file "
                "instead of its folder to read the cameras in it"
            )
        cameras += found
    return Found(tuple(cameras))


def _cameras(file: Path) -> list[FoundCamera]:
    record = _record(file)
    rectified = record.first_of("Tr_velo_to_cam", "Tr_velo_cam", "Tr").transform(3)
    turn = record.first_of("R0_rect", "R_rect")
    rotation = np.eye(3)
    if turn.value is not None or record.at("Tr").value is None:
        rotation = rigid_transform(np.array(turn.matrix(3, 3)), np.zeros(3), turn)[:3, :3]
    rectified[:3] = rotation @ rectified[:3]
    found: dict[tuple, FoundCamera] = {}
    for i in range(_COUNT):
        projection = record.at(f"P{i}")
        if projection.value is None and i != 2:
            continue
        matrix = np.array(projection.matrix(3, 4))
        if not matrix.any():
            continue  # a camera that is not there
        size = record.at(f"S_rect_0{i}")
        width_px, height_px = (None, None) if size.value is None else map(int, size.numbers(2))
        calibration = Record(projection.location, matrix[:, :3].tolist())
        optics = optics_of_matrix(calibration, width_px=width_px, height_px=height_px)
        camera_from_velodyne = rectified.copy()
        camera_from_velodyne[:3, 3] += np.linalg.solve(matrix[:, :3], matrix[:, 3])  # the baseline
        key = (*matrix.flat, width_px, height_px)
        found.setdefault(key, FoundCamera(f"image_{i}", np.linalg.inv(camera_from_velodyne), optics))
    if not found:
        raise InputError(f"{file}: P2: expected a camera's 3 x 4 projection matrix, got none")
    if len(found) == 1:
        camera = next(iter(found.values()))
        return [FoundCamera(file.stem, camera.file_from_camera, camera.optics)]
    return list(found.values())


def _record(file: Path) -> Record:
    numbers: dict[str, list] = {}
    for n, line in enumerate(read_text(file, "a KITTI calibration file").splitlines(), 1):
        key, colon, rest = line.partition(":")
        if not line.strip():
            continue
        if not colon:
            raise InputError(f"{file}:{n}: expected KEY: NUMBERS, got {line.strip()[:40]!r}")
        try:
            numbers[key.strip()] = [float(word) for word in rest.split()]
        except ValueError:
            numbers[key.strip()] = rest.split()  # validated on use; this may be a date
    return Record(file, numbers)


def write(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """One file a camera."""
    files = {}
    for file, camera in zip(file_for_each(cameras, target, (".txt",)), cameras, strict=True):
        model = pinhole_of(camera, losses)
        projection = np.c_[np.array(camera_matrix(model)), np.zeros(3)]
        lines = [_line(f"P{i}", projection) for i in range(_COUNT)]
        lines += [
            _line("R0_rect", np.eye(3)),
            _line("Tr_velo_to_cam", np.linalg.inv(camera.file_from_camera)[:3]),
            _line("Tr_imu_to_velo", np.eye(4)[:3]),
            *(_line(f"S_rect_0{i}", np.array([model.width_px, model.height_px])) for i in range(_COUNT)),
        ]
        files[file] = ("\n".join(lines) + "\n").encode()
    return files


def _line(key: str, numbers: np.ndarray) -> str:
    return f"{key}: {' '.join(f'{value:.15e}' for value in numbers.flat)}"


FORMAT = RigFormat(
    "kitti",
    frame="lidar to camera, lidar x forward, y left, z up, right-handed, metres; cameras x right, y down, z forward",
    origin="the lidar's (KITTI's own sits 1.73 m above the ground)",
    is_ego_origin=False,
    read=read,
    write=write,
)
