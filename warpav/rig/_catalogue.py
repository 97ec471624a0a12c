"""Catalogues of camera modules: their YAML file, the one that ships with warpav, and a table of what is in them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import Field

from warpav.core.records import LEFT_OUT, Form, Number, Point3, read_form
from warpav.core.table import aligned
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


_Pixels = Annotated[list[int], Field(min_length=2, max_length=2)]
_PIXELS_TEXT = "columns and rows as two whole numbers [px], such as [1920, 1080]"


class _ModuleForm(Form):
    """A module in a file; whether its numbers fit is for `Module` to say."""

    name: str = Field(description="a name, such as front_8mp_30")
    sensor_px: _Pixels = Field(description=_PIXELS_TEXT)
    network_px: _Pixels = Field(LEFT_OUT, description=_PIXELS_TEXT)
    network_by: Fitting = Field(Fitting.SCALING, strict=False)
    lens: Lens = Field(Lens.PINHOLE, strict=False)
    fov_deg: Number = Field(description="the horizontal field of view of the whole sensor in degrees, such as 100.0")
    vertical_fov_deg: Number = Field(LEFT_OUT, description="a number of degrees, such as 60.0")
    distortion: list[Number] = Field([], description="a list of finite numbers in OpenCV's order")
    housing: _HousingForm = Field(description="a mapping with size_m and maybe offset_m")
    price: _PriceForm = Field(description="a mapping with value and unit")
    power_w: Number | None = Field(None, description="watts, or null where it is unknown")
    zones: list[str] = Field([], description="a list of names, such as [windscreen]; [] for all zones")
    role: Role = Field(Role.ANY, strict=False, description="what it is for, which bounds where it stands and looks")
    source: str = Field(description="where the figures come from, as text")

    def module(self) -> Module:
        given: dict[str, Any] = {name: value for name, value in self if name in self.model_fields_set}
        given |= {name: tuple(value) for name, value in given.items() if isinstance(value, list)}
        for name in {"fov_deg", "vertical_fov_deg"} & given.keys():
            given[name.replace("_deg", "_rad")] = math.radians(given.pop(name))
        (width, height, depth), (right, down, forward) = self.housing.size_m, self.housing.offset_m
        given["housing"] = Housing((width, height, depth), (right, down, forward))
        given["price"] = Price(self.price.value, self.price.unit)
        return Module(**given)


class ModulesForm(Form):
    """A catalogue of modules."""

    extends: Literal["builtin"] = Field(LEFT_OUT, description=f"{BUILTIN}, to hold the shipped modules as well")
    modules: list[_ModuleForm] = Field(description="a list of at least one module", min_length=1)


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
    form, mistakes = read_form(ModulesForm, Path(source).expanduser())
    found = builtin_modules() if form.extends else {}
    first_of = dict.fromkeys((name.casefold() for name in found), "the shipped catalogue")
    for i, each in enumerate(form.modules):
        first = first_of.setdefault(each.name.casefold(), f"modules[{i}]")
        if first != f"modules[{i}]":
            remedy = f"give it another name than that of {first}"
            mistakes.note(f"expected every name once, got {each.name!r}; {remedy}", "modules", i, "name")
        try:
            found[each.name] = each.module()
        except ModuleError as error:
            for problem in error.problems:
                field = problem.field.replace("fov_rad", "fov_deg").replace("[", ".").replace("]", "").split(".")
                mistakes.note(str(problem), "modules", i, *field)
    mistakes.refuse()
    return found
