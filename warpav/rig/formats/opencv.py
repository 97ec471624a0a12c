"""OpenCV's FileStorage (YAML, XML, JSON): one camera per file, as OpenCV's calibration sample writes it, plus the pose.

OpenCV names no frame. Exports write ``camera_from_ego``, 4 x 4, from the vehicle's coordinates to the camera's, which
is the direction of OpenCV's own ``rvec`` and ``tvec``; imports also take ``R`` with ``T``, and ``rvec`` with ``tvec``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.bounded_files import LEVELS_MAX, check_nesting, parse_xml, read_text, refuse_levels
from warpav.core.errors import InputError
from warpav.raster.lens import Lens
from warpav.rig.formats.format import (
    Found,
    FoundCamera,
    Losses,
    PlacedCamera,
    RigFormat,
    camera_matrix,
    file_for_each,
    optics_of_matrix,
)
from warpav.rig.formats.record import Record, rigid_transform

if TYPE_CHECKING:
    import cv2

_SUFFIXES = (".yaml", ".yml", ".xml", ".json")
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D")
_SIZE = (("image_width", "image_Width"), ("image_height", "image_Height"))
_POSE = ("camera_from_ego", "R", "T", "rvec", "tvec")
_KEYS = ("camera_name", "fisheye_model", *_MATRIX, *_DISTORTION, *_SIZE[0], *_SIZE[1], *_POSE)
_KIND = "an OpenCV FileStorage file"
_BYTES_MAX = 5_000_000


def read(path: Path, part: str | None) -> Found:
    """The camera of a file, or the cameras of all files of a folder."""
    del part
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in _SUFFIXES)
        if not files:
            raise InputError(f"{path}: expected OpenCV's files (*.yaml, *.yml, *.xml), got none in this folder")
    return Found(tuple(map(_camera, files)))


def _camera(file: Path) -> FoundCamera:
    record = _record(file)
    matrix, coefficients = record.first_of(*_MATRIX), record.first_of(*_DISTORTION)
    is_fisheye = record.at("fisheye_model").whole(0) != 0
    distortion: list[float] = []
    if is_fisheye:
        distortion = coefficients.numbers(4)
    elif coefficients.value is not None:
        distortion = coefficients.numbers(4, 5, 8, 12, 14)
        if any(distortion[8:]):
            raise coefficients.error("at most 8 coefficients that are not 0; warpav has no thin prism or tilted sensor")
        distortion = distortion[:8]
    width, height = (record.first_of(*names) for names in _SIZE)
    optics = optics_of_matrix(
        matrix,
        lens=Lens.FISHEYE if is_fisheye else Lens.BROWN_CONRADY,
        distortion=distortion,
        width_px=None if width.value is None else width.whole(),
        height_px=None if height.value is None else height.whole(),
    )
    return FoundCamera(record.at("camera_name").text(file.stem), np.linalg.inv(_camera_from_ego(record)), optics)


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
    import cv2

    text = read_text(file, _KIND, bytes_max=_BYTES_MAX)
    _check_levels(text, str(file))
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        reason = str(error.__cause__ or error)
        found = reason.partition("error: ")[2] or reason
        raise InputError(
            f"{file}: expected an OpenCV FileStorage file, which begins with %YAML:1.0, got: "
            f"{' '.join(found.split())[:120]}"
        ) from None
    root = storage.root()
    if not storage.isOpened() or not root.isMap():
        raise InputError(f"{file}: expected an OpenCV FileStorage file with camera_matrix, got no mapping")
    return Record(file, {key: _value(root.getNode(key)) for key in _KEYS})  # the search for one goes through all keys


def _check_levels(text: str, place: str) -> None:
    """Reject a text whose levels overflow the stack of OpenCV's parsers.

    Raises:
        InputError: It has more than may be.
    """
    if text.lstrip().startswith("<"):
        parse_xml(text.encode(), place, _KIND)
        return
    check_nesting(text, place, quotes="\"'")
    indents = [-1]
    for number, line in enumerate(re.sub(r"\"[^\"\n]*\"", "", text).splitlines(), 1):
        begun = line.lstrip(" ")
        if not begun:
            continue
        while indents[-1] >= len(line) - len(begun):
            indents.pop()
        indents.append(len(line) - len(begun))
        # lists and mappings that begin in one line, such as - - a: b: 1
        if len(indents) - 1 + begun.count("- ") + begun.count(":") > LEVELS_MAX:
            refuse_levels(f"{place}:{number}")


def _value(node: cv2.FileNode) -> Any:  # noqa: ANN401
    """Plain data of a node; of a matrix its numbers, row by row; of another mapping an empty one."""
    import cv2

    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isMap():
        try:
            matrix = node.mat()
        except cv2.error:
            matrix = None
        return {} if matrix is None else [float(value) for value in np.ravel(matrix)]
    if node.isSeq():
        return [_value(node.at(i)) for i in range(node.size())]
    return None


def write(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """One file a camera."""
    import cv2

    files = {}
    for file, camera in zip(file_for_each(cameras, target, (".yaml", ".yml")), cameras, strict=True):
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
        files[file] = storage.releaseAndGetString().encode()
    return files


FORMAT = RigFormat(
    "opencv",
    frame="vehicle to camera, vehicle x forward, y left, z up, right-handed, metres; cameras x right, y down, z "
    "forward, pixel centres at 0",
    origin="free in OpenCV",
    is_ego_origin=False,
    read=read,
    write=write,
)
