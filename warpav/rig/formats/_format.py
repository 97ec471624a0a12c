"""What every format of rig files is made of: values with their places, what a reader finds, what a writer gets.

Principal points in other tools' files count from the centre of the upper left pixel, as OpenCV does; warpav counts from
the image's corner. `_PIXEL_CENTRE_PX` is the difference, and is added and taken away here only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from warpav.core.bounded_files import NODES_MAX, read_json
from warpav.core.errors import InputError
from warpav.core.frames import (
    FLU_FROM_RDF,
    rotation_from_quaternion,
    rotation_from_yaw_pitch_roll,
    yaw_pitch_roll_from_rotation,
)
from warpav.core.records import nearest, place_of, unread_text
from warpav.core.yaml_file import Location, dotted, read_yaml
from warpav.raster.beams import Beams
from warpav.raster.camera import MAX_IMAGE_PX, CameraModel
from warpav.raster.lens import Lens
from warpav.raster.mesh import Mesh

_ROTATION_TOLERANCE = 1e-3  # files round to four decimals


class Record:
    """A value, and where it stands; it remembers which keys below it were asked for, so `unread` names the others."""

    def __init__(
        self,
        file: Path | str,
        value: Any,  # noqa: ANN401
        location: Location = (),
        line_of: Mapping[Location, int] | None = None,
        asked: set[Location] | None = None,
    ) -> None:
        """The value at ``location`` of a file; ``line_of`` knows the lines of values, as `read_yaml` gives them."""
        self.value = value
        self._file = file
        self._location = location
        self._line_of = line_of or {}
        self._asked: set[Location] = set() if asked is None else asked

    @property
    def location(self) -> str:
        """File, line where it is known, and field."""
        return place_of(str(self._file), self._location, self._line_of if self._location else None)

    def error(self, expected: str, got: str | None = None) -> InputError:
        """The error that states what was expected here and what was given."""
        text = repr(self.value)
        shown = got or ("nothing" if self.value is None else text if len(text) <= 60 else f"{text:.60}...")
        return InputError(f"{self.location}: expected {expected}, got {shown}")

    def at(self, key: str | int) -> Record:
        """The value of a key or index, which counts as read; of None where there is none."""
        found = self.peek(key)
        self._asked.add(found._location)
        return found

    def peek(self, key: str | int) -> Record:
        """The same, which does not count as read."""
        value = None
        if isinstance(self.value, dict):
            value = self.value.get(key)
        elif isinstance(self.value, list) and isinstance(key, int) and key < len(self.value):
            value = self.value[key]
        return Record(self._file, value, (*self._location, str(key)), self._line_of, self._asked)

    def unread(self, *harmless: str) -> Iterator[str]:
        """The keys below that no reader asked for, but those that are harmless; without the numbers of lists."""
        above = {location[:k] for location in self._asked for k in range(len(location) + 1)}
        waiting: list[Record] = [self]
        while waiting:
            record = waiting.pop()
            is_list = isinstance(record.value, list)
            keys = range(len(record.value)) if is_list else record.value if isinstance(record.value, dict) else ()
            for below in (record.peek(key) for key in keys if key not in harmless):
                if below._location in above:
                    waiting.append(below)
                elif not is_list:
                    yield dotted(tuple(part for part in below._location if not part.isdigit()))

    def first_of(self, *keys: str) -> Record:
        """The value of the first key that is there; of None, by the first key, where none is."""
        return self.at(next((key for key in keys if self.at(key).value is not None), keys[0]))

    def mapping(self, expected: str = "a mapping") -> dict[str, Record]:
        """The values by key, none of which counts as read."""
        if not isinstance(self.value, dict):
            raise self.error(expected)
        return {key: self.peek(key) for key in self.value}

    def items(self, expected: str = "a list") -> list[Record]:
        if not isinstance(self.value, list):
            raise self.error(expected)
        return [self.peek(i) for i in range(len(self.value))]

    def text(self, default: str | None = None) -> str:
        if self.value is None and default is not None:
            return default
        if not isinstance(self.value, str) or not self.value.strip():
            raise self.error("a text")
        return self.value.strip()

    def one_of(self, words: Iterable[str]) -> str:
        known = list(words)
        if not isinstance(self.value, str) or self.value not in known:
            got = f"{self.value!r}{nearest(self.value, known)}" if isinstance(self.value, str) else None
            raise self.error(f"one of {', '.join(known)}", got)
        return self.value

    def number(self, default: float | None = None) -> float:
        if self.value is None and default is not None:
            return default
        if not is_number(self.value):
            raise self.error("a finite number")
        return float(self.value)

    def whole(self, default: int | None = None) -> int:
        value = self.value
        if value is None and default is not None:
            return default
        if not is_number(value) or float(value) != int(value):
            raise self.error("a whole number")
        return int(value)

    def numbers(self, *counts: int) -> list[float]:
        """A list of finite numbers, as many as one of ``counts`` says (any, if none is given)."""
        value = self.value
        is_fit = isinstance(value, list) and all(map(is_number, value)) and (not counts or len(value) in counts)
        if not is_fit:
            wanted = f"{' or '.join(map(str, counts))} " if counts else ""
            raise self.error(f"a list of {wanted}finite numbers")
        return [float(number) for number in value]

    def matrix(self, rows: int, columns: int) -> list[list[float]]:
        """A matrix of finite numbers: a list of rows, or of all numbers row by row."""
        value = self.value
        if isinstance(value, list) and len(value) == rows and all(isinstance(row, list) for row in value):
            value = [number for row in value for number in row] if {len(row) for row in value} == {columns} else None
        if not isinstance(value, list) or len(value) != rows * columns or not all(map(is_number, value)):
            raise self.error(f"a {rows} x {columns} matrix of finite numbers")
        return [[float(number) for number in value[i : i + columns]] for i in range(0, rows * columns, columns)]

    def transform(self, rows: int = 4) -> np.ndarray:
        """A rigid transform that the file writes as 3 x 4 or 4 x 4 matrix, [4, 4]."""
        matrix = np.array(self.matrix(rows, 4))
        if rows == 4 and not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-6):
            raise self.error("a transform whose last row is 0, 0, 0, 1", f"{matrix[3].tolist()}")
        return rigid_transform(matrix[:3, :3], matrix[:3, 3], self)

    def unit_quaternion(self, quaternion: Sequence[float]) -> np.ndarray:
        """The rotation of a quaternion ``w, x, y, z`` that the file holds here, [3, 3]."""
        length = math.hypot(*quaternion)
        if abs(length - 1.0) > _ROTATION_TOLERANCE:
            raise self.error("a quaternion of length 1", f"{list(quaternion)} of length {length:.6g}")
        return rotation_from_quaternion(np.array(quaternion))


def unread_note(file: Path, keys: Iterable[str]) -> tuple[str, ...]:
    """The note that names what of a file is not read; none where nothing is named."""
    text = unread_text(keys)
    return (f"{file}: {text}",) if text else ()


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether it is a finite number of a size that can mean something."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -1e9 < value < 1e9


def rigid_transform(rotation: np.ndarray, position_m: np.ndarray | Sequence[float], record: Record) -> np.ndarray:
    """The transform of a rotation [3, 3], made orthonormal of what rounding left, and a position [m]; [4, 4]."""
    rotation = np.asarray(rotation, dtype=np.float64)
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if error > _ROTATION_TOLERANCE:
        raise record.error("a rotation, whose columns are orthonormal", f"one that is off by {error:.2g}")
    if np.linalg.det(rotation) < 0.0:
        raise record.error("a rotation", "one with a mirror; is the file left-handed?")
    left, _, right = np.linalg.svd(rotation)
    transform = np.eye(4)
    transform[:3, :3] = rotation if error < 1e-12 else left @ right
    transform[:3, 3] = position_m
    return transform


def read_json_record(file: Path, kind: str, *, nodes_max: int = NODES_MAX) -> Record:
    """The data of a JSON file."""
    return Record(file, read_json(file, kind, nodes_max=nodes_max))


def read_yaml_record(file: Path) -> Record:
    """The data of a YAML file, with lines."""
    data, line_of = read_yaml(file)
    return Record(file, data, (), line_of)


READ_PX = 0.25
"""How far a lens that is read by a fit may be off anywhere in the image [px], unless the user takes more."""
_PIXEL_CENTRE_PX = 0.5
_SAME_PX = 1e-5  # rig files keep six decimals
_SAME_EXACTLY = 1e-9


@dataclass(frozen=True)
class Optics:
    """Image size and lens of a camera as stated in a file; None where not stated."""

    width_px: int | None = None
    height_px: int | None = None
    fov_rad: float | None = None
    focal_px: tuple[float, float] | None = None
    centre_px: tuple[float, float] | None = None
    lens: Lens = Lens.PINHOLE
    distortion: tuple[float, ...] = ()
    off_px: float = 0.0  # how far the lens is from that of the file, at most

    def model(self, location: str) -> CameraModel:
        """The camera model; square pixels around the middle are given by the field of view, as people write it."""
        assert self.width_px is not None
        assert self.height_px is not None
        for name, size in (("width_px", self.width_px), ("height_px", self.height_px)):
            if not 8 <= size <= MAX_IMAGE_PX:
                raise InputError(f"{location}: {name}: expected from 8 to {MAX_IMAGE_PX} pixels, got {size}")
        distortion = self.distortion if any(self.distortion) else ()
        lens = Lens.PINHOLE if self.lens is Lens.BROWN_CONRADY and not distortion else self.lens
        try:
            if self.focal_px is None:
                assert self.fov_rad is not None
                return CameraModel(self.width_px, self.height_px, self.fov_rad, lens=lens, distortion=distortion)
            model = CameraModel(
                self.width_px,
                self.height_px,
                lens=lens,
                focal_px=self.focal_px,
                centre_px=self.centre_px,
                distortion=distortion,
            )
            if is_plain(model, within=_SAME_EXACTLY):
                return CameraModel(self.width_px, self.height_px, model.fov_rad, lens=lens, distortion=distortion)
        except ValueError as error:
            raise InputError(f"{location}: expected valid camera parameters, got: {error}") from None
        return model


@dataclass(frozen=True)
class FoundCamera:
    """A camera in a file; ``file_from_camera`` [4, 4]: its frame made right-handed, x forward, y left, z up [m].

    A LiDAR has the model of its beams, or ``lacks_beams`` where the file does not hold them.
    """

    name: str
    file_from_camera: np.ndarray
    optics: Optics | CameraModel | None = None
    lacks_beams: bool = False


@dataclass(frozen=True)
class Found:
    """What a reader found."""

    cameras: tuple[FoundCamera, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlacedCamera:
    """A camera for a writer."""

    name: str
    file_from_camera: np.ndarray
    model: CameraModel


@dataclass
class Losses:
    """Properties of a rig that a format cannot represent: an error, unless the user allows dropping them."""

    format_name: str
    are_allowed: bool = False
    notes: list[str] = field(default_factory=list)

    def leave_out(self, camera_name: str, thing: str) -> None:
        """Drop a property."""
        if not self.are_allowed:
            raise InputError(
                f"camera {camera_name!r}: {self.format_name} cannot represent {thing}; `approximate` drops it"
            )
        self.notes.append(f"camera {camera_name!r}: {thing} is dropped")

    def unsupported(self, camera_name: str, thing: str) -> InputError:
        """The error for a property that cannot even be dropped."""
        return InputError(f"camera {camera_name!r}: {self.format_name} cannot represent {thing}; choose another format")


@dataclass(frozen=True)
class RigFormat:
    """A format of rig files.

    Attributes:
        files: Names of the files of a folder: one stands for the folder, and may be called otherwise; of several the
            folder is read and written as a whole. None where every camera has a file of its own.
        suffixes: How names of files end; the first one is written.
        read: Of a path, and of a part of it where ``parts`` says what that is.
        write: Of cameras, a path and `Losses`; of one camera and these losses where every camera has a file of its own.
            Returns what is to be written.
        holds_vehicle: Whether ``write`` takes ``vehicle`` too, a mesh or None.
        lidars: What ``write`` takes of LiDARs: ``"beams"``, or ``"frames"`` alone; None: nothing.
    """

    name: str
    frame: str
    origin: str
    is_ego_origin: bool
    files: tuple[str, ...]
    suffixes: tuple[str, ...]
    read: Callable[..., Found] | None
    write: Callable[..., Any] | None
    parts: str | None = None
    mirrored_hint: str = "is the file left-handed?"
    note: str = ""
    holds_vehicle: bool = False
    lidars: str | None = None

    def found(self, path: Path, part: str | None) -> Found:
        """What is in a file or folder."""
        assert self.read is not None
        path = path / self.files[0] if len(self.files) == 1 and path.is_dir() else path
        return self.read(path) if self.parts is None else self.read(path, part)

    def written(
        self, cameras: Sequence[PlacedCamera], target: Path, losses: Losses, vehicle: Mesh | None = None
    ) -> dict[Path, bytes]:
        """The files of cameras, and of the vehicle in the file's frame, for a target, and what is to be in them."""
        assert self.write is not None
        losses.notes += [self.note] if self.note else []
        for lidar in (each for each in cameras if each.model.lens_text == "lidar" and self.lidars != "beams"):
            losses.leave_out(lidar.name, "the beams of a LiDAR (its frame stays)" if self.lidars else "a LiDAR")
        radars = [each for each in cameras if each.model.beams and each.model.beams.radar]
        for radar in radars:
            losses.leave_out(radar.name, "a radar")
        cameras = [each for each in cameras if (self.lidars or not each.model.beams) and each not in radars]
        if not cameras:
            raise InputError(f"{self.name}: expected a camera, got LiDARs alone; choose another format")
        is_file = target.suffix.lower() in self.suffixes and not target.is_dir()
        if not self.files:
            if is_file and len(cameras) > 1:
                count = len(cameras)
                raise InputError(f"{target}: expected a folder for the files of {count} cameras, got a file's name")
            return {
                target if is_file else target / f"{camera.name}{self.suffixes[0]}": self.write(camera, losses)
                for camera in cameras
            }
        first, *others = self.files
        if others and is_file:
            names = " and ".join(self.files)
            raise InputError(f"{target}: {self.name}: expected a folder for {names}, got a file's name")
        more = {"vehicle": vehicle} if self.holds_vehicle else {}
        return self.write(cameras, target if is_file or others else target / first, losses, **more)


