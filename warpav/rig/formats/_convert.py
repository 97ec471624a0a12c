"""Import and export of rigs: selects the format, transforms its frame, completes lenses, checks sides.

One transform, ``ego_from_file``, gives the position of the file's origin in warpav's ego frame (on the ground below the
centre of the rear axle) and the rotation of its axes. Imports and exports of all formats use it.
"""

from __future__ import annotations

import importlib
import logging
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.core.files import atomic_write, writing
from warpav.core.frames import rotation_from_yaw_pitch_roll
from warpav.core.records import nearest
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig._catalogue import builtin_modules
from warpav.rig._check import FAR_M, folded_lenses, mirrored_cameras
from warpav.rig._module import Module
from warpav.rig._rig import Rig, RigCamera
from warpav.rig.formats import IMPORTED_ONLY, RIG_FORMATS
from warpav.rig.formats._format import READ_PX, FoundCamera, Losses, Optics, PlacedCamera, RigFormat
from warpav.rig.formats._ros import FOLDER, read_camera_infos

_OTHER_NAMES = {
    "av2": "argoverse2",
    "argoverse-2": "argoverse2",
    "ros2-urdf": "urdf",
    "carla-leaderboard": "carla-python",
    "kitti-object": "kitti",
}
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_logger = logging.getLogger(__name__)
_UNFIT = re.compile(r"[^A-Za-z0-9_.-]+")


@dataclass(frozen=True)
class ImportOptions:
    """Information that a file lacks."""

    origin_m: tuple[float, float, float] | None = None
    origin_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    width_px: int | None = None
    height_px: int | None = None
    fov_deg: float | None = None
    intrinsics: Path | None = None
    part: str | None = None
    accept_mirrored: bool = False
    mirror_y: bool = False
    approximate: bool = False
    lidar: str | None = None


@dataclass(frozen=True)
class _ExportOptions:
    """Where the file's origin lies, and what may be lost; see `export_rig`."""

    origin_m: tuple[float, float, float] | None = None
    origin_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    approximate: bool = False
    overwrite: bool = False
    vehicle: Mesh | None = None


def find_format(name: str) -> RigFormat:
    plain = name.strip().lower().replace("_", "-")
    plain = _OTHER_NAMES.get(plain, plain)
    if plain == "carla":
        raise ArgumentError(
            "format_name",
            "expected carla-ros-bridge (objects.json: y left, pitch nose down) or "
            "carla-python (sensors of an agent: left-handed, y right, pitch nose up), got carla, which may be either",
        )
    if plain not in RIG_FORMATS:
        hint = nearest(plain, [*RIG_FORMATS, *_OTHER_NAMES])
        raise ArgumentError("format_name", f"expected one of {', '.join(RIG_FORMATS)}, got {name!r}{hint}")
    module = importlib.import_module(f"warpav.rig.formats.{RIG_FORMATS[plain]}")
    return next(form for form in module.FORMATS if form.name == plain)


def import_rig(
    path: str | Path,
    format_name: str,
    *,
    origin_m: tuple[float, float, float] | None = None,
    origin_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    width_px: int | None = None,
    height_px: int | None = None,
    fov_deg: float | None = None,
    intrinsics: str | Path | None = None,
    part: str | None = None,
    accept_mirrored: bool = False,
    mirror_y: bool = False,
    approximate: bool = False,
    lidar: str | None = None,
) -> Rig:
    """The rig in another tool's file, in the ego frame.

    Args:
        path: File or folder.
        format_name: One of `RIG_FORMATS`, such as ``"urdf"``.
        origin_m: Where the file's origin lies in the ego frame [m]; None: where the ego frame's does.
        origin_rpy_deg: Roll, pitch and yaw of the file's axes in the ego frame [deg], about fixed axes.
        width_px: Image width [px] of cameras without one.
        height_px: Image height [px] of cameras without one.
        fov_deg: Horizontal field of view [deg] of cameras without a lens.
        intrinsics: camera_info YAML, or a folder of such: it replaces the file's values of those cameras.
        part: Which of several rigs in the file.
        accept_mirrored: Accept cameras whose name contradicts their side or direction.
        mirror_y: The file's y points to the right, and its angles about x and z are turned the other way round.
        approximate: Take a lens that warpav's nearest one is off by more than a quarter of a pixel.
        lidar: Module of the shipped catalogue for LiDARs whose beams the file does not hold; None: they are not read.

    What of a file is not read is logged as a warning.

    Raises:
        InputError: The file cannot be used.
    """
    options = ImportOptions(
        origin_m,
        origin_rpy_deg,
        width_px,
        height_px,
        fov_deg,
        None if intrinsics is None else Path(intrinsics),
        part,
        accept_mirrored,
        mirror_y,
        approximate,
        lidar,
    )
    rig, notes = import_rig_with_notes(path, format_name, options)
    for note in notes[1:]:
        _logger.warning("%s", note)
    return rig


