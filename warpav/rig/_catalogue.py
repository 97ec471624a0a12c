"""Catalogues of modules: their YAML file, the one that ships with warpav, and a table of what is in them."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from warpav.core.bounded_files import read_text
from warpav.core.errors import InputError
from warpav.core.records import LEFT_OUT, Form, Number, Point2, Point3, Positive, read_form
from warpav.core.section import mistake
from warpav.core.table import aligned
from warpav.raster.beams import Beams, Radar
from warpav.raster.lens import Lens
from warpav.rig._module import Fitting, Housing, Module, ModuleError, Price, Role

BUILTIN = "builtin"
"""What a catalogue writes after ``extends:`` to hold the shipped modules as well."""

_FILE = Path(__file__).parent / "modules.yaml"


def builtin_modules() -> dict[str, Module]:
    """The modules that ship with warpav, by name: generic ones, of no maker."""
    return dict(_builtin())


@cache
def _builtin() -> Mapping[str, Module]:
    return MappingProxyType(read_modules(_FILE))


def module_table(modules: Mapping[str, Module]) -> str:
    """The modules as a table of plain text."""
    return "\n".join(aligned([_HEADINGS, *map(_row, modules.values())], left=(0, 3, 8, 9, 10)))


_HEADINGS = ("module", "sensor [px]", "network [px]", "lens", "field of view [°]", "px/° in the middle", "price")
_HEADINGS += ("power [W]", "role", "zones", "source")


def _row(module: Module) -> tuple[str, ...]:
    model, beams = module.camera_model(), module.beams
    crop = " crop" if module.network_by is Fitting.CROP else ""
    images = ("{} x {}".format(*module.sensor_px), "{} x {}".format(*module.network_px) + crop, str(module.lens))
    if beams is not None:
        images = (f"{len(beams.elevation_rad)} lines", f"{beams.count} points", "lidar")
    if beams is not None and beams.radar is not None:
        cell = f"cell {beams.radar.cell_m:g} m x {math.degrees(beams.step_rad):g}°"
        images = (f"up to {max(beams.radar.range_m):g} m", cell, "radar")
    return (
        module.name,
        *images,
        f"{math.degrees(model.fov_rad):.1f}",
        "-" if beams else f"{module.pixels_per_degree:.1f}",
        f"{module.price.value:g} {module.price.unit}",
        "-" if module.power_w is None else f"{module.power_w:g}",
        str(module.role),
        ", ".join(module.zones) or "all",
        " ".join(module.source.split()),
    )


class _HousingForm(Form):
    size_m: Point3 = Field(description="width, height and depth [m], such as [0.03, 0.03, 0.04]")
    offset_m: Point3 = Field([0.0, 0.0, 0.0], description="three numbers [m]: right, down, forward")


class _PriceForm(Form):
    value: Number = Field(description="a number, such as 1.5")
    unit: str = Field(description="a unit, such as EUR or relative")


_MOST_SHOTS_BYTES = 100_000_000


class BeamsForm(Form):
    """The beams of a LiDAR in a file."""

    elevation_deg: list[Number] = Field(
        LEFT_OUT,
        description="rising elevations of the beams in degrees; with lines, the lowest and the highest",
    )
    lines: Annotated[int, Field(ge=2, le=4096)] = Field(LEFT_OUT, description="a whole number of evenly spread beams")
    azimuth_step_deg: Positive = Field(LEFT_OUT, description="degrees from a shot of a beam to the next, such as 0.2")
    azimuth_deg: Point2 = Field([-180.0, 180.0], description="first and last azimuth in degrees, to the left positive")
    range_m: Point2 = Field(description="metres at which 10 % and 80 % reflectivity are measured, such as [60, 150]")
    least_range_m: Positive = Field(description="metres from which on it measures, such as 0.5")
    rate_hz: Positive = Field(10.0, description="scans a second, such as 10")
    weight: list[list[Number]] = Field(
        LEFT_OUT, description="shots of each beam in equal parts of the sector, over those of azimuth_step_deg"
    )
    pattern: str = Field(
        LEFT_OUT, description="a CSV file of one scan with columns azimuth_deg,elevation_deg, instead of angles"
    )

    @model_validator(mode="after")
    def _is_whole(self) -> BeamsForm:
        by_angles = {"elevation_deg", "azimuth_step_deg"}
        given = self.model_fields_set & {*by_angles, "lines", "weight", "azimuth_deg"}
        if "pattern" in self.model_fields_set:
            if given:
                mistake(f"expected nothing beside pattern, got {min(given)}; leave one of them out", min(given))
            return self
        for name in sorted(by_angles - given):
            mistake(f"expected {type(self).model_fields[name].description}, got nothing; add {name}", name)
        if self.lines is not None and len(self.elevation_deg) != 2:
            mistake(f"expected the lowest and the highest beside lines, got {len(self.elevation_deg)}", "elevation_deg")
        return self

    def beams(self, folder: Path) -> Beams:
        """The beams; ``folder``: where paths begin.

        Raises:
            ValueError: Numbers that no LiDAR has.
            InputError: The pattern cannot be read.
        """
        near_m, far_m = self.range_m
        if self.pattern is not None:
            return Beams.of_pattern(np.radians(_pattern_deg(folder / self.pattern)), (near_m, far_m), self.rate_hz)
        up_deg = self.elevation_deg
        if self.lines is not None:
            up_deg = np.linspace(up_deg[0], up_deg[1], self.lines).tolist()
        first_deg, last_deg = self.azimuth_deg
        return Beams(
            tuple(map(math.radians, up_deg)),
            math.radians(self.azimuth_step_deg),
            (math.radians(first_deg), math.radians(last_deg)),
            (near_m, far_m),
            None if self.weight is None else tuple(map(tuple, self.weight)),
            self.rate_hz,
        )


def _pattern_deg(file: Path) -> np.ndarray:
    """Azimuth and elevation of every shot of a file [deg], float64 [shot, 2]."""
    expected = "columns azimuth_deg,elevation_deg and numbers below"
    lines = read_text(file, "a pattern of a LiDAR", bytes_max=_MOST_SHOTS_BYTES).splitlines()
    if not lines or [name.strip() for name in lines[0].split(",")] != ["azimuth_deg", "elevation_deg"]:
        raise InputError(f"{file}:1: pattern: expected {expected}, got {lines[0] if lines else 'nothing'!r}")
    shots = []
    for number, line in enumerate(lines[1:], 2):
        try:
            azimuth_deg, elevation_deg = map(float, line.split(","))
        except ValueError:
            raise InputError(f"{file}:{number}: pattern: expected two numbers, got {line!r}") from None
        shots.append((azimuth_deg, elevation_deg))
    return np.array(shots).reshape(-1, 2)


class RangesForm(Form):
    """How far a radar finds what."""

    vehicle: Positive = Field(description="metres, such as 150")
    pedestrian: Positive = Field(description="metres, such as 60")
    cyclist: Positive = Field(description="metres, such as 80")


class RadarForm(Form):
    """A radar in a file."""

    azimuth_deg: Point2 = Field(description="first and last azimuth of the field of view in degrees, left positive")
    elevation_deg: Point2 = Field(description="lowest and highest elevation of it in degrees, such as [-8, 8]")
    range_m: RangesForm = Field(description="a mapping with vehicle, pedestrian and cyclist, metres each")
    least_range_m: Positive = Field(description="metres from which on it measures, such as 0.3")
    cell_m: Positive = Field(description="metres of range within which two in one cell of azimuth merge, such as 0.5")
    cell_deg: Positive = Field(description="degrees of azimuth within which two in one cell of range merge, such as 3")
    visible_share: Positive = Field(0.2, description="share of a box that must be visible for an even chance, below 1")
    probability: Positive = Field(0.95, description="to find what is clearly visible within range, such as 0.95")
    rate_hz: Positive = Field(15.0, description="scans a second, such as 15")

    def beams(self, _: Path) -> Beams:
        """Those of the radar.

        Raises:
            ValueError: Numbers that no radar has.
        """
        range_m = self.range_m.vehicle, self.range_m.pedestrian, self.range_m.cyclist
        radar = Radar(range_m, self.cell_m, self.visible_share, self.probability)
        (right, left), (low, high) = np.radians([self.azimuth_deg, self.elevation_deg]).tolist()
        return Beams.of_radar(radar, (right, left), (low, high), math.radians(self.cell_deg), self.rate_hz)


_Pixels = Annotated[list[int], Field(min_length=2, max_length=2)]
_PIXELS_TEXT = "columns and rows as two whole numbers [px], such as [1920, 1080]"


class _ModuleForm(Form):
    """A module in a file; whether its numbers fit is for `Module` to say."""

    name: str = Field(description="a name, such as front_8mp_30")
    kind: Literal["camera", "lidar", "radar"] = "camera"
    beams: BeamsForm = Field(LEFT_OUT, description="the beams of a LiDAR, a mapping, instead of the fields of a camera")
    radar: RadarForm = Field(LEFT_OUT, description="what a radar sees, a mapping, instead of the fields of a camera")
    sensor_px: _Pixels = Field(LEFT_OUT, description=_PIXELS_TEXT)
    network_px: _Pixels = Field(LEFT_OUT, description=_PIXELS_TEXT)
    network_by: Fitting = Field(Fitting.SCALING, strict=False)
    lens: Lens = Field(Lens.PINHOLE, strict=False)
    fov_deg: Number = Field(
        LEFT_OUT, description="the horizontal field of view of the whole sensor in degrees, such as 100.0"
    )
    vertical_fov_deg: Number = Field(LEFT_OUT, description="a number of degrees, such as 60.0")
    distortion: list[Number] = Field([], description="a list of finite numbers in OpenCV's order")
    housing: _HousingForm = Field(description="a mapping with size_m and maybe offset_m")
    price: _PriceForm = Field(description="a mapping with value and unit")
    power_w: Number | None = Field(None, description="watts, or null where it is unknown")
    zones: list[str] = Field([], description="a list of names, such as [windscreen]; [] for all zones")
    role: Role = Field(Role.ANY, strict=False, description="what it is for, which bounds where it stands and looks")
    source: str = Field(description="where the figures come from, as text")

    @model_validator(mode="after")
    def _is_of_a_kind(self) -> _ModuleForm:
        given = self.model_fields_set
        needed = {"lidar": ("beams",), "radar": ("radar",)}.get(self.kind, ("sensor_px", "fov_deg"))
        for name in needed:
            if name not in given:
                text = type(self).model_fields[name].description
                mistake(f"expected {text}, got nothing; add {name}, or change kind", name)
        strange = sorted(given & ((_OF_CAMERAS if self.kind != "camera" else set()) | {"beams", "radar"} - {*needed}))
        if strange:
            mistake(f"expected nothing of another kind than {self.kind}, got {strange[0]}; remove it", strange[0])
        return self

    def module(self, folder: Path) -> Module:
        """The module; ``folder``: where paths begin."""
        given: dict[str, Any] = {name: value for name, value in self if name in self.model_fields_set - {"kind"}}
        given |= {name: tuple(value) for name, value in given.items() if isinstance(value, list)}
        for name in {"fov_deg", "vertical_fov_deg"} & given.keys():
            given[name.replace("_deg", "_rad")] = math.radians(given.pop(name))
        (width, height, depth), (right, down, forward) = self.housing.size_m, self.housing.offset_m
        given["housing"] = Housing((width, height, depth), (right, down, forward))
        given["price"] = Price(self.price.value, self.price.unit)
        if self.kind == "camera":
            return Module(**given)
        field = "beams" if self.kind == "lidar" else "radar"
        form = given.pop(field)
        try:
            beams = form.beams(folder)
        except ValueError as error:
            mistake(str(error), field)
        return Module.of_beams(given.pop("name"), beams, form.least_range_m, **given)


_OF_CAMERAS = {"sensor_px", "network_px", "network_by", "lens", "fov_deg", "vertical_fov_deg", "distortion"}


class ModulesForm(Form):
    """A catalogue of modules."""

    extends: Literal["builtin"] = Field(LEFT_OUT, description=f"{BUILTIN}, to hold the shipped modules as well")
    modules: list[_ModuleForm] = Field(description="a list of at least one module", min_length=1)


def read_modules(source: str | Path = BUILTIN) -> dict[str, Module]:
    """Read a catalogue of modules, strictly.

    Args:
        source: ``builtin`` for the generic modules that ship with warpav, or a YAML file: ``modules``, a list of
            mappings with the fields of `Module`, angles in degrees as ``fov_deg`` and ``vertical_fov_deg``; and, to
            hold the shipped modules as well, ``extends: builtin``.

    Returns:
        The modules by name, in the order of the file, behind those that it extends.

    Raises:
        InputError: The file cannot be read or breaks the format; one line per mistake, each with file and line, field,
            what was expected, what came and how to put it right.
    """
    if source == BUILTIN:
        return builtin_modules()
    file = Path(source).expanduser()
    form, mistakes = read_form(ModulesForm, file)
    found = builtin_modules() if form.extends else {}
    first_of = dict.fromkeys((name.casefold() for name in found), "the shipped catalogue")
    for i, each in enumerate(form.modules):
        first = first_of.setdefault(each.name.casefold(), f"modules[{i}]")
        if first != f"modules[{i}]":
            remedy = f"give it another name than that of {first}"
            mistakes.note(f"expected every name once, got {each.name!r}; {remedy}", "modules", i, "name")
        with mistakes.noting("modules", i):
            try:
                found[each.name] = each.module(file.parent)
            except ModuleError as error:
                for problem in error.problems:
                    field = problem.field.replace("fov_rad", "fov_deg").replace("[", ".").replace("]", "").split(".")
                    mistakes.note(str(problem), "modules", i, *field)
    mistakes.refuse()
    return found


def copy_catalogue(source: Path, target: Path) -> None:
    """Copy a catalogue, and the patterns that it names by relative paths, which then lie beside the copy."""
    shutil.copyfile(source, target)
    form, _ = read_form(ModulesForm, source)
    for each in form.modules:
        pattern = None if each.beams is None else each.beams.pattern
        if pattern is not None and not Path(pattern).is_absolute():
            (target.parent / pattern).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source.parent / pattern, target.parent / pattern)
