"""Requirements' YAML files, and the templates that ship with warpav."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from warpav.core.errors import InputError
from warpav.core.files import write_text
from warpav.core.records import LEFT_OUT, Form, Number, Point2, Positive, Whole, in_order, nearest, read_form
from warpav.core.section import mistake, shown
from warpav.core.yaml_file import read_yaml
from warpav.scene import read_vehicle_file
from warpav.sight._requirement import SECTORS, SIZES_M, Area, Band, Polygon, Requirement, Strip, TestObject
from warpav.sight.templates import template_file, template_names

_Share = Annotated[float, Field(gt=0.0, le=1.0)]
_Span = Annotated[Point2, AfterValidator(in_order)]
_Kind = Literal["post", "bollard", "child", "adult", "lying"]
_SIZE_TEXT = "a positive number [m]"


def _far_enough(ends: list[float]) -> list[float]:
    return ends if ends[0] >= 0.0 else mistake(f"expected distances of 0 m or more, got {shown(ends)}")


def _box(box: list[float] | list[list[float]]) -> Polygon:
    (x0, y0), (x1, y1) = np.reshape(box, (2, 2)).tolist()
    if not (x0 < x1 and y0 < y1):
        mistake(f"expected a box: its lowest corner, then its highest, got {shown(box)}")
    return Polygon(((x0, y0), (x1, y0), (x1, y1), (x0, y1)))


def _polygon(corners: list[list[float]]) -> Polygon:
    array = np.array(corners).reshape(-1, 2)
    area = 0.5 * float(np.sum(array[:, 0] * np.roll(array[:, 1], -1) - np.roll(array[:, 0], -1) * array[:, 1]))
    if len(corners) < 3 or abs(area) < 1e-6:
        mistake(f"expected at least three corners that enclose an area, got {shown(corners)}")
    return Polygon(tuple((x, y) for x, y in corners))


class _StripForm(Form):
    side: Literal["front", "rear", "left", "right"]
    distance_m: _Span = Field(description="two numbers [m]: least and greatest distance from that side")
    along_m: Annotated[_Span | None, Field(description="two numbers [m]: from where to where along the side")] = None


class _AreaForm(Form, json_schema_extra={"minProperties": 1, "maxProperties": 1}):
    around_m: Annotated[_Span, AfterValidator(_far_enough)] | None = Field(
        None, description="two numbers [m]: least and greatest distance from the body"
    )
    strip: _StripForm | None = None
    box_m: Annotated[
        Annotated[list[Point2], Field(min_length=2, max_length=2)]
        | Annotated[list[Number], Field(min_length=4, max_length=4)],
        AfterValidator(_box),
        Field(description="lowest and highest corner [x, y] [m]"),
    ] = LEFT_OUT
    polygon_m: Annotated[list[Point2], AfterValidator(_polygon)] = Field(
        LEFT_OUT, description="corners [x, y] in order along the border [m]"
    )

    @model_validator(mode="after")
    def _is_one(self) -> _AreaForm:
        if len(self.model_fields_set) != 1:
            came = ", ".join(name for name in type(self).model_fields if name in self.model_fields_set) or "none"
            mistake(f"expected one of {', '.join(type(self).model_fields)}, got {came}")
        return self

    def area(self) -> Area:
        if self.around_m:
            return Band((self.around_m[0], self.around_m[1]))
        if self.strip:
            (near, far), along = self.strip.distance_m, self.strip.along_m
            return Strip(self.strip.side, (near, far), None if along is None else (along[0], along[1]))
        return self.box_m or self.polygon_m  # pyright: ignore[reportReturnType]


class _ObjectForm(Form):
    kind: _Kind | None = None
    mesh: str | None = Field(None, description="the path of a mesh file of its own")
    height_m: Positive | None = Field(None, description=_SIZE_TEXT)
    width_m: Positive | None = Field(None, description=_SIZE_TEXT)
    length_m: Positive | None = Field(None, description=_SIZE_TEXT)
    yaw_deg: Number = Field(0.0, description="a number [deg]")

    @model_validator(mode="after")
    def _is_kind_or_mesh(self) -> _ObjectForm:
        if (self.kind is None) == (self.mesh is None):
            mistake(f"expected one of kind and mesh, got {'none' if self.kind is None else 'both'}")
        sized = {"height_m", "width_m", "length_m"} & self.model_fields_set
        if self.mesh is not None and sized:
            mistake("expected no size of a mesh, which has its own, got one", min(sized))
        return self


def _test_object(form: str | _ObjectForm, info: ValidationInfo) -> TestObject:
    if isinstance(form, str):
        return TestObject(form, SIZES_M[form])
    if form.mesh is not None:
        assert info.context is not None  # the folder of the file
        return _own(info.context / Path(form.mesh).expanduser(), math.radians(form.yaw_deg))
    assert form.kind is not None
    length, width, height = SIZES_M[form.kind]
    size_m = (form.length_m or length, form.width_m or width, form.height_m or height)
    return TestObject(form.kind, size_m, math.radians(form.yaw_deg))


def _own(path: Path, yaw_rad: float) -> TestObject:
    """A mesh of one's own, put onto the ground at the origin."""
    try:
        file = read_vehicle_file(path, vertices_max=None)  # its shape alone counts
    except InputError as error:
        mistake(str(error), "mesh")
    mesh = file.in_ego_frame(file.usual)
    low, high = mesh.bounds_m()
    size = (high - low).astype(np.float64)
    if not (size > 1e-3).all() or size.max() > 20.0:
        got = f"one of {np.round(size, 3).tolist()} m"
        mistake(f"expected a mesh of 1 mm to 20 m along every axis, got {got}", "mesh")
    shift = -np.append(0.5 * (low + high)[:2], low[2])
    length, width, height = size.tolist()
    return TestObject(path.stem, (length, width, height), yaw_rad, mesh.transformed(np.eye(3), shift))


