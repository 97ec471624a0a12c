"""Rigs: named cameras at fixed poses on the vehicle, and their YAML file."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.data_frame import data_frame
from warpav.core.errors import InputError
from warpav.core.files import atomic_write, writing
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll, yaw_pitch_roll_from_rotation
from warpav.core.json_schema import NAME, NUMBER, TEXT, Schema, described, document, items, mapping
from warpav.core.yaml_file import Location, read_yaml, yaml_name
from warpav.raster.camera import MAX_IMAGE_PX, CameraModel
from warpav.raster.lens import Lens, LensShape
from warpav.raster.pane import Pane
from warpav.rig.catalogue import builtin_modules, read_modules
from warpav.rig.formats.record import Mistakes, is_number, nearest, yaml_number

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingImports]

    from warpav.rig.module import Module

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
        model: Image size and lens; by default a pinhole of 256 x 256 px and 90 degrees.
        module: Name of the camera module that it is, if it is one of a catalogue; the model is that of the network's
            image then.
        behind_glass: The pane of the own vehicle that it looks through from inside; what of the body belongs to it is
            clear for this camera and for nobody else. None: the whole body is opaque.

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

    def __str__(self) -> str:
        """The cameras as a table of plain text."""
        columns = self._columns
        rows = [["camera", *columns], *([camera.name, *_table_row(camera, columns)] for camera in self.cameras)]
        width = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(text.rjust(width[k]) for k, text in enumerate(row) if k) for row in rows]
        return "\n".join(f"{row[0].ljust(width[0])}  {line}" for row, line in zip(rows, lines, strict=True))

    @property
    def _columns(self) -> tuple[str, ...]:
        """Columns of a table; the module where some camera is one."""
        return (*_TABLE_COLUMNS, *(("module",) if any(camera.module for camera in self.cameras) else ()))

    def _repr_html_(self) -> str:
        """What Jupyter shows: the cameras as a table."""
        rows = "".join(
            f"<tr><td style='text-align:left'>{html.escape(camera.name)}</td>"
            + "".join(f"<td>{html.escape(text)}</td>" for text in _table_row(camera, self._columns))
            + "</tr>"
            for camera in self.cameras
        )
        count = f"{len(self.cameras)} camera{'' if len(self.cameras) == 1 else 's'}"
        head = "".join(f"<th>{html.escape(text)}</th>" for text in ("camera", *self._columns))
        return (
            f"<table><caption>Rig of {count}, ego frame: x forward, y left, z up</caption>"
            f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
        )

    def plot(self, out: str | Path | None = None, **options: Any) -> Any:  # noqa: ANN401
        """Show the rig in a window or a notebook, or write its image to a file; see `warpav.view.plot`."""
        from warpav.view import plot

        return plot(self, out=out, **options)

    def to_pyvista(self, *, depth_m: float = 1.25) -> MultiBlock:
        """The rig as ``pyvista.MultiBlock``: for every camera ``body``, ``frustum`` and ``axis``.

        See `warpav.view.blocks.rig_to_pyvista`.

        Args:
            depth_m: How far frustums and axes reach [m].
        """
        from warpav.view.blocks import rig_to_pyvista

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


_TABLE_COLUMNS = (
    "x [m]",
    "y [m]",
    "z [m]",
    "yaw [°]",
    "pitch [°]",
    "roll [°]",
    "field of view [°]",
    "image [px]",
    "lens",
)


def _table_row(camera: RigCamera, columns: Sequence[str]) -> list[str]:
    """What a table says of a camera in its columns."""
    model = camera.model
    position = [f"{value:.3f}" for value in camera.position_m]
    angles = [f"{math.degrees(angle):.1f}" for angle in (camera.yaw_rad, camera.pitch_rad, camera.roll_rad)]
    size = f"{model.width_px} x {model.height_px}"
    row = [*position, *angles, f"{math.degrees(model.fov_rad):.1f}", size, str(model.lens), camera.module or "-"]
    return row[: len(columns)]


_OTHER_TOOLS_TEXT = "files of other tools are read by warpav rig import FILE --format NAME"
_POSITION_TEXT = "three finite numbers in metres [x forward, y left, z up], such as [1.2, 0.0, 1.7]"
_ANGLE_TEXT = "a finite number in degrees, such as 90.0"
_FOV_TEXT = "a number of degrees between 0 and 180, up to 360 for a fisheye or a panorama, such as 90.0"
_SIZE_TEXT = f"a whole number of pixels from 8 to {MAX_IMAGE_PX}, such as 256"
_EXPECTED = {
    "name": _NAME_TEXT,
    "position_m": _POSITION_TEXT,
    "yaw_deg": _ANGLE_TEXT + ", left positive",
    "pitch_deg": _ANGLE_TEXT + ", nose down positive",
    "roll_deg": _ANGLE_TEXT + ", right side down positive",
    "fov_deg": _FOV_TEXT,
    "width_px": _SIZE_TEXT,
    "height_px": _SIZE_TEXT,
    "lens": f"one of {', '.join(Lens)}",
    "focal_px": "two positive numbers of pixels [fx, fy], such as [640.0, 640.0]",
    "centre_px": "two finite numbers of pixels [cx, cy] from the image's upper left corner, such as [320.0, 240.0]",
    "distortion": "a list of finite numbers in OpenCV's order, such as [-0.31, 0.11, 0.0, 0.0]",
    "module": "the name of a camera module, such as side_2mp_100",
    "behind_glass": "the name of one of the file's panes, such as windscreen",
}
_OPTIONAL = ("lens", "focal_px", "centre_px", "distortion", "module", "behind_glass")
_OF_MODEL = ("lens", "focal_px", "centre_px", "distortion")
_OF_MODULE = ("fov_deg", "width_px", "height_px")
"""What a camera need not say that is a module of the catalogue."""

_PANE = ("normal", "outline_m", "reach_m")
_ROOT = {field: f"the field {field}" for field in ("frame", "cameras", "modules", "panes")}


def rig_schema() -> Schema:
    """The JSON Schema of a rig's YAML file, of the fields by which `read_rig` reads it."""
    size = {"type": "integer", "minimum": 8, "maximum": MAX_IMAGE_PX}
    forms: dict[str, Schema] = dict.fromkeys(_EXPECTED, NUMBER)
    forms |= dict.fromkeys(("name", "module", "behind_glass"), NAME) | dict.fromkeys(("width_px", "height_px"), size)
    forms |= {"position_m": items(NUMBER, 3), "centre_px": items(NUMBER, 2), "distortion": items(NUMBER)}
    forms |= {"lens": {"enum": [str(lens) for lens in Lens]}}
    forms |= {"fov_deg": {"type": "number", "exclusiveMinimum": 0, "maximum": 360}}
    forms |= {"focal_px": items({"type": "number", "exclusiveMinimum": 0}, 2)}
    pose = [field for field in _EXPECTED if field not in (*_OPTIONAL, *_OF_MODULE)]
    image = [
        {"required": ["module"], "properties": dict.fromkeys((*_OF_MODULE, "focal_px"), False)},
        {"required": [*_OF_MODULE]},
        {"required": ["focal_px", "width_px", "height_px"]},
    ]
    camera = mapping({field: described(forms[field], text) for field, text in _EXPECTED.items()}, pose, anyOf=image)
    outline_m = items(items(NUMBER, 3), least=3)
    pane = mapping(dict(zip(_PANE, (items(NUMBER, 3), outline_m, items(NUMBER, 2)), strict=True)), _PANE)
    root = {
        "frame": described({"const": "ego"}, "x forward, y left, z up"),
        "cameras": items(camera, least=1),
        "modules": described(TEXT, "path of a catalogue of modules"),
        "panes": {"type": "object", "description": "what cameras look through, by name", "additionalProperties": pane},
    }
    return document("rig", "rig of cameras", mapping(root, ["frame", "cameras"]))


