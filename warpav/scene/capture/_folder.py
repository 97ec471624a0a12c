"""Captures on disk: one folder a situation, with ``capture.json`` and three image files for every view.

``capture.json`` (schema ``warpav-capture/1``) holds, in the ego frame (ISO 8855, metres, degrees):

* ``name``, ``source``, and ``recipe``, a fingerprint of its settings, so that it is not recorded twice; recordings from
  elsewhere have none, and are never replaced;
* ``ego``: ``box_center_m``, ``box_size_m``, ``box_yaw_deg``;
* ``vehicles``: for each ``instance_id`` (1 to 65534), ``class``, the three box fields, ``spawn_m``, ``spawn_yaw_deg``
  and ``instance_rgb``, the simulator's own colour of the instance, and where it is known ``velocity_ego_m_s`` (forward
  and left, relative to the ego vehicle);
* ``images``: for each ``name``, ``kind`` (see `ViewKind`), ``width_px``, ``height_px``, ``intrinsics`` (3 x 3, pixel
  centres at +0.5), ``ego_from_camera`` (4 x 4, camera axes x right, y down, z forward), and the files ``rgb``,
  ``depth`` and ``instance``, relative to the folder;
* ``depth_step_m``: metres per unit of depth images that are PNG files.

Colour is an 8-bit PNG. Depth along the optical axis is a 16-bit PNG, 0 where nothing is hit, or an ``.npz`` with the
array ``depth_m`` (float32, inf where nothing is hit). Instances are a 16-bit PNG: 0 environment, 65535 ego vehicle,
else the instance id; window panes belong to their vehicle.
"""

from __future__ import annotations

import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import AfterValidator, ConfigDict, Field

from warpav.core.bounded_files import (
    ARRAY_BYTES_MAX,
    PNG_SIGNATURE,
    is_inner_path,
    is_whole_png,
    parse_json,
    read_arrays,
    read_bytes,
    read_text,
)
from warpav.core.cache import digest
from warpav.core.errors import InputError
from warpav.core.files import atomic_write, writing
from warpav.core.records import Point2, Point3, Record, read_record
from warpav.raster.camera import CameraModel
from warpav.scene._scene import Box
from warpav.scene.capture._capture import (
    EGO_INSTANCE,
    ENVIRONMENT_INSTANCE,
    Capture,
    CapturedImage,
    CapturedVehicle,
    CaptureView,
    PlanSettings,
    Simulator,
    ViewKind,
    capture_plan,
    spawn_visible_traffic,
)

_SCHEMA = "warpav-capture/1"
DESCRIPTION = "capture.json"
_DEPTH_STEP_M = 0.002  # metres per unit of the depth images that are written here: 131 m fit into 16 bits
UNFINISHED = "capture.part.json"  # what an unfinished capture is going to hold
_MAX_ROTATION_ERROR = 1e-3
_PIXELS_MAX = 1 << 26  # of a view: with its depths and instances half a gigabyte


def _checked_pose(rows: list[list[float]]) -> list[list[float]]:
    pose = np.array(rows, np.float64)
    rotation = pose[:3, :3]
    error = max(float(np.abs(rotation @ rotation.T - np.eye(3)).max()), abs(float(np.linalg.det(rotation)) - 1.0))
    if error > _MAX_ROTATION_ERROR:
        mirrored = " (a mirror: the recording is left-handed)" if np.linalg.det(rotation) < 0.0 else ""
        raise ValueError(f"expected a rotation in the upper left 3 x 3, got one that is off by {error:.3g}{mirrored}")
    if np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
        raise ValueError(f"expected 0 0 0 1 in the last row, got {rows[3]}")
    return rows


def _checked_intrinsics(rows: list[list[float]]) -> list[list[float]]:
    matrix = np.array(rows)
    if not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0):
        raise ValueError(f"expected positive focal lengths, got {matrix[0, 0]} and {matrix[1, 1]}")
    matrix[[0, 1], [0, 1]], matrix[:2, 2] = 1.0, 0.0
    if np.abs(matrix - np.eye(3)).max() > 1e-9:
        raise ValueError("expected focal lengths and a principal point without skew in fx 0 cx, 0 fy cy, 0 0 1")
    return rows


def _checked_place(name: str) -> str:
    if not is_inner_path(name):
        raise ValueError(f"expected a file inside the folder of {DESCRIPTION}, got {name!r}")
    return name


_Matrix3 = Annotated[list[Point3], Field(min_length=3, max_length=3), AfterValidator(_checked_intrinsics)]
_Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]
_Matrix4 = Annotated[list[_Row4], Field(min_length=4, max_length=4), AfterValidator(_checked_pose)]
_Inside = Annotated[str, AfterValidator(_checked_place)]
_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
_Sizes = Annotated[list[Annotated[float, Field(gt=0.0)]], Field(min_length=3, max_length=3)]
_Rgb = Annotated[list[Annotated[int, Field(ge=0, le=255)]], Field(min_length=3, max_length=3)]