def transform_of_link(
    position_m: Sequence[float] | np.ndarray, *, yaw_rad: float, pitch_rad: float, roll_rad: float
) -> np.ndarray:
    """``file_from_camera`` of a camera whose link (x forward, y left, z up) lies so in the file's frame, [4, 4]."""
    transform = np.eye(4)
    transform[:3, :3] = rotation_from_yaw_pitch_roll(yaw_rad, pitch_rad, roll_rad) @ FLU_FROM_RDF
    transform[:3, 3] = position_m
    return transform


def link_of_transform(file_from_camera: np.ndarray) -> tuple[list[float], dict[str, float]]:
    """Position [m] and ``yaw_rad``, ``pitch_rad``, ``roll_rad`` of a camera's link; undoes `transform_of_link`."""
    angles = yaw_pitch_roll_from_rotation(file_from_camera[:3, :3] @ FLU_FROM_RDF.T)
    position_m = (file_from_camera[:3, 3] + 0.0).tolist()  # files need no -0.0
    return position_m, {
        name: angle + 0.0 for name, angle in zip(("yaw_rad", "pitch_rad", "roll_rad"), angles, strict=True)
    }


def is_plain(model: CameraModel, *, within: float = _SAME_PX) -> bool:
    """Whether pixels are square and the principal point is the image's middle, within so many pixels."""
    (fx, _, cx), (_, fy, cy), _ = model.intrinsics.tolist()
    return max(abs(fx - fy), abs(cx - 0.5 * model.width_px), abs(cy - 0.5 * model.height_px)) <= within


