"""What every format of rig files is made of: what its reader finds, what its writer gets, and words about its frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll, yaw_pitch_roll_from_rotation
from warpav.raster.camera import CameraModel
from warpav.rig.formats.optics import Optics


@dataclass(frozen=True)
class FoundCamera:
    """A camera in a file.

    Attributes:
        name: As the file calls it.
        file_from_camera: From camera coordinates (x right, y down, z forward) to the file's frame, made right-handed
            with x forward, y left, z up [m], shape [4, 4].
        optics: Image size and lens stated in the file; None: not stated.
    """

    name: str
    file_from_camera: np.ndarray
    optics: Optics | None = None


@dataclass(frozen=True)
class Found:
    """What a reader found.

    Attributes:
        cameras: At least one.
        notes: What the user should know of the reading, one sentence each.
    """

    cameras: tuple[FoundCamera, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlacedCamera:
    """A camera for a writer.

    Attributes:
        name: Its name in the rig.
        file_from_camera: As in `FoundCamera`.
        model: Image size and lens.
    """

    name: str
    file_from_camera: np.ndarray
    model: CameraModel


@dataclass
class Losses:
    """Properties of a rig that a format cannot represent: an error, unless the user allows dropping them.

    Attributes:
        format_name: The format.
        are_allowed: Whether properties may be dropped.
        notes: What was dropped, one sentence per camera and property.
    """

    format_name: str
    are_allowed: bool = False
    notes: list[str] = field(default_factory=list)

    def leave_out(self, camera_name: str, thing: str) -> None:
        """Drop a property.

        Raises:
            InputError: Dropping is not allowed.
        """
        if not self.are_allowed:
            raise InputError(
                f"camera {camera_name!r}: {self.format_name} cannot represent {thing}; --approximate drops it"
            )
        self.notes.append(f"camera {camera_name!r}: {thing} is dropped")

    def unsupported(self, camera_name: str, thing: str) -> InputError:
        """The error for a property that cannot even be dropped."""
        return InputError(f"camera {camera_name!r}: {self.format_name} cannot represent {thing}; choose another format")


Reader = Callable[[Path, str | None], Found]
"""Reads a file or folder; the text picks a part of it (`RigFormat.parts`)."""

Writer = Callable[[Sequence[PlacedCamera], Path, Losses], dict[Path, bytes]]
"""Returns the files and their content for the target; writes nothing itself."""


@dataclass(frozen=True)
class RigFormat:
    """A format of rig files.

    Attributes:
        name: As the user names it.
        frame: Axes, handedness and units, in words.
        origin: Origin of the frame, in words.
        is_ego_origin: Whether it is warpav's: on the ground below the centre of the rear axle.
        read: None where the format cannot be imported.
        write: None where it cannot be exported.
        parts: What `--part` picks of a file that holds several rigs; None: nothing.
        mirrored_hint: What to try when left and right seem swapped.
    """

    name: str
    frame: str
    origin: str
    is_ego_origin: bool
    read: Reader | None
    write: Writer | None
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
    """The file of every camera: in the folder ``target``, or ``target`` itself if there is only one camera.

    Raises:
        InputError: The target is one file, but there are several cameras.
    """
    if target.suffix.lower() in suffixes and not target.is_dir():
        if len(cameras) > 1:
            raise InputError(f"{target}: expected a folder for the files of {len(cameras)} cameras, got a file's name")
        return [target]
    return [target / f"{camera.name}{suffixes[0]}" for camera in cameras]
