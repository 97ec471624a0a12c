"""Requirements' YAML files, and the templates that ship with warpav."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import yaml

from warpav.core.errors import InputError
from warpav.core.files import write_text
from warpav.core.json_schema import (
    FLAG,
    NUMBER,
    TEXT,
    Schema,
    described,
    document,
    either,
    items,
    mapping,
    named,
)
from warpav.rig.formats.record import Record, did_you_mean, read_yaml_record
from warpav.scene.own_vehicle import read_vehicle_file
from warpav.sight.requirement import SECTORS, SIDES, SIZES_M, Area, Band, Polygon, Requirement, Strip, TestObject
from warpav.sight.templates import template_file, template_names

_SPAN = items(NUMBER, 2)
_SIZE: Schema = {"type": "number", "exclusiveMinimum": 0}
_SHARE: Schema = {"type": "number", "exclusiveMinimum": 0, "maximum": 1}
_STRIP: dict[str, Schema] = {
    "side": {"enum": list(SIDES)},
    "distance_m": described(_SPAN, "least and greatest distance from that side"),
    "along_m": described(either(_SPAN, {"type": "null"}), "from where to where along it; without it, all of the side"),
}
_AREAS: dict[str, Schema] = {
    "around_m": described(_SPAN, "least and greatest distance from the body"),
    "strip": mapping(_STRIP, ["side", "distance_m"], about="a strip along one side of the body"),
    "box_m": described(either(items(_SPAN, 2), items(NUMBER, 4)), "lowest and highest corner [x, y]"),
    "polygon_m": described(items(_SPAN, least=3), "corners [x, y] in order along the border"),
}
_OBJECT: dict[str, Schema] = {
    "kind": {"enum": list(SIZES_M)},
    "mesh": described(TEXT, "a mesh file of its own"),
    **dict.fromkeys(("height_m", "width_m", "length_m"), _SIZE),
    "yaw_deg": NUMBER,
}
_KEYS: dict[str, Schema] = {
    "area": mapping(_AREAS, about="ground beside the vehicle", minProperties=1, maxProperties=1),
    "grid_m": described(_SIZE, "distance between points of the ground"),
    "object": described(either({"enum": list(SIZES_M)}, mapping(_OBJECT)), "what stands at every point"),
    "visible_share": described(_SHARE, "share of it that has to be seen"),
    "pixels": described({"type": "number", "minimum": 0}, "area of it in the image that has to be seen [px^2]"),
    "cameras": described({"type": "integer", "minimum": 1}, "how many cameras have to see it"),
    "sector": described(
        either({"enum": [*SECTORS]}, _SPAN, {"type": "null"}), "a name, or two yaws in degrees, counter-clockwise"
    ),
    "hard": described(FLAG, "whether it must be met; a weight beside it says how much it counts instead"),
    "weight": described(either(_SIZE, {"type": "null"}), "how much it counts"),
    "share": described(_SHARE, "share of the points that must be met, with a weight"),
}
"""Every key of a requirement in a file, and its schema."""


def requirements_schema() -> Schema:
    """The JSON Schema of a file of requirements, of the keys by which `read_requirements` reads it."""
    wanted = named(mapping(_KEYS, ["area", "grid_m", "object"]), about="requirements by name")
    root = mapping({"requirements": wanted}, ["requirements"])
    return document("requirements", "requirements on the ground around a vehicle", root)


def read_requirements(source: str | Path) -> tuple[Requirement, ...]:
    """Read requirements, strictly.

    Args:
        source: A YAML file, or the name of a shipped template (`template_names`). The file holds ``requirements``, a
            mapping from names to what is required: ``area`` with one of ``around_m`` (least and greatest distance from
            the body), ``strip`` (``side``, ``distance_m``, ``along_m``), ``box_m`` (two corners) and ``polygon_m`` in
            the ego frame; ``grid_m``; ``object``, a name of `SIZES_M` or a mapping with ``kind`` or ``mesh``,
            ``height_m``, ``width_m``, ``length_m``, ``yaw_deg``; and, where wanted, ``visible_share`` (0.5),
            ``pixels`` (0), ``cameras`` (1), ``sector`` (a name of `SECTORS`, or two yaws in degrees), and ``hard``
            (true) or a ``weight`` with the ``share`` of the points that must be met (1).

    Raises:
        InputError: There is no such file or template, or it breaks the format; the line says where, which field, what
            was expected and what came.
    """
    file = _found(source)
    record = read_yaml_record(file)
    record.fields(("requirements",), "a mapping with requirements")
    found = record.at("requirements").mapping("a mapping from names to requirements")
    if not found:
        raise record.at("requirements").error("at least one requirement")
    return tuple(_requirement(name, each, file.parent) for name, each in found.items())


def copy_requirements(file: Path, copy: Path) -> None:
    """Write the requirements of a YAML file to another place, where their meshes are found too."""
    data = read_yaml_record(file).value
    for each in data["requirements"].values():
        if isinstance(each.get("object"), dict) and "mesh" in each["object"]:
            each["object"]["mesh"] = str((file.parent / Path(each["object"]["mesh"]).expanduser()).absolute())
    write_text(copy, yaml.safe_dump(data, sort_keys=False))


def _found(source: str | Path) -> Path:
    names = template_names()
    if str(source) in names:
        return template_file(str(source))
    path = Path(source).expanduser()
    if path.suffix.lower() not in (".yaml", ".yml") and not path.is_file():
        hint = did_you_mean(source, names)
        raise InputError(f"requirements: expected a YAML file or one of {', '.join(names)}, got {str(source)!r}{hint}")
    return path


def _requirement(name: str, record: Record, folder: Path) -> Requirement:
    record.fields(_KEYS, "a requirement: a mapping with area, grid_m and object")
    visible_share = record.at("visible_share").number(0.5)
    if not 0.0 < visible_share <= 1.0:
        raise record.at("visible_share").error("a share above 0 and up to 1")
    pixels = record.at("pixels").number(0.0)
    if pixels < 0.0:
        raise record.at("pixels").error("an area of 0 px^2 or more")
    cameras = record.at("cameras").whole(1)
    if cameras < 1:
        raise record.at("cameras").error("at least 1 camera")
    hard = record.at("hard")
    hard.flag()
    weight = None if record.at("weight").value is None else _positive(record.at("weight"))
    if hard.value is True and weight is not None:
        raise record.at("weight").error("no weight of a hard requirement; leave out one of hard and weight")
    if hard.value is False and weight is None:
        raise hard.error("a weight beside it, such as weight: 1.0", "hard: false alone")
    share = record.at("share").number(1.0)
    if not 0.0 < share <= 1.0:
        raise record.at("share").error("a share of the points above 0 and up to 1")
    if share < 1.0 and weight is None:
        raise record.at("share").error("none of a hard requirement, which is met at every point; give it a weight")
    return Requirement(
        name=name,
        area=_area(record.at("area")),
        grid_m=_positive(record.at("grid_m")),
        test_object=_test_object(record.at("object"), folder),
        visible_share=visible_share,
        pixels=pixels,
        cameras=cameras,
        sector_rad=_sector(record.at("sector")),
        weight=weight,
        share=share,
    )


def _area(record: Record) -> Area:
    fields = record.fields(_AREAS, f"an area: a mapping with one of {', '.join(_AREAS)}")
    if len(fields) != 1:
        raise record.error(f"one of {', '.join(_AREAS)}", f"{', '.join(fields) or 'none'}")
    ((kind, value),) = fields.items()
    if kind == "around_m":
        distance = _range(value)
        if distance[0] < 0.0:
            raise value.error("distances of 0 m or more")
        return Band(distance)
    if kind == "strip":
        value.fields(_STRIP, f"a mapping with {', '.join(_STRIP)}")
        side = value.at("side").one_of(SIDES)
        along = value.at("along_m")
        return Strip(side, _range(value.at("distance_m")), None if along.value is None else _range(along))
    if kind == "box_m":
        (x0, y0), (x1, y1) = value.matrix(2, 2)
        if not (x0 < x1 and y0 < y1):
            raise value.error("a box: its lowest corner, then its highest")
        return Polygon(((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
    corners = [each.numbers(2) for each in value.items("a list of corners [x, y]")]
    array = np.array(corners).reshape(-1, 2)
    area = 0.5 * float(np.sum(array[:, 0] * np.roll(array[:, 1], -1) - np.roll(array[:, 0], -1) * array[:, 1]))
    if len(corners) < 3 or abs(area) < 1e-6:
        raise value.error("at least three corners that enclose an area")
    return Polygon(tuple((x, y) for x, y in corners))


def _test_object(record: Record, folder: Path) -> TestObject:
    if isinstance(record.value, str):
        return TestObject(record.one_of(SIZES_M), SIZES_M[record.one_of(SIZES_M)])
    fields = record.fields(_OBJECT, f"one of {', '.join(SIZES_M)}, or a mapping with {', '.join(_OBJECT)}")
    if ("kind" in fields) == ("mesh" in fields):
        raise record.error("one of kind and mesh", "both" if "kind" in fields else "none")
    yaw_rad = math.radians(record.at("yaw_deg").number(0.0))
    if "mesh" in fields:
        sized = [name for name in ("height_m", "width_m", "length_m") if name in fields]
        if sized:
            raise fields[sized[0]].error("no size of a mesh, which has its own")
        return _own(record.at("mesh"), folder, yaw_rad)
    kind = record.at("kind").one_of(SIZES_M)
    size = [
        _positive(record.at(name)) if name in fields else usual
        for name, usual in zip(("length_m", "width_m", "height_m"), SIZES_M[kind], strict=True)
    ]
    return TestObject(kind, (size[0], size[1], size[2]), yaw_rad)


def _own(record: Record, folder: Path, yaw_rad: float) -> TestObject:
    """A mesh of one's own, put onto the ground at the origin."""
    path = folder / Path(record.text()).expanduser()
    try:
        file = read_vehicle_file(path, vertices_max=None)  # its shape alone counts
    except InputError as error:
        raise InputError(f"{record.location}: {error}") from None
    mesh = file.in_ego_frame(file.usual)
    low, high = mesh.bounds_m()
    size = (high - low).astype(np.float64)
    if not (size > 1e-3).all() or size.max() > 20.0:
        raise record.error("a mesh of 1 mm to 20 m along every axis", f"one of {np.round(size, 3).tolist()} m")
    shift = -np.append(0.5 * (low + high)[:2], low[2])
    length, width, height = size.tolist()
    return TestObject(path.stem, (length, width, height), yaw_rad, mesh.transformed(np.eye(3), shift))


def _sector(record: Record) -> tuple[float, float] | None:
    if record.value is None:
        return None
    if isinstance(record.value, str):
        name = record.one_of(SECTORS, ", or two yaws in degrees")
        middle = 0.25 * math.pi * SECTORS.index(name)
        return middle - math.pi / 8.0, middle + math.pi / 8.0
    start, end = record.numbers(2)
    if not start < end <= start + 360.0:
        raise record.error("two yaws in degrees, counter-clockwise, such as [135, 225] for the rear")
    return (math.radians(start), math.radians(end)) if end < start + 360.0 else None


def _range(record: Record) -> tuple[float, float]:
    low, high = record.numbers(2)
    if not low < high:
        raise record.error("a range, the lower end first")
    return low, high


def _positive(record: Record) -> float:
    value = record.number()
    if value <= 0.0:
        raise record.error("a positive number")
    return value
