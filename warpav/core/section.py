"""Sections: immutable settings that are read strictly, quantities with units, and what messages about them need."""

from __future__ import annotations

import contextlib
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NoReturn

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, WithJsonSchema, model_validator
from pydantic_core import PydanticCustomError

from warpav.core.errors import one_line
from warpav.core.yaml_file import Location


class Section(BaseModel):
    """Base of all sections: immutable, unknown keys rejected, no silent conversions."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    renamed: ClassVar[Mapping[str, str]] = {}
    """New names of options by the old ones, which work for one version with a warning."""

    @model_validator(mode="before")
    @classmethod
    def with_new_names(cls, data: object) -> object:
        """The same data with options of old names under their new ones; what is no mapping stays as it is."""
        if not isinstance(data, dict) or cls.renamed.keys().isdisjoint(data):
            return data
        for old, new in cls.renamed.items():
            if old in data and new in data:
                mistake(f"expected one of {old} and {new}, its new name, got both", new)
            if old in data:
                warn_renamed("", old, new)
        return {cls.renamed.get(name, name): value for name, value in data.items()}


def section_of(annotation: object) -> type[Section] | None:
    """The section that a field holds; None where it holds something else."""
    return annotation if isinstance(annotation, type) and issubclass(annotation, Section) else None


def renamed_options(section: type[Section], prefix: Location = ()) -> Iterator[tuple[Location, Location]]:
    """Old and new location of every option below a section that has another name now."""
    for old, new in section.renamed.items():
        yield (*prefix, old), (*prefix, new)
    for name, field in section.model_fields.items():
        inner = section_of(field.annotation)
        if inner:
            yield from renamed_options(inner, (*prefix, name))


def move_option(data: dict[str, Any], old: Location, new: Location) -> bool:
    """Move an option in nested data to its new name; False where it is not there, or both are."""
    section: Any = data
    for name in old[:-1]:
        section = section.get(name) if isinstance(section, dict) else None
    if not isinstance(section, dict) or old[-1] not in section or new[-1] in section:
        return False
    section[new[-1]] = section.pop(old[-1])
    return True


def warn_renamed(place: str, old: str, new: str) -> None:
    """Warn that an option has another name now, in one line; ``place`` says where it stands, if that is known."""
    text = f"{old} is called {new} now; the old name works in this version only"
    warnings.warn_explicit(one_line(f"{place}: {text}" if place else text), FutureWarning, filename="warpav", lineno=1)


@dataclass(frozen=True)
class Expectation:
    """What a field expects, in words; ``{range}`` is replaced by the field's limits, ``unit`` follows them."""

    text: str
    unit: str = ""


def mistake(text: str, *fields: str) -> NoReturn:
    """Reject a value with a finished text; ``fields`` are the members of the section that the text speaks of."""
    raise PydanticCustomError("mistake", "{text}", {"text": text, "fields": fields})


def shown(value: object) -> str:
    """A value as messages show it, on one line of at most 60 characters."""
    if value is None:
        return "nothing (null)"
    if isinstance(value, (list, tuple, dict)):
        text = yaml.safe_dump(_beginning(value, [60]), default_flow_style=True, width=10_000).strip()
    else:
        text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _beginning(value: object, left: list[int]) -> object:
    """As much of a value as a message shows; ``left`` counts how many more parts that may be."""
    left[0] -= 1
    if isinstance(value, dict):
        return {key: _beginning(inner, left) for key, inner in value.items() if left[0] > 0}
    if isinstance(value, (list, tuple)):
        return [_beginning(inner, left) for inner in value if left[0] > 0]
    return value


METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}
SECONDS_PER_UNIT = {"s": 1.0, "ms": 1e-3}
DEGREES_PER_UNIT = {"deg": 1.0, "rad": 180.0 / math.pi}


_QUANTITY = re.compile(r"\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([^\s0-9.]*)\s*")


def number_in(value: object, unit_factor: Mapping[str, float]) -> float | None:
    """A number, or a text with its unit, in the base unit; None where it is neither."""
    match = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if match and match[2] in unit_factor:
        with contextlib.suppress(ValueError):
            return float(match[1]) * unit_factor[match[2]]
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _quantity_reader(quantity: str, unit_factor: Mapping[str, float], example: str) -> BeforeValidator:
    def read(value: object) -> object:
        if not isinstance(value, str):
            return value
        number = number_in(value, unit_factor)
        if number is not None:
            return number
        match = _QUANTITY.fullmatch(value)
        problem = ""
        if match and match[2] and match[2] not in unit_factor:
            problem = f"; {match[2]!r} is no unit of {quantity}, use {', '.join(unit_factor)}"
        mistake(f"expected {example}, got {value!r}{problem}")

    return BeforeValidator(read)


_LENGTH_TEXT = 'a length in metres{range}, such as 0.2 or "20 cm"'
_ANGLE_TEXT = 'an angle in degrees{range}, such as 90, "90 deg" or "1.57 rad"'
NUMBER_OR_TEXT = {"anyOf": [{"type": "number"}, {"type": "string"}]}

Metres = Annotated[
    float,
    _quantity_reader("length", METRES_PER_UNIT, _LENGTH_TEXT.format(range="")),
    Expectation(_LENGTH_TEXT, " m"),
    WithJsonSchema(NUMBER_OR_TEXT),
]
Degrees = Annotated[
    float,
    _quantity_reader("angle", DEGREES_PER_UNIT, _ANGLE_TEXT.format(range="")),
    Expectation(_ANGLE_TEXT, " deg"),
    WithJsonSchema(NUMBER_OR_TEXT),
]


def range_reader(unit_factor: Mapping[str, float], expected: str, *, low: float, high: float) -> BeforeValidator:
    """Reads two ends of a range, each a number or a text with its unit, from ``low`` to ``high`` in the base unit."""

    def read(value: object) -> tuple[float, float] | None:
        if value is None:
            return None
        ends = [number_in(end, unit_factor) for end in value] if isinstance(value, (list, tuple)) else []
        if len(ends) != 2 or ends[0] is None or ends[1] is None or not low <= ends[0] < ends[1] <= high:
            mistake(f"expected {expected}, or null, got {shown(value)}")
        return ends[0], ends[1]

    return BeforeValidator(read)
