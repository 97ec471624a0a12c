"""Rigs: named cameras at fixed poses on the vehicle, and their YAML file."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from warpav.core.errors import InputError
from warpav.core.files import write_text
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll, yaw_pitch_roll_from_rotation
from warpav.core.records import LEFT_OUT, Form, Name, Number, Point2, Point3, Positive, nearest, read_form
from warpav.core.section import mistake, shown
from warpav.core.table import Table, aligned, data_frame
from warpav.core.yaml_file import read_yaml, yaml_lines, yaml_name, yaml_number, yaml_row
from warpav.raster.beams import Beams
from warpav.raster.camera import MAX_IMAGE_PX, CameraModel
from warpav.raster.lens import Lens, LensShape
from warpav.raster.pane import Pane
from warpav.rig._catalogue import BeamsForm, RadarForm, RangesForm, builtin_modules, read_modules
from warpav.rig._module import PLAIN_HOUSING, Housing

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingImports]

    from warpav.rig._module import Module

    MultiBlock = Any

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")  # camera names become file names
_NAME_TEXT = "a name of letters, digits, '_', '-' and '.', such as front_left"
_QUICK_MODEL = CameraModel(256, 256, fov_rad=math.pi / 2)
_DECIMALS = 6  # micrometres and microdegrees: below what any mount holds


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera on the vehicle.

    Attributes:
        name: Short name, unique within a rig; letters, digits, ``_``, ``-`` and ``.``.
        position_m: Centre of projection in the ego frame [m], float64, shape [3].
        yaw_rad: Turn to the left about z [rad].
        pitch_rad: Nose down [rad].
        roll_rad: Right side down [rad].
        model: Image size and lens; by default a pinhole of 256 x 256 px and 90 degrees. One with ``beams`` is a LiDAR.
        module: Name of the camera module that it is, if it is one of a catalogue; the model is that of the network's
            image then.
        behind_glass: The pane of the own vehicle that it looks through from inside; what of the body belongs to it is
            clear for this camera and for nobody else. None: the whole body is opaque.
        housing: Its box, which other cameras see.

    Raises:
        InputError: A name is unfit, or a number is not finite.
    """

    name: str
    position_m: np.ndarray
    yaw_rad: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    model: CameraModel = _QUICK_MODEL
    module: str | None = None
    behind_glass: Pane | None = None
    housing: Housing = PLAIN_HOUSING

    def __post_init__(self) -> None:
        location = f"camera {self.name!r}"
        if self.module is not None and not (isinstance(self.module, str) and _NAME.fullmatch(self.module)):
            raise InputError(f"{location}: module: expected {_NAME_TEXT}, got {self.module!r}")
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name):
            raise InputError(f"{location}: name: expected {_NAME_TEXT}, got {self.name!r}")
        position_m = np.array(self.position_m, dtype=np.float64)
        if position_m.shape != (3,) or not np.isfinite(position_m).all():
            raise InputError(f"{location}: position_m: expected three finite numbers, got {self.position_m!r}")
        object.__setattr__(self, "position_m", position_m)
        for field in ("yaw_rad", "pitch_rad", "roll_rad"):
            angle_rad = float(getattr(self, field))
            if not math.isfinite(angle_rad):
                raise InputError(f"{location}: {field}: expected a finite number, got {angle_rad!r}")
            object.__setattr__(self, field, angle_rad)

    @classmethod
    def at(cls, name: str, ego_from_camera: np.ndarray, model: CameraModel) -> RigCamera:
        """The camera of a transform; the inverse of `ego_from_camera`.

        Args:
            name: Short name.
            ego_from_camera: The transform from camera to ego coordinates, shape [4, 4] or [3, 4].
            model: Image size and lens.
        """
        angles = yaw_pitch_roll_from_rotation(ego_from_camera[:3, :3] @ FLU_FROM_RDF.T)
        return cls(name, np.array(ego_from_camera[:3, 3], dtype=np.float64), *angles, model)

    @property
    def ego_from_camera(self) -> np.ndarray:
        """The transform from camera to ego coordinates, float64, shape [4, 4]."""
        transform = np.eye(4)
        transform[:3, :3] = rotation_from_yaw_pitch_roll(self.yaw_rad, self.pitch_rad, self.roll_rad) @ FLU_FROM_RDF
        transform[:3, 3] = self.position_m
        return transform