def _sector(value: str | list[float] | None) -> tuple[float, float] | None:
    if value is None:
        return None
    if isinstance(value, str):
        if value not in SECTORS:
            names = ", ".join(SECTORS)
            mistake(f"expected one of {names}, or two yaws in degrees, got {value!r}{nearest(value, SECTORS)}")
        middle = 0.25 * math.pi * SECTORS.index(value)
        return middle - math.pi / 8.0, middle + math.pi / 8.0
    start, end = value
    if not start < end <= start + 360.0:
        text = "two yaws in degrees, counter-clockwise, such as [135, 225] for the rear"
        mistake(f"expected {text}, got {shown(value)}")
    return (math.radians(start), math.radians(end)) if end < start + 360.0 else None


def _or_kind(schema: dict[str, Any]) -> None:
    schema["anyOf"] = [{"enum": list(SIZES_M)}, {"$ref": schema.pop("$ref")}]


class _RequirementForm(Form):
    area: _AreaForm
    grid_m: Positive = Field(description="a positive number [m]: distance between points of the ground")
    object: Annotated[
        _ObjectForm,
        BeforeValidator(lambda value: {"kind": value} if isinstance(value, str) else value),
        AfterValidator(_test_object),
    ] = Field(json_schema_extra=_or_kind)
    visible_share: _Share = Field(0.5, description="a share above 0 and up to 1: how much of it has to be seen")
    pixels: float = Field(0.0, ge=0.0, description="an area of 0 px^2 or more that has to be seen in an image")
    cameras: Whole = Field(1, ge=1, description="at least 1 camera, a whole number: how many have to see it")
    sector: Annotated[str | Point2 | None, AfterValidator(_sector)] = Field(
        None, description="a sector's name, or two yaws in degrees, counter-clockwise"
    )
    hard: bool | None = Field(None, description="true or false: whether it must be met, or has a weight")
    weight: Positive | None = Field(None, description="a positive number: how much it counts")
    share: _Share = Field(1.0, description="a share of the points above 0 and up to 1: how many must be met")

    @model_validator(mode="after")
    def _is_hard_or_weighs(self) -> _RequirementForm:
        if self.hard and self.weight is not None:
            text = "no weight of a hard requirement; leave out one of hard and weight"
            mistake(f"expected {text}, got {self.weight:g}", "weight")
        if self.hard is False and self.weight is None:
            mistake("expected a weight beside it, such as weight: 1.0, got hard: false alone", "hard")
        if self.share < 1.0 and self.weight is None:
            text = "none of a hard requirement, which is met at every point; give it a weight"
            mistake(f"expected {text}, got {self.share:g}", "share")
        return self

    def requirement(self, name: str) -> Requirement:
        given = self.model_dump(include={"grid_m", "visible_share", "pixels", "cameras", "weight", "share"})
        return Requirement(
            name=name,
            area=self.area.area(),
            test_object=self.object,  # pyright: ignore[reportArgumentType]
            sector_rad=self.sector,  # pyright: ignore[reportArgumentType]
            **given,
        )