def rig_text(rig: Rig) -> str:
    """A rig as YAML, as `write_rig` writes it."""
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
            "panes:",
        ]
    for pane in rig.panes.values():
        lines += [
            f"  {yaml_name(pane.name)}:",
            f"    normal: {_numbers(pane.normal)}",
            "    outline_m:",
            *(f"      - {_numbers(corner)}" for corner in pane.outline_m),
            f"    reach_m: {_numbers(pane.reach_m)}",
        ]
    lines.append("cameras:")
    for camera in rig.cameras:
        position = ", ".join(_number(value) for value in camera.position_m)
        lines += [
            f"  - name: {yaml_name(camera.name)}",
            f"    position_m: [{position}]",
            f"    yaw_deg: {_angle(camera.yaw_rad)}",
            f"    pitch_deg: {_angle(camera.pitch_rad)}",
            f"    roll_deg: {_angle(camera.roll_rad)}",
            *([] if camera.module is None else [f"    module: {yaml_name(camera.module)}"]),
            *([] if camera.behind_glass is None else [f"    behind_glass: {yaml_name(camera.behind_glass.name)}"]),
            *_model_lines(camera.model),
        ]
    return "\n".join(lines) + "\n"


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
    file = Path(path)
    with writing(file), atomic_write(file) as draft:
        draft.write_text(rig_text(rig), encoding="utf-8")


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
    data, line_of = read_yaml(file)
    reader = _RigReader(str(file), line_of)
    items = reader.cameras(data)
    cameras = [reader.camera(item, ("cameras", str(i))) for i, item in enumerate(items)]
    if reader.mistakes:
        raise InputError(*reader.mistakes)
    try:
        return Rig(camera for camera in cameras if camera)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _number(value: float) -> str:
    """The number rounded to the file's decimals, in its shortest form, without exponent or negative zero."""
    text = f"{value:.{_DECIMALS}f}".rstrip("0")
    text += "0" if text.endswith(".") else ""
    return "0.0" if text == "-0.0" else text


