"""ROS camera_info YAML: image size and lens of one camera, without its pose."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.core.yaml_file import yaml_number
from warpav.raster.lens import Lens
from warpav.rig.formats.format import (
    Losses,
    Optics,
    PlacedCamera,
    RigFormat,
    camera_matrix,
    file_for_each,
    optics_of_matrix,
)
from warpav.rig.formats.record import Record, read_yaml_record

FOLDER = "camera_info"
"""Folder of these files in exports and imports."""

_MODELS = {
    "plumb_bob": (Lens.BROWN_CONRADY, (0, 4, 5)),
    "rational_polynomial": (Lens.BROWN_CONRADY, (8,)),
    "equidistant": (Lens.FISHEYE, (4,)),
}


def read_camera_infos(path: Path) -> dict[str, Optics]:
    """The optics in a camera_info file or in all those of a folder."""
    files = [path]
    if path.is_dir():
        files = sorted(file for end in ("yaml", "yml") for file in (*path.glob(f"*.{end}"), *path.glob(f"*/*.{end}")))
        if not files:
            raise InputError(f"{path}: expected a folder with camera_info YAML files, got none in it")
    found: dict[str, Optics] = {}
    for file in files:
        record = read_yaml_record(file)
        optics = _optics_of_info(record)
        found[file.parent.name if file.stem == "camera_info" else file.stem] = optics
        if record.at("camera_name").value is not None:
            found.setdefault(record.at("camera_name").text(), optics)
    return found


def _optics_of_info(record: Record) -> Optics:
    """The optics of a camera_info mapping."""
    record.mapping("a camera_info mapping with image_width, image_height, camera_matrix and distortion_model")
    lens, counts = _MODELS[record.at("distortion_model").one_of(_MODELS)]
    coefficients = record.at("distortion_coefficients").at("data")
    distortion = coefficients.numbers(*counts) if coefficients.value is not None or 0 not in counts else []
    return optics_of_matrix(
        record.at("camera_matrix").at("data"),
        lens=lens,
        distortion=distortion,
        width_px=record.at("image_width").whole(),
        height_px=record.at("image_height").whole(),
    )


def _camera_info_text(camera: PlacedCamera, losses: Losses) -> str:
    """The file of one camera."""
    model = camera.model
    if model.lens not in (Lens.PINHOLE, Lens.BROWN_CONRADY, Lens.FISHEYE):
        raise losses.unsupported(camera.name, f"a {model.lens} lens")
    wanted = {Lens.FISHEYE: 4}.get(model.lens, 8 if len(model.distortion) == 8 else 5)
    distortion = [*model.distortion, *(0.0,) * (wanted - len(model.distortion))]
    name = {4: "equidistant", 5: "plumb_bob", 8: "rational_polynomial"}[wanted]
    matrix = np.array(camera_matrix(model))
    lines = [
        f"image_width: {model.width_px}",
        f"image_height: {model.height_px}",
        f"camera_name: {json.dumps(camera.name)}",
        *_matrix("camera_matrix", matrix),
        f"distortion_model: {name}",
        *_matrix("distortion_coefficients", np.array([distortion])),
        *_matrix("rectification_matrix", np.eye(3)),
        *_matrix("projection_matrix", np.c_[matrix, np.zeros(3)]),
    ]
    return "\n".join(lines) + "\n"


def _matrix(name: str, matrix: np.ndarray) -> list[str]:
    numbers = ", ".join(yaml_number(value) for value in matrix.flat)
    return [f"{name}:", f"  rows: {matrix.shape[0]}", f"  cols: {matrix.shape[1]}", f"  data: [{numbers}]"]


def camera_info_files(cameras: Sequence[PlacedCamera], folder: Path, losses: Losses) -> dict[Path, bytes]:
    """The files of all cameras, ``NAME.yaml`` each."""
    return {folder / f"{camera.name}.yaml": _camera_info_text(camera, losses).encode() for camera in cameras}


def write(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """One file per camera, without poses: camera_info does not contain them."""
    files = file_for_each(cameras, target, (".yaml", ".yml"))
    losses.notes.append("camera_info holds no poses; urdf and autoware do")
    return {file: _camera_info_text(camera, losses).encode() for file, camera in zip(files, cameras, strict=True)}


FORMAT = RigFormat(
    "camera-info",
    frame="cameras x right, y down, z forward, pixels; no poses",
    origin="none",
    is_ego_origin=True,
    read=None,
    write=write,
)