class _Described(Record):
    model_config = ConfigDict(extra="forbid", strict=False, allow_inf_nan=False)


class _BoxRecord(_Described):
    box_center_m: Point3
    box_size_m: _Sizes
    box_yaw_deg: float

    @property
    def box(self) -> Box:
        return Box(np.array(self.box_center_m), np.array(self.box_size_m), math.radians(self.box_yaw_deg))


class _VehicleRecord(_BoxRecord):
    instance_id: int = Field(gt=ENVIRONMENT_INSTANCE, lt=EGO_INSTANCE)
    category: str = Field(alias="class", min_length=1)
    spawn_m: Point3 | None = None
    spawn_yaw_deg: float | None = None
    instance_rgb: _Rgb | None = None
    velocity_ego_m_s: Point2 | None = None


class _ImageRecord(_Described):
    name: _Name
    kind: ViewKind = ViewKind.OTHER
    width_px: int = Field(ge=8, le=16384)
    height_px: int = Field(ge=8, le=16384)
    intrinsics: _Matrix3
    ego_from_camera: _Matrix4
    rgb: _Inside
    depth: _Inside
    instance: _Inside


class _CaptureRecord(_Described):
    """All of ``capture.json``."""

    schema_: Literal["warpav-capture/1"] = Field(alias="schema")
    name: _Name
    source: str = ""
    recipe: str = ""
    depth_step_m: float = Field(default=_DEPTH_STEP_M, gt=0.0)
    ego: _BoxRecord
    vehicles: list[_VehicleRecord]
    images: list[_ImageRecord] = Field(min_length=1)


def read_capture(folder: Path) -> Capture:
    """A capture whose images are read, and checked, when they are asked for."""
    record = _read_record(folder / DESCRIPTION)
    vehicles = tuple(
        CapturedVehicle(
            one.instance_id,
            one.category,
            one.box,
            np.array(one.spawn_m if one.spawn_m is not None else one.box_center_m),
            math.radians(one.spawn_yaw_deg if one.spawn_yaw_deg is not None else one.box_yaw_deg),
            np.array(one.instance_rgb or (0, 0, 0), np.uint8),
            None if one.velocity_ego_m_s is None else np.array(one.velocity_ego_m_s),
        )
        for one in sorted(record.vehicles, key=lambda one: one.instance_id)
    )
    return Capture(record.name, record.source, record.ego.box, vehicles, _Images(folder, record))


def check_capture(folder: Path) -> Iterator[str]:
    """Everything that is wrong with a capture, a line each: file, what was expected, what came."""
    try:
        capture = read_capture(folder)
    except InputError as error:
        yield from str(error).splitlines()
        return
    box_of = {EGO_INSTANCE: capture.ego_box, **{one.instance_id: one.box for one in capture.vehicles}}
    pixels, inside = dict.fromkeys(box_of, 0), dict.fromkeys(box_of, 0)
    for index in range(len(capture.images)):
        try:
            image = capture.images[index]
        except InputError as error:
            yield str(error)
            continue
        for instance_id, count in zip(*np.unique(image.instance, return_counts=True), strict=True):
            box = box_of.get(int(instance_id))
            if box is not None:
                pixels[int(instance_id)] += int(count)
                row, column = np.nonzero((image.instance == int(instance_id)) & np.isfinite(image.depth_m))
                ray = image.view.model.rays(np.stack([column + 0.5, row + 0.5], axis=-1)).reshape(-1, 3)
                pose = image.view.ego_from_camera
                point_m = (ray * image.depth_m[row, column, None]) @ pose[:3, :3].T + pose[:3, 3]
                inside[int(instance_id)] += int(np.count_nonzero(box.contains(point_m)))
    for instance_id, count in pixels.items():
        if inside[instance_id] > 0:
            continue
        place = "ego" if instance_id == EGO_INSTANCE else f"vehicles: instance_id {instance_id}"
        hint = "" if instance_id == EGO_INSTANCE else "; remove it from the list"
        if count == 0:
            yield f"{folder / DESCRIPTION}: {place}: expected it in some instance image, got none{hint}"
        else:
            yield (
                f"{folder / DESCRIPTION}: {place}: expected its pixels to lie in its 3D box, got none of {count}; are "
                "boxes and poses in the ego frame, and depths along the optical axis, in metres?"
            )


