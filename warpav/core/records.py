"""Files of others as pydantic models: the model of a kind of file is its reader, its schema and the text of its errors.

A mistake is one line: place, field, what was expected, what came, and the nearest name where one is near.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from warpav.core.errors import InputError
from warpav.core.section import shown
from warpav.core.yaml_file import Location, dotted

_EXPECTED = {
    "list_type": "a list",
    "dict_type": "an object",
    "model_type": "an object",
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "string_type": "text",
    "bool_type": "true or false",
    "missing": "a value",
    "literal_error": "{expected}",
    "enum": "{expected}",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "less than {lt:g}",
    "less_than_equal": "at most {le:g}",
    "too_short": "at least {min_length} values",
    "too_long": "at most {max_length} values",
    "string_too_short": "text",
    "string_pattern_mismatch": "text like {pattern}",
}
"""What a field expects by the type of pydantic's error; other errors speak for themselves."""


class Record(BaseModel):
    """An object in a file; nothing is converted, and unknown keys are passed over."""

    model_config = ConfigDict(strict=True, frozen=True, populate_by_name=True)


Content = TypeVar("Content", bound=BaseModel)
Point2 = Annotated[list[float], Field(min_length=2, max_length=2)]
Point3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Word = Annotated[str, BeforeValidator(str)]
"""A name, which files may write as a number."""


def read_record(
    form: type[Content],
    data: object,
    place: str,
    *,
    most: int = 1,
    line_of: Mapping[Location, int] | None = None,
    name_of: Callable[[Location], tuple[str, int]] | None = None,
) -> Content:
    """The data as a model.

    Args:
        name_of: How messages call the beginning of a location, and how many parts that is; None: as it is written.
    """
    try:
        return form.model_validate(data)
    except ValidationError as error:
        found = error.errors(include_url=False)[:most]
    lines = []
    for each in found:
        location = tuple(map(str, each["loc"]))
        name, count = ("", 0) if name_of is None else name_of(location)
        lines_at = (
            []
            if line_of is None
            else [line_of[end] for k in range(len(location), -1, -1) if (end := location[:k]) in line_of]
        )
        at = f"{place}:{lines_at[0]}" if lines_at else place
        lines.append(": ".join(part for part in (at, name, dotted(location[count:]), _text(each, form)) if part))
    raise InputError(*dict.fromkeys(lines))


def _text(mistake: Any, form: type[BaseModel]) -> str:  # noqa: ANN401 (pydantic's ErrorDetails)
    kind, got = mistake["type"], mistake["input"]
    if kind in ("value_error", "mistake"):
        text = mistake["msg"].removeprefix("Value error, ")
        return text if ", got" in text else f"{text}, got {shown(got)}"
    names: list[str] = []
    if kind == "extra_forbidden":
        got, names = mistake["loc"][-1], [field.alias or name for name, field in form.model_fields.items()]
        expected = f"one of {', '.join(names)}"
    elif kind in _EXPECTED:
        expected = _EXPECTED[kind].format(**mistake.get("ctx", {}))
        names = expected.replace("'", "").replace(" or ", ", ").split(", ") if kind in ("literal_error", "enum") else []
        expected = f"one of {', '.join(names)}" if len(names) > 1 else expected.replace("'", "")
    else:
        expected = mistake["msg"]
    near = difflib.get_close_matches(str(got), names, 1, 0.5)
    hint = f"; did you mean {near[0]}?" if near else ""
    return f"expected {expected}, got {'nothing' if kind == 'missing' else shown(got)}{hint}"