@dataclass(frozen=True, repr=False, init=False)
class Rig:
    """The cameras of a vehicle.

    Attributes:
        cameras: At least one, in a fixed order, with unique names; kept as a tuple.

    Raises:
        InputError: There is no camera, or a name is there twice.
        TypeError: Something is no camera.
    """

    cameras: tuple[RigCamera, ...]

    def __init__(self, cameras: Iterable[RigCamera]) -> None:
        """A rig of these cameras, in this order."""
        object.__setattr__(self, "cameras", tuple(cameras))
        if not self.cameras:
            raise InputError("rig: expected at least one camera, got none")
        first_of: dict[str, int] = {}
        for i, camera in enumerate(self.cameras):
            if not isinstance(camera, RigCamera):
                raise TypeError(f"cameras: expected cameras of a rig, got {type(camera).__name__}")
            # File systems that ignore case would lose one of two images.
            first = first_of.setdefault(camera.name.casefold(), i)
            if first != i:
                raise InputError(
                    f"rig: cameras[{i}].name: expected every name once, got {camera.name!r} again "
                    f"(first as cameras[{first}])"
                )
        self.panes  # noqa: B018 (says whether they can be told apart by name)

    @property
    def is_lidar(self) -> list[bool]:
        """Which of the cameras have beams."""
        return [camera.model.beams is not None for camera in self.cameras]

    @property
    def panes(self) -> dict[str, Pane]:
        """What its cameras look through, by name.

        Raises:
            InputError: Two different ones have one name.
        """
        found: dict[str, Pane] = {}
        for camera in self.cameras:
            pane = camera.behind_glass
            if pane is not None and found.setdefault(pane.name, pane) != pane:
                raise InputError(
                    f"rig: camera {camera.name!r}: behind_glass: expected one pane called {pane.name!r}, got two that "
                    "differ; rename one of their zones"
                )
        return found

    def __repr__(self) -> str:
        return f"Rig({', '.join(camera.name for camera in self.cameras)})"

    @property
    def _table(self) -> Table:
        columns = ("camera", *_TABLE_COLUMNS, *(("module",) if any(each.module for each in self.cameras) else ()))
        rows = tuple((camera.name, *_table_row(camera))[: len(columns)] for camera in self.cameras)
        count = f"{len(self.cameras)} camera{'' if len(self.cameras) == 1 else 's'}"
        return Table(columns, rows, f"Rig of {count}, ego frame: x forward, y left, z up")

    def __str__(self) -> str:
        return "\n".join(aligned([self._table.columns, *self._table.rows]))

    def _repr_html_(self) -> str:
        return self._table._repr_html_()

    def plot(self, out: str | Path | None = None, **options: Any) -> Any:  # noqa: ANN401
        """Show the rig in a window or a notebook, or write its image to a file; see `warpav.view.plot`."""
        from warpav.view import plot

        return plot(self, out=out, **options)

    def to_pyvista(self, *, depth_m: float = 1.25) -> MultiBlock:
        """The rig as ``pyvista.MultiBlock``: for every camera ``body``, ``frustum`` and ``axis``.

        See `warpav.view._blocks.rig_to_pyvista`.

        Args:
            depth_m: How far frustums and axes reach [m].
        """
        from warpav.view import rig_to_pyvista

        return rig_to_pyvista(self, depth_m=depth_m)

    def to_pandas(self) -> pandas.DataFrame:
        """The cameras as a table of pandas, by name: positions in the ego frame [m], angles [deg], image [px], lens.

        ``fov_deg`` is horizontal; ``module`` is None where a camera is none of a catalogue.

        Raises:
            ImportError: pandas is not installed.
        """
        rows = {}
        for camera in self.cameras:
            place = zip(("x_m", "y_m", "z_m"), camera.position_m.tolist(), strict=True)
            angles = {"yaw": camera.yaw_rad, "pitch": camera.pitch_rad, "roll": camera.roll_rad}
            angles |= {"fov": camera.model.fov_rad}
            rows[camera.name] = {
                **dict(place),
                **{f"{name}_deg": math.degrees(angle_rad) for name, angle_rad in angles.items()},
                "width_px": camera.model.width_px,
                "height_px": camera.model.height_px,
                "lens": str(camera.model.lens),
                "module": camera.module,
            }
        return data_frame(rows)


_TABLE_COLUMNS = ("x [m]", "y [m]", "z [m]", "yaw [°]", "pitch [°]", "roll [°]")
_TABLE_COLUMNS += ("field of view [°]", "image [px]", "lens")


