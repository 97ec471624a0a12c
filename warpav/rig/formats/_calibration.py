"""Calibration tools: OpenCV's FileStorage and Kalibr's camchain.

OpenCV (YAML, XML, JSON): one camera per file, as its calibration sample writes it, plus the pose. It names no frame.
Exports write ``camera_from_ego``, 4 x 4, from the vehicle's coordinates to the camera's, which is the direction of
OpenCV's own ``rvec`` and ``tvec``; imports also take ``R`` with ``T``, and ``rvec`` with ``tvec``.

Kalibr: cameras in a chain, or at an IMU; to be read only.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from warpav.core.bounded_files import parse_json, parse_xml, read_text
from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF
from warpav.core.yaml_file import read_yaml
from warpav.raster.lens import Lens
from warpav.rig.formats._format import (
    Found,
    FoundCamera,
    Losses,
    Optics,
    PlacedCamera,
    Record,
    RigFormat,
    brown_conrady,
    camera_matrix,
    is_number,
    optics_of,
    optics_of_matrix,
    read_yaml_record,
    rigid_transform,
    unread_note,
)

# ----------------------------------------------------------------------------------------------------------- OpenCV

_SUFFIXES = (".yaml", ".yml", ".xml", ".json")
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_COEFFICIENTS = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D")
_SIZE = (("image_width", "image_Width"), ("image_height", "image_Height"))
_OTHERS = (
    *("calibration_time", "calibrationDate", "nframes", "nr_of_frames", "framesCount", "board_width"),
    *("board_height", "square_size", "aspectRatio", "flags", "flagValue", "fix_K1", "fix_K2", "fix_K3", "fix_K4"),
    *("fix_K5", "extrinsic_parameters", "image_points", "grid_points", "avg_reprojection_error"),
    *("per_view_reprojection_errors", "reprojection_error"),
)
"""What calibration tools write of how they calibrated."""
_KIND = "an OpenCV FileStorage file"
_TAG = re.compile(r"!!opencv-[a-z-]+")


def _read_opencv(path: Path) -> Found:
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in _SUFFIXES)
        if not files:
            raise InputError(f"{path}: expected OpenCV's files (*.yaml, *.yml, *.xml), got none in this folder")
    records = list(map(_record, files))
    cameras = tuple(_camera(record, file.stem) for record, file in zip(records, files, strict=True))
    return Found(cameras, unread_note(path, (key for record in records for key in record.unread(*_OTHERS))))


def _camera(record: Record, stem: str) -> FoundCamera:
    matrix, coefficients = record.first_of(*_MATRIX), record.first_of(*_COEFFICIENTS)
    is_fisheye = record.at("fisheye_model").whole(0) != 0
    distortion: list[float] = []
    if is_fisheye:
        distortion = coefficients.numbers(4)
    elif coefficients.value is not None:
        distortion = brown_conrady(coefficients, 4, 5, 8, 12, 14)
    width, height = (record.first_of(*names) for names in _SIZE)
    optics = optics_of_matrix(
        matrix,
        lens=Lens.FISHEYE if is_fisheye else Lens.BROWN_CONRADY,
        distortion=distortion,
        width_px=None if width.value is None else width.whole(),
        height_px=None if height.value is None else height.whole(),
    )
    return FoundCamera(record.at("camera_name").text(stem), np.linalg.inv(_camera_from_ego(record)), optics)


def _camera_from_ego(record: Record) -> np.ndarray:
    whole = record.at("camera_from_ego")
    if whole.value is not None:
        return whole.transform(3 if isinstance(whole.value, list) and len(whole.value) == 12 else 4)
    turn, vector = record.at("R"), record.at("rvec")
    if turn.value is not None:
        return rigid_transform(np.array(turn.matrix(3, 3)), record.at("T").numbers(3), turn)
    if vector.value is not None:
        import cv2

        return rigid_transform(cv2.Rodrigues(np.array(vector.numbers(3)))[0], record.at("tvec").numbers(3), vector)
    raise whole.error("the camera's pose: camera_from_ego (4 x 4), or R and T, or rvec and tvec")


def _record(file: Path) -> Record:
    """What a file says of one camera, read here: OpenCV's own parsers crash on broken files."""
    text = read_text(file, _KIND)
    begun, lines = text.lstrip(), {}
    if begun.startswith("<"):
        root = parse_xml(begun.encode(), str(file), _KIND)
        data: Any = {element.tag: _of_element(element) for element in root}
    elif begun.startswith("{"):
        data = parse_json(text, str(file), _KIND)
    elif begun.startswith("%YAML"):
        data, lines = read_yaml(_TAG.sub("", text), str(file))  # its tags are no YAML
    else:
        raise InputError(
            f"{file}: expected {_KIND}, which begins with %YAML:1.0, got: {' '.join(text[:60].split()) or 'nothing'}"
        )
    if not isinstance(data, dict):
        raise InputError(f"{file}: expected {_KIND} with camera_matrix, got no mapping")
    return Record(file, {key: _value(value) for key, value in data.items()}, (), lines)


