"""Catalogues of camera modules: their YAML file, the one that ships with warpav, and a table of what is in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

from warpav.core.errors import InputError
from warpav.core.json_schema import NAME, NUMBER, TEXT, Schema, described, document, items, mapping
from warpav.core.yaml_file import Location, read_yaml
from warpav.raster.camera import MAX_IMAGE_PX
from warpav.raster.lens import Lens
from warpav.rig.formats.record import Mistakes, is_number
from warpav.rig.module import MAX_HOUSING_M, MIN_IMAGE_PX, Fitting, Housing, Module, ModuleError, Price

BUILTIN = "builtin"
"""What a catalogue writes after ``extends:`` to hold the shipped modules as well."""

_FILE = Path(__file__).parent / "modules.yaml"


def builtin_modules() -> dict[str, Module]:
    """The modules that ship with warpav, by name: generic ones, of no maker."""
    return dict(_builtin())


@cache
def _builtin() -> Mapping[str, Module]:
    return MappingProxyType(read_modules(_FILE))


def read_modules(source: str | Path = BUILTIN) -> dict[str, Module]:
    """Read a catalogue of camera modules, strictly.

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
    data, line_of = read_yaml(file)
    reader = _CatalogueReader(str(file), line_of)
    modules = reader.modules(data)
    if reader.mistakes:
        raise InputError(*reader.mistakes)
    return modules


def module_table(modules: Mapping[str, Module]) -> str:
    """The modules as a table of plain text."""
    rows = [_HEADINGS, *(_row(module) for module in modules.values())]
    width = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            text.ljust(width[k]) if k in _LEFT_COLUMNS else text.rjust(width[k]) for k, text in enumerate(row)
        ).rstrip()
        for row in rows
    )


_HEADINGS = (
    "module",
    "sensor [px]",
    "network [px]",
    "lens",
    "field of view [°]",
    "px/° in the middle",
    "price",
    "power [W]",
    "zones",
    "source",
)
_LEFT_COLUMNS = (0, 3, 8, 9)


def _row(module: Module) -> tuple[str, ...]:
    """What a table says of a module, in the order of `_HEADINGS`."""
    model = module.camera_model()
    crop = " crop" if module.network_by is Fitting.CROP else ""
    return (
        module.name,
        "{} x {}".format(*module.sensor_px),
        "{} x {}".format(*module.network_px) + crop,
        str(module.lens),
        f"{math.degrees(model.fov_rad):.1f}",
        f"{module.pixels_per_degree:.1f}",
        f"{module.price.value:g} {module.price.unit}",
        "-" if module.power_w is None else f"{module.power_w:g}",
        ", ".join(module.zones) or "all",
        " ".join(module.source.split()),
    )


@dataclass(frozen=True)
class _Form:
    """What a value of the file looks like: words, whether it is that, its schema; numbers are judged by `Module`."""

    text: str
    fits: Callable[[Any], bool]
    schema: Schema