def _table_row(camera: RigCamera) -> list[str]:
    """What a table says of a camera in `_TABLE_COLUMNS`, and its module."""
    model = camera.model
    position = [f"{value:.3f}" for value in camera.position_m]
    angles = [f"{math.degrees(angle):.1f}" for angle in (camera.yaw_rad, camera.pitch_rad, camera.roll_rad)]
    image = model.size_text, model.lens_text
    return [*position, *angles, f"{math.degrees(model.fov_rad):.1f}", *image, camera.module or "-"]


_POSITION_TEXT = "three finite numbers in metres [x forward, y left, z up], such as [1.2, 0.0, 1.7]"
_ANGLE_TEXT = "a finite number in degrees, such as 90.0"
_FOV_TEXT = "a number of degrees between 0 and 180, up to 360 for a fisheye or a panorama, such as 90.0"
_SIZE_TEXT = f"a whole number of pixels from 8 to {MAX_IMAGE_PX}, such as 256"
_IMAGE = ("fov_deg", "width_px", "height_px")
"""What a camera need not say that is a module of the catalogue."""

_Size = Annotated[int, Field(ge=8, le=MAX_IMAGE_PX, description=_SIZE_TEXT)]


def _any_of_images(schema: dict[str, Any]) -> None:
    schema["anyOf"] = [
        {"required": ["module"], "properties": dict.fromkeys((*_IMAGE, "focal_px"), False)},
        {"required": list(_IMAGE)},
        {"required": ["beams"]},
        {"required": ["radar"]},
        {"required": ["focal_px", "width_px", "height_px"]},
    ]


class _CameraForm(Form, json_schema_extra=_any_of_images):
    """A camera in a file."""

    name: Name = Field(description=_NAME_TEXT)
    position_m: Point3 = Field(description=_POSITION_TEXT)
    yaw_deg: Number = Field(description=f"{_ANGLE_TEXT}, left positive")
    pitch_deg: Number = Field(description=f"{_ANGLE_TEXT}, nose down positive")
    roll_deg: Number = Field(description=f"{_ANGLE_TEXT}, right side down positive")
    fov_deg: Annotated[float, Field(gt=0.0, le=360.0)] = Field(LEFT_OUT, description=_FOV_TEXT)
    width_px: _Size = LEFT_OUT
    height_px: _Size = LEFT_OUT
    lens: Lens = Field(Lens.PINHOLE, strict=False)
    focal_px: Annotated[list[Positive], Field(min_length=2, max_length=2)] = Field(
        LEFT_OUT, description="two positive numbers of pixels [fx, fy], such as [640.0, 640.0]"
    )
    centre_px: Point2 = Field(
        LEFT_OUT,
        description="two finite numbers of pixels [cx, cy] from the image's upper left corner, such as [320.0, 240.0]",
    )
    distortion: list[Number] = Field(
        [], description="a list of finite numbers in OpenCV's order, such as [-0.31, 0.11, 0.0, 0.0]"
    )
    beams: BeamsForm = Field(LEFT_OUT, description="the beams of a LiDAR, a mapping, instead of an image")
    radar: RadarForm = Field(LEFT_OUT, description="what a radar sees, a mapping, instead of an image")
    module: Name = Field(LEFT_OUT, description="the name of a camera module, such as side_2mp_100")
    behind_glass: Name = Field(LEFT_OUT, description="the name of one of the file's panes, such as windscreen")

    @model_validator(mode="after")
    def _has_an_image(self) -> _CameraForm:
        given = self.model_fields_set
        if own := [name for name in ("beams", "radar") if name in given]:
            others = {*_IMAGE, "focal_px", "centre_px", "lens", "distortion", "behind_glass", *own[1:]}
            strange = sorted(given & others)
            if strange:
                mistake(f"expected no {strange[0]} beside {own[0]}; remove one of them", strange[0])
            return self
        if "module" not in given or given & {*_IMAGE, "focal_px"}:
            for name in _IMAGE:
                if name not in given and not (name == "fov_deg" and "focal_px" in given):
                    mistake(f"expected {type(self).model_fields[name].description}, got nothing; add {name}", name)
        if "fov_deg" in given and self.fov_deg >= 180.0 and not LensShape(self.lens).has_unit_rays:
            mistake(f"expected {_FOV_TEXT}, got {self.fov_deg:g}", "fov_deg")
        return self

    def camera(self, modules: Mapping[str, Module], panes: Mapping[str, Pane], folder: Path) -> RigCamera:
        if self.behind_glass is not None and self.behind_glass not in panes:
            expected = f"one of panes, {', '.join(panes)}" if panes else "panes beside frame, with this name"
            hint = nearest(self.behind_glass, panes)
            mistake(f"expected {expected}, got {self.behind_glass!r}{hint}", "behind_glass")
        measures = self.beams or self.radar
        if measures is not None:
            model = CameraModel.of_beams(measures.beams(folder), measures.least_range_m)
        elif "width_px" in self.model_fields_set:
            angle = {} if self.fov_deg is None else {"fov_rad": math.radians(self.fov_deg)}
            given = self.model_dump(include={"lens", "focal_px", "centre_px", "distortion"}, exclude_unset=True)
            try:
                model = CameraModel(self.width_px, self.height_px, **angle, **given)
            except ValueError as error:
                raise ValueError(f"expected valid camera parameters, got: {error}") from None
        elif self.module in modules:
            model = modules[self.module].camera_model()
        else:
            names, hint = ", ".join(modules), nearest(self.module, modules)
            mistake(f"expected a module of the catalogue, {names}, got {self.module!r}{hint}", "module")
        yaw_rad, pitch_rad, roll_rad = map(math.radians, (self.yaw_deg, self.pitch_deg, self.roll_deg))
        pane = None if self.behind_glass is None else panes[self.behind_glass]
        position_m = np.array(self.position_m)
        housing = modules[self.module].housing if self.module in modules else PLAIN_HOUSING
        return RigCamera(self.name, position_m, yaw_rad, pitch_rad, roll_rad, model, self.module, pane, housing)