def _of_element(element: ElementTree.Element) -> Any:  # noqa: ANN401
    """The data of an element: a mapping, a list, a number, numbers or a text."""
    if len(element):
        if all(child.tag == "_" for child in element):
            return [_of_element(child) for child in element]
        return {child.tag: _of_element(child) for child in element}
    text = (element.text or "").strip()
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return text.strip('"')
    return numbers[0] if len(numbers) == 1 else numbers


def _value(value: Any) -> Any:  # noqa: ANN401
    """Plain data; of a matrix its numbers, row by row; of another mapping an empty one."""
    if not isinstance(value, dict):
        return value
    rows, columns, numbers = value.get("rows"), value.get("cols"), value.get("data")
    numbers = [numbers] if isinstance(numbers, float) else numbers  # of one element
    is_whole = is_number(rows) and is_number(columns) and isinstance(numbers, list) and rows * columns == len(numbers)
    return numbers if is_whole else {}


def _write_opencv(camera: PlacedCamera, losses: Losses) -> bytes:
    import cv2

    model = camera.model
    if model.lens not in (Lens.PINHOLE, Lens.BROWN_CONRADY, Lens.FISHEYE):
        raise losses.unsupported(camera.name, f"a {model.lens} lens")
    is_fisheye = model.lens is Lens.FISHEYE
    count = 4 if is_fisheye else max(5, len(model.distortion))
    distortion = np.pad(np.array(model.distortion, np.float64), (0, count - len(model.distortion)))
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.writeComment("camera_from_ego: from x forward, y left, z up [m] to x right, y down, z forward")
    storage.write("camera_name", camera.name)
    storage.write("image_width", model.width_px)
    storage.write("image_height", model.height_px)
    storage.write("fisheye_model", int(is_fisheye))
    storage.write("camera_matrix", np.array(camera_matrix(model)))
    storage.write("distortion_coefficients", distortion[:, None])
    storage.write("camera_from_ego", np.linalg.inv(camera.file_from_camera))
    return storage.releaseAndGetString().encode()


# ----------------------------------------------------------------------------------------------------------- Kalibr

_DISTORTION = {
    "none": (Lens.PINHOLE, 0),
    "radtan": (Lens.BROWN_CONRADY, 4),
    "equidistant": (Lens.FISHEYE, 4),
}
_UNIFIED = {"eucm": Lens.EUCM, "ds": Lens.DOUBLE_SPHERE, "omni": Lens.EUCM}
_UNPLACED = ("rostopic", "cam_overlaps", "timeshift_cam_imu")
"""Keys that say nothing of places and lenses."""
_CHAINED = re.compile(r"cam(\d+)")