def _numbers(values: Iterable[float]) -> str:
    return f"[{', '.join(_number(value) for value in values)}]"


def _angle(angle_rad: float) -> str:
    """The angle [deg] in (-180, 180], after rounding."""
    text = _number(math.remainder(math.degrees(angle_rad), 360.0))
    return "180.0" if text == "-180.0" else text


def _model_lines(model: CameraModel) -> list[str]:
    lines = [] if model.lens is Lens.PINHOLE else [f"    lens: {model.lens}"]
    if model.focal_px is None or model.centre_px is None:
        lines.append(f"    fov_deg: {_number(math.degrees(model.fov_rad))}")
    else:
        lines.append(f"    focal_px: [{', '.join(_number(value) for value in model.focal_px)}]")
        lines.append(f"    centre_px: [{', '.join(_number(value) for value in model.centre_px)}]")
    if model.distortion:
        lines.append(f"    distortion: [{', '.join(yaml_number(value) for value in model.distortion)}]")
    return [*lines, f"    width_px: {model.width_px}", f"    height_px: {model.height_px}"]


class _RigReader(Mistakes):
    """Validates a rig's data and collects every mistake with its location."""

    def __init__(self, location: str, line_of: Mapping[Location, int]) -> None:
        super().__init__(location, line_of)
        self.modules = builtin_modules()
        self.panes: dict[str, Pane] = {}

    def cameras(self, data: object) -> list[Any]:
        """What the file says of each camera."""
        if not isinstance(data, dict) or not {"frame", "cameras"} & data.keys():
            is_config = isinstance(data, dict) and "rig" in data
            hint = "this is a configuration: of a run, give the folder instead" if is_config else _OTHER_TOOLS_TEXT
            self.report((), "a mapping with frame, cameras", data, hint)
            raise InputError(self.mistakes[0])
        root = self.mapping(data, (), _ROOT, ("modules", "panes"), {"frame": "write frame: ego"})
        panes = root.get("panes", {})
        if not isinstance(panes, dict):
            self.report(("panes",), "a mapping from names to panes", panes)
            panes = {}
        self.panes = {str(name): pane for name, each in panes.items() if (pane := self._pane(str(name), each))}
        if "modules" in root:
            self.modules = self._catalogue(root["modules"])
        if "frame" in root and root["frame"] != "ego":
            self.report(("frame",), "ego (x forward, y left, z up)", root["frame"])
        cameras = root.get("cameras", [None])
        if not isinstance(cameras, list) or not cameras:
            self.report(("cameras",), "a list of at least one camera", cameras)
            cameras = []
        return cameras if "cameras" in root else []

    def camera(self, data: object, location: Location) -> RigCamera | None:
        known_count = len(self.mistakes)
        is_calibrated = isinstance(data, dict) and "focal_px" in data
        is_module = isinstance(data, dict) and "module" in data and not {*_OF_MODULE, "focal_px"} & data.keys()
        optional = (*_OPTIONAL, *(_OF_MODULE if is_module else ("fov_deg",) if is_calibrated else ()))
        item = self.mapping(data, location, _EXPECTED, optional)
        for field, value in item.items():
            if not _is_fit(field, value, item.get("lens", Lens.PINHOLE)):
                self.report(
                    (*location, field), _EXPECTED[field], value, nearest(value, Lens) if field == "lens" else ""
                )
        glass = item.get("behind_glass")
        if _is_fit("behind_glass", glass, None) and glass not in self.panes:
            expected = f"one of panes, {', '.join(self.panes)}" if self.panes else "panes beside frame, with this name"
            self.report((*location, "behind_glass"), expected, glass, nearest(glass, self.panes))
        model = self.model(item, location) if len(self.mistakes) == known_count else None
        if model is None:
            return None
        return RigCamera(
            item["name"],
            item["position_m"],
            math.radians(item["yaw_deg"]),
            math.radians(item["pitch_deg"]),
            math.radians(item["roll_deg"]),
            model,
            item.get("module"),
            self.panes[item["behind_glass"]] if "behind_glass" in item else None,
        )

    def _pane(self, name: str, data: object) -> Pane | None:
        """A pane; None where it is a mistake."""
        location = ("panes", name)
        known_count = len(self.mistakes)
        item = self.mapping(data, location, {field: f"the field {field}" for field in _PANE})
        for field, count in (("normal", 3), ("reach_m", 2)):
            if field in item and not _are_numbers(item[field], count):
                self.report((*location, field), f"{count} finite numbers", item[field])
        corners = item.get("outline_m", [])
        if not isinstance(corners, list) or not all(_are_numbers(corner, 3) for corner in corners):
            self.report((*location, "outline_m"), "a list of corners, each [x, y, z] in metres", corners)
        if len(self.mistakes) > known_count:
            return None
        try:
            outline_m = tuple((float(x), float(y), float(z)) for x, y, z in corners)
            (x, y, z), (low_m, high_m) = item["normal"], item["reach_m"]
            return Pane(name, (float(x), float(y), float(z)), outline_m, (float(low_m), float(high_m)))
        except ValueError as error:
            self.tell(location, str(error))
            return None

    def _catalogue(self, path: object) -> dict[str, Module]:
        """The modules of a file beside the rig's, or the shipped ones where it cannot be read."""
        if not isinstance(path, str):
            self.report(("modules",), "the path of a catalogue of modules", path)
            return builtin_modules()
        return read_modules(Path(self.file).parent / Path(path).expanduser())

    def model(self, item: Mapping[str, Any], location: Location) -> CameraModel | None:
        """The camera model of a mapping whose fields are fit one by one; a mistake where they contradict each other."""
        if "width_px" not in item:
            name = item["module"]
            if name in self.modules:
                return self.modules[name].camera_model()
            expected = f"a module of the catalogue, {', '.join(self.modules)}"
            self.report((*location, "module"), expected, name, nearest(name, self.modules))
            return None
        angle = {"fov_rad": math.radians(item["fov_deg"])} if "fov_deg" in item else {}
        given = {field: item[field] for field in _OF_MODEL if field in item}
        try:
            return CameraModel(item["width_px"], item["height_px"], **angle, **given)
        except ValueError as error:
            self.tell(location, f"expected valid camera parameters, got: {error}")
            return None


def _are_numbers(value: object, count: int | None = None) -> bool:
    return isinstance(value, list) and len(value) == (count or len(value)) and all(map(is_number, value))


def _is_fit(field: str, value: Any, lens: object) -> bool:  # noqa: ANN401
    match field:
        case "name" | "module" | "behind_glass":
            return isinstance(value, str) and _NAME.fullmatch(value) is not None
        case "position_m":
            return _are_numbers(value, 3)
        case "lens":
            return value in list(Lens)
        case "focal_px":
            return _are_numbers(value, 2) and min(value) > 0.0
        case "centre_px":
            return _are_numbers(value, 2)
        case "distortion":
            return _are_numbers(value)
        case "fov_deg":
            is_wide = lens in list(Lens) and LensShape(Lens(lens)).has_unit_rays
            return is_number(value) and (0.0 < value < 180.0 or (is_wide and 180.0 <= value <= 360.0))
        case "width_px" | "height_px":
            return isinstance(value, int) and not isinstance(value, bool) and 8 <= value <= MAX_IMAGE_PX
        case _:
            return is_number(value)
