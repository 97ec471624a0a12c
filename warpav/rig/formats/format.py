"""What every format of rig files is made of: what its reader finds, what its writer gets, and words about its frame.

Principal points in other tools' files count from the centre of the upper left pixel, as OpenCV does; warpav counts from
the image's corner. `_PIXEL_CENTRE_PX` is the difference, and is added and taken away here only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll, yaw_pitch_roll_from_rotation
from warpav.raster.camera import MAX_IMAGE_PX, CameraModel
from warpav.raster.lens import Lens

if TYPE_CHECKING:
    from warpav.rig.formats.record import Record

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

    def model(self, location: str) -> CameraModel:
        """The camera model; the size and the lens must be there.

        A lens with square pixels around the middle is given by its field of view, which is how people write it.
        """
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
    """A camera in a file.

    Attributes:
        file_from_camera: From camera coordinates (x right, y down, z forward) to the file's frame, made right-handed
            with x forward, y left, z up [m], shape [4, 4].
    """

    name: str
    file_from_camera: np.ndarray
    optics: Optics | None = None


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


_Reader = Callable[[Path, str | None], Found]
"""Reads a file or folder; the text picks a part of it (`RigFormat.parts`)."""

_Writer = Callable[[Sequence[PlacedCamera], Path, Losses], dict[Path, bytes]]
"""Returns the files and their content for the target; writes nothing itself."""


@dataclass(frozen=True)
class RigFormat:
    """A format of rig files."""

    name: str
    frame: str
    origin: str
    is_ego_origin: bool
    read: _Reader | None
    write: _Writer | None
    parts: str | None = None
    mirrored_hint: str = "is the file left-handed?"


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


def file_at(target: Path, suffixes: Sequence[str], name: str) -> Path:
    """The one file to write: the target itself where it ends in one of the suffixes, else ``name`` in that folder."""
    return target if target.suffix.lower() in suffixes and not target.is_dir() else target / name


def file_in(path: Path, name: str) -> Path:
    """The one file to read: the path itself, or ``name`` in it where it is a folder."""
    return path / name if path.is_dir() else path


def file_for_each(cameras: Sequence[PlacedCamera], target: Path, suffixes: Sequence[str]) -> list[Path]:
    """The file of every camera: in the folder ``target``, or ``target`` itself if there is only one camera."""
    if target.suffix.lower() in suffixes and not target.is_dir():
        if len(cameras) > 1:
            raise InputError(f"{target}: expected a folder for the files of {len(cameras)} cameras, got a file's name")
        return [target]
    return [target / f"{camera.name}{suffixes[0]}" for camera in cameras]


def is_plain(model: CameraModel, *, within: float = _SAME_PX) -> bool:
    """Whether pixels are square and the principal point is the image's middle, within so many pixels."""
    (fx, _, cx), (_, fy, cy), _ = model.intrinsics.tolist()
    return max(abs(fx - fy), abs(cx - 0.5 * model.width_px), abs(cy - 0.5 * model.height_px)) <= within


def camera_matrix(model: CameraModel) -> list[list[float]]:
    """Focal lengths and principal point as other tools write them, 3 x 3."""
    matrix = model.intrinsics.copy()
    matrix[:2, 2] -= _PIXEL_CENTRE_PX
    return matrix.tolist()


def optics_of_matrix(
    matrix: Record,
    *,
    lens: Lens = Lens.PINHOLE,
    distortion: Sequence[float] = (),
    width_px: int | None = None,
    height_px: int | None = None,
) -> Optics:
    """The optics of a 3 x 3 camera matrix as other tools write it."""
    (fx, skew, cx), (zero, fy, cy), last = matrix.matrix(3, 3)
    if abs(skew) > 1e-6 * abs(fx) or zero != 0.0 or last != [0.0, 0.0, 1.0]:
        raise matrix.error("a camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] without skew")
    if min(fx, fy) <= 0.0:
        raise matrix.error("positive focal lengths fx and fy")
    return Optics(
        width_px,
        height_px,
        focal_px=(fx, fy),
        centre_px=(cx + _PIXEL_CENTRE_PX, cy + _PIXEL_CENTRE_PX),
        lens=lens,
        distortion=tuple(distortion),
    )


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