def import_rig_with_notes(
    path: str | Path, format_name: str, options: ImportOptions | None = None
) -> tuple[Rig, list[str]]:
    """The rig in another tool's file."""
    options = options or ImportOptions()
    file = Path(path).expanduser()
    form = find_format(format_name)
    if form.read is None and form.files:
        raise ArgumentError("format_name", f"{form.name} is for export only; import the rig of which it was made")
    if form.read is None:
        raise InputError(
            f"{file}: {form.name}: expected a format with camera poses, got one without; import the file that has "
            f"them, such as `format_name` urdf or autoware, with `intrinsics` {file}"
        )
    if not file.exists():
        raise InputError(f"{file}: expected a file or folder of the format {form.name}, got no such file")
    if options.part is not None and form.parts is None:
        raise ArgumentError("part", f"{form.name} files hold one rig, got {options.part!r}; leave it out")
    ego_from_file = _placement(options.origin_m, options.origin_rpy_deg)
    found = form.found(file, options.part)
    lenses, lens_notes = _lenses(file, options)
    lidar = _lidar_module(options.lidar)
    bare = [each.name for each in found.cameras if each.lacks_beams]
    read = [each for each in found.cameras if lidar or not each.lacks_beams]
    if not read:
        names = ", ".join(bare)
        raise InputError(f"{file}: expected cameras, got LiDARs without beams, {names}; `lidar` MODULE gives them some")
    if lidar and not bare:
        raise ArgumentError("lidar", f"expected a file with LiDARs that lack beams, got none in {file}; leave it out")
    models = [
        lidar.camera_model() if lidar and each.lacks_beams else _model(each, lenses, options, file) for each in read
    ]
    # of a mirrored camera the image's x turns round as well
    before, behind = (_MIRROR, np.diag([-1.0, 1.0, 1.0, 1.0])) if options.mirror_y else (np.eye(4), np.eye(4))
    try:
        cameras = [
            RigCamera.at(_fit_name(camera.name), ego_from_file @ before @ camera.file_from_camera @ behind, model)
            for camera, model in zip(read, models, strict=True)
        ]
        rig = Rig(
            replace(camera, module=lidar.name, housing=lidar.housing) if lidar and each.lacks_beams else camera
            for camera, each in zip(cameras, read, strict=True)
        )
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    cameras = rig.cameras
    for camera in cameras:
        if np.linalg.norm(camera.position_m) > FAR_M:
            position = ", ".join(f"{value:g}" for value in camera.position_m)
            raise InputError(
                f"{file}: camera {camera.name!r}: expected a position within {FAR_M:g} m of the rear axle, got "
                f"[{position}]; are these millimetres, or world coordinates?"
            )
    mirrored = [] if options.accept_mirrored else list(mirrored_cameras(cameras))
    if mirrored:
        more = f" ({len(mirrored)} cameras like this)" if len(mirrored) > 1 else ""
        raise InputError(
            f"{file}: {mirrored[0]}{more}; {form.mirrored_hint} `mirror_y` turns it round, "
            "`accept_mirrored` takes it as it is"
        )
    count = f"{len(cameras)} camera{'s' if len(cameras) > 1 else ''}"
    lidar_count = sum(camera.model.beams is not None for camera in cameras)
    count += f" ({lidar_count} of them LiDARs)" if lidar_count else ""
    notes = [f"{file}: read {count} as {form.name}: {form.frame}", *found.notes, *lens_notes, *folded_lenses(cameras)]
    if bare:
        how = f"read with those of {lidar.name}" if lidar else "not read; `lidar` MODULE gives them those of a module"
        notes.append(f"{', '.join(bare)}: LiDARs whose beams the file does not hold, {how}")
    renamed = [camera.name for camera in read if camera.name != _fit_name(camera.name)]
    if renamed:
        notes.append(f"names keep letters, digits, '_', '-' and '.': {renamed[0]!r} becomes {_fit_name(renamed[0])!r}")
    notes += _origin_notes(form, options.origin_m)
    return rig, notes