def camera_matrix(model: CameraModel) -> list[list[float]]:
    """Focal lengths and principal point as other tools write them, 3 x 3."""
    matrix = model.intrinsics.copy()
    matrix[:2, 2] -= _PIXEL_CENTRE_PX
    return matrix.tolist()


def optics_of_matrix(matrix: Record, **others: Any) -> Optics:  # noqa: ANN401
    """The optics of a 3 x 3 camera matrix as other tools write it; ``others`` as of `optics_of`."""
    (fx, skew, cx), (zero, fy, cy), last = matrix.matrix(3, 3)
    if abs(skew) > 1e-6 * abs(fx) or zero != 0.0 or last != [0.0, 0.0, 1.0]:
        raise matrix.error("a camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] without skew")
    return optics_of(matrix, fx, fy, cx, cy, **others)


def brown_conrady(coefficients: Record, *counts: int) -> list[float]:
    """Coefficients in OpenCV's order, as many as say something: 4, 5 or 8."""
    numbers = coefficients.numbers(*counts)
    if any(numbers[8:]):
        raise coefficients.error("at most 8 coefficients that are not 0; warpav has no thin prism or tilted sensor")
    return numbers[:8] if any(numbers[5:]) else numbers[:5]


def optics_of(
    at: Record,
    *intrinsics_px: float,
    lens: Lens = Lens.PINHOLE,
    distortion: Sequence[float] = (),
    width_px: int | None = None,
    height_px: int | None = None,
) -> Optics:
    """The optics of focal lengths ``fx, fy`` and a principal point ``cx, cy`` as other tools count it."""
    fx, fy, cx, cy = intrinsics_px
    if min(fx, fy) <= 0.0:
        raise at.error("positive focal lengths fx and fy")
    centre_px = (cx + _PIXEL_CENTRE_PX, cy + _PIXEL_CENTRE_PX)
    size = (width_px, height_px)
    return Optics(*size, focal_px=(fx, fy), centre_px=centre_px, lens=lens, distortion=tuple(distortion))


