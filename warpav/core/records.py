"""Files as pydantic models: the model of a kind of file is its reader, its JSON Schema and the text of its errors.

A mistake is one line: place, field, what was expected, what came, and how to put it right. What a field expects is its
``description``, which editors show as well; without one it follows from the type of pydantic's error.
"""

from __future__ import annotations

import contextlib
import difflib
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import PydanticCustomError

from warpav.core.errors import InputError
from warpav.core.section import mistake, shown
from warpav.core.yaml_file import Location, dotted, read_yaml

_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_MOST, _TOLD = 20, 8
"""Mistakes, and keys that are not read, of one file that messages list."""

_EXPECTED = {
    "list_type": "a list",
    "dict_type": "an object",
    "float_type": "a number",
    "float_parsing": "a number",
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
    """An object in a file of others; nothing is converted, and unknown keys are kept for `unread` to name."""

    model_config = ConfigDict(strict=True, frozen=True, populate_by_name=True, extra="allow")


class Form(BaseModel):
    """A mapping in a file that people write; nothing is converted, and unknown keys are mistakes."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)


LEFT_OUT: Any = None
"""Default of a field that may be left out, but not be null."""

_Content = TypeVar("_Content", bound=BaseModel)
Number = Annotated[float, Field(gt=-1e9, lt=1e9)]
"""Finite, and of a size that can mean something."""
Positive = Annotated[float, Field(gt=0.0, lt=1e9)]
Point2 = Annotated[list[Number], Field(min_length=2, max_length=2)]
Point3 = Annotated[list[Number], Field(min_length=3, max_length=3)]
Word = Annotated[str, BeforeValidator(str)]
"""A name, which files may write as a number."""
Whole = Annotated[
    int, BeforeValidator(lambda value: int(value) if isinstance(value, float) and value.is_integer() else value)
]
"""A whole number, which files may write with a point."""
Name = Annotated[str, Field(pattern=r"^[_A-Za-z0-9][_A-Za-z0-9.-]*$")]
"""What may be a file's name."""


def in_order(ends: list[float]) -> list[float]:
    """Two ends of a range, the lower one first; else they are rejected."""
    return ends if ends[0] < ends[1] else mistake(f"expected a range, the lower end first, got {shown(ends)}")


def unread(content: object, above: str = "") -> Iterator[str]:
    """The keys of a `Record`, and of those in it, that its model does not have; without the numbers of lists."""
    if isinstance(content, BaseModel):
        yield from (f"{above}{key}" for key in content.model_extra or ())
        for name in type(content).model_fields:
            yield from unread(getattr(content, name), f"{above}{name}.")
    elif isinstance(content, list) and content and isinstance(content[0], BaseModel):
        for each in content:
            yield from unread(each, above)


def unread_text(keys: Iterable[str]) -> str:
    """What messages say of keys that no reader asked for; empty where there are none."""
    names = list(dict.fromkeys(keys))
    more = f" and {len(names) - _TOLD} more" if len(names) > _TOLD else ""
    return f"not read: {', '.join(names[:_TOLD])}{more}" if names else ""


def nearest(word: object, known: Iterable[str]) -> str:
    """The nearest of some words as the end of a message; empty where none is near."""
    near = difflib.get_close_matches(str(word), list(known), 1, 0.5)
    return f"; did you mean {near[0]}?" if near else ""


def schema_of(form: type[BaseModel], name: str, title: str) -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of a kind of file, by which editors complete and check it."""
    body = form.model_json_schema()
    return {"$schema": _DIALECT, "$id": f"urn:warpav:schema:{name}", **body, "title": title}


def place_of(place: str, location: Location, line_of: Mapping[Location, int] | None = None) -> str:
    """Where a value stands, or should: file, line and field."""
    ends = [location[:k] for k in range(len(location), -1, -1)]
    line = next((line_of[end] for end in ends if end in line_of), None) if line_of else None
    return ": ".join(part for part in (place if line is None else f"{place}:{line}", dotted(location)) if part)


class _Mistakes:
    """What is wrong with a file beside its form, each with its place."""

    def __init__(self, place: str, line_of: Mapping[Location, int]) -> None:
        self._place, self._line_of, self._lines = place, line_of, []

    def note(self, text: str, *location: object) -> None:
        self._lines.append(f"{place_of(self._place, tuple(map(str, location)), self._line_of)}: {text}")

    @contextlib.contextmanager
    def noting(self, *location: object) -> Iterator[None]:
        """Note what the block raises as one of a location, or of its fields that `mistake` names."""
        try:
            yield
        except PydanticCustomError as error:
            self.note(error.message(), *location, *(error.context or {}).get("fields", ()))
        except ValueError as error:
            self.note(str(error), *location)

    def refuse(self) -> None:
        if self._lines:
            raise InputError(*self._lines)


def read_form(form: type[_Content], file: Path, *, context: object = None) -> tuple[_Content, _Mistakes]:
    """The content of a YAML file, and what takes further mistakes in it."""
    data, line_of = read_yaml(file)
    content = read_record(form, data, str(file), most=_MOST, line_of=line_of, context=context)
    return content, _Mistakes(str(file), line_of)


def read_record(
    form: type[_Content],
    data: object,
    place: str,
    *,
    most: int = 1,
    line_of: Mapping[Location, int] | None = None,
    name_of: Callable[[Location], tuple[str, int]] | None = None,
    context: object = None,
) -> _Content:
    """The data as a model.

    Args:
        name_of: How messages call the beginning of a location, and how many parts that is; None: as it is written.
    """
    try:
        return form.model_validate(data, context=context)
    except ValidationError as error:
        found = error.errors(include_url=False)
    meant = {(*each["loc"][:-1], _meant(each, found, form)) for each in found if each["type"] == "extra_forbidden"}
    lines: dict[Location, str] = {}
    for each in found:
        if each["type"] == "missing" and tuple(each["loc"]) in meant:  # it is there under a name that is nearly right
            continue
        location, text = _told(each, found, form, data)
        name, count = ("", 0) if name_of is None else name_of(location)
        at = place_of(place, location, line_of).removesuffix(dotted(location)).removesuffix(": ")
        line = ": ".join(part for part in (at, name, dotted(location[count:]), text) if part)
        lines.setdefault(location, line)  # alternatives that do not fit are one mistake
    raise InputError(*list(lines.values())[:most])


def _told(mistake: Any, found: Any, form: type[BaseModel], data: object) -> tuple[Location, str]:  # noqa: ANN401
    """Where a mistake is, and its text; ``mistake`` is one of pydantic's ErrorDetails, ``found`` all of them."""
    kind, got, context = mistake["type"], mistake["input"], mistake.get("ctx", {})
    location = (*map(str, mistake["loc"]), *(part for name in context.get("fields", ()) for part in name.split(".")))
    if kind in ("value_error", "mistake"):
        text = mistake["msg"].removeprefix("Value error, ")
        return location, text if ", got" in text else f"{text}, got {shown(got)}"
    parent, count, description = _field_at(form, location)
    if kind == "extra_forbidden":
        names, near = _names(parent), _meant(mistake, found, form)
        remedy = f"did you mean {near}?" if near else "remove it"
        return location, f"expected one of {', '.join(names)}, got {location[-1]!r}; {remedy}"
    if kind == "missing":
        return location, f"expected {description or _EXPECTED[kind]}, got nothing; add {location[-1]}"
    if kind == "model_type":
        kept = _field_at(form, (*location, ""))[0]
        expected = f"a mapping with {', '.join(_names(kept))}" if issubclass(kept, Form) else "an object"
        return location, f"expected {expected}, got {shown(got)}"
    hint, expected = "", _EXPECTED[kind].format(**context) if kind in _EXPECTED else mistake["msg"]
    if kind in ("literal_error", "enum"):
        names = expected.replace("'", "").replace(" or ", ", ").split(", ")
        expected, hint = f"one of {', '.join(names)}" if len(names) > 1 else names[0], nearest(got, names)
    if not description:
        return location, f"expected {expected}, got {shown(got)}{hint}"
    for part in location[:count]:
        data = data[int(part)] if isinstance(data, list) else data[part]  # pyright: ignore[reportIndexIssue]
    return location[:count], f"expected {description}, got {shown(data)}{hint}"


def _meant(mistake: Any, found: Any, form: type[BaseModel]) -> str:  # noqa: ANN401
    """The name that an unknown key probably means, one that is missing beside it before any other."""
    *above, key = mistake["loc"]
    missing = [each["loc"][-1] for each in found if each["type"] == "missing" and [*each["loc"][:-1]] == above]
    names = _names(_field_at(form, tuple(map(str, mistake["loc"])))[0])
    near = [each for some in (missing, names) for each in difflib.get_close_matches(str(key), some, 1, 0.5)]
    return near[0] if near else ""


def _names(form: type[BaseModel]) -> list[str]:
    return [field.alias or name for name, field in form.model_fields.items()]


def _field_at(form: type[BaseModel], location: Location) -> tuple[type[BaseModel], int, str]:
    """The innermost model on the way to a location, and how far the innermost field with a description is, and it."""
    annotation: Any = form
    model, count, description = form, 0, ""
    for k, part in enumerate(location):
        annotation = _without_null(annotation)
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            model, count, description = annotation, 0, ""
            field = next((each for name, each in model.model_fields.items() if part in (name, each.alias)), None)
            if field is None:
                break
            annotation = field.annotation
            count, description = (k + 1, field.description) if field.description else (count, description)
        else:
            annotation = (typing.get_args(annotation) or (None,))[-1]
    return model, count, description


def _without_null(annotation: Any) -> Any:  # noqa: ANN401
    while typing.get_origin(annotation) in (Annotated, typing.Union, types.UnionType):
        annotation = typing.get_args(annotation)[0]
    return annotation
