"""Lengths, times and angles that may carry their own unit (``20 cm``, ``1.57 rad``); the field's name has the unit."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping
from typing import Annotated

from pydantic import BeforeValidator, WithJsonSchema

from warpav.core.section import Expectation, mistake, shown

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}
SECONDS_PER_UNIT = {"s": 1.0, "ms": 1e-3}
DEGREES_PER_UNIT = {"deg": 1.0, "rad": 180.0 / math.pi}


def _quantity_reader(quantity: str, unit_factor: Mapping[str, float], example: str) -> BeforeValidator:
    def read(value: object) -> object:
        if not isinstance(value, str):
            return value
        match = re.fullmatch(r"\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([^\s0-9.]*)\s*", value)
        unit = match[2] if match else ""
        if match and unit in unit_factor:
            try:
                return float(match[1]) * unit_factor[unit]
            except ValueError:
                match = None
        problem = f"; {unit!r} is no unit of {quantity}, use {', '.join(unit_factor)}" if match and unit else ""
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


def number_in(value: object, unit_factor: Mapping[str, float]) -> float | None:
    """A number, or a text with its unit, in the base unit; None where it is neither."""
    match = re.fullmatch(r"\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([^\s0-9.]+)\s*", str(value))
    if isinstance(value, str) and match and match[2] in unit_factor:
        with contextlib.suppress(ValueError):
            return float(match[1]) * unit_factor[match[2]]
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


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