def pinhole_of(camera: PlacedCamera, losses: Losses, *, is_centred: bool = False) -> CameraModel:
    """The pinhole of a camera, for formats that hold nothing else."""
    model = camera.model
    if model.lens not in (Lens.PINHOLE, Lens.BROWN_CONRADY):
        raise losses.unsupported(camera.name, f"a {model.lens} lens")
    if any(model.distortion):
        losses.leave_out(camera.name, "the lens's distortion")
    (fx, _, cx), (_, fy, cy), _ = model.intrinsics.tolist()
    size = (model.width_px, model.height_px)
    if not is_centred:
        if not any(model.distortion):
            return model
        return CameraModel(*size, focal_px=(fx, fy), centre_px=(cx, cy))
    if abs(fx - fy) > _SAME_PX:
        losses.leave_out(camera.name, f"focal lengths that differ ({fx:g} and {fy:g} px; the first is kept)")
    if max(abs(cx - 0.5 * size[0]), abs(cy - 0.5 * size[1])) > _SAME_PX:
        losses.leave_out(camera.name, f"a principal point ({cx:g}, {cy:g} px) beside the image's middle")
    if model.focal_px is None and not any(model.distortion):
        return model
    return CameraModel(*size, 2.0 * math.atan(0.5 * size[0] / fx))