def record_capture(
    simulator: Simulator,
    seed: int,
    folder: Path,
    settings: PlanSettings,
    *,
    on_image: Callable[[int, int], None] | None = None,
) -> Path:
    """Set up a situation, take its images, and write them; one that was interrupted goes on where it stopped.

    ``capture.json`` is written last: a folder that holds it was complete, and if it was made with the same settings and
    no image file is missing or truncated, it is left alone. Images that an unfinished run of the same plan has written
    are kept; others are taken again. One that was made with other settings is replaced.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: expected a folder to write to, got: {error.strerror}") from None
    made_with = digest(simulator.world, seed, settings)
    if (folder / DESCRIPTION).is_file():
        found = _read_record(folder / DESCRIPTION)
        if not found.recipe:
            raise InputError(
                f"{folder / DESCRIPTION}: expected a capture that may be replaced, got one without a recipe, recorded "
                "elsewhere; choose another folder"
            )
        if found.recipe == made_with and all(_has_files(folder, one) for one in found.images):
            return folder
    ego_box = simulator.begin(seed)
    vehicles = spawn_visible_traffic(simulator, ego_box, settings)
    views = capture_plan(ego_box, vehicles, settings)
    record = _CaptureRecord.model_validate(
        {
            "schema": _SCHEMA,
            "name": simulator.name,
            "source": simulator.source,
            "recipe": made_with,
            "ego": _box_fields(ego_box),
            "vehicles": [
                {
                    "instance_id": one.instance_id,
                    "class": one.category,
                    **_box_fields(one.box),
                    "spawn_m": np.asarray(one.spawn_m, float).tolist(),
                    "spawn_yaw_deg": math.degrees(one.spawn_yaw_rad),
                    "instance_rgb": np.asarray(one.instance_rgb).tolist(),
                    "velocity_ego_m_s": None if one.velocity_ego_m_s is None else one.velocity_ego_m_s.tolist(),
                }
                for one in vehicles
            ],
            "images": [
                {
                    "name": view.name,
                    "kind": view.kind,
                    "width_px": view.model.width_px,
                    "height_px": view.model.height_px,
                    "intrinsics": view.model.intrinsics.tolist(),
                    "ego_from_camera": view.ego_from_camera.tolist(),
                    **{kind: f"images/{view.name}_{kind}.png" for kind in ("rgb", "depth", "instance")},
                }
                for view in views
            ],
        }
    )
    planned = record.model_dump_json(by_alias=True, indent=1)
    if _text(folder / DESCRIPTION) == planned:  # it was complete, but files are missing or truncated
        os.replace(folder / DESCRIPTION, folder / UNFINISHED)
    if _text(folder / UNFINISHED) != planned:
        for part in (folder / DESCRIPTION, folder / "images"):
            shutil.rmtree(part) if part.is_dir() else part.unlink(missing_ok=True)
        (folder / "images").mkdir()
        _write(folder / UNFINISHED, planned.encode())
    for index, (view, files) in enumerate(zip(views, record.images, strict=True)):
        if not _has_files(folder, files):
            image = simulator.capture(view)
            _write(folder / files.rgb, _png(image.rgb[..., ::-1]))
            _write(folder / files.instance, _png(image.instance))
            step = np.round(np.where(np.isfinite(image.depth_m), image.depth_m, 0.0) / _DEPTH_STEP_M)
            _write(folder / files.depth, _png(np.where(step <= 65535, step, 0).astype(np.uint16)))
        if on_image is not None:
            on_image(index + 1, len(views))
    os.replace(folder / UNFINISHED, folder / DESCRIPTION)
    return folder


class _Images(Sequence[CapturedImage]):
    """Images of a folder, each read when it is asked for."""

    def __init__(self, folder: Path, record: _CaptureRecord) -> None:
        self._folder, self._record = folder, record
        self._known = {one.instance_id for one in record.vehicles} | {ENVIRONMENT_INSTANCE, EGO_INSTANCE}

    def __len__(self) -> int:
        return len(self._record.images)

    def __getitem__(self, index: Any) -> Any:  # noqa: ANN401 (one image or a list, as sequences do)
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        one = self._record.images[index]
        if one.width_px * one.height_px > _PIXELS_MAX:
            raise InputError(
                f"{self._folder / DESCRIPTION}: images[{index}]: expected at most {_PIXELS_MAX:,} pixels, got "
                f"{one.width_px} x {one.height_px}"
            )
        try:
            (fx, _, cx), (_, fy, cy), _ = one.intrinsics
            model = CameraModel(one.width_px, one.height_px, focal_px=(fx, fy), centre_px=(cx, cy))
            view = CaptureView(one.name, one.kind, np.array(one.ego_from_camera), model)
        except ValueError as error:
            place = f"{self._folder / DESCRIPTION}: images[{index}].intrinsics"
            raise InputError(f"{place}: expected those of a camera, got: {error}") from None
        size = (one.height_px, one.width_px)
        rgb = self._read(one.rgb, np.uint8, (*size, 3))[..., ::-1]
        instance = self._read(one.instance, np.uint16, size)
        depth_m = self._depth_m(one.depth, size)
        for instance_id in np.unique(instance):
            if int(instance_id) not in self._known:
                raise InputError(
                    f"{self._folder / one.instance}: expected 0, 65535 and the instance ids of {DESCRIPTION}, got "
                    f"{instance_id}, which has no box there"
                )
        return CapturedImage(view, np.ascontiguousarray(rgb), depth_m, instance)

    def _there(self, name: str, what: str) -> Path:
        file = self._folder / name
        if not file.is_file():
            raise InputError(f"{file}: expected {what}, got no such file; take or copy it again")
        return file

    def _read(self, name: str, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
        file = self._there(name, "an image")
        data = read_bytes(file, "a PNG image", bytes_max=ARRAY_BYTES_MAX)
        size_px = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")  # stated before all pixels
        if data.startswith(PNG_SIGNATURE) and size_px != shape[1::-1]:
            raise InputError(
                f"{file}: expected {shape[1]} x {shape[0]} px as {DESCRIPTION} says, got {size_px[0]} x {size_px[1]}"
            )
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if is_whole_png(data) else None
        if image is None:
            raise InputError(f"{file}: expected a PNG image, got a file that is truncated or no image")
        if image.ndim == 3 and image.shape[2] == 4 and len(shape) == 3:
            image = image[..., :3]
        if image.dtype != dtype or image.shape != shape:
            got = f"{image.dtype} {list(image.shape)}"
            raise InputError(f"{file}: expected {np.dtype(dtype)} {list(shape)} as {DESCRIPTION} says, got {got}")
        return image

    def _depth_m(self, name: str, size: tuple[int, int]) -> np.ndarray:
        file = self._there(name, "depths")
        if file.suffix != ".npz":
            step = self._read(name, np.uint16, size)
            return np.where(step > 0, np.float32(self._record.depth_step_m) * step, np.inf).astype(np.float32)
        arrays = read_arrays(file, "an .npz with the array depth_m", names=("depth_m",))
        if "depth_m" not in arrays:
            raise InputError(f"{file}: expected an .npz with the array depth_m, got none of that name")
        depth_m = arrays["depth_m"]
        if depth_m.shape != size or depth_m.dtype.kind != "f":
            raise InputError(
                f"{file}: expected depth_m as floats {list(size)}, got {depth_m.dtype} {list(depth_m.shape)}"
            )
        if not (depth_m >= 0.0).all():
            raise InputError(f"{file}: expected depths of at least 0 m, inf where nothing is, got negative ones or NaN")
        return depth_m.astype(np.float32)


def _box_fields(box: Box) -> dict[str, Any]:
    center_m, size_m = (np.asarray(each, float).tolist() for each in (box.center_m, box.size_m))
    return {"box_center_m": center_m, "box_size_m": size_m, "box_yaw_deg": math.degrees(box.yaw_rad)}


def _read_record(file: Path) -> _CaptureRecord:
    text = _text(file)
    if text is None:
        is_begun = (file.parent / UNFINISHED).is_file()
        got = "an unfinished capture; run warpav scenes capture again" if is_begun else "no such file"
        raise InputError(f"{file}: expected the description of a capture, got {got}")
    content = parse_json(text, str(file), "the description of a capture")
    if not isinstance(content, dict):
        got = " ".join(text.split())[:60]
        raise InputError(f"{file}:1: expected an object with schema, name, ego, vehicles and images, got {got}")
    record = read_record(_CaptureRecord, content, str(file), most=20)
    for field, values in (
        ("images: name", [one.name for one in record.images]),
        ("vehicles: instance_id", [str(one.instance_id) for one in record.vehicles]),
    ):
        value, count = max(Counter(values).items(), key=lambda each: each[1], default=("", 0))
        if count > 1:
            raise InputError(f"{file}: {field}: expected each once, got {value} {count} times")
    return record


def _text(file: Path) -> str | None:
    return read_text(file, "the description of a capture") if file.exists() else None


def _png(image: np.ndarray) -> bytes:
    done, data = cv2.imencode(".png", np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    assert done
    return data.tobytes()


def _has_files(folder: Path, one: _ImageRecord) -> bool:
    """Whether a view's files are there and end as they should."""
    files = [folder / name for name in (one.rgb, one.depth, one.instance)]
    contents = (file.read_bytes() if file.is_file() else b"" for file in files)
    return all(data and (not data.startswith(PNG_SIGNATURE) or is_whole_png(data)) for data in contents)


def _write(file: Path, data: bytes) -> None:
    """Write a file that appears whole or not at all."""
    with writing(file), atomic_write(file) as draft:
        draft.write_bytes(data)