def _read_kalibr(path: Path) -> Found:
    """The cameras, in the IMU's frame where the file has one, else in that of cam0 with x along its optical axis."""
    record = read_yaml_record(path)
    entries = record.mapping("a camchain with cam0, cam1, ...")
    numbers = sorted(int(match[1]) for key in entries if (match := _CHAINED.fullmatch(key)))
    if not numbers or numbers != list(range(len(numbers))):
        raise InputError(f"{path}: expected cam0, cam1, ... without gaps, got {', '.join(entries) or 'nothing'}")
    has_imu = _camera_from_imu(record.at("cam0")) is not None
    cameras = []
    camera_from_body = np.eye(4)
    camera_from_body[:3, :3] = FLU_FROM_RDF.T
    for i in numbers:
        entry = record.at(f"cam{i}")
        camera_from_imu = _camera_from_imu(entry)
        if camera_from_imu is not None and has_imu:
            camera_from_body = camera_from_imu
        elif i > 0:
            camera_from_body = entry.at("T_cn_cnm1").transform() @ camera_from_body
        cameras.append(FoundCamera(f"cam{i}", np.linalg.inv(camera_from_body), _optics(entry)))
    note = (
        "poses are in the IMU's frame, whose axes are assumed to be x forward, y left, z up"
        if has_imu
        else "poses are relative to cam0, which is assumed to point forward"
    )
    return Found(
        tuple(cameras), (f"{note}; `origin_rpy_deg` turns them", *unread_note(path, record.unread(*_UNPLACED)))
    )


def _camera_from_imu(entry: Record) -> np.ndarray | None:
    """The transform as Kalibr writes it, or its inverse as OpenVINS does; None where there is neither."""
    if entry.at("T_cam_imu").value is not None:
        return entry.at("T_cam_imu").transform()
    inverse = entry.at("T_imu_cam")
    return None if inverse.value is None else np.linalg.inv(inverse.transform())


def _optics(entry: Record) -> Optics:
    model, distortion = entry.at("camera_model"), entry.at("distortion_model")
    model.one_of(("pinhole", *_UNIFIED))
    known = _DISTORTION if model.value == "pinhole" else {"none": (_UNIFIED[model.value], 0)}
    if model.value == "omni" and distortion.value != "none":
        raise distortion.error("none beside omni, which is read as eucm then; calibrate as pinhole-equi, eucm or ds")
    lens, count = known[distortion.one_of(known)]
    given = entry.at("distortion_coeffs")
    if not count and given.value is not None and any(given.numbers()):
        raise given.error("none beside distortion_model none")
    size = entry.at("resolution")
    sides = [each.whole() for each in size.items("[width, height]")]
    if len(sides) != 2:
        raise size.error("[width, height]")
    values = entry.at("intrinsics")
    *own, fx, fy, cx, cy = values.numbers({"pinhole": 4, "omni": 5}.get(str(model.value), 6))
    if model.value == "omni":  # is the eucm with beta = 1
        if own[0] < 0.0:
            raise values.error("xi of at least 0")
        growth = 1.0 + own[0]
        own, fx, fy = [own[0] / growth, 1.0], fx / growth, fy / growth
    coefficients = given.numbers(count) if count else own
    return optics_of(values, fx, fy, cx, cy, lens=lens, distortion=coefficients, width_px=sides[0], height_px=sides[1])


FORMATS = (
    RigFormat(
        "opencv",
        frame="vehicle to camera, vehicle x forward, y left, z up, right-handed, metres; cameras x right, y down, z "
        "forward, pixel centres at 0",
        origin="free in OpenCV",
        is_ego_origin=False,
        files=(),
        suffixes=(".yaml", ".yml"),
        read=_read_opencv,
        write=_write_opencv,
    ),
    RigFormat(
        "kalibr",
        frame="IMU to camera, and each camera to the next; right-handed, metres; cameras x right, y down, z forward",
        origin="the IMU's, or cam0's where there is no IMU",
        is_ego_origin=False,
        files=(),
        suffixes=(),
        read=_read_kalibr,
        write=None,
    ),
)