LEAST_RANGE_M = 0.1  # where a file says none
_SAME_RAD = 1e-7  # beams keep microdegrees


def lidar_model(
    location: str,
    *,
    elevation_rad: tuple[float, float],
    lines: int,
    step_rad: float,
    azimuth_rad: tuple[float, float],
    range_m: float,
    least_range_m: float = 0.0,
    rate_hz: float = 10.0,
) -> CameraModel:
    """The model of a LiDAR of evenly spread lines, of which a file holds the lowest and the highest."""
    right, left = azimuth_rad
    if left - right > 2.0 * math.pi - step_rad:  # whose last shot meets the first
        right, left = -math.pi, math.pi
    try:
        up_rad = np.linspace(*elevation_rad, min(lines, MAX_IMAGE_PX))
        beams = Beams(tuple(up_rad), step_rad, (right, left), (range_m, range_m), rate_hz=rate_hz)
        return CameraModel.of_beams(beams, least_range_m or LEAST_RANGE_M)
    except ValueError as error:
        raise InputError(f"{location}: expected the beams of a LiDAR, got: {error}") from None


def even_beams(camera: PlacedCamera, losses: Losses) -> Beams:
    """The beams of a LiDAR, for formats that hold evenly spread lines and one range alone."""
    beams = camera.model.beams
    assert beams is not None
    up_rad = np.array(beams.elevation_rad)
    if beams.weight is not None:
        losses.leave_out(camera.name, "the pattern of a LiDAR (as many shots on evenly spread lines stay)")
    elif np.abs(up_rad - np.linspace(up_rad[0], up_rad[-1], len(up_rad))).max() > _SAME_RAD:
        losses.leave_out(
            camera.name, "the uneven spread of a LiDAR's lines (the lowest, the highest, their number stay)"
        )
    near_m, far_m = beams.range_m
    if near_m < far_m:
        losses.leave_out(camera.name, f"a LiDAR's range at 80 % reflectivity ({far_m:g} m; {near_m:g} m stay)")
    return beams
