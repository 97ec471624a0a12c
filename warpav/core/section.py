"""Sections: immutable settings that are read strictly, and what messages about them need."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NoReturn

import yaml
from pydantic import BaseModel, ConfigDict, model_validator
from pydantic_core import PydanticCustomError

from warpav.core.printable import one_line
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