class _PaneForm(Form):
    """A pane in a file."""

    normal: Point3 = Field(description="3 finite numbers, outwards")
    outline_m: list[Point3] = Field(description="a list of corners, each [x, y, z] in metres")
    reach_m: Point2 = Field(description="2 finite numbers in metres, the lower one first")

    def pane(self, name: str) -> Pane:
        outline_m = tuple((x, y, z) for x, y, z in self.outline_m)
        return Pane(name, tuple(self.normal), outline_m, tuple(self.reach_m))  # pyright: ignore[reportArgumentType]


class RigForm(Form):
    """A file of a rig."""

    frame: Literal["ego"] = Field(description="ego (x forward, y left, z up)")
    panes: dict[str, _PaneForm] = Field({}, description="a mapping from names to panes, what cameras look through")
    modules: str = Field(LEFT_OUT, description="the path of a catalogue of modules")
    cameras: list[_CameraForm] = Field(description="a list of at least one camera", min_length=1)


def rig_text(rig: Rig) -> str:
    """A rig as YAML, as `write_rig` writes it."""
    row, number = partial(yaml_row, decimals=_DECIMALS), partial(yaml_number, decimals=_DECIMALS)
    lines = [
        "# Cameras in the vehicle's frame (ISO 8855): x forward, y left, z up, metres, origin on the ground below the",
        "# centre of the rear axle. Yaw is positive to the left, pitch nose down, roll right side down; fov_deg is the",
        "# horizontal field of view.",
    ]
    if any(camera.model.focal_px for camera in rig.cameras):
        lines.append("# centre_px is the principal point from the image's upper left corner: OpenCV's plus 0.5.")
    lines.append("frame: ego")
    if rig.panes:
        lines += [
            "# What of the own body is clear for the cameras that name it in behind_glass: triangles under the",
            "# outline, seen along the normal, from the least to the greatest reach_m along it from the outline's",
            "# middle.",
        ]
    panes = {
        yaml_name(pane.name): {
            "normal": row(pane.normal),
            "outline_m": list(map(row, pane.outline_m)),
            "reach_m": row(pane.reach_m),
        }
        for pane in rig.panes.values()
    }

    def written(camera: RigCamera) -> dict[str, Any]:
        model = camera.model
        is_by_angle = model.focal_px is None or model.centre_px is None
        placed = {
            "name": yaml_name(camera.name),
            "position_m": row(camera.position_m),
            "yaw_deg": _angle(camera.yaw_rad),
            "pitch_deg": _angle(camera.pitch_rad),
            "roll_deg": _angle(camera.roll_rad),
            "module": None if camera.module is None else yaml_name(camera.module),
        }
        if model.beams is not None:
            named = "beams" if model.beams.radar is None else "radar"
            return placed | {named: _written_beams(model.beams, model.near_m)}
        return placed | {
            "behind_glass": None if camera.behind_glass is None else yaml_name(camera.behind_glass.name),
            "lens": None if model.lens is Lens.PINHOLE else str(model.lens),
            "fov_deg": number(math.degrees(model.fov_rad)) if is_by_angle else None,
            "focal_px": None if is_by_angle else row(model.focal_px or ()),
            "centre_px": None if is_by_angle else row(model.centre_px or ()),
            "distortion": yaml_row(model.distortion) if model.distortion else None,
            "width_px": model.width_px,
            "height_px": model.height_px,
        }

    content = {"panes": panes or None, "cameras": list(map(written, rig.cameras))}
    return "\n".join([*lines, *yaml_lines(content)]) + "\n"