def export_rig(
    rig: Rig,
    format_name: str,
    target: str | Path,
    *,
    origin_m: tuple[float, float, float] | None = None,
    origin_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    approximate: bool = False,
    overwrite: bool = False,
    vehicle: Mesh | None = None,
) -> list[Path]:
    """Write a rig for another tool, and return the files.

    Args:
        rig: The cameras.
        format_name: One of `RIG_FORMATS`, such as ``"autoware"``.
        target: File or folder, as the format has it; folders are made.
        origin_m: Where the file's origin lies in the ego frame [m]; None: where the ego frame's does.
        origin_rpy_deg: Roll, pitch and yaw of the file's axes in the ego frame [deg], about fixed axes.
        approximate: Drop what the format cannot represent instead of raising an error.
        overwrite: Replace existing files.
        vehicle: What carries the rig, in the ego frame, to be in the file as well, where the format holds one (usd).

    Raises:
        InputError: The format cannot represent the rig, a file exists already, or cannot be written.
    """
    place = {"origin_m": origin_m, "origin_rpy_deg": origin_rpy_deg}
    others = {"approximate": approximate, "overwrite": overwrite, "vehicle": vehicle}
    return export_rig_with_notes(rig, format_name, target, **place, **others)[0]


def export_rig_with_notes(
    rig: Rig,
    format_name: str,
    target: str | Path,
    **keywords: Any,  # noqa: ANN401
) -> tuple[list[Path], list[str]]:
    """Write a rig for another tool; ``keywords`` are those of `export_rig`."""
    options = _ExportOptions(**keywords)
    form = find_format(format_name)
    losses = Losses(form.name, options.approximate)
    files = _content_of(rig, form, Path(target).expanduser(), losses, options)
    for file in files:
        check_target(file, overwrite=options.overwrite)
    for file, content in files.items():
        with writing(file):
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(file) as draft:
                draft.write_bytes(content)
    return list(files), [f"frame: {form.frame}", *losses.notes, *_origin_notes(form, options.origin_m)]


def check_target(file: Path, *, overwrite: bool) -> None:
    if file.is_dir():
        raise InputError(f"{file}: expected a file to write, got a folder; name a file in it")
    if file.exists() and not overwrite:
        raise InputError(f"{file}: expected a file that does not exist yet, got one that does; `overwrite` replaces it")
    for folder in file.parents:
        if folder.is_file():
            raise InputError(f"{folder}: expected a folder to write to, got a file; choose another path")


def _content_of(rig: Rig, form: RigFormat, target: Path, losses: Losses, options: _ExportOptions) -> dict[Path, bytes]:
    """The files that hold a rig, unwritten."""
    if form.write is None:
        names = ", ".join(name for name in RIG_FORMATS if name not in IMPORTED_ONLY)
        raise ArgumentError("format_name", f"expected one of {names}; {form.name} is for import only")
    file_from_ego = np.linalg.inv(_placement(options.origin_m, options.origin_rpy_deg))
    placed = [PlacedCamera(camera.name, file_from_ego @ camera.ego_from_camera, camera.model) for camera in rig.cameras]
    if options.vehicle is None:
        return form.written(placed, target, losses)
    if not form.holds_vehicle:
        raise ArgumentError("with_vehicle", f"expected the format usd, {form.name} holds cameras alone; leave it out")
    vehicle = options.vehicle.transformed(file_from_ego[:3, :3], file_from_ego[:3, 3])
    return form.written(placed, target, losses, vehicle)


def formats_for(rig: Rig) -> tuple[list[str], dict[str, str]]:
    """The formats that can be exported and hold a rig without loss, and why the others do not."""
    fit, unfit = [], {}
    for name in (name for name in RIG_FORMATS if name not in IMPORTED_ONLY):
        try:
            _content_of(rig, find_format(name), Path("rig"), Losses(name), _ExportOptions())
            fit.append(name)
        except InputError as error:
            unfit[name] = str(error).removeprefix(f"{name}: ")
    return fit, unfit


