"""Messages about configurations, and the description of every option."""

from __future__ import annotations

import difflib
import functools
import inspect
import itertools
import operator
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic.fields import FieldInfo

from warpav.core.records import nearest
from warpav.core.section import Expectation, Section, section_of, shown
from warpav.core.yaml_file import Location
from warpav.runs.config._schema import ConfigTree

COMMAND_LINE = "command line"


def placed(place: str, text: str) -> str:
    """A text behind the place that it is about, if there is one."""
    return f"{place}: {text}" if place else text


def explain(
    found: Mapping[str, Any], file: Path | None, written_at: Mapping[Location, str], override_of: Mapping[Location, str]
) -> str:
    """One line about one mistake that the validation found."""
    section: type[Section] = ConfigTree
    field: FieldInfo | None = None
    location: Location = ()
    for part in found["loc"]:  # the tail can be an index, or a name that pydantic gave a validator
        location, field = (*location, str(part)), section.model_fields.get(str(part))
        inner = section_of(field.annotation) if field else None
        if inner is None:
            break
        section, field = inner, None
    fields = found.get("ctx", {}).get("fields", ()) if found["type"] == "mistake" else ()
    locations = [(*location, *name.split(".")) for name in fields] or [location]
    overridden = [name for name in locations if _override_at(name, override_of) is not None]
    written = [name for name in locations if name in written_at]
    place = place_of((overridden or written or locations)[0], file, written_at, override_of)
    location = locations[0]

    if found["type"] == "extra_forbidden":
        text = _unknown_option(section, location)
    elif found["type"] == "mistake":
        text = found["ctx"]["text"]
    elif field is None:
        text = f"expected a section with {', '.join(section.model_fields)}, got {shown(found['input'])}"
    else:
        default = "null" if field.get_default() is None else shown(field.get_default())
        text = f"expected {_expected(field)}, got {shown(found['input'])}"
        near = nearest(found["input"], map(str, _choices(field)))
        text += near or f"; {field.description} (default {default})"
    return placed(place, f"{'.'.join(location)}: {text}")


def _override_at(location: Location, override_of: Mapping[Location, str]) -> str | None:
    for key, override in reversed(list(override_of.items())):
        if key[: len(location)] == location or location[: len(key)] == key:
            return override
    return None


def place_of(
    location: Location, file: Path | None, written_at: Mapping[Location, str], override_of: Mapping[Location, str]
) -> str:
    """Where an option stands: in an override, at a line of a file, or nowhere and so in the defaults."""
    override = _override_at(location, override_of)
    if override is not None:
        return override
    if file is None:
        return "defaults"
    for length in range(len(location), 0, -1):
        if location[:length] in written_at:
            return written_at[location[:length]]
    return str(file)


def _unknown_option(section: type[Section], location: Location) -> str:
    names = list(section.model_fields)
    unknown = location[-1]
    parts = unknown.split(".")
    if tuple(parts) in option_locations(ConfigTree):
        return f"expected sections, got {unknown!r}; write {': {'.join(parts)}: ...{'}' * (len(parts) - 1)}"
    elsewhere = [".".join(name) for name in option_locations(ConfigTree) if name[-1] == unknown]
    near = difflib.get_close_matches(unknown, names, 1, 0.5)
    hint = elsewhere[0] if elsewhere else ".".join((*location[:-1], near[0])) if near else ""
    return f"expected one of {', '.join(names)}, got {unknown!r}" + (f"; did you mean {hint}?" if hint else "")


def _kinds(field: FieldInfo) -> tuple[object, ...]:
    is_union = typing.get_origin(field.annotation) in (types.UnionType, typing.Union)
    return typing.get_args(field.annotation) if is_union else (field.annotation,)


def _choices(field: FieldInfo) -> list[object]:
    kinds = _kinds(field)
    words = [word for kind in kinds if typing.get_origin(kind) is Literal for word in typing.get_args(kind)]
    return ["true", "false", *words] if words and bool in kinds else words


def _expected(field: FieldInfo) -> str:
    kinds, metadata, choices = _kinds(field), list(field.metadata), list(map(str, _choices(field)))
    optional = ", or null" if type(None) in kinds else ""
    annotation = kinds[0]
    if typing.get_origin(annotation) is Annotated:
        annotation = typing.get_args(annotation)[0]
        metadata += typing.get_args(kinds[0])[1:]
    words = next((item for item in metadata if isinstance(item, Expectation)), None)
    if choices:
        return " or ".join(filter(None, [", ".join(choices[:-1]), choices[-1]])) + optional
    limits = _limits(metadata, words.unit if words else "")
    if words:
        return words.text.replace("{range}", limits) + optional
    noun = {bool: "true or false", int: "a whole number", float: "a number"}.get(typing.cast(type, annotation), "text")
    return noun + limits + optional


def _limits(metadata: Sequence[object], unit: str) -> str:
    words = {"ge": " from", "gt": " above", "le": " to", "lt": " below"}
    found = {name: value for item in metadata for name in words if (value := getattr(item, name, None)) is not None}
    text = "".join(f"{word} {_number(found[name])}{unit}" for name, word in words.items() if name in found)
    return text.replace(" below", " and below") if len(found) > 1 else text


def _number(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def option_values(config: ConfigTree) -> dict[str, object]:
    """Every option by its dotted name, such as ``rig.cameras``, in the order of the tree, as written in files."""
    tree = config.model_dump(mode="json")
    return {
        ".".join(location): functools.reduce(operator.getitem, location, tree)
        for location in option_locations(ConfigTree)
    }


@dataclass(frozen=True)
class DescribedOption:
    """One option of the configuration, for documentation."""

    name: str
    section: str
    section_description: str
    expected: str
    default: object
    description: str


def described_options() -> Iterator[DescribedOption]:
    """Every option with what is known of it, in the order of the tree, what stands at the top first."""
    default_of = option_values(ConfigTree())
    below: dict[Location, list[DescribedOption]] = {(): []}
    for location, section, field in _options(ConfigTree):
        name = ".".join(location)
        below.setdefault(location[:-1], []).append(
            DescribedOption(
                name=name,
                section=".".join(location[:-1]),
                section_description=inspect.getdoc(section) or "",
                expected=_expected(field),
                default=default_of[name],
                description=field.description or "",
            )
        )
    return itertools.chain(*below.values())


def option_locations(section: type[Section]) -> Iterator[Location]:
    """Where the options of a section stand, in order."""
    return (location for location, _, _ in _options(section))


def _options(section: type[Section], prefix: Location = ()) -> Iterator[tuple[Location, type[Section], FieldInfo]]:
    for name, field in section.model_fields.items():
        inner = section_of(field.annotation)
        if inner:
            yield from _options(inner, (*prefix, name))
        else:
            yield (*prefix, name), section, field