def _written_beams(beams: Beams, least_range_m: float) -> dict[str, Any]:
    def degrees(angles_rad: Iterable[float]) -> str:
        return yaml_row(map(math.degrees, angles_rad), _DECIMALS)

    if (radar := beams.radar) is not None:
        return {
            "azimuth_deg": degrees(beams.azimuth_rad),
            "elevation_deg": degrees(beams.ends_rad[[0, -1]]),
            "range_m": dict(
                zip(RangesForm.model_fields, (yaml_number(each, _DECIMALS) for each in radar.range_m), strict=True)
            ),
            "least_range_m": yaml_number(least_range_m, _DECIMALS),
            "cell_m": yaml_number(radar.cell_m, _DECIMALS),
            "cell_deg": yaml_number(math.degrees(beams.step_rad), _DECIMALS),
            "visible_share": yaml_number(radar.visible_share, _DECIMALS),
            "probability": yaml_number(radar.probability, _DECIMALS),
            "rate_hz": yaml_number(beams.rate_hz, _DECIMALS),
        }
    return {
        "elevation_deg": degrees(beams.elevation_rad),
        "azimuth_step_deg": yaml_number(math.degrees(beams.step_rad), _DECIMALS),
        "azimuth_deg": degrees(beams.azimuth_rad),
        "range_m": yaml_row(beams.range_m),
        "least_range_m": yaml_number(least_range_m, _DECIMALS),
        "rate_hz": yaml_number(beams.rate_hz, _DECIMALS),
        "weight": None if beams.weight is None else [yaml_row(row) for row in beams.weight],
    }


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as YAML; the same rig gives the same bytes, and an existing file is replaced in one step.

    Numbers are rounded to micrometres, microdegrees and micropixels, angles brought to (-180, 180]; distortion
    coefficients are written in full.

    Args:
        rig: The cameras.
        path: The file; its folder must exist.

    Raises:
        InputError: The folder does not exist or cannot be written to.
    """
    write_text(Path(path), rig_text(rig))


def read_rig(path: str | Path) -> Rig:
    """Read a rig's YAML file, strictly.

    Args:
        path: The file: ``frame: ego`` and ``cameras``, a list of mappings with name, position_m, yaw_deg, pitch_deg,
            roll_deg, fov_deg (horizontal), width_px and height_px, all of them required. A camera may also have a lens
            (else pinhole), distortion, and focal_px and centre_px instead of fov_deg; see `CameraModel`. With
            ``behind_glass`` it looks through a pane of the own vehicle: ``panes`` beside ``frame`` has them by name,
            with normal, outline_m and reach_m (see `warpav.raster.pane.Pane`). With
            ``module`` and no image size it is that module of the shipped catalogue, or of the file that ``modules``
            names beside ``frame``.

    Returns:
        The rig.

    Raises:
        InputError: The file cannot be read or breaks the format; one line per mistake, each with file and line, field,
            what was expected and what came.
    """
    file = Path(path).expanduser()
    data, _ = read_yaml(file)
    if not isinstance(data, dict) or not {"frame", "cameras"} & data.keys():
        is_config = isinstance(data, dict) and "rig" in data
        tools = "files of other tools are read by warpav rig import FILE --format NAME"
        hint = "this is a configuration: of a run, give the folder instead" if is_config else tools
        where = file if data is None else f"{file}:1"
        got = "nothing" if data is None else shown(data)
        raise InputError(f"{where}: expected a mapping with frame, cameras, got {got}; {hint}")
    form, mistakes = read_form(RigForm, file)
    modules = builtin_modules() if form.modules is None else read_modules(file.parent / Path(form.modules).expanduser())
    panes: dict[str, Pane] = {}
    for name, each in form.panes.items():
        with mistakes.noting("panes", name):
            panes[name] = each.pane(name)
    cameras = []
    for i, each in enumerate(form.cameras):
        with mistakes.noting("cameras", i):
            cameras.append(each.camera(modules, panes, file.parent))
    mistakes.refuse()
    try:
        return Rig(cameras)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _angle(angle_rad: float) -> str:
    text = yaml_number(math.remainder(math.degrees(angle_rad), 360.0), _DECIMALS)
    return "180.0" if text == "-180.0" else text