def _is_list(count: int | None, fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: (
        isinstance(value, list) and len(value) == (len(value) if count is None else count) and all(map(fits, value))
    )


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_text(value: object) -> bool:
    return isinstance(value, str)


_COUNT = {"type": "integer", "minimum": MIN_IMAGE_PX, "maximum": MAX_IMAGE_PX}
_PIXELS = _Form(
    "columns and rows as two whole numbers [px], such as [1920, 1080]", _is_list(2, _is_whole), items(_COUNT, 2)
)
_FORMS = {
    "name": _Form("a name, such as front_8mp_30", _is_text, NAME),
    "sensor_px": _PIXELS,
    "network_px": _PIXELS,
    "network_by": _Form(f"one of {', '.join(Fitting)}", _is_text, {"enum": [str(each) for each in Fitting]}),
    "lens": _Form("the name of a lens, such as pinhole or fisheye", _is_text, {"enum": [str(each) for each in Lens]}),
    "fov_deg": _Form(
        "the horizontal field of view of the whole sensor in degrees, such as 100.0",
        is_number,
        {"type": "number", "exclusiveMinimum": 0, "maximum": 360},
    ),
    "vertical_fov_deg": _Form(
        "a number of degrees, such as 60.0", is_number, {"type": "number", "exclusiveMinimum": 0, "maximum": 360}
    ),
    "distortion": _Form("a list of finite numbers in OpenCV's order", _is_list(None, is_number), items(NUMBER)),
    "housing": _Form(
        "a mapping with size_m and maybe offset_m", lambda value: isinstance(value, dict), {"type": "object"}
    ),
    "price": _Form("a mapping with value and unit", lambda value: isinstance(value, dict), {"type": "object"}),
    "power_w": _Form(
        "watts, or null where it is unknown",
        lambda value: value is None or is_number(value),
        {"type": ["number", "null"], "minimum": 0},
    ),
    "zones": _Form("a list of names, such as [windscreen]; [] for all zones", _is_list(None, _is_text), items(NAME)),
    "source": _Form("where the figures come from, as text", _is_text, TEXT),
    "housing.size_m": _Form(
        "width, height and depth [m], such as [0.03, 0.03, 0.04]",
        _is_list(3, is_number),
        items({"type": "number", "exclusiveMinimum": 0, "maximum": MAX_HOUSING_M}, 3),
    ),
    "housing.offset_m": _Form("three numbers [m]: right, down, forward", _is_list(3, is_number), items(NUMBER, 3)),
    "price.value": _Form("a number, such as 1.5", is_number, {"type": "number", "minimum": 0}),
    "price.unit": _Form("a unit, such as EUR or relative", _is_text, TEXT),
}
_OPTIONAL = {"network_px", "network_by", "lens", "vertical_fov_deg", "distortion", "zones", "housing.offset_m"}
_AS_WRITTEN = ("name", "lens", "network_by", "power_w", "source")
_TUPLES = ("sensor_px", "network_px", "distortion", "zones")
_FIELD_IN_FILE = {"fov_rad": "fov_deg", "vertical_fov_rad": "vertical_fov_deg"}


def modules_schema() -> Schema:
    """The JSON Schema of a catalogue, of the forms by which `read_modules` reads it."""

    def part(prefix: str) -> Schema:
        fields = [name.removeprefix(prefix) for name in _FORMS if name.startswith(prefix)]
        fields = [name for name in fields if "." not in name]
        inner = {name: part(f"{prefix}{name}.") for name in ("housing", "price") if not prefix}
        properties = {
            name: described(inner.get(name) or _FORMS[prefix + name].schema, _FORMS[prefix + name].text)
            for name in fields
        }
        return mapping(properties, [name for name in fields if prefix + name not in _OPTIONAL])

    extends = described({"const": BUILTIN}, "to hold the shipped modules as well")
    root = {"extends": extends, "modules": items(part(""), least=1)}
    return document("modules", "catalogue of camera modules", mapping(root, ["modules"]))


class _CatalogueReader(Mistakes):
    """Validates a catalogue's data and collects every mistake with its location."""

    def modules(self, data: object) -> dict[str, Module]:
        """The modules of the file, and those that it extends."""
        if not isinstance(data, dict) or "modules" not in data:
            remedy = "write modules: and below it a list of modules"
            self.report((), "a mapping with modules, and maybe extends", data, remedy)
            return {}
        root = self.mapping(data, (), {"extends": BUILTIN, "modules": "a list of modules"}, ("extends",))
        found: dict[str, Module] = {}
        if "extends" in root:
            if root["extends"] == BUILTIN:
                found |= _builtin()
            else:
                self.report(("extends",), BUILTIN, root["extends"], f"write extends: {BUILTIN}, or remove it")
        items = root["modules"]
        if not isinstance(items, list) or not items:
            self.report(("modules",), "a list of at least one module", items, "add a module")
            return found
        first_of: dict[str, str] = dict.fromkeys((name.casefold() for name in found), "the shipped catalogue")
        for i, item in enumerate(items):
            location = ("modules", str(i))
            module = self.module(item, location)
            name = item.get("name") if isinstance(item, dict) else None
            if isinstance(name, str):
                first = first_of.setdefault(name.casefold(), f"modules[{i}]")
                if first != f"modules[{i}]":
                    place = (*location, "name")
                    self.report(place, "every name once", name, f"give it another name than that of {first}")
            if module is not None:
                found[module.name] = module
        return found

    def module(self, data: object, location: Location) -> Module | None:
        """A module; None where something is wrong with it."""
        known_count = len(self.mistakes)
        item = self.part(data, location, "")
        parts = [name for name in ("housing", "price") if isinstance(item.get(name), dict)]
        inner = {name: self.part(item[name], (*location, name), f"{name}.") for name in parts}
        if len(self.mistakes) > known_count:
            return None
        given: dict[str, Any] = {name: item[name] for name in _AS_WRITTEN if name in item}
        given |= {name: tuple(item[name]) for name in _TUPLES if name in item}
        given |= {name: math.radians(item[angle]) for name, angle in _FIELD_IN_FILE.items() if angle in item}
        given["housing"] = Housing(**{name: tuple(value) for name, value in inner["housing"].items()})
        given["price"] = Price(**inner["price"])
        try:
            return Module(**given)
        except ModuleError as error:
            for problem in error.problems:
                field = _FIELD_IN_FILE.get(problem.field, problem.field)
                place = (*location, *field.replace("[", ".").replace("]", "").split("."))
                self.tell(place, str(problem))
            return None

    def part(self, data: object, location: Location, prefix: str) -> dict[str, Any]:
        """The fields of a mapping that are what they should be; all else is a mistake."""
        names = [name for name in _FORMS if name.startswith(prefix) and "." not in name.removeprefix(prefix)]
        texts = {name.removeprefix(prefix): _FORMS[name].text for name in names}
        optional = {name.removeprefix(prefix) for name in names if name in _OPTIONAL}
        item = self.mapping(data, location, texts, optional)
        for name, value in item.items():
            form = _FORMS[prefix + name]
            if not form.fits(value):
                self.report((*location, name), form.text, value, "correct it" if value is not None else "write it")
        return item
