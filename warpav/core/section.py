"""Sections: immutable settings that are read strictly, and what messages about them need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn

import yaml
from pydantic import BaseModel, ConfigDict
from pydantic_core import PydanticCustomError


class Section(BaseModel):
    """Base of all sections: immutable, unknown keys refused, no silent conversions."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Expectation:
    """What a field expects, in words; ``{range}`` is replaced by the field's limits, ``unit`` follows them."""

    text: str
    unit: str = ""


def mistake(text: str, *fields: str) -> NoReturn:
    """Refuse a value with a finished text; ``fields`` are the members of the section that the text speaks of."""
    raise PydanticCustomError("mistake", "{text}", {"text": text, "fields": fields})


def shown(value: object) -> str:
    """A value as messages show it, on one line of at most 60 characters."""
    if value is None:
        return "nothing (null)"
    if isinstance(value, (list, tuple, dict)):
        text = yaml.safe_dump(value, default_flow_style=True, width=10_000).strip()
    else:
        text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