def _placement(origin_m: tuple[float, float, float] | None, origin_rpy_deg: tuple[float, float, float]) -> np.ndarray:
    """The transform from a file's coordinates to the ego frame, [4, 4]."""
    for name, numbers in (("origin_m", origin_m or ()), ("origin_rpy_deg", origin_rpy_deg)):
        if not all(map(math.isfinite, numbers)):
            raise ArgumentError(name, f"expected three finite numbers, got {numbers}")
    roll, pitch, yaw = map(math.radians, origin_rpy_deg)
    transform = np.eye(4)
    transform[:3, :3] = rotation_from_yaw_pitch_roll(yaw, pitch, roll)
    transform[:3, 3] = origin_m or (0.0, 0.0, 0.0)
    return transform


def _origin_notes(form: RigFormat, origin_m: tuple[float, float, float] | None) -> list[str]:
    if origin_m is not None:
        x, y, z = origin_m
        return [
            f"origin: {form.origin}; it lies at ({x:g}, {y:g}, {z:g}) m from the ground below the centre of the rear "
            "axle"
        ]
    if form.is_ego_origin:
        return []
    return [
        f"warning: the file's origin is {form.origin}; without `origin_m` X Y Z, which gives its position, it is "
        "assumed to be warpav's, on the ground below the centre of the rear axle"
    ]


def _lenses(file: Path, options: ImportOptions) -> tuple[dict[str, Optics], list[str]]:
    """The optics that come from camera_info files, by name of the camera, and what is not read of them."""
    beside = (file if file.is_dir() else file.parent) / FOLDER
    path = options.intrinsics or (beside if beside.is_dir() else None)
    if path is None:
        return {}, []
    found, notes = read_camera_infos(path.expanduser())
    return {_key(name): optics for name, optics in found.items()}, notes


def _lidar_module(name: str | None) -> Module | None:
    modules = {each.name: each for each in builtin_modules().values() if each.beams and not each.beams.radar}
    if name is not None and name not in modules:
        raise ArgumentError("lidar", f"expected one of {', '.join(modules)}, got {name!r}{nearest(name, modules)}")
    return None if name is None else modules[name]


def _model(camera: FoundCamera, lenses: dict[str, Optics], options: ImportOptions, file: Path) -> CameraModel:
    if isinstance(camera.optics, CameraModel):
        beams = camera.optics.beams
        if beams is None or not options.mirror_y:
            return camera.optics
        right_rad, left_rad = beams.azimuth_rad
        return CameraModel.of_beams(replace(beams, azimuth_rad=(-left_rad, -right_rad)), camera.optics.near_m)
    location = f"{file}: camera {camera.name!r}"
    optics = lenses.get(_key(camera.name)) or camera.optics
    if optics is None:
        if None in (options.width_px, options.height_px, options.fov_deg):
            raise InputError(
                f"{location}: expected its image and lens, which the file does not hold; give `width_px`, `height_px` "
                "and `fov_deg`, or `intrinsics` with camera_info YAML files"
            )
        assert options.fov_deg is not None
        if not 0.0 < options.fov_deg < 180.0:
            raise ArgumentError("fov_deg", f"expected a number of degrees between 0 and 180, got {options.fov_deg}")
        optics = Optics(options.width_px, options.height_px, fov_rad=math.radians(options.fov_deg))
    if optics.width_px is None or optics.height_px is None:
        if options.width_px is None or options.height_px is None:
            raise InputError(
                f"{location}: expected the image's size, which the file does not hold; give `width_px` and `height_px`"
            )
        optics = replace(optics, width_px=options.width_px, height_px=options.height_px)
    if optics.off_px >= READ_PX and not options.approximate:
        raise InputError(
            f"{location}: expected a lens that one of warpav's comes within {READ_PX:g} px of, got one that it is off "
            f"by {optics.off_px:.2g} px; `approximate` takes it"
        )
    return optics.model(location)


def _key(name: str) -> str:
    return _fit_name(name).casefold()


def _fit_name(name: str) -> str:
    fit = _UNFIT.sub("_", name).strip("_") or "camera"
    return fit if fit[0].isalnum() else f"_{fit}"