class Checks(Form):
    """What ``warpav check`` asks of a rig besides; null: nothing."""

    far_m: dict[Literal["vehicle", "pedestrian", "cyclist"], Positive] | None = Field(
        default={"vehicle": 40.0, "pedestrian": 40.0, "cyclist": 40.0},
        description="distances [m] of vehicle, pedestrian, cyclist: how far ahead each is found with probability 0.9, "
        "at least (40: where a car from 50 km/h stops, after 1 s and with 4 m/s^2)",
    )
    traffic_lights: _Share | None = Field(
        default=1.0,
        description="a share of the places of a traffic light, at least (1: it is read from the stop line on)",
    )
    redundancy: _Share | None = Field(
        default=None,
        description="a share of the cells near the body where two cameras see a car, at least (the concept says it)",
    )
    camera_loss: _Share | None = Field(
        default=None,
        description="a share of the area near the body that is blind without any one camera, at most (likewise)",
    )
    tolerance: bool = Field(
        default=True,
        description="true or false: whether pitching all cameras by 1 degree, as mounts do, may break no more rules",
    )
    hard: list[Literal["far_m", "traffic_lights", "redundancy", "camera_loss", "tolerance"]] = Field(
        default=[], description="names of the other checks: those whose failing ends the command with status 1"
    )


class RequirementsForm(Form):
    """A file of requirements."""

    requirements: dict[str, _RequirementForm] = Field(
        description="a mapping from names to at least one requirement", min_length=1
    )
    checks: Checks = Field(Checks(), description="limits of what warpav check measures besides")


def read_checks(source: str | Path) -> Checks:
    """The limits in ``checks`` of what `read_requirements` reads."""
    return _read(source).checks


def read_requirements(source: str | Path) -> tuple[Requirement, ...]:
    """Read requirements, strictly.

    Args:
        source: A YAML file, or the name of a shipped template (`template_names`). The file holds ``requirements``, a
            mapping from names to what is required: ``area`` with one of ``around_m`` (least and greatest distance from
            the body), ``strip`` (``side``, ``distance_m``, ``along_m``), ``box_m`` (two corners) and ``polygon_m`` in
            the ego frame; ``grid_m``; ``object``, a name of `SIZES_M` or a mapping with ``kind`` or ``mesh``,
            ``height_m``, ``width_m``, ``length_m``, ``yaw_deg``; and, where wanted, ``visible_share`` (0.5),
            ``pixels`` (0), ``cameras`` (1), ``sector`` (a name of `SECTORS`, or two yaws in degrees), and ``hard``
            (true) or a ``weight`` with the ``share`` of the points that must be met (1). ``checks`` are `Checks`.

    Raises:
        InputError: There is no such file or template, or it breaks the format; the line says where, which field, what
            was expected and what came.
    """
    return tuple(each.requirement(name) for name, each in _read(source).requirements.items())


def _read(source: str | Path) -> RequirementsForm:
    names = template_names()
    file = template_file(str(source)) if str(source) in names else Path(source).expanduser()
    if file.suffix.lower() not in (".yaml", ".yml") and not file.is_file():
        listed = ", ".join(names)
        raise InputError(
            f"requirements: expected a YAML file or one of {listed}, got {str(source)!r}{nearest(source, names)}"
        )
    return read_form(RequirementsForm, file, context=file.parent)[0]


def copy_requirements(file: Path, copy: Path) -> None:
    """Write the requirements of a YAML file to another place, where their meshes are found too."""
    data, _ = read_yaml(file)
    for each in data["requirements"].values():
        if isinstance(each.get("object"), dict) and "mesh" in each["object"]:
            each["object"]["mesh"] = str((file.parent / Path(each["object"]["mesh"]).expanduser()).absolute())
    write_text(copy, yaml.safe_dump(data, sort_keys=False))
